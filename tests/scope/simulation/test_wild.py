"""A wild session's pictures show what its scene says, by another camera model: OpenCV's."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scope.simulation import draw_wild, write_wild


def test_a_wild_session_has_its_camera_in_its_boards(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scene = draw_wild(rng)
    write_wild(scene, tmp_path, rng)
    marks = np.zeros((48, 3), np.float32)
    marks[:, :2] = np.mgrid[0:8, 0:6].T.reshape(-1, 2) * 20.0
    corners = []
    for path in sorted((tmp_path / "board").glob("*.jpg")):
        seen, found = cv2.findChessboardCornersSB(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), (8, 6))
        if seen:
            corners.append(found)
    assert len(corners) >= 7
    error, matrix, *_ = cv2.calibrateCamera([marks] * len(corners), corners, (640, 480), None, None)
    assert error < 0.5
    assert abs(matrix[0, 0] / scene.focal - 1.0) < 0.03
