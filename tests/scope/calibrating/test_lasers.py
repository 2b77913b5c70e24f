"""Several lasers: told apart, fused, and how far they disagree."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.two_lasers import session
from calibration.errors import FileError
from calibration.rig import Rig
from scope.calibrating import calibrate
from scope.cloud import ScanCloud
from scope.scanning import run_scan
from scope.scanning.agreement import agreements


def surface(shift: float, rng: np.random.Generator, *, slope: float = 0.3, sigma: float = 0.01) -> ScanCloud:
    """Two lasers' points on one sloping plane, the second moved by ``shift`` mm along its normal."""
    frame, line = np.meshgrid(np.arange(40), np.arange(60), indexing="ij")
    parts = []
    for laser in (0, 1):
        x, y = (line.ravel() - 30) * 0.4 + 0.11 * laser, (frame.ravel() - 20) * 0.5 + 0.2 * laser
        normal = np.array([slope, 0.0, -1.0]) / np.hypot(slope, 1.0)
        points = np.column_stack([x, y, 400.0 + slope * x]) + laser * shift * normal
        points[:, 2] += rng.normal(0, sigma, len(points))
        parts.append(points)
    n = len(parts[0])
    return replace(
        ScanCloud.from_points(np.concatenate(parts)),
        frame=np.tile(frame.ravel(), 2).astype(np.int32),
        pixels=np.tile(np.column_stack([line.ravel(), np.full(n, 0.5)]), (2, 1)).astype(np.float32),
        laser=np.repeat([0, 1], n).astype(np.uint8),
        sigma=np.full(2 * n, sigma, np.float32),
        sigma_cal=np.zeros(2 * n, np.float32),
        laser_names=("a", "b"),
    )


@pytest.mark.parametrize("shift", [0.0, 0.05, -0.2])
def test_a_known_distance_is_found(shift: float) -> None:
    (pair,) = agreements(surface(shift, np.random.default_rng(1)))
    assert (pair.first, pair.second) == ("a", "b")
    assert pair.cells > 40
    assert pair.mean_mm == pytest.approx(shift, abs=4 * pair.sigma_mm / np.sqrt(pair.cells))
    assert 0.7 < np.sqrt(pair.rms_mm**2 - pair.mean_mm**2) / pair.sigma_mm < 1.3
    assert (pair.beyond < 0.03) if shift == 0 else (pair.beyond > 0.97)


def test_one_laser_has_none_to_agree_with() -> None:
    cloud = surface(0.1, np.random.default_rng(1))
    assert agreements(cloud.select(cloud.laser == 0)) == ()


def test_lasers_that_saw_different_places_have_no_cell() -> None:
    cloud = surface(0.0, np.random.default_rng(1))
    points = cloud.points + 1000.0 * cloud.laser[:, None]
    (pair,) = agreements(replace(cloud, points=points))
    assert pair.cells == 0
    assert np.isnan(pair.mean_mm)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lasers")


@pytest.mark.parametrize("sequence", ["cycle", "together"])
def test_two_simulated_lasers_see_one_surface(folder: Path, sequence: str) -> None:
    calibration, capture = session(folder, sequence, frames=20, scale=0.5)  # type: ignore[arg-type]
    rig = calibrate(calibration).rig
    found = run_scan(capture, rig)
    cloud = found.cloud
    assert cloud.laser_names == ("red", "green")
    per_laser = np.bincount(cloud.laser, minlength=2)
    assert per_laser.min() > 0.7 * per_laser.max()
    if sequence == "cycle":
        assert np.array_equal(cloud.frame % 2, cloud.laser)
    order = cloud.frame.astype(int) * 2 + cloud.laser
    assert (np.diff(order) >= 0).all()
    plane = np.abs(cloud.points[:, 2] - 415.0) < 3.0
    plane &= np.hypot(cloud.points[:, 0], cloud.points[:, 1]) > 40.0
    for laser in (0, 1):
        assert abs(np.median(cloud.points[plane & (cloud.laser == laser), 2]) - 415.0) < 0.05
    (pair,) = found.agreement
    assert pair.cells > 5
    assert abs(pair.mean_mm) < 0.05
    rig.save(folder / f"{sequence}.json")


def test_lasers_of_one_colour_cannot_shine_together(folder: Path) -> None:
    rig = Rig.load(folder / "cycle.json")  # calibrated in grey
    capture = folder / "together" / "capture.toml"
    with pytest.raises(FileError, match="told apart by colour"):
        run_scan(capture, rig)
