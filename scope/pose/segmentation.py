"""Which points of a scan may be the part: tables taken away, the rest in clusters."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Bools, Plane, fit_plane
from scope.cloud import Region, ScanCloud
from scope.errors import MeasurementError
from scope.model import fibonacci_sphere

Indices: TypeAlias = NDArray[np.int64]
LEAST_POINTS = 300


def clusters(
    cloud: ScanCloud,
    diameter: float,
    face: float,
    *,
    width: float = 0.0,
    region: Region | None = None,
    tables: bool | None = None,
) -> list[Indices]:
    """Indices of the points of each thing that may be the part, the one with most points first.

    Parameters
    ----------
    cloud : ScanCloud
        With the sensors where known: what lies behind a table is then told from what lies on it.
    diameter : float
        Of the part, mm: things much smaller than it are left out, pieces that fit into it together are joined.
    face : float
        Largest area, mm2, that the part can show; a plane that is larger is a table.
    width : float
        Of the part, mm: a plane that is not longer and not wider than the part is no table either.
    region : Region, optional
        Only its points are looked at, and then no table is taken away and pieces are joined whatever their gap.
    tables : bool, optional
        Whether tables are taken away and the rest cut into pieces; by default where there is no region.

    Raises
    ------
    MeasurementError
        Too few points, or nothing left but tables.
    """
    keep = np.arange(len(cloud)) if region is None else np.flatnonzero(region.contains(cloud.points))
    if len(keep) < LEAST_POINTS:
        where = "the cloud" if region is None else "the region"
        raise MeasurementError(
            f"{where} has {len(keep)} points and a pose needs {LEAST_POINTS}; scan the part or choose another region"
        )
    camera = None if cloud.sensors is None else cloud.sensors.centre.mean(axis=0)
    planes: list[Plane] = []
    cut = region is None if tables is None else tables
    if cut:
        keep, planes = _without_tables(cloud.points, keep, diameter, face, width, camera)
    if len(keep) < LEAST_POINTS:
        raise MeasurementError(
            f"{len(cloud)} points lie on {len(planes)} plane(s) larger than the part and only {len(keep)} stand out; "
            "nothing here can be the part: scan it, or give its region"
        )
    cell = _cell(cloud.points[keep], diameter)
    keep = keep[crowded(cloud.points[keep], cell)]
    if not cut:
        return [keep] if len(keep) >= LEAST_POINTS else []
    pieces = _joined(cloud.points, _connected(cloud.points, keep, cell), diameter)
    large = [
        p for p in pieces if len(p) >= max(LEAST_POINTS, 0.02 * len(keep)) and extent(cloud.points[p]) > 0.2 * diameter
    ]
    if not large:
        raise MeasurementError(
            f"the largest of {len(pieces)} piece(s) has {max((len(p) for p in pieces), default=0)} points; "
            "none is large enough to be the part: scan it more densely, or give its region"
        )
    return sorted(large, key=len, reverse=True)


def extent(points: Array) -> float:
    """Greatest width, mm, over some directions, of points (N, 3) without the outermost 0.5 % on either side."""
    along = points[:: max(1, len(points) // 4000)] @ fibonacci_sphere(60).T
    low, high = np.percentile(along, [0.5, 99.5], axis=0)
    return float((high - low).max())


def _cell(points: Array, diameter: float) -> float:
    """Side, mm, of the cubes in which neighbours touch: 2 % of the diameter, more for a sparse scan."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return 0.02 * diameter
    some = points[:: max(1, len(points) // 500)]
    return max(0.02 * diameter, 3.0 * float(np.median(cKDTree(points).query(some, k=2)[0][:, 1])))


def _without_tables(
    points: Array, keep: Indices, diameter: float, face: float, width: float, camera: Array | None
) -> tuple[Indices, list[Plane]]:
    found: list[Plane] = []
    for _ in range(3):
        plane = largest_plane(points[keep], 0.008 * diameter, np.random.default_rng(len(found)))
        if plane is None:
            break
        side = plane.distance(points[keep])
        if camera is not None and plane.distance(camera[None])[0] < 0:
            side = -side
        on = np.abs(side) < 0.008 * diameter
        cell = _cell(points[keep[on]], diameter)
        # the largest sheet counts, not all points of the plane: equal parts side by side have faces in one plane
        sheets = _connected(points, keep[on], cell)
        flat = points[max(sheets, key=len)] if sheets else points[:0]
        area = len(np.unique(np.floor(_in_plane(flat, plane) / cell).astype(np.int64), axis=0)) * cell * cell
        behind = side < -0.02 * diameter
        if len(flat) < LEAST_POINTS or (area < 1.2 * face and extent(flat) < 1.3 * diameter):
            break
        if _fits(_in_plane(flat, plane), diameter, width + cell):  # a rod is flat too, where nothing else is seen of it
            break
        if camera is not None and behind.sum() > 0.1 * len(keep):
            break
        found.append(plane)
        keep = keep[~on & ~behind] if camera is not None else keep[~on]
        if len(keep) < LEAST_POINTS:
            break
    return keep, found


def _fits(flat: Array, length: float, width: float) -> bool:
    """Whether points (N, 2) mm fit into a rectangle but for the outermost 0.5 % on either side."""
    centred = flat - flat.mean(axis=0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    low, high = np.percentile(along, [0.5, 99.5], axis=0)
    return bool(high[0] - low[0] < length and high[1] - low[1] < width)


def _in_plane(points: Array, plane: Plane) -> Array:
    axes = np.linalg.svd(plane.normal[None])[2][1:]
    return np.asarray(points @ axes.T)


def largest_plane(points: Array, tolerance: float, rng: np.random.Generator, *, trials: int = 300) -> Plane | None:
    """The plane with most points within ``tolerance`` of it (RANSAC of Fischler & Bolles 1981, then total least squares)."""
    some = points[rng.permutation(len(points))[:3000]]
    a, b, c = (some[rng.integers(len(some), size=trials)] for _ in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    good = length > 1e-9
    if not good.any():
        return None
    normal, a = normal[good] / length[good, None], a[good]
    near = np.abs(some @ normal.T - (normal * a).sum(axis=1)) < tolerance
    best = int(np.argmax(near.sum(axis=0)))
    plane = Plane.through(a[best], normal[best])
    for _ in range(2):
        on = np.abs(plane.distance(points)) < tolerance
        if on.sum() < 10:
            return None
        plane = fit_plane(points[on][:: max(1, int(on.sum()) // 5000)])
    return plane


def crowded(points: Array, cell: float) -> Bools:
    """Points with neighbours: strays have fewer than five, or than 2 % of what is usual, in their cube and the 26 about it.

    Surface seen at a slant is sparse and must stay: it may hold the one feature that decides.
    """
    from scipy.ndimage import uniform_filter

    index, shape = _cubes(points, cell)
    count = np.zeros(shape, dtype=np.float32)
    np.add.at(count, tuple(index.T), 1.0)
    around = uniform_filter(count, size=3, mode="constant") * 27.0
    mine = around[tuple(index.T)]
    return np.asarray(mine > max(4.5, 0.02 * float(np.median(mine))))


def _connected(points: Array, keep: Indices, cell: float) -> list[Indices]:
    """Pieces whose cubes of 2 % of the diameter touch, corners included."""
    from scipy.ndimage import label

    index, shape = _cubes(points[keep], cell)
    full = np.zeros(shape, dtype=np.bool_)
    full[tuple(index.T)] = True
    number, count = label(full, structure=np.ones((3, 3, 3)))
    mine = number[tuple(index.T)]
    return [keep[mine == k] for k in range(1, count + 1)]


def _cubes(points: Array, cell: float) -> tuple[Indices, tuple[int, ...]]:
    low = points.min(axis=0)
    side = max(cell, float(np.ptp(points, axis=0).max()) / 400)
    index = np.floor((points - low) / side).astype(np.int64) + 1
    return index, tuple(int(n) for n in index.max(axis=0) + 2)


def _joined(points: Array, pieces: list[Indices], diameter: float) -> list[Indices]:
    """Pieces that fit into the part together, joined: an edge hides a strip behind it and cuts a part in two."""
    pieces = sorted(pieces, key=len, reverse=True)
    small = [p for p in pieces if len(p) < 20]
    pieces = [p for p in pieces if len(p) >= 20][:60]
    merged = True
    while merged and len(pieces) > 1:
        merged = False
        middles = [points[p].mean(axis=0) for p in pieces]
        pairs = [(float(np.linalg.norm(middles[i] - middles[j])), i, j) for i in range(len(pieces)) for j in range(i)]
        for _, i, j in sorted(pairs):
            both = np.concatenate([pieces[i], pieces[j]])
            if extent(points[both]) < 1.02 * diameter:
                pieces = [p for k, p in enumerate(pieces) if k not in (i, j)] + [np.sort(both)]
                merged = True
                break
    return pieces + small
