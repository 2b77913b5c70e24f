"""Height and slope parameters of a map of heights (ISO 25178-2), with gaps left out and never filled."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calibration.geometry import Array, Bools

_BLOCK = 64  # rows worked on at a time, so that they stay in the cache


def height_parameters(heights: Array) -> dict[str, float]:
    """Sa Sq Ssk Sku Sp Sv Sz of heights (N,) mm about their mean (ISO 25178-2, clause 4.2).

    A flat set (Sq = 0) has no skewness and no kurtosis: NaN. ``ValueError`` for no heights at all.
    """
    if len(heights) == 0:
        raise ValueError("no heights")
    height = heights - heights.mean()
    square = height * height
    variance = float(square.mean())
    flat = variance == 0.0
    return {
        "Sa": float(np.abs(height).mean()),
        "Sq": float(np.sqrt(variance)),
        "Ssk": float("nan") if flat else float(square @ height) / len(height) / variance**1.5,
        "Sku": float("nan") if flat else float(square @ square) / len(height) / variance**2,
        "Sp": float(height.max()),
        "Sv": float(-height.min()),
        "Sz": float(height.max() - height.min()),
    }


def gradient_products(first: Array, second: Array, pitch: tuple[float, float]) -> Array:
    """Mean products of the slopes of two maps (rows, columns) mm, down the rows and along the columns, (2,).

    A slope is the difference of two neighbours over the pitch (down, along) mm. With one map twice these are its mean
    square slopes, whose sum is Sdq squared; with two scans of one surface their independent noise averages out. Each
    mean runs over the pairs that are whole in both maps, NaN where none is.
    """
    total, count = np.zeros(2), np.zeros(2)
    for axis in (0, 1):
        for rows in _row_blocks(first.shape[0], 1 - axis):
            a = np.diff(first[rows], axis=axis)
            b = a if second is first else np.diff(second[rows], axis=axis)
            total[axis], count[axis] = _accumulate(a * b, total[axis], count[axis])
    mean = np.divide(total, count, out=np.full(2, np.nan), where=count > 0)
    return np.asarray(mean / np.square(pitch))


def root_mean_square_gradient(z: Array, pitch: tuple[float, float]) -> float:
    """Sdq of heights (rows, columns) mm at pitch (down, along) mm (ISO 25178-2, clause 4.4.2): a pure number.

    The two directions are averaged apart and then added, so that a gap costs only the pairs that meet it. Slopes are
    differences of neighbours, the discretisation that Sdr's triangles have and that other software uses; they lie
    below the slopes of the continuous surface by about (pitch / correlation length) squared / 4.
    """
    return float(np.sqrt(gradient_products(z, z, pitch).sum()))


def developed_area_ratio(z: Array, pitch: tuple[float, float], *, scale: float = 1.0) -> float:
    """Sdr of heights (rows, columns) mm (ISO 25178-2, clause 4.4.3, annex D): 0.01 is 1 % more area than its shadow.

    Every square of four heights is cut along both diagonals and the two areas are averaged; squares with a gap are
    left out, above and below. ``scale`` multiplies the heights first. NaN where no square is whole.
    """
    total, count = 0.0, 0.0
    for rows in _row_blocks(z.shape[0], 1):
        part = z[rows]
        along = np.diff(part, axis=1)
        along *= scale / pitch[1]
        along *= along
        along += 1.0
        down = np.diff(part, axis=0)
        down *= scale / pitch[0]
        down *= down
        cell = np.sqrt(along[:-1] + down[:, :-1])
        for corner in (along[:-1] + down[:, 1:], along[1:] + down[:, :-1], along[1:] + down[:, 1:]):
            cell += np.sqrt(corner, out=corner)
        total, count = _accumulate(cell, total, count)
    return float(total / (4.0 * count) - 1.0) if count else float("nan")


def _row_blocks(rows: int, overlap: int) -> Iterator[slice]:
    for start in range(0, max(rows - overlap, 0), _BLOCK):
        yield slice(start, min(start + _BLOCK + overlap, rows))


def _accumulate(values: Array, total: float, count: float) -> tuple[float, float]:
    """Add the finite values of a block to a running sum and count."""
    block = float(values.sum())
    if np.isfinite(block):
        return total + block, count + values.size
    known: Bools = np.isfinite(values)
    return total + float(values[known].sum()), count + int(known.sum())
