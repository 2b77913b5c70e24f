"""Planes that a calibrated camera sees again: truth by the sessions' own projection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.sessions import FIVE, SIZE, misplacement, session
from calibration.geometry import Pose
from calibration.rays import fit_two_plane
from calibration.verification import Lattice, faults_against

CENTRE = np.array([144.0, 108.0])
LATTICE = Lattice(10, 13, (24.0, 24.0))


def seen(seed: int, **options):
    return session(np.random.default_rng(seed), stand_offs=FIVE, rows=10, columns=13, pitch=24.0, **options)


@pytest.fixture(scope="module")
def field():
    return fit_two_plane(seen(1), SIZE).joint.field


def test_planes_that_stand_where_they_should_have_no_fault(field) -> None:
    assert faults_against(field, seen(2)) == ()
    assert faults_against(field, seen(3)[2:3]) == ()


@pytest.mark.parametrize(
    ("kind", "size", "value"),
    [
        ("slip", 0.2, 0.2),
        ("rotation", 2e-3, np.degrees(2e-3)),
        ("stand_off", 1.0, 1.0),
        ("tilt", 0.02, np.degrees(0.02)),
        ("stand_off", -40.0, -40.0),
    ],
)
def test_even_one_plane_alone_is_told(field, kind: str, size: float, value: float) -> None:
    """Against known rays one plane is enough, where a calibration needs four."""
    plane = seen(4, true_pose={2: misplacement(kind, size, 0.7, CENTRE)})[2]
    (fault,) = faults_against(field, [plane], lattice=LATTICE)
    assert (fault.plane, fault.kind) == ("w400", kind)
    assert fault.value == pytest.approx(value, abs=5 * fault.standard_error + 2e-3 * abs(value))


def test_a_camera_that_moved_is_one_fault(field) -> None:
    moved = Pose.from_rotation_vector([0.0, 0.003, 0.001], [0.4, -0.2, 0.1])
    planes = [replace(p, c_from_plane=moved.inverse @ p.c_from_plane) for p in seen(5)]
    (fault,) = faults_against(field, planes)
    assert (fault.plane, fault.kind, fault.unit) == ("all", "moved", "mm")
    assert "calibrate again" in fault.remedy
    middle = np.concatenate([p.world for p in planes]).mean(axis=0)
    assert fault.value == pytest.approx(np.linalg.norm(moved.apply(middle[None])[0] - middle), rel=0.02)
