"""Laws of the robot's end: what a file says is taken as said, and what it does not say is never guessed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.errors import FileError
from calibration.geometry import Pose
from calibration.notation import COLUMNS, NOTATIONS
from scope.pose import notations_text, pose_json, read_robot_from_camera, read_transform

TURN = Rotation.from_euler("xyz", [10.0, 20.0, 30.0], degrees=True)
MATRIX = np.eye(4)
MATRIX[:3, :3], MATRIX[:3, 3] = TURN.as_matrix(), [100.0, 200.0, 300.0]
STATED = {
    "quaternion-xyzw": TURN.as_quat(),
    "quaternion-wxyz": TURN.as_quat(scalar_first=True),
    "abb": TURN.as_quat(scalar_first=True),
    "ur": TURN.as_rotvec(),
    "kuka": [30.0, 20.0, 10.0],
    "fanuc": [10.0, 20.0, 30.0],
    "rpy-deg": [10.0, 20.0, 30.0],
}


@pytest.mark.parametrize("convention", [n for n in NOTATIONS if n != "matrix"])
def test_every_convention_gives_the_same_pose(tmp_path: Path, convention: str) -> None:
    numbers = [0.1, 0.2, 0.3, *map(float, STATED[convention])]
    content = {"robot_from_camera": numbers, "units": "m", "convention": convention}
    (tmp_path / "r.json").write_text(json.dumps(content))
    found = read_robot_from_camera(tmp_path / "r.json")
    assert np.abs(found.robot_from_camera.matrix - MATRIX).max() < 1e-9
    assert not found.warning


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"robot_from_camera": MATRIX.tolist()}, "units"),
        ({"robot_from_camera": MATRIX.tolist(), "units": "mm", "unit": "m"}, "'unit' is an unknown key"),
        ({"robot_from_camera": MATRIX.tolist(), "units": "feet"}, "feet"),
        ({"robot_from_camera": [1.0] * 7, "units": "mm"}, "convention"),
        ({"robot_from_camera": [1.0, 2, 3, 0, 0, 0, 1], "units": "mm", "convention": "quaternion"}, "quaternion-xyzw"),
        ({"robot_from_camera": [1.0, 2, 3], "units": "mm", "convention": "ur"}, "rx ry rz"),
        ({"robot_from_camera": "x", "units": "mm", "convention": "ur"}, "numbers"),
        ({"matrix": MATRIX.tolist(), "units": "mm"}, "no key robot_from_camera"),
        (MATRIX.tolist(), "no key robot_from_camera"),
        ({"cloud_from_model": MATRIX.tolist(), "found": True}, "answer of scope pose"),
    ],
)
def test_what_is_not_stated_is_refused_in_a_line(tmp_path: Path, content: object, said: str) -> None:
    (tmp_path / "r.json").write_text(json.dumps(content))
    with pytest.raises(FileError, match=said) as caught:
        read_robot_from_camera(tmp_path / "r.json")
    assert len(str(caught.value).replace(str(tmp_path), "")) < 300


def test_metres_taken_for_millimetres_are_warned_of(tmp_path: Path) -> None:
    small = MATRIX.copy()
    small[:3, 3] /= 1000.0
    (tmp_path / "r.json").write_text(json.dumps({"robot_from_camera": small.tolist(), "units": "mm"}))
    assert "metres" in read_robot_from_camera(tmp_path / "r.json").warning
    (tmp_path / "t.json").write_text(json.dumps({"matrix": small.tolist(), "units": "m"}))
    assert np.abs(read_transform(tmp_path / "t.json").matrix - MATRIX).max() < 1e-9


def test_the_answer_comes_in_each_notation_by_name() -> None:
    told = pose_json(Pose(MATRIX[:3, :3], MATRIX[:3, 3]))
    assert {"matrix", "translation_mm", "quaternion_wxyz", "rpy_deg"} <= set(told)
    text = "\n".join(notations_text(Pose(MATRIX[:3, :3], MATRIX[:3, 3])))
    for name, turn in STATED.items():
        assert told[name] == pytest.approx([100.0, 200.0, 300.0, *map(float, turn)])
        assert f"{name}: {COLUMNS[name][0]} 100.000" in text
