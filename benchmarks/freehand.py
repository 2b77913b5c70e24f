"""Freehand cameras beside OpenCV's five terms: python -m benchmarks.freehand [SESSIONS]."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.shared import head, row
from calibration.errors import CalibrationError
from calibration.geometry import Array, Pose
from calibration.rays import PinholeCamera, PlaneMarks, coverage_of, fit_freehand, next_view, undetermined


@dataclass(frozen=True)
class Kind:
    """Sessions of one kind: an independent pinhole and how a board is held before it."""

    name: str
    lens: tuple[float, ...]  # fx fy cx cy k1 k2 p1 p2 k3
    size: tuple[int, int]
    board: tuple[int, int, float]  # rows, columns, pitch mm
    tilt: float  # degrees, at most, about each axis
    spread: float  # of half the image, over which the board's middle lies
    depth: tuple[float, float]  # mm
    noise: float  # px
    count: int


KINDS = (
    Kind("10 views of a small board near the middle, 640 x 480", (600, 600, 330, 228, -0.1, 0.02, 0, 0, 0), (640, 480), (5, 5, 8.0), 30, 0.3, (280, 400), 0.2, 10),
    Kind("the same, tilted by 8 degrees at most", (600, 600, 330, 228, -0.1, 0.02, 0, 0, 0), (640, 480), (5, 5, 8.0), 8, 0.3, (280, 400), 0.2, 10),
    Kind("20 views, webcam, 640 x 480", (650, 650, 318, 246, 0.05, -0.15, 0.001, -0.0005, 0), (640, 480), (6, 8, 40.0), 35, 0.7, (500, 900), 0.15, 20),
    Kind("15 views, good lens, 1280 x 960", (900, 900, 655, 470, -0.25, 0.12, 0.0008, -0.0005, -0.03), (1280, 960), (7, 9, 12.0), 35, 0.8, (150, 260), 0.1, 15),
)  # fmt: skip


def session(kind: Kind, rng: np.random.Generator) -> list[PlaneMarks]:
    """Views of a board, all of it in the image."""
    lens, size = np.array(kind.lens, dtype=np.float64), np.array(kind.size, dtype=np.float64)
    rows, columns, pitch = kind.board
    at = np.stack(np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2), axis=-1)
    points = pitch * at.reshape(-1, 2)
    found: list[PlaneMarks] = []
    while len(found) < kind.count:
        turn, depth = np.deg2rad(rng.uniform(-kind.tilt, kind.tilt, 3)), rng.uniform(*kind.depth)
        middle = size / 2 * (1 + rng.uniform(-kind.spread, kind.spread, 2))
        shift = np.append((middle - lens[2:4]) / lens[:2] * depth, depth)
        pixels = cv2.projectPoints(_flat(points), turn, shift, matrix_of(lens), lens[4:])[0][:, 0]
        if (pixels < 0).any() or (pixels > size - 1).any():
            continue
        pixels = pixels + rng.normal(0, kind.noise, pixels.shape)
        number, unknown = np.arange(len(points)), np.full((len(points), 2, 2), np.nan)
        found.append(PlaneMarks(f"v{len(found)}", pixels, points, Pose.identity(), number, unknown))
    return found


def _flat(points: Array) -> Array:
    return np.column_stack([points, np.zeros(len(points))])


def matrix_of(lens: Array) -> Array:
    """Camera matrix (3, 3)."""
    return np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])


def ray_error(matrix: Array, distortion: Array, kind: Kind, pixels: Array) -> float:
    """Median angle, mrad, between rays and the true ones, the best common turn (which a pose takes up) removed."""
    lens = np.array(kind.lens, dtype=np.float64)
    a = PinholeCamera.directions(pixels, matrix, distortion)
    b = PinholeCamera.directions(pixels, matrix_of(lens), lens[4:])
    u, _, v = np.linalg.svd(a.T @ b)
    turned = a @ (u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v)
    return float(np.median(np.linalg.norm(turned - b, axis=1)) * 1000)


def main() -> None:
    """Print the tables."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    for kind in KINDS:
        focal: dict[str, list[float]] = {"OpenCV, five terms": [], "SCOPE": []}
        rays: dict[str, list[float]] = {name: [] for name in focal}
        over, passed, wrong = [], 0, 0
        for seed in range(count):
            views = session(kind, np.random.default_rng(seed))
            objects = [_flat(v.points).astype(np.float32) for v in views]
            images = [v.pixels.astype(np.float32) for v in views]
            matrix, distortion = cv2.calibrateCamera(objects, images, kind.size, None, None)[1:3]
            try:
                fit = fit_freehand(views, kind.size)
            except CalibrationError:
                continue
            covered = coverage_of(fit)
            pixels = covered.pixels[covered.covered]
            found = {
                "OpenCV, five terms": (matrix, distortion.ravel()[:5]),
                "SCOPE": (fit.camera.matrix, fit.camera.distortion),
            }
            for name, (m, d) in found.items():
                focal[name].append(abs(m[0, 0] / kind.lens[0] - 1))
                rays[name].append(ray_error(m, d, kind, pixels))
            over.append((fit.camera.matrix[0, 0] - kind.lens[0]) / np.sqrt(fit.camera.covariance[0, 0]))
            if not undetermined(fit, next_view(fit).advice):
                passed += 1
                wrong += focal["SCOPE"][-1] > 0.05
        head(f"{kind.name}, {kind.noise} px, {count} sessions", "", "OpenCV, five terms", "SCOPE")
        row(
            "focal length off, %, median; 95 %",
            *(f"{100 * np.median(f):.2f}; {100 * np.quantile(f, 0.95):.2f}" for f in focal.values()),
        )
        row(
            "rays between the marks off, mrad, median; 95 %",
            *(f"{np.median(r):.3f}; {np.quantile(r, 0.95):.3f}" for r in rays.values()),
        )
        row("focal length over its standard error, rms", "-", f"{np.sqrt(np.mean(np.square(over))):.2f}")
        row("pass; pass with a focal length off by more than 5 %", "-", f"{passed}; {wrong}")


if __name__ == "__main__":
    main()
