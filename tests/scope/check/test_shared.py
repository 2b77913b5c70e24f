"""What a rig by hand leaves uncertain, against calibrations drawn with their noise: of points, and of a diameter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.by_hand import RADIUS, drawn
from scope.check import check_artefact
from scope.cloud import ScanCloud
from scope.scanning import point_covariance


def test_a_rig_by_hand_errs_as_it_says_and_a_diameter_hardly(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    found = [drawn(rng) for _ in range(8)]  # one number a session: a standard error of an rms is 0.25
    sizes = [each[4] for each in found]
    assert np.sqrt(np.mean([each[2] ** 2 for each in found])) == pytest.approx(1.0, abs=0.5)
    assert np.sqrt(np.mean([s.error**2 / (s.calibration**2 + s.scatter**2) for s in sizes])) == pytest.approx(
        1.0, abs=0.5
    )
    assert (
        np.median([each[3] for each in found]) > 1.5
    )  # taken as found apart, they would be said to err by twice as much
    assert np.median([s.uncertainty for s in sizes]) < 0.25 * np.median(
        found[0][1].sigma_cal
    )  # what all share changes no size
    rig, cloud = found[0][:2]  # between its nodes, and through a file, the cloud knows what the rig knows
    cloud.save(tmp_path / "c.ply")
    told = ScanCloud.load(tmp_path / "c.ply").shared_moves()
    assert told is not None
    exact = point_covariance(cloud, rig).calibration
    assert np.abs(np.einsum("nik,njk->nij", told[0], told[0]) - exact).max() < 0.01 * np.abs(exact).max()
    without = replace(cloud, systematic=None)
    assert without.shared_moves() is None
    assert replace(cloud, sensors=None).shared_moves() is None
    assert check_artefact(without, f"sphere:d={2 * RADIUS}").sizes[0].calibration > 0
