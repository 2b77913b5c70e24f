"""Does a patch straddle an edge? A step in level is no roughness."""

from __future__ import annotations

import warnings

import numpy as np

from calibration.geometry import Array
from scope.errors import MeasurementError
from scope.heightmap.heights import HeightMap

_BLOCKS = 48  # blocks along a side, at most
_SHARP = 8.0  # an edge steps by this many typical steps between blocks


def refuse_edges(heights: HeightMap) -> None:
    """``MeasurementError`` where the level of a patch steps, and stays, along a line that crosses half of it.

    Medians of blocks are compared two blocks apart, since the one between may hold the edge. A step must be eight
    times the typical one, recur in half of the rows or columns, and remain in the medians of a quarter of the patch to
    either side, which grooves and scratches do not. Folds (a change of slope without a step) are not seen here.
    """
    level = _block_medians(heights.z)
    for axis, name in ((0, "down"), (1, "along")):
        found = _step(level if axis == 1 else level.T)
        if found is not None:
            raise MeasurementError(
                f"the region straddles an edge: the surface steps by {found:.3g} mm {name} the scan; choose a region "
                "on one side of it"
            )


def _step(level: Array) -> float | None:
    """Height of a step that most rows of block medians (rows, columns) cross, mm; None where there is none."""
    rows, columns = level.shape
    if columns < 8 or rows < 4:
        return None
    jump = level[:, 2:] - level[:, :-2]
    if not np.isfinite(jump).any():
        return None
    jump = jump - np.nanmedian(jump)
    typical = float(np.nanmedian(np.abs(jump)))
    place = np.nanargmax(np.where(np.isfinite(jump), np.abs(jump), -1.0), axis=1)
    largest = jump[np.arange(rows), place]
    stays = np.zeros(rows)
    reach = max(3, columns // 4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a side that is all gap has no median: NaN, and no step
        for row, column in enumerate(place):
            before = np.nanmedian(level[row, max(0, column + 1 - reach) : column + 1])
            after = np.nanmedian(level[row, column + 2 : column + 2 + reach])
            stays[row] = after - before
    sharp = (np.abs(largest) > _SHARP * typical) & (stays * np.sign(largest) > 0.4 * np.abs(largest))
    if sharp.sum() < 0.5 * rows:
        return None
    return float(np.median(np.abs(largest[sharp])))


def _block_medians(z: Array) -> Array:
    """Medians of square blocks of at least four samples, NaN where a block is empty."""
    side = max(4, *(-(-n // _BLOCKS) for n in z.shape))
    rows, columns = (n // side for n in z.shape)
    blocks = z[: rows * side, : columns * side].reshape(rows, side, columns, side).swapaxes(1, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmedian(blocks.reshape(rows, columns, side * side), axis=2))
