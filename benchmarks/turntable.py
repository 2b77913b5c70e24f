"""A webcam, a line laser, a board and a turntable that nobody prepared, beside a plain script: python -m benchmarks.turntable [PICTURE]."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks.shared import head, require, row
from calibration.geometry import Array, fit_plane
from calibration.stages import Stage
from scope.calibrating import Calibration, calibrate
from scope.report import cloud_from
from scope.scanning import ScanOptions, run_scan

ROWS, COLUMNS, PITCH = 6, 8, 40.0
NEARER = 120.0  # mm before the nearest board, where the front of the table stands
CALIBRATION = """format = 1
units = "mm"

[target]
kind = "chessboard"
rows = 6
columns = 8
pitch = 40.0

[[views]]
images = "{0}/board/*.jpg"

[[views]]
images = "{0}/laser/*.jpg"
laser = "same"

[[stage]]
kind = "turntable"
images = "{0}/markers/*.jpg"
positions = [{1}]

[stage.target]
kind = "markers"
dictionary = "DICT_4X4_50"
marker = 30.0
places = [
  {{ id = 5, x = 90.0, y = 0.0 }},
  {{ id = 27, x = 0.0, y = 90.0 }},
  {{ id = 42, x = -90.0, y = 0.0 }},
  {{ id = 18, x = 0.0, y = -90.0 }},
]
"""
CAPTURE = """format = 1
units = "mm"
images = "{0}/turn/*.jpg"

