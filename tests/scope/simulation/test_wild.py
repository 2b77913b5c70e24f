"""A wild session's pictures show what its scene says, by another camera model: OpenCV's."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import scope
from calibration.errors import FileError
from cli.main import app
from scope.simulation import draw_wild, read_any_design, write_wild

ROOT = Path(__file__).parents[3]


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


def test_the_markers_of_a_wild_turntable_go_about_its_axis(tmp_path: Path) -> None:
    """By OpenCV's detector and camera: a marker's place in the picture is where the truth puts it at that angle."""
    rng = np.random.default_rng(2)
    scene = replace(draw_wild(rng), frames=8, boards=0, lasers=0, noise=1.0, quality=95, paper=170.0)
    truth = write_wild(scene, tmp_path, rng)
    up, middle = np.array(truth["turntable"]["axis_direction"]), np.array(truth["turntable"]["axis_point"])
    across = np.cross(up, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    kinds = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    ways = cv2.aruco.DetectorParameters()
    ways.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(kinds, ways)
    off = []
    for k, path in enumerate(sorted((tmp_path / "markers").glob("*.jpg"))):
        corners, numbers, _ = detector.detectMarkers(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        for four, number in zip(corners, () if numbers is None else numbers.ravel(), strict=True):
            angle = {5: 0.0, 27: 90.0, 42: 180.0, 18: 270.0}[int(number)] + 30.0 * k
            turn = cv2.Rodrigues(np.radians(angle) * up)[0]
            place = middle + turn @ (90.0 * across)
            pixel = cv2.projectPoints(
                place[None], np.zeros(3), np.zeros(3), np.array(truth["K"]), np.array(truth["dist"])
            )[0]
            a, b, c, d = four[0]
            t = np.linalg.solve(np.column_stack([c - a, b - d]), b - a)[0]  # where the diagonals cross
            off.append(np.linalg.norm(a + t * (c - a) - pixel.ravel()))
    assert len(off) >= 36
    assert np.median(off) < 0.35


@pytest.mark.long
def test_the_first_scan_goes_as_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command of docs/first-scan.md, in its order, as a user would type it; the cloud is the truth's."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "first-scan.md").read_text(encoding="utf-8")
    lines = [line for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    told = [*lines, "scope target webcam/calibration.toml --measured 199.4,99.7"]
    assert "`scope target webcam/calibration.toml --measured 199.4,99.7`" in text
    assert len(lines) == 6
    for line in told:
        words = line.replace("examples/", f"{ROOT}/examples/").split()[1:]
        if words[0] == "view":
            words += ["--no-show", "-o", "view.html"]
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, (line, done.output)
    truth = json.loads(Path("webcam/truth/truth.json").read_text())["turntable"]
    (stage,) = scope.Rig.load("rig.json").stages
    axis, point = np.array(truth["axis_direction"]), np.array(truth["axis_point"])
    assert np.degrees(np.arccos(min(stage.direction @ axis, 1.0))) < 0.3
    cloud = scope.ScanCloud.load("cloud.ply")
    x = np.cross(axis, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(axis, [0.0, 0.0, 1.0]))
    flat = (cloud.points - point) @ np.stack([x, np.cross(axis, x), axis]).T
    (x0, y0, _), (x1, y1, height) = truth["block"]
    on = (flat[:, 0] > x0 + 4) & (flat[:, 0] < x1 - 4) & (flat[:, 1] > y0 + 4) & (flat[:, 1] < y1 - 4)
    top = flat[on & (flat[:, 2] > 0.7 * height), 2]
    table = flat[(np.hypot(flat[:, 0], flat[:, 1]) > 70) & (np.abs(flat[:, 2]) < 6), 2]
    assert len(top) > 500
    assert np.median(top) - np.median(table) == pytest.approx(height, abs=0.5)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[wild]\nlens = 3\n", "wild.lens: unknown key"),
        ("[wild]\npaper = -1.0\n", "wild.paper: found -1.0"),
        ("[wild]\n[wild.turntable]\nframes = 1\n", "wild.turntable.frames: found 1"),
        ("[wild]\n[camera]\n", "stands alone"),
        ('units = "cm"\n[wild]\n', 'units = "mm"'),
    ],
)
def test_a_wild_design_that_cannot_be_is_refused(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "d.toml").write_text(text, encoding="utf-8")
    with pytest.raises(FileError, match=told) as error:
        read_any_design(tmp_path / "d.toml")
    assert len(str(error.value)) < 320 + len(str(tmp_path))
