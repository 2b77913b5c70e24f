"""Where frames are put back to: formulas of docs/formats.md, written out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.geometry import Pose
from ranging.errors import RangingError
from ranging.motion import Fixed, Linear, Poses, Positions, Turntable

POINT = np.array([[12.0, -7.0, 300.0]])
AXIS = np.array([2.0, -1.0, 2.0]) / 3


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_linear(sign: float) -> None:
    moved = Linear(AXIS, Positions(1.0, 0.5), sign).cloud_from_c(4).apply(POINT)
    assert np.allclose(moved, POINT - sign * 3.0 * AXIS, atol=1e-13)  # s = start + 4 steps


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_turntable(sign: float) -> None:
    p = np.array([3.0, 4.0, 310.0])
    moved = Turntable(p, AXIS, Positions(0.1, 0.2), sign).cloud_from_c(3).apply(POINT)
    assert np.allclose(moved, p + Rotation.from_rotvec(-sign * 0.7 * AXIS).apply(POINT - p), atol=1e-12)
    assert np.allclose(Turntable(p, AXIS, Positions(0.0, 2 * np.pi)).cloud_from_c(1).apply(POINT), POINT, atol=1e-11)


def test_an_object_that_turns_stands_still_in_the_cloud() -> None:
    p, positions = np.array([3.0, 4.0, 310.0]), Positions(0.0, 0.3)
    for frame in range(5):
        seen = p + Rotation.from_rotvec(0.3 * frame * AXIS).apply(POINT - p)
        assert np.allclose(Turntable(p, AXIS, positions).cloud_from_c(frame).apply(seen), POINT, atol=1e-11)


def test_lists_and_their_end() -> None:
    listed = Positions(9.0, 9.0, np.array([0.0, 2.5]))
    assert np.allclose(Linear(AXIS, listed).cloud_from_c(1).translation, -2.5 * AXIS)
    with pytest.raises(RangingError, match="2 positions for frame 2"):
        listed.at(2)
    poses = Poses((Pose.identity(), Pose(np.eye(3), np.ones(3))))
    assert poses.cloud_from_c(1).translation.tolist() == [1.0, 1.0, 1.0]
    with pytest.raises(RangingError, match="2 poses and a frame 2"):
        poses.cloud_from_c(2)
    assert np.array_equal(Fixed().cloud_from_c(7).matrix, np.eye(4))