[motion]
kind = "turntable"
moves = "object"
axis = "rig"
step = 4.5
"""


def plain(folder: Path) -> tuple[int, int, list[float], float, float]:
    """The script of an afternoon: boards, stripes, a view left out (mm each), rms of all (mm), px of the camera."""
    marks = np.zeros((ROWS * COLUMNS, 3), np.float32)
    marks[:, :2] = np.mgrid[0:COLUMNS, 0:ROWS].T.reshape(-1, 2) * PITCH
    found, lit = [], []
    for path in [*sorted((folder / "board").glob("*.jpg")), *sorted((folder / "laser").glob("*.jpg"))]:
        image = cv2.imread(str(path))
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        seen, corners = cv2.findChessboardCorners(grey, (COLUMNS, ROWS))
        if seen:
            until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
            found.append(cv2.cornerSubPix(grey, corners, (5, 5), (-1, -1), until))
            lit.append(image if path.parent.name == "laser" else None)
    error, matrix, distortion, turns, shifts = cv2.calibrateCamera([marks] * len(found), found, (640, 480), None, None)
    stripes = []
    for image, r, t in zip(lit, turns, shifts, strict=True):
        if image is not None:
            stripes.append(_stripe(image.astype(np.float64), matrix, distortion, cv2.Rodrigues(r)[0], t.ravel()))
    usable = [points for points in stripes if len(points) >= 20]
    left_out = [_rms(_plane([p for j, p in enumerate(usable) if j != k]), points) for k, points in enumerate(usable)]
    return len(stripes), len(usable), left_out, _rms(_plane(usable), np.concatenate(usable)), error


def _stripe(image: Array, matrix: Array, distortion: Array, turn: Array, shift: Array) -> Array:
    """Centre of mass of green's excess, a row; those within 260 mm of the board's middle, on its plane, by a robust line."""
    excess = np.maximum(image[:, :, 1] - 0.5 * (image[:, :, 0] + image[:, :, 2]), 0.0)
    points = []
    for v, line in enumerate(excess):
        u = int(line.argmax())
        part = np.arange(max(u - 4, 0), min(u + 5, 640))
        if line[u] < 15:
            continue
        centre = (line[part] * part).sum() / line[part].sum()
        x, y = cv2.undistortPoints(np.array([[[centre, float(v)]]]), matrix, distortion)[0, 0]
        ray = np.array([x, y, 1.0])
        points.append(ray * (turn[:, 2] @ shift) / (turn[:, 2] @ ray))
    if len(points) < 20:
        return np.zeros((0, 3))
    flat = (np.array(points) - shift) @ turn
    near = np.linalg.norm(flat[:, :2] - [0.5 * (COLUMNS - 1) * PITCH, 0.5 * (ROWS - 1) * PITCH], axis=1) < 260.0
    flat, kept = flat[near], np.array(points)[near]
    if len(flat) < 20:
        return np.zeros((0, 3))
    rng, best = np.random.default_rng(1), np.zeros(len(flat), bool)
    for _ in range(200):
        a, b = flat[rng.choice(len(flat), 2, replace=False), :2]
        across = np.array([b[1] - a[1], a[0] - b[0]]) / max(float(np.linalg.norm(b - a)), 1e-9)
        on = np.abs((flat[:, :2] - a) @ across) < 2.0
        best = on if on.sum() > best.sum() else best
    return np.asarray(kept[best])


def _plane(stripes: list[Array]) -> tuple[Array, float]:
    points = np.concatenate(stripes)
    weights = np.ones(len(points))
    for _ in range(20):
        plane = fit_plane(points, weights=weights)
        off = plane.distance(points)
        weights = np.maximum(1 - (off / (4.685 * 1.4826 * np.median(np.abs(off)))) ** 2, 0.0) ** 2 + 1e-12
    return plane.normal, plane.offset


def _rms(plane: tuple[Array, float], points: Array) -> float:
    off = points @ plane[0] - plane[1]
    kept = np.abs(off - np.median(off)) < 6 * 1.4826 * np.median(np.abs(off - np.median(off)))
    return float(np.sqrt((off[kept] ** 2).mean()))


def on_table(points: Array, stage: Stage) -> Array:
    """Points with z up the axis from where it was put, x and y about it."""
    up = stage.direction * -np.sign(stage.direction @ stage.point)  # the camera looks down
    x = np.cross(up, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.asarray((points - stage.point) @ np.stack([x, np.cross(up, x), up]).T)


def table_top(points: Array) -> tuple[float, float, float]:
    """Rms of the table about its plane, mm; tilt of that against the axis, degrees; its height, mm."""
    radius = np.hypot(points[:, 0], points[:, 1])
    ring = points[(radius > 75.0) & (radius < 95.0) & (np.abs(points[:, 2]) < 8.0)]
    plane = fit_plane(ring)
    off = plane.distance(ring)
    kept = np.abs(off) < 4 * 1.4826 * np.median(np.abs(off))
    tilt = np.degrees(np.arccos(min(abs(float(plane.normal[2])), 1.0)))
    return float(off[kept].std()), float(tilt), float(np.median(ring[:, 2]))


def block(points: Array) -> tuple[float, Array, Array, Array]:
    """Height of the block, mm; distances of its two pairs of faces, mm; angles between the faces of a pair, degrees; rms, mm."""
    from scipy.optimize import least_squares

    side = points[(points[:, 2] > 12.0) & (points[:, 2] < 35.0) & (np.hypot(points[:, 0], points[:, 1]) < 70.0)]

    def edges(p: Array) -> Array:
        c, s = np.cos(p[0]), np.sin(p[0])
        flat = (side[:, :2] - p[1:3]) @ np.array([[c, -s], [s, c]])
        return np.abs(flat) - np.abs(p[3:5]) / 2

    fits = [
        least_squares(
            lambda p: np.abs(edges(p)).min(axis=1),
            [angle, *np.median(side[:, :2], axis=0), *size],
            loss="soft_l1",
            f_scale=1.0,
        )
        for angle in np.radians([0, 22, 45, 67])
        for size in ((60.0, 40.0), (40.0, 60.0))
    ]
    best = min(fits, key=lambda fit: fit.cost)
    c, s = np.cos(best.x[0]), np.sin(best.x[0])
    flat = (side[:, :2] - best.x[1:3]) @ np.array([[c, -s], [s, c]])
    nearest = np.abs(edges(best.x)).argmin(axis=1)
    distances, angles, scatter = [], [], []
    for axis in (0, 1):
        lines = []
        for sign in (-1, 1):
            half = abs(best.x[3 + axis]) / 2
            own = flat[
                (nearest == axis) & (np.sign(flat[:, axis]) == sign) & (np.abs(np.abs(flat[:, axis]) - half) < 3.0)
            ]
            own = own[np.abs(own[:, 1 - axis]) < 0.35 * abs(best.x[4 - axis])]
            line = np.polyfit(own[:, 1 - axis], own[:, axis], 1)
            scatter.append(float(np.std(own[:, axis] - np.polyval(line, own[:, 1 - axis]))))
            lines.append(line)
        distances.append(float(lines[1][1] - lines[0][1]))
        angles.append(float(np.degrees(np.arctan(lines[1][0]) - np.arctan(lines[0][0]))))
    inside = (points[:, :2] - best.x[1:3]) @ np.array([[c, -s], [s, c]])
    on_top = (np.abs(inside) < np.abs(best.x[3:5]) / 2 - 6.0).all(axis=1) & (points[:, 2] > 35.0)
    heights = np.histogram(points[on_top, 2], bins=np.arange(35.0, 90.0, 0.5))
    top = heights[1][heights[0].argmax()] + 0.25
    return float(top), np.array(distances), np.array(angles), np.array(scatter)


def main() -> None:
    """Print the tables; with an argument, write a picture of the cloud there."""
    folder = require("desktop-turntable")
    boards, usable, left_out, rms, camera = plain(folder)
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / "calibration.toml").write_text(
            CALIBRATION.format(folder, ", ".join(str(22.5 * k) for k in range(16))), encoding="utf-8"
        )
        (Path(place) / "capture.toml").write_text(CAPTURE.format(folder), encoding="utf-8")
        found = calibrate(Path(place) / "calibration.toml")
        usual = run_scan(Path(place) / "capture.toml", found.rig)
        cloud = run_scan(Path(place) / "capture.toml", found.rig, options=ScanOptions(extrapolate=NEARER)).cloud
    laser = found.rig.lasers["laser"]
    head("figure", "plain script", "SCOPE")
    row("boards in the 31 laser images", boards, sum(p["name"].startswith("laser/") for p in found.planes))
    row("with a stripe", usable, len(laser.planes))
    row("points", "", laser.n)
    row("a view left out, median of the rms, mm", float(np.median(left_out)), laser.loo_mm)
    row("worst, mm", max(left_out), max(p.loo_mm for p in laser.planes))
    row("rms of all, mm", rms, laser.rms_mm)
    row("camera, px", camera, found.result["fit_px"])
    row("channel; passed", "green-excess", f"{laser.channel}; {found.result['passed']}")
    _scan(found, usual.cloud.points, on_table(cloud.points, found.rig.stages[0]))
    if len(sys.argv) > 1:
        picture(on_table(cloud.points, found.rig.stages[0]), Path(sys.argv[1]))


def _scan(found: Calibration, usual: Array, points: Array) -> None:
    (stage,) = found.rig.stages
    rms, tilt, height = table_top(points)
    top, distances, angles, scatter = block(points)
    head("scan of 80 frames", "SCOPE")
    row(
        "axis, standard error, degrees; scale of its markers",
        f"{np.degrees(stage.direction_sigma):.3f}; {stage.scale:.4f}",
    )
    row("points; within the calibrated depths only", f"{len(points)}; {len(usual)}")
    row("table top: flat, rms mm; tilt against the axis, degrees; height, mm", f"{rms:.3f}; {tilt:.2f}; {height:+.2f}")
    row("block: height, mm", f"{top - height:.1f}")
    row("block: opposite faces apart, mm", ", ".join(f"{d:.2f}" for d in distances))
    row("block: opposite faces out of parallel, degrees", ", ".join(f"{a:+.2f}" for a in angles))
    row("block: scatter of each face, mm", ", ".join(f"{s:.2f}" for s in scatter))
    for text in found.result["warnings"]:
        row("warning", text)


def picture(points: Array, path: Path) -> None:
    """Write three sides of the cloud, coloured by height."""
    near = points[(np.hypot(points[:, 0], points[:, 1]) < 130.0) & (points[:, 2] > -12.0)]
    views = [
        cloud_from(near, near[:, 2], np.array(right, dtype=np.float64), np.array(down, dtype=np.float64), width=520)
        for right, down in (((1, 0, 0), (0, 0, -1)), ((0, 1, 0), (0, 0, -1)), ((0.8, -0.6, 0), (-0.3, -0.4, -0.866)))
    ]
    tall = max(view.shape[0] for view in views)
    padded = [
        cv2.copyMakeBorder(view, 0, tall - view.shape[0], 0, 0, cv2.BORDER_CONSTANT, value=(24, 24, 24))
        for view in views
    ]
    cv2.imwrite(str(path), np.hstack(padded))


if __name__ == "__main__":
    main()
