"""Directions and axes of stages from marks that move as they are told."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.errors import CalibrationError
from calibration.stages import fit_linear, fit_turntable

MARKS = np.random.default_rng(0).uniform([-80, -60, 380], [80, 60, 420], (40, 3))
AXIS = np.array([0.1, -0.98, 0.17]) / np.linalg.norm([0.1, -0.98, 0.17])
POINT = np.array([10.0, 0.0, 450.0])
ANGLES = np.deg2rad([0.0, 15.0, 40.0, 70.0])


def turned(angles: np.ndarray, noise: float = 0.0, rng: np.random.Generator | None = None) -> np.ndarray:
    tracks = np.stack([POINT + Rotation.from_rotvec(a * AXIS).apply(MARKS - POINT) for a in angles])
    return tracks if rng is None else tracks + rng.normal(0, noise, tracks.shape)


def test_linear_stage_and_its_scale() -> None:
    s = np.array([0.0, 10.0, 30.0, 45.0])
    stage = fit_linear(MARKS + 1.002 * s[:, None, None] * AXIS, s)
    assert np.allclose(stage.direction, AXIS, atol=1e-12)
    assert stage.scale == pytest.approx(1.002, abs=1e-12)
    assert stage.rms_mm < 1e-9


def test_direction_sigma_is_that_of_repetition() -> None:
    rng, s = np.random.default_rng(1), np.array([0.0, 20.0, 40.0])
    stages = [fit_linear(MARKS + s[:, None, None] * AXIS + rng.normal(0, 0.05, (3, 40, 3)), s) for _ in range(400)]
    across = np.cross([st.direction for st in stages], AXIS)
    assert np.sqrt((across**2).sum(axis=1).mean() / 2) == pytest.approx(
        np.mean([st.direction_sigma for st in stages]), rel=0.1
    )


def test_direction_sigma_of_a_rigid_target() -> None:
    """Its marks err together, and more along the sight than across: once understated twenty-fold."""
    rng, s = np.random.default_rng(2), np.array([0.0, 8.0, 16.0, 24.0])
    covariance = np.broadcast_to(np.diag([1e-4, 1e-4, 3e-3]) ** 2, (4, 3, 3))
    way = np.array([0.8, 0.6, 0.0])
    off = rng.normal(0, [1e-4, 1e-4, 3e-3], (400, 4, 3))
    stages = [fit_linear(MARKS + s[:, None, None] * way + e[:, None], s, covariance=covariance) for e in off]
    across = np.cross([st.direction for st in stages], way)
    assert np.sqrt((across**2).sum(axis=1).mean() / 2) == pytest.approx(
        np.mean([st.direction_sigma for st in stages]), rel=0.1
    )


@pytest.mark.parametrize("start", [0.0, 1.0])
def test_turntable(start: float) -> None:
    stage = fit_turntable(turned(ANGLES + start), ANGLES + start)
    assert np.allclose(stage.direction, AXIS, atol=1e-10)
    assert np.linalg.norm(np.cross(stage.point - POINT, AXIS)) < 1e-8
    assert stage.rms_mm < 1e-8


@pytest.mark.parametrize("positions", [4, 5, 8, 16])
def test_the_axis_of_a_turntable_is_as_sure_as_its_repetition(positions: int) -> None:
    """Poses of a rigid target err as a whole, and a half turn tells nothing of the axis by its own rotation alone."""
    rng = np.random.default_rng(3)
    angles = 2 * np.pi * np.arange(positions) / positions
    clean = turned(angles)
    stages = []
    for _ in range(200 // positions + 60):
        tilt = Rotation.from_rotvec(rng.normal(0, 2e-3, (positions, 3)))
        shift = rng.normal(0, [0.05, 0.05, 0.4], (positions, 3))
        centres = clean.mean(axis=1)
        tracks = np.stack([centres[k] + tilt[k].apply(clean[k] - centres[k]) + shift[k] for k in range(positions)])
        stages.append(fit_turntable(tracks + rng.normal(0, 0.02, tracks.shape), angles))
    across = np.cross([stage.direction for stage in stages], AXIS)
    true = np.sqrt((across**2).sum(axis=1).mean() / 2)
    stated = np.sqrt(np.mean([stage.direction_sigma**2 for stage in stages]))
    assert 0.8 < stated / true < 1.25


def test_a_stage_that_does_not_do_as_told() -> None:
    with pytest.raises(CalibrationError, match="all 3 positions are 5"):
        fit_linear(np.tile(MARKS, (3, 1, 1)), np.full(3, 5.0))
    with pytest.raises(CalibrationError, match=r"0.0000 mm a stated mm"):
        fit_linear(np.tile(MARKS, (3, 1, 1)), np.arange(3.0))
    with pytest.raises(CalibrationError, match=r"1\.00 degrees"):
        fit_turntable(turned(np.deg2rad([0.0, 1.0])), np.deg2rad([0.0, 1.0]))
    with pytest.raises(CalibrationError, match="sign"):
        fit_turntable(turned(np.deg2rad([0.0, 30.0, -30.0])), np.deg2rad([0.0, 30.0, 30.0]))
