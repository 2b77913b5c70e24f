"""Printed targets seen by a camera: whether all marks are found, and the scale of the drawing.

``python -m benchmarks.targets [DPI]`` draws every kind as SVG and PDF, rasterises them by CairoSVG and MuPDF (which share
nothing with SCOPE), looks at them obliquely with a pinhole, and hands the image to `scope calibrate --check`. The
scale is that of the marks that were found, put back on the sheet through the known homography, over the marks stated.
"""

from __future__ import annotations

import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.shared import head, row
from calibration.geometry import Array
from scope.calibrating import check_plane
from scope.calibrating.marks import measure_plane
from scope.printing import print_target
from scope.session import read_calibration

KINDS = ("spots", "chessboard", "charuco", "markers", "circles")
SIZE = (1600, 1200)
FINE = 4


@dataclass(frozen=True, slots=True)
class Seen:
    """What became of one printed target."""

    found: int
    expected: int
    remedy: str
    scale: float  # marks found over marks stated
    rms_mm: float  # about that similarity, on the sheet


def raster(path: Path, dpi: float) -> NDArray[np.uint8]:
    """Grey picture of an SVG or of a PDF's first page."""
    if path.suffix == ".svg":
        import cairosvg

        png = np.frombuffer(cairosvg.svg2png(url=str(path), dpi=dpi), np.uint8)
        return np.asarray(cv2.imdecode(png, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    import pymupdf

    with pymupdf.open(path) as document:
        pixmap = document[0].get_pixmap(matrix=pymupdf.Matrix(dpi / 72, dpi / 72), colorspace=pymupdf.csGRAY)
        return np.frombuffer(pixmap.samples, np.uint8).reshape(pixmap.h, pixmap.stride)[:, : pixmap.w].copy()


def pinhole(width: float, height: float) -> Array:
    """Homography, mm on the sheet to px, of a pinhole that looks obliquely at a sheet and sees all of it."""
    turn = cv2.Rodrigues(np.array([0.22, -0.15, 0.03]))[0]
    focal = 1.9 * SIZE[0]
    matrix = np.array([[focal, 0, SIZE[0] / 2 + 7.3], [0, focal, SIZE[1] / 2 - 4.1], [0, 0, 1.0]])
    away = 1.15 * focal * max(width / SIZE[0], height / SIZE[1])
    middle = np.array([0.0, 0.0, away]) - turn @ np.array([width / 2, height / 2, 0.0])
    return np.asarray(matrix @ np.column_stack([turn[:, :2], middle]))


def photograph(
    picture: NDArray[np.uint8], dpi: float, homography: Array, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Image of a sheet: averaged over each pixel, blurred, noisy; 10 to 220 grey levels."""
    mm = 25.4 / dpi
    to_sheet = np.array([[mm, 0, mm / 2], [0, mm, mm / 2], [0, 0, 1.0]])
    finer = np.array([[FINE, 0, FINE / 2 - 0.5], [0, FINE, FINE / 2 - 0.5], [0, 0, 1.0]])
    size = (SIZE[0] * FINE, SIZE[1] * FINE)
    large = cv2.warpPerspective(picture, finer @ homography @ to_sheet, size, flags=cv2.INTER_LINEAR, borderValue=90)
    image = cv2.GaussianBlur(cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA).astype(np.float32), (0, 0), 0.7)
    noisy = 10.0 + image * (210.0 / 255.0) + rng.normal(0.0, 1.2, image.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


def see(kind: str, ending: str, folder: Path, dpi: float) -> Seen:
    """Draw a kind of target, look at it, and judge it as a user would."""
    drawn = print_target(kind, folder / f"{kind}{ending}")
    homography = pinhole(drawn.width, drawn.height)
    image = photograph(raster(drawn.files[0], dpi), dpi, homography, np.random.default_rng(1))
    cv2.imwrite(str(folder / f"{kind}.png"), image)
    text = re.sub(r"\n\[\[plane\]\].*", "", drawn.toml.read_text(encoding="utf-8"), flags=re.DOTALL)
    file = folder / f"{kind}-calibration.toml"
    file.write_text(
        text + f'\n[[plane]]\nname = "p"\nimages = "{kind}.png"\norigin = [0.0, 0.0, 400.0]\n', encoding="utf-8"
    )
    checked = check_plane(file, "p")
    plan = read_calibration(file)
    marks = measure_plane(plan, plan.planes[0]).marks
    back = np.column_stack([marks.pixels, np.ones(len(marks))]) @ np.linalg.inv(homography).T
    scale, rms = similarity(marks.points, back[:, :2] / back[:, 2:])
    return Seen(checked["found"], checked["expected"], checked["remedy"], scale, rms)


def similarity(stated: Array, found: Array) -> tuple[float, float]:
    """Scale and rms residual, mm, of the best turned and shifted copy of ``stated`` (complex least squares)."""
    a, b = ((p - p.mean(axis=0)) @ [1.0, 1j] for p in (stated, found))
    factor = np.vdot(a, b) / np.vdot(a, a)
    return float(abs(factor)), float(np.sqrt(np.mean(np.abs(b - factor * a) ** 2)))


def main() -> None:
    dpi = float(sys.argv[1]) if len(sys.argv) > 1 else 600.0
    head("target", "as", "marks found", "of", "scale - 1, %", "rms, mm", "reach", "")
    with tempfile.TemporaryDirectory() as folder:
        for kind in KINDS:
            for ending in (".svg", ".pdf"):
                seen = see(kind, ending, Path(folder), dpi)
                met = seen.found == seen.expected and not seen.remedy and abs(seen.scale - 1) <= 1e-4
                error = f"{100 * (seen.scale - 1):+.4f}"
                row(kind, ending[1:], seen.found, seen.expected, error, seen.rms_mm, "all; 0.01", "met" if met else f"**missed** {seen.remedy}")  # fmt: skip


if __name__ == "__main__":
    main()
