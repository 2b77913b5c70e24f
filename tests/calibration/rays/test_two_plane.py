"""Sighting rays of the method of planes against OpenCV's exact camera."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.camera import centre_of
from calibration.errors import CalibrationError
from calibration.geometry import Pose
from calibration.rays import TwoPlaneCamera, fit_two_plane
from calibration.rays.two_plane import with_model

SIZE = (1280, 960)
DEPTHS = np.array([335.0, 380.0, 420.0, 470.0])


def inner_pixels(n: int = 300) -> np.ndarray:
    return np.random.default_rng(2).uniform([400, 250], [900, 700], (n, 2))


def error_mm(truth, rays, pixels: np.ndarray, depth: float) -> np.ndarray:
    return np.linalg.norm(rays.at_depth(depth) - depth * truth.directions(pixels), axis=1)


@pytest.fixture(scope="module", params=[0.0, 15.0], ids=["facing", "tilted"])
def camera(request: pytest.FixtureRequest, truth) -> TwoPlaneCamera:
    """A camera that was fitted to marks without noise."""
    return fit_two_plane(truth.jig(tilt=request.param), SIZE).camera


@pytest.mark.parametrize("model", ["joint", "two-plane"])
def test_rays_meet_the_exact_camera_between_the_planes(truth, camera: TwoPlaneCamera, model: str) -> None:
    pixels = inner_pixels()
    for depth in DEPTHS:
        rays = camera.rays(pixels, near=depth) if model == "two-plane" else camera.rays(pixels)
        assert np.median(error_mm(truth, rays, pixels, depth)) < 0.001  # mm: 3.5 thousandths of a pixel
        assert np.abs(np.linalg.norm(rays.direction, axis=1) - 1).max() < 1e-12
        assert (rays.direction[:, 2] > 0).all()  # away from the camera


def test_near_takes_the_two_planes_nearest(camera: TwoPlaneCamera) -> None:
    pixels = inner_pixels(4)
    for near, (first, second) in {
        300.0: (0, 1),
        350.0: (0, 1),
        399.0: (1, 2),
        401.0: (2, 3),
        470.0: (3, 4),
        900.0: (3, 4),
    }.items():
        rays = camera.rays(pixels, near=near)
        for k in (first, second):
            assert rays.distance_to(camera.maps[k].points(pixels)).max() < 1e-9


def test_shift_is_the_difference_of_rays(camera: TwoPlaneCamera) -> None:
    pixels = inner_pixels(20)
    points = camera.rays(pixels).at_depth(390.0)
    for p in range(2):
        step = 0.05 * np.eye(2)[p]
        numeric = (camera.rays(pixels + step).at_depth(390.0) - camera.rays(pixels - step).at_depth(390.0)) / 0.1
        assert np.abs(camera.shift(pixels, points)[:, :, p] - numeric).max() < 1e-6


def test_a_turned_jig_gives_turned_rays(truth) -> None:
    turn = Pose.from_rotation_vector([0.4, 1.3, -0.2], [100.0, -50.0, 30.0])
    jig = truth.jig()
    moved = [type(m)(m.name, m.pixels, m.points, turn @ m.c_from_plane, m.mark, m.covariance) for m in jig]
    pixels = inner_pixels(50)
    plain, turned = (
        fit_two_plane(jig, SIZE, order=5).camera.rays(pixels),
        fit_two_plane(moved, SIZE, order=5).camera.rays(pixels),
    )
    assert turned.distance_to(turn.apply(plain.at_depth(400.0))).max() < 1e-3
    assert np.abs(turned.direction - plain.direction @ turn.rotation.T).max() < 1e-5


def test_nothing_is_known_of_no_pixel(camera: TwoPlaneCamera) -> None:
    for rays in (
        camera.rays(np.full((2, 2), np.nan)),
        with_model(camera, "two-plane").rays(np.full((2, 2), np.nan), near=400.0),
    ):
        assert np.isnan(rays.direction).all()
    assert len(camera.rays(np.zeros((0, 2)))) == 0
    assert len(camera.rays(np.zeros((0, 2)), near=400.0)) == 0


def test_the_centre_of_a_pinhole_is_found(camera: TwoPlaneCamera) -> None:
    assert np.linalg.norm(centre_of(camera.rays(inner_pixels()))) < 0.1


@pytest.mark.parametrize(
    ("keep", "text"),
    [([0], "one plane"), ([], "one plane"), ([1, 1], "w360 and w360.*360"), ([0, 2, 2], "w400 and w400")],
)
def test_planes_that_do_not_suffice(truth, keep: list[int], text: str) -> None:
    jig = truth.jig()
    with pytest.raises(CalibrationError, match=text):
        fit_two_plane([jig[k] for k in keep], SIZE)
