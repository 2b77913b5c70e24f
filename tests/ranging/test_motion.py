"""Where frames are put back to: formulas of docs/formats.md, written out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.geometry import Pose
from ranging.errors import RangingError
from ranging.motion import Fixed, Linear, Poses, Turntable

POINT = np.array([[12.0, -7.0, 300.0]])
AXIS = np.array([2.0, -1.0, 2.0]) / 3


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_linear(sign: float) -> None:
    moved = Linear(AXIS, 0.5, start=1.0, sign=sign).cloud_from_c(4).apply(POINT)
    assert np.allclose(moved, POINT - sign * 3.0 * AXIS, atol=1e-13)  # s = start + 4 steps


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_turntable(sign: float) -> None:
    p = np.array([3.0, 4.0, 310.0])
    moved = Turntable(p, AXIS, 0.2, start=0.1, sign=sign).cloud_from_c(3).apply(POINT)
    assert np.allclose(moved, p + Rotation.from_rotvec(-sign * 0.7 * AXIS).apply(POINT - p), atol=1e-12)
    assert np.allclose(Turntable(p, AXIS, 2 * np.pi).cloud_from_c(1).apply(POINT), POINT, atol=1e-11)


def test_an_object_that_turns_stands_still_in_the_cloud() -> None:
    p = np.array([3.0, 4.0, 310.0])
    for frame in range(5):
        seen = p + Rotation.from_rotvec(0.3 * frame * AXIS).apply(POINT - p)
        assert np.allclose(Turntable(p, AXIS, 0.3).cloud_from_c(frame).apply(seen), POINT, atol=1e-11)


def test_lists_and_their_end() -> None:
    listed = Linear(AXIS, positions=[0.0, 2.5])
    assert np.allclose(listed.cloud_from_c(1).translation, -2.5 * AXIS)
    with pytest.raises(RangingError, match="2 positions for frame 2"):
        listed.cloud_from_c(2)
    poses = Poses((Pose.identity(), Pose(np.eye(3), np.ones(3))))
    assert poses.cloud_from_c(1).translation.tolist() == [1.0, 1.0, 1.0]
    with pytest.raises(RangingError, match="2 poses and a frame 2"):
        poses.cloud_from_c(2)
    assert np.array_equal(Fixed().cloud_from_c(7).matrix, np.eye(4))


def test_lengths_of_directions_do_not_matter() -> None:
    p = np.array([3.0, 4.0, 310.0])
    assert np.allclose(Linear(5.0 * AXIS, 2.0).cloud_from_c(1).translation, -2.0 * AXIS, atol=1e-15)
    for frame in range(3):
        assert np.allclose(
            Turntable(p, 7.0 * AXIS, 0.2).cloud_from_c(frame).matrix, Turntable(p, AXIS, 0.2).cloud_from_c(frame).matrix
        )


def test_poses_come_as_matrices_too() -> None:
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec(0.3 * AXIS).as_matrix()
    turned[:3, 3] = [1.0, 2.0, 3.0]
    assert np.allclose(Poses(np.stack([np.eye(4), turned])).cloud_from_c(1).matrix, turned, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Linear(AXIS), "either step"),
        (lambda: Linear(AXIS, 1.0, positions=[0.0]), "either step"),
        (lambda: Linear(AXIS, 0.0), "step is 0 mm"),
        (lambda: Linear((0.0, 0.0, 0.0), 1.0), r"\(0, 0, 0\)"),
        (lambda: Linear((1.0, 0.0), 1.0), r"shape \(2,\)"),
        (lambda: Linear(AXIS, 1.0, sign=0.5), "sign"),
        (lambda: Linear(AXIS, positions=[[0.0]]), r"shape \(1, 1\)"),
        (lambda: Turntable((0.0, np.nan, 0.0), AXIS, 1.0), "point"),
        (lambda: Poses(np.ones((1, 4, 4))), "no rotation"),
    ],
)
def test_what_is_no_motion_is_refused(make, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        make()
