"""Bad marks of one plane: found among clean ones, beside each other, and never a lens that is hard to follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.sessions import SIZE, session
from calibration.geometry import Array, Pose
from calibration.rays import PlaneMarks, find_bad_marks, fit_ray_field
from calibration.verification import find_faults


def spoilt(marks: PlaneMarks, rows: Array, px: float, rng: np.random.Generator) -> PlaneMarks:
    angle = rng.uniform(0, 2 * np.pi, len(rows))
    pixels = marks.pixels.copy()
    pixels[rows] += px * np.column_stack([np.cos(angle), np.sin(angle)])
    return replace(marks, pixels=pixels)


def equidistant(rng: np.random.Generator, noise: float = 0.02) -> list[PlaneMarks]:
    """Five planes before an equidistant lens of 110 degrees: the radius in the image is the angle (closed form)."""
    half = np.deg2rad(55.0)
    pitch = 2 * 200.0 * np.tan(half) / 24
    flat = np.stack(np.meshgrid(np.arange(25) * pitch, np.arange(19) * pitch), axis=-1).reshape(-1, 2)
    middle = flat.mean(axis=0)
    planes = []
    for z in (100.0, 125.0, 150.0, 175.0, 200.0):
        slope = (flat - middle) / z
        length = np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
        pixels = 640 / half * slope * np.arctan(length) / length + [655.0, 470.0]
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
        inside = ((pixels > 5) & (pixels < np.array(SIZE) - 6)).all(axis=1)
        pose = Pose(np.eye(3), np.array([-middle[0], -middle[1], z]))
        unknown = np.full((int(inside.sum()), 2, 2), np.nan)
        planes.append(PlaneMarks(f"w{z:.0f}", pixels[inside], flat[inside], pose, np.flatnonzero(inside), unknown))
    return planes


@pytest.mark.parametrize(("share", "px"), [(0.01, 5.0), (0.05, 5.0), (0.05, 0.2), (0.2, 50.0)])
def test_just_the_bad_ones_are_found_and_measured(share: float, px: float) -> None:
    rng = np.random.default_rng(1)
    for marks in session(rng, noise_px=0.02, oblique=0.3):
        rows = rng.choice(len(marks), round(share * len(marks)), replace=False)
        found = find_bad_marks(spoilt(marks, rows, px, rng))
        assert set(np.flatnonzero(found.rows)) == set(rows)
        # 3 %: the map is taken as straight over the distance
        assert np.abs(found.size[rows] - px).max() < 5 * found.sigma[rows].max() + 0.03 * px
        assert 0.01 < np.median(found.sigma[rows]) < 0.03


def test_clean_planes_have_none() -> None:
    """Of few marks and of many, with errors of the target, seen obliquely: a false one in less than a plane of a thousand."""
    rng = np.random.default_rng(2)
    alarms = 0
    for _ in range(40):
        rows, columns = int(rng.integers(3, 10)), int(rng.integers(4, 12))
        planes = session(
            rng, rows=rows, columns=columns, pitch=200 / columns, target_mm=float(rng.choice([0.0, 0.1])),
            oblique=rng.uniform(0, 0.7), noise_px=float(rng.choice([0.01, 0.3])),
        )  # fmt: skip
        alarms += sum(int(find_bad_marks(m).rows.sum()) for m in planes)
    assert alarms <= 1


def test_one_of_twenty_marks_shows_on_all_planes_together() -> None:
    rng = np.random.default_rng(3)
    planes = session(rng, rows=4, columns=5, pitch=50.0, noise_px=0.02)
    planes[2] = spoilt(planes[2], np.array([5]), 5.0, rng)
    (fault,) = find_faults(planes)
    assert (fault.plane, fault.kind, fault.mark) == (planes[2].name, "mark", int(planes[2].mark[5]))


def test_a_faint_mark_may_stand_off_by_its_own_error() -> None:
    rng = np.random.default_rng(4)
    marks = session(rng, noise_px=0.02)[0]
    covariance = np.tile(np.eye(2) * 0.02**2, (len(marks), 1, 1))
    off = spoilt(marks, np.array([100]), 0.6, rng)
    covariance[100] = np.eye(2) * 0.4**2
    assert not find_bad_marks(replace(off, covariance=covariance)).rows.any()
    covariance[100] = np.eye(2) * 0.02**2
    assert np.flatnonzero(find_bad_marks(replace(off, covariance=covariance)).rows).tolist() == [100]


def test_a_very_wide_lens_is_not_blamed_on_marks() -> None:
    """At 110 degrees no order that the marks of one plane allow follows the corners; the field of all planes gets there."""
    planes = equidistant(np.random.default_rng(5))
    assert not any(find_bad_marks(m).rows.any() for m in planes)
    assert find_faults(planes) == ()
    fit = fit_ray_field(planes)
    assert fit.field.slope_order > 9
    assert fit.loo_px < 1.2 * 0.02 * np.sqrt(2)


def test_bad_marks_before_a_very_wide_lens() -> None:
    rng = np.random.default_rng(6)
    for marks in equidistant(rng):
        rows = rng.choice(len(marks), round(0.03 * len(marks)), replace=False)
        found = find_bad_marks(spoilt(marks, rows, 5.0, rng))
        assert set(np.flatnonzero(found.rows)) == set(rows)


def test_too_few_and_degenerate_marks_are_left_alone() -> None:
    marks = session(np.random.default_rng(7))[0]
    assert not find_bad_marks(marks.select(np.arange(len(marks)) < 7)).rows.any()
    line = marks.select(marks.points[:, 1] == marks.points[0, 1])
    assert not find_bad_marks(line).rows.any()
