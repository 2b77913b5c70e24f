"""Flat patches of a cloud that nobody has named: what one may have wanted to measure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Bools
from scope.cloud import Box
from scope.heightmap.patch import LEAST_POINTS

_CELLS = 160  # along the longer side, at most
_IN_CELL = 12  # points of a typical cell, at least
_FEWEST = 6  # points with which a cell counts
_ROUGHEST = 0.1  # rms about its plane, of a cell's side: more is an edge
_BEND = 0.2  # by which the slopes of neighbours may differ (11 degrees): texture tilts small cells
_STEP = 0.1  # of a cell's side, by which neighbours may lie apart beyond three times their rms
_LEAST_SIDE = 5  # cells of a patch
_CURVED = 0.6  # of the variance about a plane that a paraboloid explains: more is a curved surface

Cells = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class FlatPatch:
    """A rectangle in x and y that holds one plane."""

    box: Box
    size: tuple[float, float]  # mm, in x and in y
    points: int
    rms: float  # mm, of the points about their plane, along z

    @property
    def region(self) -> str:
        """As ``--region`` takes it."""
        return "box:" + ",".join(f"{value:.6g}" for side in (self.box.x, self.box.y, self.box.z) for value in side)


def flat_patches(points: Array, *, most: int = 4) -> tuple[FlatPatch, ...]:
    """The largest flat patches of points (N, 3) mm, the largest first; empty where none has enough points.

    Planes are fitted to the points of square cells in x and y; neighbours that continue each other are one surface, of which the largest
    rectangle is taken. Planes steeper than the cells are wide against z are not seen, nor a second one behind another.
    """
    if len(points) < LEAST_POINTS:
        return ()
    low, extent = points[:, :2].min(axis=0), np.ptp(points[:, :2], axis=0)
    side = max(float(extent.max()) / _CELLS, float(np.sqrt(max(float(extent.prod()), 1e-12) * _IN_CELL / len(points))))
    if not side > 0.0:
        return ()
    index = np.floor((points[:, :2] - low) / side).astype(np.intp)
    shape = (int(index[:, 0].max()) + 1, int(index[:, 1].max()) + 1)
    cell = index[:, 0] * shape[1] + index[:, 1]
    plane, rms = _planes(points, cell, (low, side), shape)
    flat = np.isfinite(rms) & (rms < _ROUGHEST * side)
    found = []
    for number in _surfaces(plane, rms, flat, side):
        corners = _rectangle(number)
        if min(corners[1] - corners[0], corners[3] - corners[2]) < _LEAST_SIDE:
            continue
        patch = _patch(points, (low, side), corners)
        if patch is not None:
            found.append(patch)
    return tuple(sorted(found, key=lambda p: -p.size[0] * p.size[1])[:most])


def _planes(points: Array, cell: Cells, grid: tuple[Array, float], shape: tuple[int, int]) -> tuple[Array, Array]:
    """Plane (rows, columns, 3): z in the cell's middle and its slopes; and rms about it, mm, NaN where there is none."""
    low, side = grid
    n = shape[0] * shape[1]
    middle = low + side * (np.stack(np.divmod(cell, shape[1]), axis=1) + 0.5)
    centre = float(np.median(points[:, 2]))
    terms = np.column_stack([np.ones(len(points)), points[:, :2] - middle])
    z = points[:, 2] - centre
    normal = np.zeros((n, 3, 3))
    right = np.zeros((n, 3))
    for i in range(3):
        right[:, i] = np.bincount(cell, terms[:, i] * z, n)
        for j in range(3):
            normal[:, i, j] = np.bincount(cell, terms[:, i] * terms[:, j], n)
    count = normal[:, 0, 0]
    scale = np.array([1.0, side, side])
    scaled = normal / (scale[:, None] * scale[None, :])
    good = (count >= _FEWEST) & (np.linalg.eigvalsh(scaled)[:, 0] > 0.01 * count)
    solution = np.full((n, 3), np.nan)
    solution[good] = np.linalg.solve(normal[good], right[good][:, :, None])[:, :, 0]
    off = z - np.einsum("ij,ij->i", terms, solution[cell])
    rms = np.sqrt(np.bincount(cell, np.nan_to_num(off) ** 2, n) / np.maximum(count - 3.0, 1.0))
    solution[:, 0] += centre
    return solution.reshape(*shape, 3), np.where(good, rms, np.nan).reshape(shape)


