"""A signed distance on a grid, and batches of Gauss-Newton alignment on it, compiled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import cached
from calibration.geometry import Array

Field = NDArray[np.float32]


class Lattice(NamedTuple):
    """A signed distance at the nodes of a cubic grid."""

    values: Field  # (X, Y, Z) mm
    origin: Array  # (3,) mm
    scale: float  # nodes a mm


class _Cloud(NamedTuple):
    """What is aligned."""

    points: Array  # (N, 3) mm
    normals: Array  # (N, 3), zero where unknown


@dataclass(frozen=True, slots=True, eq=False)
class DistanceGrid:
    """Signed distance to a closed surface at the nodes of a cubic grid, negative inside."""

    origin: Array  # (3,) mm, node (0, 0, 0)
    spacing: float  # mm
    values: Field  # (X, Y, Z) mm

    @property
    def lattice(self) -> Lattice:
        """The same as the compiled functions take it."""
        return Lattice(self.values, self.origin, 1.0 / self.spacing)

    def look_up(self, points: Array) -> tuple[Array, Array]:
        """Distances (N,) mm and their gradients (N, 3) at points (N, 3), trilinear; outside: the border plus the way."""
        distance, gradient = np.empty(len(points)), np.empty((len(points), 3))
        _look_up(self.values, self.origin, 1.0 / self.spacing, np.ascontiguousarray(points), distance, gradient)
        return distance, gradient


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """S poses model_from_cloud after alignment, and how well they explain the points."""

    rotation: Array  # (S, 3, 3)
    translation: Array  # (S, 3) mm
    cost: Array  # (S,) 0: every point explained; 1: none (truncated squares)


def align(
    grid: DistanceGrid,
    points: Array,
    normals: Array,
    rotation: Array,
    translation: Array,
    reach: Array,
) -> Aligned:
    """Gauss-Newton alignment of one cloud to one model from many starts.

    Parameters
    ----------
    grid : DistanceGrid
        Of the model.
    points, normals : (N, 3)
        mm, and unit normals out of the surface (zero where unknown: the point then counts whatever it meets).
    rotation, translation : (S, 3, 3), (S, 3)
        Starts model_from_cloud.
    reach : (K,) mm
        Where Tukey's weight ends, one a step: wide first, then narrower.

    Returns
    -------
    Aligned
        The last poses; a start that loses all of its points stays where it was, with cost 1.
    """
    r, t = rotation.copy(), translation.copy()
    cost = np.empty(len(r))
    _align(grid.lattice, _Cloud(points, normals), r, t, reach, cost)
    return Aligned(r, t, cost)


def passes(grid: DistanceGrid, start: Array, end: Array, depth: float, clear: float) -> NDArray[np.bool_]:
    """Whether each segment (N, 3) -> (N, 3) stays out of the model: never deeper inside than ``depth`` mm.

    The first ``clear`` mm are not looked at, so that a point on the surface may start a segment.
    """
    free = np.empty(len(start), dtype=np.bool_)
    _passes(grid.lattice, start, end, depth, clear, free)
    return free


def hidden(full: NDArray[np.bool_], low: Array, voxel: float, start: Array, end: Array) -> NDArray[np.bool_]:
    """Whether each segment (N, 3) -> (N, 3) passes a full voxel, the first three voxels of the way left out.

    ``full`` (X, Y, Z) has its corner at ``low`` (3,) mm and cubes of side ``voxel`` mm.
    """
    found = np.zeros(len(start), dtype=np.bool_)
    _hidden(full, low, voxel, np.ascontiguousarray(start), np.ascontiguousarray(end), found)
    return found


@cached(nogil=True, fastmath=True, inline="always")
def _trilinear(
    values: Field, origin: Array, scale: float, x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    fx, fy, fz = (x - origin[0]) * scale, (y - origin[1]) * scale, (z - origin[2]) * scale
    cx = min(max(fx, 0.0), values.shape[0] - 1.001)
    cy = min(max(fy, 0.0), values.shape[1] - 1.001)
    cz = min(max(fz, 0.0), values.shape[2] - 1.001)
    i, j, k = int(cx), int(cy), int(cz)
    u, v, w = cx - i, cy - j, cz - k
    a00, a01 = values[i, j, k], values[i, j, k + 1]
    a10, a11 = values[i, j + 1, k], values[i, j + 1, k + 1]
    b00, b01 = values[i + 1, j, k], values[i + 1, j, k + 1]
    b10, b11 = values[i + 1, j + 1, k], values[i + 1, j + 1, k + 1]
    a0, a1 = a00 + w * (a01 - a00), a10 + w * (a11 - a10)
    b0, b1 = b00 + w * (b01 - b00), b10 + w * (b11 - b10)
    a, b = a0 + v * (a1 - a0), b0 + v * (b1 - b0)
    d = a + u * (b - a)
    gx = (b - a) * scale
    gy = ((a1 - a0) * (1 - u) + (b1 - b0) * u) * scale
    low = (a01 - a00) * (1 - v) + (a11 - a10) * v
    high = (b01 - b00) * (1 - v) + (b11 - b10) * v
    gz = (low * (1 - u) + high * u) * scale
    ox, oy, oz = (fx - cx) / scale, (fy - cy) / scale, (fz - cz) / scale
    out = ox * ox + oy * oy + oz * oz
    if out > 1e-12:  # outside the grid: go on from its border
        px, py, pz = ox + d * gx, oy + d * gy, oz + d * gz
        d = np.sqrt(px * px + py * py + pz * pz)
        gx, gy, gz = px / d, py / d, pz / d
    return d, gx, gy, gz


@cached(nogil=True, fastmath=True)
def _look_up(values: Field, origin: Array, scale: float, points: Array, distance: Array, gradient: Array) -> None:
    for i in range(len(points)):
        d, gx, gy, gz = _trilinear(values, origin, scale, points[i, 0], points[i, 1], points[i, 2])
        distance[i] = d
        gradient[i, 0], gradient[i, 1], gradient[i, 2] = gx, gy, gz


@cached(nogil=True, fastmath=True)
def _passes(lattice: Lattice, start: Array, end: Array, depth: Any, clear: Any, free: Any) -> None:
    values, origin, scale = lattice
    least = 0.5 / scale
    for i in range(len(start)):
        x, y, z = start[i, 0], start[i, 1], start[i, 2]
        dx, dy, dz = end[i, 0] - x, end[i, 1] - y, end[i, 2] - z
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / length, dy / length, dz / length
        s = clear
        free[i] = True
        while s < length:
            px, py, pz = x + s * dx, y + s * dy, z + s * dz
            fx, fy, fz = (px - origin[0]) * scale, (py - origin[1]) * scale, (pz - origin[2]) * scale
            if (
                (fx < 0 and dx <= 0)
                or (fy < 0 and dy <= 0)
                or (fz < 0 and dz <= 0)
                or (fx > values.shape[0] - 1 and dx >= 0)
                or (fy > values.shape[1] - 1 and dy >= 0)
                or (fz > values.shape[2] - 1 and dz >= 0)
            ):
                break  # leaves the box of the model for good
            d, _, _, _ = _trilinear(values, origin, scale, px, py, pz)
            if d < -depth:
                free[i] = False
                break
            s += max(abs(d + depth), least)


@cached(nogil=True)
def _hidden(full: Any, low: Array, voxel: float, start: Array, end: Array, found: Any) -> None:
    for i in range(len(start)):
        near, far = 3.0 * voxel, 0.0
        for a in range(3):
            far += (end[i, a] - start[i, a]) ** 2
        far = length = np.sqrt(far)
        for a in range(3):  # the stretch of the segment inside the box of voxels
            way = (end[i, a] - start[i, a]) / length
            first, last = low[a] - start[i, a], low[a] + full.shape[a] * voxel - start[i, a]
            if abs(way) < 1e-12:
                if first > 0 or last < 0:
                    far = -1.0
            else:
                near = max(near, min(first / way, last / way))
                far = min(far, max(first / way, last / way))
        s = near
        while s < far:
            x = int((start[i, 0] + s * (end[i, 0] - start[i, 0]) / length - low[0]) / voxel)
            y = int((start[i, 1] + s * (end[i, 1] - start[i, 1]) / length - low[1]) / voxel)
            z = int((start[i, 2] + s * (end[i, 2] - start[i, 2]) / length - low[2]) / voxel)
            if 0 <= x < full.shape[0] and 0 <= y < full.shape[1] and 0 <= z < full.shape[2] and full[x, y, z]:
                found[i] = True
                break
            s += 0.7 * voxel


@cached(nogil=True, fastmath=True)
def _step(h: Array, g: Array, damping: float, x: Array) -> None:
    """Solve (h + damping) x = -g by Cholesky; h is overwritten."""
    for i in range(6):
        h[i, i] += damping * h[i, i] + 1e-9
        for j in range(i + 1):
            s = h[i, j]
            for k in range(j):
                s -= h[i, k] * h[j, k]
            if i == j:
                h[i, i] = np.sqrt(max(s, 1e-12))
            else:
                h[i, j] = s / h[j, j]
    for i in range(6):
        s = -g[i]
        for k in range(i):
            s -= h[i, k] * x[k]
        x[i] = s / h[i, i]
    for i in range(5, -1, -1):
        s = x[i]
        for k in range(i + 1, 6):
            s -= h[k, i] * x[k]
        x[i] = s / h[i, i]


class _Work(NamedTuple):
    """What one alignment works with: normal equations and turns that are overwritten, and what turns are about."""

    h: Array  # (6, 6)
    g: Array  # (6,)
    x: Array  # (6,) the step
    row: Array  # (6,)
    turn: Array  # (3, 3)
    old: Array  # (3, 3)
    middle: Array  # (3,) mm, of the grid
    arm: float  # mm: turns and shifts alike


@cached(nogil=True, fastmath=True, inline="always")
def _gather(lattice: Lattice, cloud: _Cloud, r: Array, t: Array, cut: float, last: bool, work: _Work) -> float:
    """The normal equations at a pose, turns about the middle of the grid; returns the cost (points lost, in parts)."""
    values, origin, scale = lattice
    points, normals = cloud
    h, g, j6, middle, arm = work.h, work.g, work.row, work.middle, work.arm
    inv = 1.0 / (cut * cut)
    h[:] = 0.0
    g[:] = 0.0
    lost = 0.0
    for i in range(len(points)):
        p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
        y0 = r[0, 0] * p0 + r[0, 1] * p1 + r[0, 2] * p2 + t[0]
        y1 = r[1, 0] * p0 + r[1, 1] * p1 + r[1, 2] * p2 + t[1]
        y2 = r[2, 0] * p0 + r[2, 1] * p1 + r[2, 2] * p2 + t[2]
        d, gx, gy, gz = _trilinear(values, origin, scale, y0, y1, y2)
        n0, n1, n2 = normals[i, 0], normals[i, 1], normals[i, 2]
        facing = 1.0
        if n0 != 0.0 or n1 != 0.0 or n2 != 0.0:
            facing = (
                gx * (r[0, 0] * n0 + r[0, 1] * n1 + r[0, 2] * n2)
                + gy * (r[1, 0] * n0 + r[1, 1] * n1 + r[1, 2] * n2)
                + gz * (r[2, 0] * n0 + r[2, 1] * n1 + r[2, 2] * n2)
            )
        e = d * d * inv
        if e >= 1.0 or facing <= 0.0:
            lost += 1.0
            continue
        lost += 1.0 - facing * (1.0 - e) if facing < 1.0 else e
        if last:
            continue
        w = (1.0 - e) * (1.0 - e) * min(facing, 1.0)
        q0, q1, q2 = (y0 - middle[0]) / arm, (y1 - middle[1]) / arm, (y2 - middle[2]) / arm
        j6[0], j6[1], j6[2] = q1 * gz - q2 * gy, q2 * gx - q0 * gz, q0 * gy - q1 * gx
        j6[3], j6[4], j6[5] = gx, gy, gz
        for a in range(6):
            wa = w * j6[a]
            g[a] += wa * d
            for b in range(a + 1):
                h[a, b] += wa * j6[b]
    return lost


@cached(nogil=True, fastmath=True, inline="always")
def _moved(r: Array, t: Array, work: _Work) -> None:
    """Apply the step to a pose, which is overwritten; half a radian at most."""
    x, turn, old, middle, arm = work.x, work.turn, work.old, work.middle, work.arm
    w0, w1, w2 = x[0] / arm, x[1] / arm, x[2] / arm
    angle = np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    shrink = min(1.0, 0.5 / (angle + 1e-12))  # never more than half a radian at once
    w0, w1, w2 = w0 * shrink, w1 * shrink, w2 * shrink
    angle *= shrink
    a1 = 1.0 if angle < 1e-8 else np.sin(angle) / angle
    a2 = 0.5 if angle < 1e-4 else (1.0 - np.cos(angle)) / (angle * angle)
    turn[0, 0], turn[0, 1], turn[0, 2] = 1 - a2 * (w1 * w1 + w2 * w2), a2 * w0 * w1 - a1 * w2, a2 * w0 * w2 + a1 * w1
    turn[1, 0], turn[1, 1], turn[1, 2] = a2 * w0 * w1 + a1 * w2, 1 - a2 * (w0 * w0 + w2 * w2), a2 * w1 * w2 - a1 * w0
    turn[2, 0], turn[2, 1], turn[2, 2] = a2 * w0 * w2 - a1 * w1, a2 * w1 * w2 + a1 * w0, 1 - a2 * (w0 * w0 + w1 * w1)
    old[:] = r
    u0, u1, u2 = t[0] - middle[0], t[1] - middle[1], t[2] - middle[2]
    for a in range(3):
        for b in range(3):
            r[a, b] = turn[a, 0] * old[0, b] + turn[a, 1] * old[1, b] + turn[a, 2] * old[2, b]
        t[a] = middle[a] + turn[a, 0] * u0 + turn[a, 1] * u1 + turn[a, 2] * u2 + x[3 + a] * shrink


@cached(nogil=True, fastmath=True)
def _align(lattice: Lattice, cloud: _Cloud, rotation: Array, translation: Array, reach: Array, cost: Array) -> None:
    n, steps, values = len(cloud.points), len(reach), lattice.values
    middle = np.empty(3)
    for c in range(3):
        middle[c] = lattice.origin[c] + 0.5 * (values.shape[c] - 1) / lattice.scale
    arm = 0.25 * (values.shape[0] + values.shape[1] + values.shape[2]) / 3.0 / lattice.scale
    work = _Work(
        np.empty((6, 6)), np.empty(6), np.zeros(6), np.empty(6), np.empty((3, 3)), np.empty((3, 3)), middle, arm
    )
    for s in range(len(rotation)):
        r, t = rotation[s], translation[s]
        for step in range(steps + 1):
            last = step == steps
            cut = reach[steps - 1] if last else reach[step]
            lost = _gather(lattice, cloud, r, t, cut, last, work)
            if last:
                cost[s] = lost / n
                break
            if lost > 0.98 * n:
                cost[s] = 1.0
                break
            _step(work.h, work.g, 1e-3, work.x)
            _moved(r, t, work)
