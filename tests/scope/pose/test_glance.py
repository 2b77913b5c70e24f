"""Pieces of a scan that do not look like the part are not searched once it is found, and the answer is the same."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import scope.pose.estimate as estimate
from benchmarks import parts
from benchmarks.several import scene
from scope.cloud import ScanCloud
from scope.model import Model
from scope.model.model import prepare_model
from scope.pose import estimate_pose, segmentation
from scope.pose.glance import glance

pytest.importorskip("open3d")


@cache
def bracket() -> Model:
    made = parts.bracket()
    return prepare_model(made.vertices, made.faces, name="bracket")


@cache
def between(seed: int) -> ScanCloud:
    cloud = scene(seed)[0]
    assert isinstance(cloud, ScanCloud)
    return cloud


@pytest.mark.parametrize("seed", [0, 1])
def test_the_part_looks_like_itself_at_a_glance(seed: int) -> None:
    """It leaves a tenth of its points unexplained at most, and each other body at least as much again as is searched harder."""
    cloud, model = between(seed), bracket()
    sides = np.sort(np.ptp(model.vertices, axis=0))
    pieces = segmentation.clusters(cloud, model.diameter, float(sides[1] * sides[2]), width=float(sides[1]))
    x = np.array([cloud.points[rows, 0].mean() for rows in pieces])
    looks = np.array([glance(cloud, rows, model) for rows in pieces])
    mine = int(np.argmin(np.abs(x)))
    assert len(pieces) >= 2
    assert looks[mine] < 0.1
    assert np.delete(looks, mine).min() > looks[mine] + estimate.LIKE


@pytest.mark.long
def test_what_is_not_searched_changes_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[bool] = []
    whole = estimate.locate

    def counted(*words: object) -> object:
        searched.append(words[5].harder)  # type: ignore[attr-defined]
        return whole(*words)  # type: ignore[arg-type]

    monkeypatch.setattr(estimate, "locate", counted)
    quick = estimate_pose(between(0), bracket())
    few = list(searched)
    monkeypatch.setattr(estimate, "UNLIKE", np.inf)
    monkeypatch.setattr(estimate, "LIKE", np.inf)
    searched.clear()
    full = estimate_pose(between(0), bracket())
    assert quick.cloud_from_model is not None
    assert full.cloud_from_model is not None
    assert np.array_equal(quick.cloud_from_model.matrix, full.cloud_from_model.matrix)
    assert few[0]
    assert not any(few[1:])
    assert len(few) <= len(searched)
