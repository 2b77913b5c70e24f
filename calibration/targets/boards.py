"""Chessboards and ChArUco boards to sub-pixel corners, by OpenCV's detectors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.geometry import Array, Ints
from calibration.targets._looks import eight_bit, looks, refined
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
        The board is not in view as a whole, its rows and columns are swapped, or more corners than were told go on with its
        pattern.

    Notes
    -----
    OpenCV's sector-based detector (Duda and Frese, BMVC 2018), whose own sub-pixel step is improved on by the gradient
    condition of `cornerSubPix`: every gradient near a corner is normal to the line to it (Forstner and Gulch 1987). It now
    and then misses a board that is in plain view; it is then asked without normalising, and after it the older detector, and
    both again at other scales and contrasts.
    """
    grey = eight_bit(image)
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
    _check_whole(grey, grid)
    moved = refined(grey, start, _spacing(grid))
    known = np.linalg.norm(moved - expected, axis=1) <= limit + 0.5
    return Corners(moved[known], np.flatnonzero(known))


def _detect(grey: NDArray[np.uint8], rows: int, columns: int) -> Array | None:
    """Corners (rows * columns, 2) px of a chessboard by the first detector that sees it whole, in whatever look of the image."""
    import cv2

    thorough = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    plain = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    for k, (look, scale) in enumerate(looks(grey)):
        for flags in (thorough | cv2.CALIB_CB_NORMALIZE_IMAGE, thorough)[: 2 if k == 0 else 1]:
            found, corners = cv2.findChessboardCornersSB(look, (columns, rows), flags=flags)
            if found:
                return (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
        found, corners = cv2.findChessboardCorners(
            look, (columns, rows), flags=plain | cv2.CALIB_CB_FAST_CHECK * (k > 0)
        )
        if found:
            return (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
        if k == 0:
            _refuse_larger(grey, rows, columns)
    return None


def _refuse_larger(grey: NDArray[np.uint8], rows: int, columns: int) -> None:
    """Refuse at once, where a board of more rows or columns than were told is in plain view; other looks would not show less of it."""
    import cv2

    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    found, _, meta = cv2.findChessboardCornersSBWithMeta(grey, (columns, rows), flags)
    seen = sorted(meta.shape[:2]) if found and meta is not None else []
    if seen and seen != sorted((rows, columns)):
        raise CalibrationError(
            f"a chessboard of {rows} x {columns} inner corners was told, and its pattern goes on: {seen[0]} x {seen[1]} inner "
            "corners are seen; count them again, since which of them are meant would be a guess"
        )


def _check_whole(grey: NDArray[np.uint8], grid: Array) -> None:
    """Refuse a board whose pattern goes on beyond the rows or columns that were told.

    Beyond the last inner corners of a whole board lie its outer squares, whose other corners touch the margin: of the four
    quadrants about such a place two are margin. Where all four alternate as about an inner corner, the board is larger.
    """
    rows, columns = grid.shape[:2]
    for axis, what in ((1, "columns"), (0, "rows")):
        along = grid if axis == 1 else grid.transpose(1, 0, 2)
        for end in (along, along[:, ::-1]):
            if end.shape[1] < 3:
                continue
            more = 3 * end[:, 0] - 3 * end[:, 1] + end[:, 2]  # a quadratic goes on
            if _alternates(grey, more, end[:, 0] - end[:, 1], end):
                count = columns if axis == 1 else rows
                raise CalibrationError(
                    f"a chessboard of {rows} x {columns} inner corners was told, and its pattern goes on: it has {count + 1} "
                    f"{what} or more; count the inner corners again, since which of them are seen would be a guess"
                )


def _alternates(grey: NDArray[np.uint8], places: Array, outwards: Array, end: Array) -> bool:
    """Whether most of a line of places (n, 2) px beyond a grid look as inner corners do, as those of the grid's rim show it."""
    sideways = np.gradient(end[:, 0], axis=0)
    rim = np.abs(_saddle(grey, end[:, 0], outwards, sideways))
    beyond = np.abs(_saddle(grey, places, outwards, sideways))
    known = np.isfinite(beyond) & np.isfinite(rim)
    if known.sum() < max(3, 0.6 * len(places)):
        return False
    return bool(np.mean(beyond[known] > 0.75 * np.median(rim[known])) > 0.7)


def _saddle(grey: NDArray[np.uint8], places: Array, outwards: Array, sideways: Array) -> Array:
    """Grey levels (n,) by which opposite quadrants about places differ from the others; NaN where they leave the image."""
    total = np.zeros(len(places))
    for a in (-0.4, 0.4):
        for b in (-0.4, 0.4):
            total += np.sign(a * b) * _levels(grey, places + a * outwards + b * sideways)
    return total


def _levels(grey: NDArray[np.uint8], pixels: Array) -> Array:
    """Grey levels (n,) at the nearest pixels; NaN outside."""
    at = np.rint(pixels).astype(int)
    inside = ((at >= 0) & (at < np.array(grey.shape[::-1]))).all(axis=1)
    levels = np.full(len(at), np.nan)
    levels[inside] = grey[at[inside, 1], at[inside, 0]]
    return levels


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
    grey = eight_bit(image)
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
