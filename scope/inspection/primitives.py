"""Planes and holes fitted to the points that lie on them, each with what every point's error does to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Ints
from scope.errors import MeasurementError
from scope.model import patches

_TRIM = 3.5  # robust standard deviations
_LEAST = 30  # points
_SLANT = 0.5  # of sigma: what a stripe does on a slope that faces the sensor badly


@dataclass(frozen=True, slots=True, eq=False)
class OnPart:
    """Points of a scan in the frame of the model, with their errors."""

    points: Array  # (N, 3) mm
    ray: Array | None  # (N, 3) unit sighting rays, model frame; None where unknown
    sigma: Array  # (N,) mm along the ray
    sigma_cal: Array  # (N,) mm along the ray
    shared: Array  # (N, 3, K) mm, one standard deviation of each of K errors of the calibration
    local: Array  # (N,) mm along the ray, what the calibration leaves unexplained from place to place

    def along(self, direction: Array, rows: Ints) -> Array:
        """Cosine (n,) by which an error along the ray moves points along directions (3,) or (n, 3); 1 where rays are not known."""
        if self.ray is None:
            return np.ones(len(rows))
        return np.asarray((self.ray[rows] * direction).sum(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Parameters of a primitive: of a plane (height, two slopes), of a hole (two coordinates of its axis, radius)."""

    kind: str
    frame: Array  # (3, 3) rows x, y, z: z the normal, or the axis
    origin: Array  # (3,) mm: the middle of the points, or the nominal axis there
    value: Array  # (3,)
    random: Array  # (3, 3)
    shared: Array  # (3, K)
    local: float  # mm, what the calibration leaves unexplained from place to place
    rows: Ints  # points that took part
    residual: Array  # (len(rows),) mm
    extent: float  # mm, rms spread of the points about their middle

    @property
    def normal(self) -> Array:
        """Unit normal of a plane."""
        tilted = self.frame[2] - self.value[1] * self.frame[0] - self.value[2] * self.frame[1]
        return np.asarray(tilted / np.linalg.norm(tilted))


def fit_plane_feature(part: OnPart, rows: Ints, normal: Array) -> Fitted:
    """Least squares plane of points (rows of ``part``) whose normal is about ``normal`` (3,).

    Raises
    ------
    MeasurementError
        Too few points, or points on a line.
    """
    _enough(rows)
    frame = _frame(normal)
    origin = part.points[rows].mean(axis=0)
    for _ in range(4):
        local = (part.points[rows] - origin) @ frame.T
        design = np.column_stack([np.ones(len(rows)), local[:, :2]])
        value, residual, influence = _solved(design, local[:, 2])
        keep = _sound(residual)
        if keep.all():
            break
        rows = rows[keep]
        _enough(rows)
    extent = np.sort(np.linalg.svd(local[:, :2] - local[:, :2].mean(axis=0), compute_uv=False)) / np.sqrt(len(rows))
    if extent[0] < 0.02 * extent[1]:
        raise MeasurementError("its points lie on one line; scan more of it")
    direction = np.broadcast_to(normal, (len(rows), 3))
    return _with_errors("plane", part, rows, frame, origin, (value, residual, influence), direction)


def fit_hole_feature(part: OnPart, rows: Ints, point: Array, axis: Array, radius: float) -> Fitted:
    """Circle across an axis through the points of a hole's wall; the axis keeps its nominal direction.

    Raises
    ------
    MeasurementError
        Too few points, or less than a third of the wall.
    """
    _enough(rows)
    frame = _frame(axis)
    value = np.array([0.0, 0.0, radius])
    for _ in range(8):
        local = (part.points[rows] - point) @ frame.T
        arm = local[:, :2] - value[:2]
        length = np.linalg.norm(arm, axis=1)
        out = arm / length[:, None]
        design = np.column_stack([out, np.ones(len(rows))])
        step, residual, influence = _solved(design, length - value[2])
        value = value + step
        keep = _sound(residual)
        if not keep.all():
            rows = rows[keep]
            _enough(rows)
    local = (part.points[rows] - point) @ frame.T
    arm = local[:, :2] - value[:2]
    length = np.linalg.norm(arm, axis=1)
    out = arm / length[:, None]
    _, residual, influence = _solved(np.column_stack([out, np.ones(len(rows))]), length - value[2])
    seen = np.unique(np.floor((np.arctan2(out[:, 1], out[:, 0]) + np.pi) / (np.pi / 18)).astype(int))
    if len(seen) < 12:
        raise MeasurementError(
            f"{10 * len(seen)} degrees of its wall are seen, 120 are needed: scan it from other sides"
        )
    along = (part.points[rows] - point) @ axis
    return _with_errors(
        "hole", part, rows, frame, point + axis * along.mean(), (value, residual, influence), out @ frame[:2]
    )


def _with_errors(
    kind: str,
    part: OnPart,
    rows: Ints,
    frame: Array,
    origin: Array,
    solved: tuple[Array, Array, Array],
    direction: Array,
) -> Fitted:
    """Errors of patches correlated in any way (sandwich), never less than sigma alone makes; the calibration's by its own parameters."""
    value, residual, influence = solved
    side = max(float(np.ptp(part.points[rows], axis=0).max()) / 12, 1e-6)
    label = patches(part.points[rows], side)
    groups = int(label.max()) + 1
    summed = np.stack([np.bincount(label, weights=row * residual, minlength=groups) for row in influence])
    cosine = part.along(direction, rows)
    noise = (influence * (part.sigma[rows] * cosine)) @ (influence * (part.sigma[rows] * cosine)).T
    random = summed @ summed.T * groups / max(groups - 3, 1)
    larger = np.maximum(np.diag(noise) / np.maximum(np.diag(random), 1e-30), 1.0)
    random = random * np.sqrt(np.outer(larger, larger))
    facing = np.broadcast_to(direction, (len(rows), 3))
    shared = influence @ np.einsum("ni,nik->nk", facing, part.shared[rows])
    # a stripe on a slope is displaced by up to about its sigma, alike all over
    bent = float(np.mean(part.sigma[rows] * np.abs(cosine) * (1.0 - np.abs(cosine)))) * _SLANT
    local = float(np.hypot(np.median(part.local[rows] * np.abs(cosine)), bent))
    extent = float(np.sqrt(((part.points[rows] - part.points[rows].mean(axis=0)) ** 2).sum(axis=1).mean()))
    return Fitted(kind, frame, origin, value, random, shared, local, rows, residual, extent)


def _solved(design: Array, right: Array) -> tuple[Array, Array, Array]:
    influence = np.asarray(np.linalg.pinv(design), dtype=np.float64)
    value = influence @ right
    return value, right - design @ value, influence


def _sound(residual: Array) -> Bools:
    spread = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
    return np.asarray(np.abs(residual) <= _TRIM * max(spread, 1e-9))


def _enough(rows: Ints) -> None:
    if len(rows) < _LEAST:
        raise MeasurementError(f"{len(rows)} points lie on it, {_LEAST} are needed: scan it, or check its place")


def _frame(z: Array) -> Array:
    x = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
