"""Laser images drawn by hand: a faint stripe on a board, and the bright one of the same sheet on a wall beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration.camera import Camera
from calibration.geometry import Array, Pose
from calibration.rays import PinholeCamera, PlaneMarks
from calibration.volume import Volume
from ranging.background import Image
from ranging.stripe import StripeOptions
from scope.calibrating.plates import common_sheet, stands_still
from scope.calibrating.reading import Look, Shot, offers_of
from scope.session import PlanePlan

SIZE = (320, 240)
PITCH, WALL = 20.0, 60.0  # mm; px, column of the light that stands still
NORMAL, OFFSET = np.array([0.9, 0.0, -0.43588989]), -196.0  # of the sheet
GRID = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), axis=-1).reshape(-1, 2) * PITCH


def camera() -> Camera:
    matrix = np.array([[350.0, 0, 160], [0, 350, 120], [0, 0, 1]])
    return PinholeCamera(matrix, np.zeros(5), Pose.identity(), SIZE, Volume.everywhere(), np.zeros((9, 9)), 0.1)


def shot(k: int, rng: np.random.Generator, *, faint: float = 40.0, wall: float = 160.0) -> tuple[Shot, Array]:
    """A board that is held somewhere, and the true column of the stripe on each row of the image."""
    depth, tilt = 420.0 + 15.0 * k, np.radians(-12.0 + 4.0 * k)
    pose = Pose.from_rotation_vector(np.array([tilt, 0.0, 0.0]), np.array([-50.0, -40.0, depth]))
    world = pose.apply(np.column_stack([GRID, np.zeros(len(GRID))]))
    pixels = world[:, :2] / world[:, 2:] * 350.0 + [160.0, 120.0]
    v, u = np.mgrid[0:240, 0:320]
    rays = np.stack([(u - 160.0) / 350.0, (v - 120.0) / 350.0, np.ones(u.shape)], axis=-1)
    board = pose.rotation[:, 2]
    reach = (board @ pose.translation) / (rays @ board)
    flat = (rays * reach[..., None] - pose.translation) @ pose.rotation[:, :2]
    on = ((flat > -PITCH) & (flat < np.array([7, 5]) * PITCH)).all(axis=-1)
    gap = (rays * reach[..., None]) @ NORMAL - OFFSET
    stripe = np.where(on, faint * np.exp(-0.5 * (gap / 1.5) ** 2), 0.0)
    stripe += np.where(on, 0.0, wall * np.exp(-0.5 * ((u - WALL) / 1.2) ** 2))
    image = np.clip(np.rint(20.0 + stripe + rng.normal(0, 2.0, u.shape)), 0, 255).astype(np.uint8)
    marks = PlaneMarks(f"v{k}", pixels, GRID, pose, np.arange(len(GRID)), np.zeros((len(GRID), 2, 2)))
    plane = PlanePlan(f"v{k}", (Path("a.png"),), None, {"laser": (Path("a.png"),)}, {}, None, None)
    images: tuple[Image, ...] = (image,)
    return Shot(plane, marks, images, None), np.abs(gap).argmin(axis=1).astype(float)


@pytest.fixture(scope="module")
def look() -> Look:
    return Look(camera(), "gray", "columns", StripeOptions(), by_hand=True)


def test_light_between_the_marks_is_found_beside_brighter_light_on_a_wall(look):
    views = []
    for k in range(6):
        one, truth = shot(k, np.random.default_rng(k))
        offers, _ = offers_of("auto", look, one)
        near = [s for s in offers if np.median(np.abs(s.pixels[:, 0] - truth[s.line])) < 1.0]
        assert len(near) >= 1
        assert len(near[0].line) > 55
        views.append(offers)
    common = common_sheet(views)
    assert common is not None
    assert len(common.chosen) == 6
    assert np.degrees(np.arccos(min(abs(common.plane.normal @ NORMAL), 1.0))) < 0.5


def test_views_that_show_the_wall_only_stand_still(look):
    views = [offers_of("auto", look, shot(k, np.random.default_rng(k), faint=0.0)[0])[0] for k in range(6)]
    views = [[s for s in offers if np.median(np.abs(s.pixels[:, 0] - WALL)) < 1.0] for offers in views]
    assert sum(map(bool, views)) >= 3
    assert stands_still(views)
    assert common_sheet(views) is None
