"""Markers stuck to a table, seen in a scan's own frames: drawn by OpenCV through a homography, moved by known motions."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.errors import FileError
from calibration.geometry import Pose
from scope.scanning import table_motion
from scope.session import read_capture
from tests.scope.hand_eye.arm import MATRIX, rig

SIDE, PLACES = 12.0, {3: (-22.0, -16.0), 7: (22.0, -16.0), 11: (-22.0, 16.0), 19: (20.0, 18.0)}
AXIS = np.array([0.1, 0.6, 0.78])
MARKERS = (
    '[motion.markers]\ndictionary = "DICT_4X4_50"\nmarker = 12.0\nplaces = ['
    + ", ".join(f"{{ id = {i}, x = {x}, y = {y} }}" for i, (x, y) in PLACES.items())
    + "]\n"
)


def drawn(pose: Pose, rng: np.random.Generator) -> np.ndarray:
    """Image of the table at a pose (C from table), with a bright stripe across it and noise."""
    cell = 10  # px a module of the drawing; a marker of DICT_4X4 has 6
    image = np.full((600, 800), 200.0)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, (x, y) in PLACES.items():
        marker = cv2.aruco.generateImageMarker(dictionary, number, 6 * cell)
        half = SIDE / 2
        corners = np.array(
            [[x - half, y - half, 0], [x + half, y - half, 0], [x + half, y + half, 0], [x - half, y + half, 0]]
        )
        seen = pose.apply(corners) @ MATRIX.T
        to = (seen[:, :2] / seen[:, 2:]).astype(np.float32)
        end = 6 * cell - 0.5
        h = cv2.getPerspectiveTransform(np.array([[-0.5, -0.5], [end, -0.5], [end, end], [-0.5, end]], np.float32), to)
        warped = cv2.warpPerspective(marker, h, (800, 600), flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.ones_like(marker), h, (800, 600), flags=cv2.INTER_NEAREST)
        image = np.where(inside > 0, 0.8 * warped + 20, image)
    image[:, 395:400] = 250.0
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


def session(folder: Path, kind: str, step: float, *, stated: float | None = None) -> Path:
    rng = np.random.default_rng(1)
    start = Pose.from_rotation_vector([0.5, 0.1, 0.2], [2.0, -3.0, 190.0])
    axis = AXIS / np.linalg.norm(AXIS)
    point = np.array([1.0, -2.0, 191.0])
    for k in range(7):
        if kind == "linear":
            pose = Pose(start.rotation, start.translation + (k - 3) * step * axis)
        else:
            turn = Pose.from_rotation_vector(np.deg2rad(k * step) * axis, np.zeros(3))
            pose = Pose(turn.rotation, point - turn.rotation @ point) @ start
        cv2.imwrite(str(folder / f"f{k}.png"), drawn(pose, rng))
    asked = "direction" if kind == "linear" else "axis"
    (folder / "capture.toml").write_text(
        f'format = 1\nimages = "f*.png"\n[motion]\nkind = "{kind}"\nmoves = "object"\n{asked} = "markers"\nstep = {stated or step}\n{MARKERS}'
    )
    return folder / "capture.toml"


def test_direction_of_a_linear_stage(tmp_path: Path) -> None:
    capture = read_capture(session(tmp_path, "linear", 2.5))
    found = table_motion(capture, rig(), capture.motion)  # type: ignore[arg-type]
    off = np.rad2deg(np.arccos(min(1.0, found.stage.direction @ AXIS / np.linalg.norm(AXIS))))
    assert off < max(4 * np.rad2deg(found.stage.direction_sigma), 0.05)
    assert off < 0.6
    assert found.stage.scale == pytest.approx(1.0, abs=0.01)
    moved = found.motion.cloud_from_c(4).translation - found.motion.cloud_from_c(2).translation  # back to position 0
    assert moved == pytest.approx(-5.0 * found.stage.direction, abs=1e-9)


def test_axis_of_a_turntable(tmp_path: Path) -> None:
    capture = read_capture(session(tmp_path, "turntable", 9.0))
    found = table_motion(capture, rig(), capture.motion)  # type: ignore[arg-type]
    axis = AXIS / np.linalg.norm(AXIS)
    assert np.rad2deg(np.arccos(min(1.0, found.stage.direction @ axis))) < max(4 * np.rad2deg(found.stage.direction_sigma), 0.1)  # fmt: skip
    arm = found.stage.point - [1.0, -2.0, 191.0]
    assert np.linalg.norm(arm - (arm @ axis) * axis) < 0.5  # mm: poses of a table of 50 mm, over an arc of 54 degrees
    assert len(found.frames) >= 6
    assert found.looked == 7


def test_markers_that_move_otherwise_are_named(tmp_path: Path) -> None:
    capture = read_capture(session(tmp_path, "linear", 2.5, stated=2.0))
    with pytest.raises(FileError, match=r"1\.2\d* mm a stated mm"):
        table_motion(capture, rig(), capture.motion)  # type: ignore[arg-type]
    for k in range(5):
        cv2.imwrite(str(tmp_path / f"f{k}.png"), np.full((600, 800), 90, np.uint8))
    with pytest.raises(FileError, match="seen in 2 of 7 frames"):
        table_motion(capture, rig(), capture.motion)  # type: ignore[arg-type]


def test_the_file_says_which_belong_together(tmp_path: Path) -> None:
    file = session(tmp_path, "linear", 2.0)
    file.write_text(file.read_text().split("[motion.markers]", maxsplit=1)[0])
    with pytest.raises(FileError, match="belong together"):
        read_capture(file)
