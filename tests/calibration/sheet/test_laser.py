"""Sheets of light from points: exact planes, outliers, curvature, standard errors by Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.geometry import Plane, Rays
from calibration.reason import Reason
from calibration.sheet import CurvedSheet, SheetFrame, StripePoints, fit_laser
from scope.simulation.optics import ExactLaser, Window

SHEET = Plane.through([0.0, 10.0, 400.0], [0.05, 0.9, -0.4])


def stripes(
    rng: np.random.Generator, noise: float, *, depths: tuple[float, ...] = (320, 360, 400, 440), bend: float = 0.0
) -> list[StripePoints]:
    found = []
    for z in depths:
        x = np.linspace(-80, 80, 120)
        y = (SHEET.offset - SHEET.normal[0] * x - SHEET.normal[2] * z) / SHEET.normal[1]
        points = np.column_stack([x, y, np.full(120, z)])
        points += np.outer(rng.normal(0, noise, 120) + bend * (x / 80) ** 2, SHEET.normal)
        found.append(StripePoints(f"w{z:g}", points, np.full(120, max(noise, 1e-3))))
    return found


def fit(found: list[StripePoints], **more: object):
    return fit_laser("red", found, along="rows", channel="gray", **more)  # type: ignore[arg-type]


def test_an_exact_sheet_is_found() -> None:
    laser = fit(stripes(np.random.default_rng(0), 0.0))
    assert abs(laser.plane.normal @ SHEET.normal) == pytest.approx(1.0, abs=1e-14)
    assert (
        np.abs(SHEET.distance(np.concatenate([s.points for s in stripes(np.random.default_rng(0), 0.0)]))).max() < 1e-9
    )
    assert laser.rms_mm < 1e-9
    assert laser.loo_mm < 1e-9
    assert isinstance(laser.sheet, Plane)


def test_reflections_do_not_pull() -> None:
    found = stripes(np.random.default_rng(1), 0.02)
    for s in found:
        s.points[:12] += 5.0 * SHEET.normal  # a tenth of the points, all to one side
    laser = fit(found)
    assert np.degrees(np.arccos(min(1.0, abs(laser.plane.normal @ SHEET.normal)))) < 0.02
    at = np.array([[0.0, 0.0, 400.0]])
    assert abs(abs(laser.plane.distance(at)[0]) - abs(SHEET.distance(at)[0])) < 0.02


def test_sigma_is_that_of_repetition() -> None:
    rng = np.random.default_rng(2)
    at = np.concatenate([s.points[[0, 60, 119]] for s in stripes(rng, 0.0)])
    lasers = [fit(stripes(rng, 0.05), curved=False) for _ in range(60)]
    offsets = np.array([laser.sheet.distance(at) * np.sign(laser.plane.normal @ SHEET.normal) for laser in lasers])
    told = np.mean([laser.sigma_at(at) for laser in lasers], axis=0)
    assert np.sqrt((told**2).mean()) == pytest.approx(np.sqrt((offsets**2).mean()), rel=0.15)


def test_a_bend_is_seen_where_there_is_one() -> None:
    rng = np.random.default_rng(3)
    bent, flat = fit(stripes(rng, 0.01, bend=0.2)), fit(stripes(rng, 0.01))
    assert isinstance(bent.sheet, CurvedSheet)
    assert bent.flatness_mm == pytest.approx(0.2, abs=0.02)
    assert bent.rms_mm == pytest.approx(0.01, rel=0.2)
    assert isinstance(flat.sheet, Plane)


def test_rays_end_on_a_curved_sheet() -> None:
    frame = SheetFrame(np.array([0.0, 0.0, 400.0]), np.array([[1.0, 0, 0], [0, 0, 1.0]]), 100.0)
    sheet = CurvedSheet(Plane.through([0.0, 0.0, 400.0], [0.0, 1.0, 0.0]), frame, np.array([0.5, -0.2, 0.3]))
    direction = np.column_stack([np.linspace(-0.3, 0.3, 50), np.full(50, 0.4), np.ones(50)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rays = Rays(np.tile([0.0, -150.0, 0.0], (50, 1)), direction)
    found = sheet.intersect(rays)
    assert (found.reason == Reason.RANGED).all()
    assert np.abs(sheet.distance(found.points)).max() < 1e-6
    assert rays.distance_to(found.points).max() < 1e-9
    a, b = (found.points[:, 0]) / 100, (found.points[:, 2] - 400) / 100
    assert np.allclose(found.points[:, 1], 0.5 * a * a - 0.2 * a * b + 0.3 * b * b, atol=1e-6)
    check_normals(sheet, found.points)


def check_normals(sheet: CurvedSheet, points: np.ndarray) -> None:
    step = 1e-3
    for k, axis in enumerate(np.eye(3)):
        slope = (sheet.distance(points + step * axis) - sheet.distance(points - step * axis)) / (2 * step)
        normal = sheet.normal_at(points)
        assert np.allclose(normal[:, k] / normal[:, 1], slope, atol=1e-6)


@pytest.mark.parametrize("order", [3, 4])
def test_normals_of_sheets_of_higher_order(order: int) -> None:
    frame = SheetFrame(np.array([0.0, 0.0, 400.0]), np.array([[1.0, 0, 0], [0, 0, 1.0]]), 100.0)
    rng = np.random.default_rng(order)
    plane = Plane.through([0.0, 0.0, 400.0], [0.0, 1.0, 0.0])
    sheet = CurvedSheet(plane, frame, rng.normal(0.0, 0.2, {3: 7, 4: 11}[order]))
    points = rng.uniform(-80.0, 80.0, (30, 3)) + np.array([0.0, 0.0, 400.0])
    check_normals(sheet, points)


def test_a_sheet_behind_thick_tilted_glass_takes_the_order_that_it_needs() -> None:
    """Snell's law bends the sheet by more than a quadratic surface: the truth is traced by `scope.simulation.optics`."""
    window = Window.tilted(30.0, 1.52, (np.deg2rad(18.0), np.deg2rad(8.0)), 100.0)
    light = ExactLaser.aimed(
        np.array([0.0, -150.0, 10.0]), np.array([0.0, 0.0, 400.0]), width=0.5, half_fan=np.deg2rad(25.0), window=window
    )
    rays = light.rays(np.linspace(-light.half_fan, light.half_fan, 250))
    rng = np.random.default_rng(4)
    found = []
    for z in (340, 370, 400, 430, 460):
        points = rays.at_depth(float(z))
        noisy = points + rng.normal(0.0, 0.008, (len(points), 1)) * light.sheet_normal(points)
        found.append(StripePoints(f"w{z}", noisy, np.full(len(points), 0.008)))
    laser = fit(found)
    between = np.concatenate([rays.at_depth(z) for z in (350.0, 385.0, 415.0, 445.0)])
    error = laser.sheet.distance(between)
    assert laser.rms_mm < 1.25 * 0.008
    assert np.sqrt((error**2).mean()) < 0.008
    assert 0.4 < np.sqrt((error**2).mean()) / np.sqrt((laser.sigma_at(between) ** 2).mean()) < 2.0


