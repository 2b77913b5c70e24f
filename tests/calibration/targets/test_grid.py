"""Labels against simulated views whose truth is known; the camera is that of the benchmark and shares no code."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.labelling import SIZE, judge, view
from calibration.errors import CalibrationError
from calibration.targets import SpotGrid, label_grid
from calibration.targets.spots import Spots

FIDUCIALS = ((4, 5), (4, 7), (1, 5))


def spots_at(pixels, diameter):
    n = len(pixels)
    return Spots(
        np.asarray(pixels, dtype=float),
        np.tile(np.eye(2) * 1e-4, (n, 1, 1)),
        np.asarray(diameter, dtype=float),
        np.full(n, 100.0),
        np.ones(n),
        np.zeros(n),
    )


def flat(target, matrix=((50.0, 0.0), (0.0, 50.0)), origin=(60.0, 70.0)):
    """A view without perspective: pixel = origin + matrix (column, row)."""
    index = np.arange(target.rows * target.columns)
    cell = np.stack([index % target.columns, index // target.columns], axis=1)
    size = np.full(len(index), 16.0)
    for row, column in target.fiducials:
        size[row * target.columns + column] = 24.0
    return spots_at(cell @ np.array(matrix).T + origin, size)


@pytest.mark.parametrize(
    ("options", "sets", "least"),
    [({}, 70, 0.95), ({"fiducials": False}, 25, 0.9), ({"lose_fiducials": True}, 25, 0.5)],
)
def test_never_a_wrong_label(options, sets, least):
    """A refusal costs a picture; a wrong label costs the calibration."""
    rng = np.random.default_rng(21)
    count = Counter(judge(view(rng, **options)) for _ in range(sets))
    assert count["wrong"] == 0
    assert count["labelled"] >= least * sets


def test_every_turn_and_reflection_of_a_target_with_fiducials():
    target = SpotGrid(8, 11, (12.0, 12.0), 4.0, "light", FIDUCIALS, 6.0)
    for quarter in range(4):
        for mirrored in (False, True):
            c, s = np.round([np.cos(quarter * np.pi / 2), np.sin(quarter * np.pi / 2)])
            matrix = 40.0 * np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if mirrored else 1.0, 1.0])
            labels = label_grid(flat(target, matrix, (600.0, 500.0)), target, image_size=SIZE)
            assert labels.mark.tolist() == list(range(88))
            assert labels.mirrored == mirrored
            assert labels.fiducials == 3
            assert labels.contradictions == 0


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_turned_says_where_the_first_mark_is(degrees):
    target = SpotGrid(8, 11, (12.0, 12.0), 4.0)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    spots = flat(target, 40.0 * np.array([[c, -s], [s, c]]), (640.0, 480.0))
    assert label_grid(spots, target, image_size=SIZE, turned=degrees).mark.tolist() == list(range(88))
    if degrees == 180:
        # by default the corner nearest to the top left is (0, 0): the same grid counted from its other end
        assert label_grid(spots, target, image_size=SIZE).mark.tolist() == list(range(88))[::-1]


@pytest.mark.parametrize("fiducials", [(), FIDUCIALS])
def test_swapped_rows_and_columns_are_named(fiducials):
    target = SpotGrid(8, 11, (12.0, 12.0), 4.0, "light", fiducials, 6.0)
    wrong = replace(target, rows=11, columns=8)
    with pytest.raises(CalibrationError, match="swapped"):
        label_grid(flat(target), wrong, image_size=SIZE)


def test_a_grid_partly_out_of_view_needs_fiducials():
    target = SpotGrid(8, 11, (12.0, 12.0), 4.0)
    spots = flat(target)
    part = spots.select(spots.centroids[:, 0] > 100)
    with pytest.raises(CalibrationError, match="no fiducials"):
        label_grid(part, target, image_size=SIZE)
    marked = SpotGrid(8, 11, (12.0, 12.0), 4.0, "light", FIDUCIALS, 6.0)
    spots = flat(marked)
    keep = spots.centroids[:, 0] > 100
    labels = label_grid(spots.select(keep), marked, image_size=SIZE)
    assert labels.mark.tolist() == np.flatnonzero(keep).tolist()


def test_two_corners_as_near_to_the_top_left_are_refused():
    target = SpotGrid(9, 9, (12.0, 12.0), 4.0)
    c = np.sqrt(0.5)
    spots = flat(target, 40.0 * np.array([[c, -c], [c, c]]), (480.0, 100.0))
    shifted = spots_at(spots.centroids - spots.centroids.mean(axis=0) + 480.0, spots.diameter)
    with pytest.raises(CalibrationError, match="turned"):
        label_grid(shifted, target, image_size=SIZE)


def test_a_view_without_its_fiducials_is_refused():
    target = SpotGrid(8, 11, (12.0, 12.0), 4.0, "light", FIDUCIALS, 6.0)
    spots = flat(target)
    plain = spots.select(spots.diameter < 20)
    with pytest.raises(CalibrationError, match="fiducials"):
        label_grid(plain, target, image_size=SIZE)


def test_dirt_is_not_labelled():
    target = SpotGrid(8, 11, (12.0, 12.0), 4.0, "light", FIDUCIALS, 6.0)
    clean = flat(target)
    dirt = clean.centroids[[12, 40, 77]] + [[23.0, 21.0], [25.0, 4.0], [-12.0, 25.0]]
    spots = spots_at(np.concatenate([clean.centroids, dirt]), np.concatenate([clean.diameter, [15.0, 24.0, 9.0]]))
    labels = label_grid(spots, target, image_size=SIZE)
    assert labels.mark[:88].tolist() == list(range(88))
    assert (labels.mark[88:] == -1).all()


def test_the_order_of_spots_does_not_matter():
    target = SpotGrid(8, 11, (12.0, 12.0), 4.0, "light", FIDUCIALS, 6.0)
    order = np.random.default_rng(3).permutation(88)
    labels = label_grid(flat(target).select(order), target, image_size=SIZE)
    assert labels.mark.tolist() == order.tolist()


@pytest.mark.parametrize("number", [0, 3, 5])
def test_too_few_spots_are_refused_with_numbers(number):
    target = SpotGrid(8, 11, (12.0, 12.0), 4.0)
    with pytest.raises(CalibrationError, match=f"found {number} spots"):
        label_grid(flat(target).select(np.arange(number)), target, image_size=SIZE)


def test_scattered_spots_are_no_grid():
    rng = np.random.default_rng(4)
    spots = spots_at(rng.uniform((0, 0), SIZE, (200, 2)), rng.uniform(10, 20, 200))
    with pytest.raises(CalibrationError):
        label_grid(spots, SpotGrid(8, 11, (12.0, 12.0), 4.0, "light", FIDUCIALS, 6.0), image_size=SIZE)
