"""Random sessions that nobody prepared, beside a plain script: python -m benchmarks.wild [N] [FIRST SEED]."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks.shared import head, row
from calibration.errors import ScopeError
from calibration.geometry import Array, fit_plane
from ranging.covariance import propagate
from scope.calibrating import Calibration, calibrate
from scope.simulation import WildScene, draw_wild, write_wild

ROWS, COLUMNS, PITCH = 6, 8, 20.0
CALLED_RIGHT = 1.0  # mm rms: a sheet of the plain script that is nearer than this counts as found


def plain(folder: Path, colour: int) -> tuple[Array, float] | None:
    """Sheet by a script of an afternoon, told the laser's colour: corners, excess, centre of mass, robust plane."""
    marks = np.zeros((ROWS * COLUMNS, 3), np.float32)
    marks[:, :2] = np.mgrid[0:COLUMNS, 0:ROWS].T.reshape(-1, 2) * PITCH
    found, lit = [], []
    for path in [*sorted((folder / "board").glob("*.jpg")), *sorted((folder / "laser").glob("*.jpg"))]:
        image = np.asarray(cv2.imread(str(path)))
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        seen, corners = cv2.findChessboardCorners(grey, (COLUMNS, ROWS))
        if seen:
            until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
            found.append(cv2.cornerSubPix(grey, corners, (5, 5), (-1, -1), until))
            lit.append(image if path.parent.name == "laser" else None)
    if len(found) < 4:
        return None
    _, matrix, distortion, turns, shifts = cv2.calibrateCamera([marks] * len(found), found, (640, 480), None, None)
    points = []
    for picture, corners, r, t in zip(lit, found, turns, shifts, strict=True):
        if picture is None:
            continue
        image = picture.astype(np.float64)
        others = [c for c in range(3) if c != colour]
        excess = cv2.GaussianBlur(np.maximum(image[:, :, colour] - image[:, :, others].mean(axis=2), 0.0), (0, 0), 2)
        hull = np.zeros(excess.shape, np.uint8)
        cv2.fillConvexPoly(hull, cv2.convexHull(corners).astype(np.int32), 1)
        turn = cv2.Rodrigues(r)[0]
        for v, line in enumerate(excess * hull):
            u = int(line.argmax())
            if line[u] < 15:
                continue
            part = np.arange(max(u - 12, 0), min(u + 13, 640))
            centre = (line[part] * part).sum() / line[part].sum()
            x, y = cv2.undistortPoints(np.array([[[centre, float(v)]]]), matrix, distortion)[0, 0]
            ray = np.array([x, y, 1.0])
            points.append(ray * (turn[:, 2] @ t.ravel()) / (turn[:, 2] @ ray))
    if len(points) < 50:
        return None
    cloud, weights = np.array(points), np.ones(len(points))
    for _ in range(20):
        plane = fit_plane(cloud, weights=weights)
        off = plane.distance(cloud)
        weights = np.maximum(1 - (off / (4.685 * 1.4826 * np.median(np.abs(off)))) ** 2, 0.0) ** 2 + 1e-12
    return plane.normal, plane.offset


def on_sheet(scene: WildScene) -> Array:
    """Points of the true sheet within the depths of the boards and the picture."""
    y, z = (a.ravel() for a in np.meshgrid(np.linspace(-70, 70, 7), np.linspace(400, 540, 7)))
    x = (scene.offset - scene.normal[1] * y - scene.normal[2] * z) / scene.normal[0]
    return np.asarray(np.stack([x, y, z], axis=1)[np.abs(x) < 0.45 * z])


def judged(found: Calibration, scene: WildScene) -> tuple[float, float]:
    """Rms error of points ranged from the true pixels of the true sheet, mm; the same over its stated sigma.

    The sigma is that of camera and laser together, carried to the points.
    """
    camera, laser = found.rig.camera, found.rig.lasers["laser"]
    points = on_sheet(scene)
    flat = points[:, :2] / points[:, 2:]
    flat *= 1.0 + scene.radial * (flat**2).sum(axis=1, keepdims=True)
    pixels = scene.focal * flat + scene.centre
    ranged = laser.sheet.intersect(camera.rays(pixels)).points
    seen = np.isfinite(ranged).all(axis=1)
    stated = propagate(
        camera, laser, pixels[seen], ranged[seen], np.zeros(int(seen.sum())), 1 if laser.along == "rows" else 0
    ).calibration
    error = float(((ranged - points)[seen] ** 2).sum(axis=1).mean())
    return float(np.sqrt(error)), float(np.sqrt(error / np.trace(stated, axis1=1, axis2=2).mean()))


def main() -> None:
    """Print a line for every session that is not right, then the table."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    errors, over, long, script = [], [], 0, []
    failed = not_passed = beyond = 0
    for seed in range(first, first + count):
        rng = np.random.default_rng(seed)
        scene = draw_wild(rng)
        with tempfile.TemporaryDirectory() as place:
            write_wild(scene, place, rng)
            sheet = plain(Path(place), scene.colour)
            points = on_sheet(scene)
            script.append(np.inf if sheet is None else float(np.sqrt(((points @ sheet[0] - sheet[1]) ** 2).mean())))
            try:
                found = calibrate(Path(place) / "calibration.toml")
            except ScopeError as error:
                failed += 1
                long += len(str(error)) > 300
                print(f"seed {seed}: {error}", flush=True)
                continue
        error_mm, ratio = judged(found, scene)
        if not found.passed:
            not_passed += 1
            print(f"seed {seed}: not passed: {found.why[:200]}", flush=True)
            continue
        errors.append(error_mm)
        over.append(ratio)
        if ratio > 3:
            beyond += 1
            print(
                f"seed {seed}: {error_mm:.3f} mm off, {ratio:.1f} stated sigma; the script {script[-1]:.3f}", flush=True
            )
    head(f"{count} sessions from seed {first}", "plain script", "SCOPE")
    row("calibrate unedited (script: sheet within 1 mm)", sum(e < CALLED_RIGHT for e in script), len(errors))
    row("refused; not passed", "", f"{failed}; {not_passed}")
    row("sheet off, median mm", float(np.median(script)), float(np.median(errors)) if errors else "-")
    row("passed and within 1 mm", "", sum(e < CALLED_RIGHT for e in errors))
    row("passed with a sheet off by more than 3 stated sigma", "", beyond)
    row("error over stated sigma, median", "", float(np.median(over)) if over else "-")
    row("error lines longer than 300 characters", "", long)


if __name__ == "__main__":
    main()
