"""Triangulation: against the closed form of a pinhole and a plane, and repeated measurement."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.geometry import Plane, Pose
from calibration.rays import PinholeCamera
from calibration.reason import Reason
from calibration.sheet import StripePoints, fit_laser
from calibration.volume import Volume
from ranging.triangulation import triangulate

FOCAL, CENTRE = 1100.0, np.array([640.0, 480.0])
SHEET = Plane.through([0.0, 0.0, 400.0], [0.02, 0.9, -0.42])


def camera(volume: Volume | None = None) -> PinholeCamera:
    matrix = np.array([[FOCAL, 0.0, CENTRE[0]], [0.0, FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]])
    return PinholeCamera(
        matrix, np.zeros(5), Pose.identity(), (1280, 960), volume or Volume.everywhere(), np.zeros((9, 9)), 0.01
    )


def laser():
    stripes = []
    for z in (340.0, 400.0, 460.0):
        x = np.linspace(-80.0, 80.0, 41)
        y = (SHEET.offset - SHEET.normal[0] * x - SHEET.normal[2] * z) / SHEET.normal[1]
        stripes.append(StripePoints(f"w{z:.0f}", np.stack([x, y, np.full_like(x, z)], axis=1), np.full_like(x, 0.01)))
    return fit_laser("laser", stripes, along="rows", channel="gray", curved=False)


def pixels(n: int = 50) -> np.ndarray:
    rng = np.random.default_rng(2)
    return np.stack([rng.uniform(100, 1180, n), rng.uniform(350, 620, n)], axis=1)


def closed_form(seen: np.ndarray) -> np.ndarray:
    ray = np.concatenate([(seen - CENTRE) / FOCAL, np.ones((len(seen), 1))], axis=1)
    return ray * (SHEET.offset / (ray @ SHEET.normal))[:, None]


def test_points_are_where_rays_meet_the_sheet():
    seen = pixels()
    found = triangulate(camera(), laser(), seen, np.full(len(seen), 0.02), 1)
    assert (found.reason == Reason.RANGED).all()
    np.testing.assert_allclose(found.points, closed_form(seen), atol=1e-6)
    np.testing.assert_allclose(
        found.view, closed_form(seen) / np.linalg.norm(closed_form(seen), axis=1)[:, None], atol=1e-9
    )
    np.testing.assert_allclose(np.abs(found.sheet @ SHEET.normal), 1.0, atol=1e-9)


@pytest.mark.parametrize("across", [0, 1])
def test_sigma_is_the_scatter_of_repeated_measurements(across):
    rng = np.random.default_rng(3)
    seen, sigma = pixels(12), 0.05
    told = triangulate(camera(), laser(), seen, np.full(len(seen), sigma), across)
    repeats = []
    for _ in range(600):
        moved = seen.copy()
        moved[:, across] += sigma * rng.standard_normal(len(seen))
        repeats.append(np.linalg.norm(closed_form(moved), axis=1))
    np.testing.assert_allclose(told.sigma, np.std(repeats, axis=0), rtol=0.1)


def test_a_pixel_across_the_stripe_moves_the_point_within_the_sheet():
    seen = pixels(20)
    found = triangulate(camera(), laser(), seen, np.full(len(seen), 0.02), 1)
    along = np.einsum("ni,ni->n", found.sheet, found.moved) / np.einsum("ni,ni->n", found.sheet, found.view)
    predicted = found.moved - along[:, None] * found.view
    step = np.array([0.0, 0.01])
    measured = (closed_form(seen + step) - closed_form(seen - step)) / 0.02
    np.testing.assert_allclose(predicted, measured, rtol=1e-4, atol=1e-6)


def test_rows_without_a_pixel_or_outside_the_volume_say_so():
    seen = pixels(4)
    seen[1] = np.nan
    corners = np.array([[x, y, z] for x in (-30.0, 30.0) for y in (-30.0, 30.0) for z in (380.0, 420.0)])
    seen[2], seen[3] = CENTRE, [CENTRE[0] + 500.0, CENTRE[1]]
    found = triangulate(camera(Volume.around(corners, np.array([0.0, 0.0, 1.0]))), laser(), seen, np.full(4, 0.02), 1)
    assert found.reason[1] == Reason.NO_LIGHT
    assert found.reason[2] == Reason.RANGED
    assert found.reason[3] == Reason.OUTSIDE_CALIBRATION
    for values in (found.points, found.view, found.moved, found.sheet):
        assert np.isnan(values[[1, 3]]).all()
    assert np.isnan(found.sigma[[1, 3]]).all()
    part = found.rows(2, 4)
    np.testing.assert_array_equal(part.points, found.points[2:4])