def _surfaces(plane: Array, rms: Array, flat: Bools, side: float) -> list[Bools]:
    """Masks (rows, columns) of cells that continue each other, those of many cells only."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    number = np.arange(flat.size).reshape(flat.shape)
    pairs = []
    for axis in (0, 1):
        first = tuple(slice(None, -1) if k == axis else slice(None) for k in (0, 1))
        second = tuple(slice(1, None) if k == axis else slice(None) for k in (0, 1))
        a, b = plane[first], plane[second]
        noise = np.maximum(rms[first], rms[second])
        gap = a[..., 0] + 0.5 * side * (a[..., 1 + axis] + b[..., 1 + axis]) - b[..., 0]
        bend = np.hypot(a[..., 1] - b[..., 1], a[..., 2] - b[..., 2])
        joined = (
            flat[first]
            & flat[second]
            & (np.abs(gap) < 3.0 * noise + _STEP * side)
            & (bend < _BEND + 4.0 * noise / side)
        )
        pairs.append(np.stack([number[first][joined], number[second][joined]]))
    i, j = np.concatenate(pairs, axis=1)
    graph = coo_matrix((np.ones(len(i), dtype=np.int8), (i, j)), shape=(flat.size, flat.size))
    label = connected_components(graph, directed=False)[1].reshape(flat.shape)
    large = np.flatnonzero(np.bincount(label[flat], minlength=1) >= _LEAST_SIDE**2)
    return [np.asarray((label == k) & flat) for k in large]


def _rectangle(mask: Bools) -> tuple[int, int, int, int]:
    """Rows and columns (first, after last, first, after last) of the largest rectangle within a mask."""
    best, corners = 0, (0, 0, 0, 0)
    height = np.zeros(mask.shape[1], dtype=np.intp)
    for row in range(mask.shape[0]):
        height = np.where(mask[row], height + 1, 0)
        stack: list[tuple[int, int]] = []  # (first column, height)
        for column, tall in enumerate([*height.tolist(), 0]):
            start = column
            while stack and stack[-1][1] >= tall:
                start, high = stack.pop()
                if high * (column - start) > best:
                    best, corners = high * (column - start), (row + 1 - high, row + 1, start, column)
            stack.append((start, tall))
    return corners


def _patch(points: Array, grid: tuple[Array, float], corners: tuple[int, int, int, int]) -> FlatPatch | None:
    """Patch of a rectangle of cells, half a cell away from its borders; None where it is no plane after all."""
    low, side = grid
    digits = max(0, int(np.ceil(-np.log10(0.2 * side))))
    x, y = (
        (
            round(float(low[k]) + side * (corners[2 * k] + 0.5), digits),
            round(float(low[k]) + side * (corners[2 * k + 1] - 0.5), digits),
        )
        for k in (0, 1)
    )
    if not (x[0] < x[1] and y[0] < y[1]):
        return None
    over = points[Box(x=x, y=y).contains(points)]
    if len(over) < LEAST_POINTS:
        return None
    terms = np.column_stack([np.ones(len(over)), over[:, :2] - over[:, :2].mean(axis=0)])
    used = np.ones(len(over), dtype=np.bool_)
    off = np.zeros(len(over))
    for _ in range(3):
        off = over[:, 2] - terms @ np.linalg.lstsq(terms[used], over[used, 2], rcond=None)[0]
        used = np.abs(off - np.median(off)) <= max(5.0 * 1.4826 * float(np.median(np.abs(off - np.median(off)))), 1e-9)
    spread = float(off[used].std())
    across = (over[used, :2] - over[used, :2].mean(axis=0)) / np.ptp(over[used, :2], axis=0)
    bowl = np.column_stack([np.ones(len(across)), across, across**2, across.prod(axis=1)])
    rest = off[used] - bowl @ np.linalg.lstsq(bowl, off[used], rcond=None)[0]
    if used.mean() < 0.8 or rest.var() < (1.0 - _CURVED) * spread**2:
        return None
    on = over[used, 2]
    margin = 5.0 * spread + 0.1 * side
    z = (round(float(on.min()) - margin, digits + 1), round(float(on.max()) + margin, digits + 1))
    return FlatPatch(Box(x=x, y=y, z=z), (x[1] - x[0], y[1] - y[0]), int(used.sum()), spread)