def test_what_the_shape_of_a_sheet_does_not_explain_counts_as_its_uncertainty() -> None:
    rng = np.random.default_rng(5)
    found = stripes(rng, 0.01)
    for s in found:
        s.points[:] += np.outer(0.03 * np.sin(np.linspace(0.0, 20.0, 120)), SHEET.normal)  # a bad lens of the laser
    laser = fit(found)
    at = np.concatenate([s.points[::10] for s in stripes(rng, 0.0)])
    assert 0.7 * 0.03 / np.sqrt(2) < np.median(laser.sigma_at(at)) < 1.5 * 0.03 / np.sqrt(2)
    even = [fit(stripes(rng, 0.01), curved=False) for _ in range(20)]
    assert np.median([np.median(laser.sigma_at(at)) for laser in even]) < 0.0015


@pytest.mark.parametrize(("depths", "text"), [((400,), "1 plane"), ((), "0 plane")])
def test_too_few_planes(depths: tuple[float, ...], text: str) -> None:
    with pytest.raises(CalibrationError, match=text):
        fit(stripes(np.random.default_rng(0), 0.01, depths=depths))


def test_stripes_on_one_line_leave_the_sheet_free() -> None:
    one = stripes(np.random.default_rng(0), 0.0, depths=(400,))[0]
    with pytest.raises(CalibrationError, match="one line"):
        fit([one, StripePoints("again", one.points.copy(), one.sigma)])


def test_views_that_are_each_turned_say_so_in_sigma() -> None:
    """Poses that were estimated are off by 0.3 mm at either end of a view, which noise of 0.05 mm a point does not tell."""
    rng = np.random.default_rng(12)
    at = np.array(
        [
            [x, (SHEET.offset - SHEET.normal[0] * x - SHEET.normal[2] * 300.0) / SHEET.normal[1], 300.0]
            for x in (-200.0, 200.0)
        ]
    )
    off, told = [], []
    for _ in range(40):
        found = stripes(rng, 0.05, depths=tuple(np.linspace(320, 440, 10)))
        for s in found:
            s.points[:] += np.outer(rng.normal(0.0, 0.3) * s.points[:, 0] / 80.0, SHEET.normal)
        laser = fit(found, curved=False)
        off.append(laser.sheet.distance(at) * np.sign(laser.plane.normal @ SHEET.normal))
        told.append(laser.sigma_at(at))
    assert 0.8 < np.sqrt(np.mean(np.square(off)) / np.mean(np.square(told))) < 1.25
