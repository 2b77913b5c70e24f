"""A surface through the points of a scan: triangles between neighbours on the scan lattice, none across a jump."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, Ints
from scope.cloud.columns import Columns
from scope.errors import MeasurementError

_SPARSEST = 200  # places of the lattice for each point
_SMALL = 20_000_000  # places that are always granted


def lattice_lines(cloud: Columns) -> Ints:
    """Number of the image line (column or row) each point was found on (N,); -1 where the cloud does not tell.

    The coordinate along the stripe is whole by construction; a laser whose points are whole in neither is -1.
    """
    lines = np.full(len(cloud), -1, dtype=np.int64)
    for laser in np.unique(cloud.laser):
        rows = np.flatnonzero(cloud.laser == laser)
        pixels = cloud.pixels[rows]
        if not np.isfinite(pixels).all():
            continue
        fraction = np.abs(pixels - np.rint(pixels)).mean(axis=0)
        axis = int(np.argmin(fraction))
        if fraction[axis] < 1e-3:
            lines[rows] = np.rint(pixels[:, axis]).astype(np.int64)
    return lines


def lattice_index(cloud: Columns, laser: int) -> Ints:
    """Index of the point at (frame, line) of one laser, as (frames, lines), -1 where there is none.

    Frames and lines are counted from the first that has a point, frames in steps of the laser's own where lasers take
    turns; (0, 0) where there is no lattice. ``MeasurementError`` where the points are too few for their frames and lines.
    """
    lines = lattice_lines(cloud)
    rows = np.flatnonzero((cloud.laser == laser) & (lines >= 0))
    if len(rows) == 0:
        return np.zeros((0, 0), dtype=np.int64)
    frame, line = cloud.frame[rows] - cloud.frame[rows].min(), lines[rows] - lines[rows].min()
    frame = frame // max(1, int(np.gcd.reduce(frame)))
    frames, width = int(frame.max()) + 1, int(line.max()) + 1
    if frames * width > _SPARSEST * len(rows) + _SMALL:
        raise MeasurementError(
            f"{len(rows)} points are spread over {frames} frames of {width} lines, which is no scan; the file is damaged, or give "
            "a part of it"
        )
    index = np.full((frames, width), -1, dtype=np.int64)
    index[frame, line] = rows
    return index


def lattice_triangles(cloud: Columns, *, jump: float = 4.0) -> Ints:
    """Triangles (M, 3) of point indices; each square of the lattice gives up to two.

    Parameters
    ----------
    cloud : Columns
        In scan order, with pixels.
    jump : float
        No triangle has an edge longer than this many times the median edge of its direction in the lattice.
    """
    found = [np.zeros((0, 3), dtype=np.int64)]
    for laser in np.unique(cloud.laser):
        index = lattice_index(cloud, int(laser))
        if min(index.shape) < 2:
            continue
        a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
        for triangle in (np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)):
            triangle = triangle[(triangle >= 0).all(axis=1)]
            edges = _edges(cloud.points, triangle)
            if len(edges):
                found.append(triangle[(edges <= jump * np.median(edges, axis=0)).all(axis=1)])
    return np.concatenate(found)


def _edges(points: Array, triangles: Ints) -> Array:
    """Lengths (M, 3) mm of the edges of triangles."""
    corners = points[triangles]
    return np.asarray(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2))
