"""The whole path on the small simulated session, beside its truth."""

from __future__ import annotations

import json

import numpy as np
import pytest

from calibration.geometry import fit_plane
from calibration.rig import Rig
from scope.cloud import ScanCloud
from scope.scanning import run_scan


@pytest.fixture(scope="module")
def cloud(session) -> ScanCloud:
    return run_scan(session.capture, session.rig).cloud


def test_the_sheet_of_light_is_the_true_one(session) -> None:
    """Light from (0, -150, 8) through (0, 0, 340), turned by 3 degrees about that line."""
    plane = Rig.load(session.rig).lasers["laser"].plane
    axis = np.array([0.0, 150.0, 332.0])
    assert abs(plane.normal @ axis / np.linalg.norm(axis)) < np.deg2rad(0.02)
    assert np.abs(plane.distance(np.array([[0.0, -150.0, 8.0], [0.0, 0.0, 340.0]]))).max() < 0.05
    assert np.degrees(np.arcsin(abs(plane.normal[0]))) == pytest.approx(3.0, abs=0.02)


def test_the_calibration_passes(session) -> None:
    rig = Rig.load(session.rig)
    assert rig.verification.passed
    assert max(p["heldout_mm"] for p in rig.verification.planes) < 0.006


def test_the_rig_knows_the_blur_of_lens_and_pixel(session) -> None:
    assert Rig.load(session.rig).blur_px == pytest.approx(np.hypot(0.6, np.sqrt(1.0 / 12.0)), rel=0.05)


def test_the_plate_is_flat_and_where_it_stands(cloud: ScanCloud) -> None:
    plate = cloud.points[np.abs(cloud.points[:, 2] - 372.0) < 0.5]
    assert len(plate) > 2000
    assert plate[:, 2].mean() == pytest.approx(372.0, abs=0.03)
    plane = fit_plane(plate)
    assert np.degrees(np.arccos(abs(plane.normal[2]))) < 0.1
    assert np.sqrt((plane.distance(plate) ** 2).mean()) < 0.06


def test_the_stripe_is_as_wide_as_it_falls_on_the_plate(cloud: ScanCloud) -> None:
    """0.5 mm square to the sheet, which meets the plate's normal at atan(150 / 332): 0.55 mm down the plate."""
    assert cloud.stripe_width == pytest.approx([0.5 * np.hypot(150.0, 332.0) / 332.0], rel=0.08)
    assert 0.5 < cloud.stripe_corrected[0] <= 1.0


def test_the_sphere_has_its_radius(cloud: ScanCloud) -> None:
    distance = np.linalg.norm(cloud.points - [-35.0, 0.0, 352.0], axis=1)
    ball = distance[(np.abs(distance - 20.0) < 0.5) & (cloud.points[:, 2] < 350.0)]
    assert len(ball) > 300
    assert np.median(ball) == pytest.approx(20.0, abs=0.06)


def test_truth_is_written_beside(session) -> None:
    told = json.loads((session.folder / "truth/truth.json").read_text(encoding="utf-8"))
    assert told
