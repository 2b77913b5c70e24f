"""Laws of the notations of rigid motions: scipy's Rotation is the independent witness."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calibration.geometry import Pose
from calibration.notation import COLUMNS, NOTATIONS, Notation, numbers_of, pose_of

ANGLE = st.floats(-179.0, 179.0)


def witness(notation: Notation, turn: np.ndarray) -> np.ndarray:
    """Rotation matrix of the numbers behind x y z, by scipy."""
    match notation:
        case "quaternion-xyzw":
            return Rotation.from_quat(turn).as_matrix()
        case "quaternion-wxyz" | "abb":
            return Rotation.from_quat(turn, scalar_first=True).as_matrix()
        case "ur":
            return Rotation.from_rotvec(turn).as_matrix()
        case "kuka":
            return Rotation.from_euler("ZYX", turn, degrees=True).as_matrix()  # about moving axes z, y', x''
        case _:
            return Rotation.from_euler("xyz", turn, degrees=True).as_matrix()  # about fixed axes x, y, z


@given(st.sampled_from([n for n in NOTATIONS if n != "matrix"]), ANGLE, ANGLE, ANGLE, st.floats(-900, 900))
@settings(max_examples=80, deadline=None)
def test_every_notation_reads_and_writes_as_scipy_does(
    notation: Notation, a: float, b: float, c: float, x: float
) -> None:
    truth = Rotation.from_euler("xyz", [a, b, c], degrees=True)
    pose = Pose(truth.as_matrix(), np.array([x, 2.0, -3.0]))
    numbers = numbers_of(notation, pose, mm=1000.0)
    assert len(numbers) == len(COLUMNS[notation])
    assert np.abs(witness(notation, numbers[3:]) - pose.rotation).max() < 1e-9
    assert np.abs(numbers[:3] * 1000.0 - pose.translation).max() < 1e-9
    back = pose_of(notation, numbers, mm=1000.0)
    assert np.abs(back.matrix - pose.matrix).max() < 1e-9


@pytest.mark.parametrize("notation", ["kuka", "fanuc", "rpy-deg"])
@pytest.mark.parametrize("pitch", [90.0, -90.0])
def test_where_two_angles_are_one_the_rotation_is_still_right(notation: Notation, pitch: float) -> None:
    pose = Pose(Rotation.from_euler("xyz", [20.0, pitch, 50.0], degrees=True).as_matrix(), np.zeros(3))
    assert np.abs(pose_of(notation, numbers_of(notation, pose)).matrix - pose.matrix).max() < 1e-7


@pytest.mark.parametrize("turn", [np.pi, 1e-9, 0.0])
def test_a_half_turn_and_no_turn_have_a_rotation_vector(turn: float) -> None:
    pose = Pose(Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix(), np.zeros(3))
    assert np.abs(pose_of("ur", numbers_of("ur", pose)).matrix - pose.matrix).max() < 1e-9


def test_a_matrix_comes_flat_or_in_rows_and_scales_its_translation_only() -> None:
    rows = np.eye(4)
    rows[:3, 3] = [0.1, 0.2, 0.3]
    for given_ in (rows, rows.ravel()):
        assert np.allclose(pose_of("matrix", given_, mm=1000.0).translation, [100.0, 200.0, 300.0])
    assert numbers_of("matrix", Pose.identity()).shape == (16,)


@pytest.mark.parametrize(
    ("notation", "values", "said"),
    [("ur", [1, 2, 3], "6 finite"), ("abb", [0, 0, 0, 1, 1, 0, 0], "length 1"), ("kuka", [0, 0, 0, 0, 0, np.nan], "finite"),
     ("matrix", np.ones((4, 4)), "rotation"), ("matrix", [1.0], "4x4")],
)  # fmt: skip
def test_what_is_no_rigid_motion_is_refused(notation: Notation, values: object, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        pose_of(notation, values)  # type: ignore[arg-type]
