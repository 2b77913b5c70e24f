"""The joint field against the exact camera, refitting, and repeats of a misplaced spot."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.rays import PlaneMarks, depth_frame, fit_ray_field


def test_the_field_is_exact_for_its_own_form(truth) -> None:
    """X = A + (z - z0) B with A of order 1 and B of order 3 is found to rounding, from three planes."""
    rng = np.random.default_rng(0)
    jig = truth.jig()[::2]
    slope = rng.normal(size=(10, 2))
    origin = rng.normal(size=(3, 2)) * 10

    def cross(pixels: np.ndarray, z: float) -> np.ndarray:
        x, y = ((pixels - [640, 480]) / 640).T
        cubic = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1)
        flat = np.stack([np.ones_like(x), x, y], axis=1)
        return flat @ origin + (z - 50.0) * (cubic @ (0.05 * slope) + np.stack([x, y], axis=1))

    made = [
        PlaneMarks(m.name, m.pixels, cross(m.pixels, z), m.c_from_plane, m.mark, m.covariance)
        for m, z in zip(jig, (320.0, 400.0, 480.0), strict=True)
    ]
    field = fit_ray_field(made, orders=(3, 3)).field
    pixels = jig[0].pixels
    for z in (330.0, 430.0):
        assert np.abs(field.crossing(pixels, np.full(len(pixels), z)) - cross(pixels, z)).max() < 1e-7


def test_left_out_leaves_a_spot_out_on_all_planes(truth) -> None:
    rng = np.random.default_rng(1)
    jig = truth.jig(noise=0.03, rng=rng)
    fit = fit_ray_field(jig, orders=(3, 1))
    for spot in (5, 111):
        rest = [m.select(m.mark != spot) for m in jig]
        field = fit_ray_field(rest, orders=(3, 1)).field
        for k, m in enumerate(jig):
            predicted = field.crossing(m.pixels[spot : spot + 1], np.array([float(m.name[1:])]))[0]
            scale = np.linalg.inv(fit.field.jacobian(m.pixels[spot : spot + 1], np.array([float(m.name[1:])])))[0]
            assert np.allclose(fit.left_out[k * 221 + spot], scale @ (m.points[spot] - predicted), atol=2e-4)


def test_rays_and_crossings_agree(truth) -> None:
    field = fit_ray_field(truth.jig(tilt=20.0)).field
    pixels = np.random.default_rng(3).uniform([450, 300], [850, 650], (30, 2))
    rays = field.rays(pixels)
    for depth in (330.0, 450.0):
        points = rays.at((depth - field.depth(rays.origin)) / (rays.direction @ field.c_from_d[:, 2]))
        assert np.abs((points @ field.c_from_d)[:, :2] - field.crossing(pixels, np.full(30, depth))).max() < 1e-9


def test_depth_is_z_unless_the_planes_look_elsewhere(truth) -> None:
    assert np.array_equal(depth_frame(truth.jig(tilt=30.0)), np.eye(3))
    side = depth_frame(truth.jig(tilt=85.0))
    assert np.abs(side @ side.T - np.eye(3)).max() < 1e-12
    assert np.linalg.det(side) == pytest.approx(1.0)
    assert abs(side[:, 2] @ truth.jig(tilt=85.0)[0].c_from_plane.rotation[:, 2]) > 0.9999


def test_one_plane_gives_no_rays(truth) -> None:
    with pytest.raises(CalibrationError, match="1 plane"):
        fit_ray_field(truth.jig()[:1])
