"""Chessboards and ChArUco boards to sub-pixel corners, by OpenCV's detectors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.geometry import Array, Ints
from calibration.targets.layout import Charuco, Chessboard


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """M corners of a board, in the order of their marks."""

    pixels: Array  # (M, 2) px (u, v)
    mark: Ints  # (M,) which mark of the target each is


def find_chessboard(image: NDArray[np.generic], target: Chessboard) -> Corners:
    """Find the inner corners of a chessboard, all of which must be in view.

    Parameters
    ----------
    image : (H, W) array
        Grey levels of any depth; only their range matters.
    target : Chessboard
        Its inner corners.

    Returns
    -------
    Corners
        All corners of the target but those, if any, that a smooth grid contradicts. Mark (0, 0) is one of the corners of the pattern, and the marks turn as (u, v) do; a
        board that looks the same after half a turn (an even sum of rows and columns) may be counted from either end.

    Raises
    ------
    CalibrationError
        The board is not in view as a whole, or its rows and columns are swapped.

    Notes
    -----
    OpenCV's sector-based detector (Duda and Frese, BMVC 2018), whose own sub-pixel step is improved on by the gradient
    condition of `cornerSubPix`: every gradient near a corner is normal to the line to it (Forstner and Gulch 1987). It now
    and then misses a board that is in plain view; it is then asked without normalising, and after it the older detector.
    """
    grey = _eight_bit(image)
    pixels = _detect(grey, target.rows, target.columns)
    if pixels is None:
        raise CalibrationError(
            f"no chessboard of {target.rows} x {target.columns} inner corners in the image; all of it must be in view: "
            "check rows and columns (inner corners, not squares), focus, glare and exposure"
        )
    grid = pixels.reshape(target.rows, target.columns, 2)
    along, down = (grid[:, -1] - grid[:, 0]).mean(axis=0), (grid[-1] - grid[0]).mean(axis=0)
    if along[0] * down[1] - along[1] * down[0] < 0:
        grid = grid[:, ::-1]  # the detector may count a board from the wrong hand
    expected = _smooth(grid)
    away = np.linalg.norm(grid.reshape(-1, 2) - expected, axis=1)
    limit = max(6.0 * 1.4826 * float(np.median(away)), 1.0)
    # the detector may put single corners pixels away; they are sought again where their neighbours expect them
    start = np.where((away > limit)[:, None], expected, grid.reshape(-1, 2))
    moved = _refine(grey, start, _spacing(grid))
    known = np.linalg.norm(moved - expected, axis=1) <= limit + 0.5
    return Corners(moved[known], np.flatnonzero(known))


def _detect(grey: NDArray[np.uint8], rows: int, columns: int) -> Array | None:
    """Corners (rows * columns, 2) px of a chessboard by the first detector that sees it whole."""
    import cv2

    thorough = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    for flags in (thorough | cv2.CALIB_CB_NORMALIZE_IMAGE, thorough):
        found, corners = cv2.findChessboardCornersSB(grey, (columns, rows), flags=flags)
        if found:
            return np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    found, corners = cv2.findChessboardCorners(
        grey, (columns, rows), flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2) if found else None


def find_charuco(image: NDArray[np.generic], target: Charuco) -> Corners:
    """Find the corners of a ChArUco board, of which any part may be in view.

    Parameters
    ----------
    image : (H, W) array
        Grey levels of any depth.
    target : Charuco
        Its squares, markers and dictionary.

    Returns
    -------
    Corners
        The corners in view, at least four that are not in one line.

    Raises
    ------
    CalibrationError
        Fewer than four corners, or an unknown dictionary.
    """
    import cv2

    number = getattr(cv2.aruco, target.dictionary, None)
    if not isinstance(number, int) or not target.dictionary.startswith("DICT_"):
        raise CalibrationError(
            f"target.dictionary is {target.dictionary!r}; one of OpenCV's is needed, such as DICT_5X5_100"
        )
    board: Any = cv2.aruco.CharucoBoard(
        (target.columns, target.rows), target.pitch[0], target.marker, cv2.aruco.getPredefinedDictionary(number)
    )
    board.setLegacyPattern(target.legacy)
    grey = _eight_bit(image)
    corners, marks, _, markers = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    count = 0 if marks is None else len(marks)
    seen = 0 if markers is None else len(markers)
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2) if count else np.zeros((0, 2))
    spread = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False) if count >= 4 else np.zeros(2)
    if count < 4 or spread[1] < 1e-3 * spread[0]:
        raise CalibrationError(
            f"found {count} corners and {seen} markers of a ChArUco board of {target.rows} x {target.columns} squares; "
            "at least four corners, not in one line, are needed: check dictionary, rows and columns, `legacy` and focus"
        )
    return Corners(pixels, np.asarray(marks, dtype=np.int64).ravel())


def _smooth(grid: Array) -> Array:
    """Where a smooth grid has its corners, (rows * columns, 2) px: a cubic of row and column, robustly fitted."""
    rows, columns = grid.shape[:2]
    v, u = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
    powers = [(i, j) for i in range(min(4, rows)) for j in range(min(4, columns)) if i + j <= 3]
    a = np.stack([(v**i * u**j).ravel() for i, j in powers], axis=1)
    seen, weight = grid.reshape(-1, 2), np.ones(rows * columns)
    fitted = seen
    for _ in range(8):
        root = np.sqrt(weight)[:, None]
        fitted = a @ np.linalg.lstsq(a * root, seen * root, rcond=None)[0]
        away = np.linalg.norm(seen - fitted, axis=1)
        weight = 1.0 / np.maximum(away / max(float(np.median(away)), 1e-3), 1.0) ** 2
    return np.asarray(fitted)


def _spacing(grid: Array) -> float:
    """Shortest distance, px, between neighbours of a (rows, columns, 2) grid of corners."""
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2) for axis in (0, 1) if grid.shape[axis] > 1]
    return float(min(step.min() for step in steps))


def _refine(grey: NDArray[np.uint8], corners: Array, spacing: float) -> Array:
    """Corners moved to where the gradients of their surroundings, a third of a square, point."""
    import cv2

    half = int(np.clip(spacing / 3.0, 2, 12))
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    moved = cv2.cornerSubPix(grey, corners.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), until)
    moved = np.asarray(moved, dtype=np.float64).reshape(-1, 2)
    # where the surroundings mislead, by glare or an edge of the board, the detector's own answer stands
    return np.where(np.linalg.norm(moved - corners, axis=1, keepdims=True) < 1.0, moved, corners)


def _eight_bit(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Stretch an image to the 8 bits that the detectors take; the darkest and brightest thousandth may clip."""
    grey = np.asarray(image)
    if grey.ndim != 2 or not grey.size:
        raise ValueError(f"an image is (H, W), one channel; found shape {grey.shape}")
    if grey.dtype == np.uint8:
        return np.ascontiguousarray(grey)
    low, high = np.percentile(grey[:: max(1, grey.shape[0] // 512), :: max(1, grey.shape[1] // 512)], [0.1, 99.9])
    scaled = (grey.astype(np.float64) - low) * (255.0 / max(high - low, 1e-9))
    return np.asarray(np.clip(np.round(scaled), 0, 255), dtype=np.uint8)
