"""Views held by hand: the camera, the views that do not belong, and each view against the camera of the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.geometry import Pose
from calibration.rays import centre_covariance, fit_freehand, locate_target, refit_without
from calibration.verification import leave_views_out

SIZE = (1280, 960)
NOISE = 0.02  # px


def views(truth, seed: int, count: int = 8, tilt: float = 30.0):
    """Views of the fixture's grid, tilted about both axes."""
    rng = np.random.default_rng(seed)
    poses = [
        Pose.from_rotation_vector(
            np.deg2rad(rng.uniform(-tilt, tilt, 3)), [rng.uniform(-20, 20), rng.uniform(-15, 15), rng.uniform(380, 480)]
        )
        for _ in range(count)
    ]
    return [truth.marks(pose, f"v{k}", noise=NOISE, rng=rng) for k, pose in enumerate(poses)]


def test_the_camera_is_found_within_its_own_covariance(truth) -> None:
    camera = fit_freehand(views(truth, 1), SIZE).camera
    off = np.array([*camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]]) - [1400.0, 1400.0, 655.0, 470.0]
    assert (np.abs(off) < 4 * np.sqrt(np.diag(camera.covariance)[:4])).all()
    assert camera.sigma == pytest.approx(NOISE, rel=0.1)


def test_a_spoiled_view_is_dropped_with_its_reason(truth) -> None:
    seen = views(truth, 2)
    pixels = seen[3].pixels + np.where(seen[3].pixels[:, :1] > 640, 1.5, 0.0)  # one half of the board bent away
    seen[3] = replace(seen[3], pixels=pixels)
    fit = fit_freehand(seen, SIZE, dropped=[("v9", "no chessboard")])
    assert [name for name, _ in fit.dropped] == ["v9", "v3"]
    assert "px where the median view has" in fit.dropped[1][1]
    assert fit.fit_px < 2 * NOISE


def test_a_view_left_out_is_missed_by_no_more_than_the_noise(truth) -> None:
    fit = fit_freehand(views(truth, 3), SIZE)
    held = leave_views_out(fit)
    assert [h.name for h in held] == [v.name for v in fit.views]
    for h in held:
        depth = 430.0
        assert h.rms_px == pytest.approx(np.sqrt(2) * NOISE, rel=0.3)
        assert h.rms_mm == pytest.approx(h.rms_px * depth / 1400.0, rel=0.25)


def test_a_view_left_out_shows_what_the_others_do_not_know(truth) -> None:
    """Its marks bent outwards where the others are not: the fit with it hides a part of that."""
    seen = views(truth, 4)
    r2 = ((seen[0].pixels - [655.0, 470.0]) ** 2).sum(axis=1, keepdims=True) / 500.0**2
    seen[0] = replace(seen[0], pixels=seen[0].pixels + 0.5 * r2 * (seen[0].pixels - [655.0, 470.0]) / 500.0)
    fit = fit_freehand(seen, SIZE, outlier=100.0)
    held = leave_views_out(fit)
    inside = np.sqrt((fit.residuals[0] ** 2).sum(axis=1).mean())
    assert held[0].rms_px > 1.02 * inside
    assert held[0].rms_px > 1.5 * held[1].rms_px


def test_refit_without_is_a_fit_of_the_others(truth) -> None:
    seen = views(truth, 5)
    fit = fit_freehand(seen, SIZE)
    assert np.allclose(
        refit_without(fit, 2).matrix, fit_freehand([*seen[:2], *seen[3:]], SIZE).camera.matrix, atol=0.01
    )


def test_parallel_or_few_views_are_refused(truth) -> None:
    flat = [truth.marks(Pose.from_rotation_vector([0, 0, 0.1 * k], [0, 0, 400.0]), f"v{k}") for k in range(5)]
    with pytest.raises(CalibrationError, match=r"focal length .* and distance cannot be told apart"):
        fit_freehand(flat, SIZE)
    with pytest.raises(CalibrationError, match=r"2 usable freehand view\(s\) of 3.*dark .v7"):
        fit_freehand(views(truth, 6)[:2], SIZE, dropped=[("v7", "dark")])
    assert leave_views_out(fit_freehand(views(truth, 7, count=3), SIZE)) == ()


def test_a_target_is_located_where_it_stands(truth) -> None:
    fit = fit_freehand(views(truth, 8), SIZE)
    pose = Pose.from_rotation_vector([0.3, -0.2, 2.0], [5.0, -8.0, 420.0])
    rng = np.random.default_rng(9)
    offsets = []
    for _ in range(40):
        placed = locate_target(fit.camera, truth.marks(pose, "new", noise=NOISE, rng=rng))
        offsets.append(placed.world.mean(axis=0))
    sigma = np.sqrt(np.diag(centre_covariance(fit.camera, placed)))
    assert np.allclose(np.std(offsets, axis=0), sigma, rtol=0.4)
    assert sigma[2] > 3 * sigma[0]  # along the sight a pose is known less well
    assert np.abs(np.mean(offsets, axis=0) - pose.translation).max() < 0.2


def test_what_is_no_view_of_the_target_has_no_place(truth) -> None:
    fit = fit_freehand(views(truth, 10), SIZE)
    seen = views(truth, 11)[0]
    mixed = replace(seen, pixels=np.random.default_rng(0).permutation(seen.pixels))
    with pytest.raises(CalibrationError, match="view v0: no pose"):
        locate_target(fit.camera, mixed)
    with pytest.raises(CalibrationError, match="view v0: 5 marks"):
        locate_target(fit.camera, seen.select(np.arange(len(seen)) < 5))
