"""Features of a part: which points lie on each, their values with uncertainty, and the decision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints
from scope.check import Decision, decide
from scope.errors import MeasurementError
from scope.inspection.features_file import Wanted
from scope.inspection.primitives import Fitted, OnPart, fit_hole_feature, fit_plane_feature
from scope.model import Model, Surface

_COPLANAR = 0.01  # rad between the normals of faces of one plane
_CELLS = 20  # of the extent, a side, over which flatness is averaged
_LEAST_IN_CELL = 8


@dataclass(frozen=True, slots=True)
class Value:
    """One measured value."""

    name: str
    kind: str
    nominal: float
    measured: float  # NaN where it could not be
    uncertainty: float  # k = 2
    unit: str
    tolerance: float | None
    decision: Decision | None
    points: int
    scatter: float = float("nan")  # one sigma, of the points
    calibration: float = float("nan")  # one sigma, through the calibration
    reason: str = ""  # why it could not be measured

    @property
    def deviation(self) -> float:
        """Measured less nominal."""
        return self.measured - self.nominal


@dataclass(frozen=True, slots=True, eq=False)
class _Nominal:
    """A plane of the model, or a hole as its file states it."""

    point: Array
    direction: Array
    radius: float = 0.0


def measured_features(
    part: OnPart, model: Model, wanted: Sequence[Wanted], tolerance: float | None, pose: Array | None
) -> list[Value]:
    """Values of all features; one that cannot be measured says why, and is undecided.

    Parameters
    ----------
    part : OnPart
        Points in the frame of the model.
    model : Model
    wanted : sequence of Wanted
    tolerance : float, optional
        mm, of every length that has none of its own.
    pose : (6, 6), optional
        Covariance of the pose (x, y, z mm; turns about x, y, z at the model's origin, rad), for positions.
    """
    surface = Surface(model.vertices, model.faces)
    fitted: dict[str, Fitted] = {}
    nominal: dict[str, _Nominal] = {}
    why: dict[str, str] = {}
    found: list[Value] = []
    for feature in wanted:
        if feature.kind not in {"plane", "hole"}:
            continue
        try:
            nominal[feature.name], fitted[feature.name] = _fit(part, model, surface, feature)
        except MeasurementError as error:
            why[feature.name] = str(error)
    for feature in wanted:
        limit = feature.tolerance if feature.tolerance is not None or feature.kind == "angle" else tolerance
        missing = [name for name in (feature.of or (feature.name,)) if name in why]
        if missing:
            reason = why[missing[0]] if not feature.of else f"{missing[0]}: {why[missing[0]]}"
            unit = "deg" if feature.kind == "angle" else "mm"
            decision: Decision | None = None if limit is None else "undecided"
            nan = float("nan")
            found.append(Value(feature.name, feature.kind, feature.nominal or feature.diameter or nan, nan, nan, unit, limit, decision, 0, reason=reason))  # fmt: skip
        elif feature.kind == "plane":
            found.append(_flatness(part, feature, fitted[feature.name], limit))
        elif feature.kind == "hole":
            found += _hole(feature, fitted[feature.name], nominal[feature.name], limit, tolerance, pose)
        elif feature.of is not None:
            pair = (fitted[feature.of[0]], fitted[feature.of[1]])
            ideal = (nominal[feature.of[0]], nominal[feature.of[1]])
            found.append((_angle if feature.kind == "angle" else _distance)(feature, pair, ideal, limit))
    return found


def _fit(part: OnPart, model: Model, surface: Surface, feature: Wanted) -> tuple[_Nominal, Fitted]:
    if feature.point is None:
        raise MeasurementError("it has no point")
    gate = min(0.6, 0.02 * model.diameter)
    if feature.kind == "hole" and feature.axis is not None and feature.diameter is not None:
        radius = feature.diameter / 2
        arm = part.points - feature.point
        across = arm - (arm @ feature.axis)[:, None] * feature.axis
        near = np.flatnonzero(np.abs(np.linalg.norm(across, axis=1) - radius) < min(gate, 0.3 * radius))
        foot, normal = surface.nearest(part.points[near])
        on_wall = np.abs(normal @ feature.axis) < 0.2
        on_wall &= np.linalg.norm(foot - part.points[near], axis=1) < gate
        rim = surface.crease_distance(foot, 1.0) > min(0.3, 0.1 * radius)
        if not on_wall.any():
            raise MeasurementError(
                f"no point lies on its wall ({len(near)} are near): scan it at a slant, or check its place"
            )
        rows = near[on_wall & rim]
        return _Nominal(feature.point, feature.axis, radius), fit_hole_feature(
            part, rows, feature.point, feature.axis, radius
        )
    faces, normal, place = _face_region(model, surface, feature.point)
    height = (part.points - place) @ normal
    near = np.flatnonzero(np.abs(height) < gate)
    flat = part.points[near] - height[near, None] * normal
    region = Surface(model.vertices, model.faces[faces])
    foot, _ = region.nearest(flat)
    inside = np.linalg.norm(foot - flat, axis=1) < 1e-3 + 1e-5 * model.diameter
    margin = min(gate, 0.1 * float(np.ptp(model.vertices[model.faces[faces]].reshape(-1, 3), axis=0).max()))
    inside &= surface.crease_distance(flat, 2 * margin) > margin
    return _Nominal(place, normal), fit_plane_feature(part, near[inside], normal)


def _face_region(model: Model, surface: Surface, point: Array) -> tuple[Ints, Array, Array]:
    """Faces of the model that lie in one plane with the face nearest to a point; its normal and a point on it."""
    foot, normal = surface.nearest(point[None])
    away = float(np.linalg.norm(foot[0] - point))
    if away > 0.02 * model.diameter:
        raise MeasurementError(
            f"its point lies {away:.3g} mm off the model; give a point on the face, in the model's frame"
        )
    corners = model.vertices[model.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(cross, axis=1)
    cosine = (cross @ normal[0]) / np.maximum(size, 1e-30)
    level = np.abs((corners.mean(axis=1) - foot[0]) @ normal[0])
    faces = np.flatnonzero((cosine > np.cos(_COPLANAR)) & (level < 1e-3 + 1e-5 * model.diameter) & (size > 0))
    if len(faces) == 0:
        raise MeasurementError("its point lies on no flat face of the model; give another")
    return faces, normal[0], foot[0]


def _flatness(part: OnPart, feature: Wanted, fit: Fitted, limit: float | None) -> Value:
    """Range of the deviations from the least squares plane (ISO 12781-1, FLTt), of means over cells that tame the noise."""
    points = (part.points[fit.rows] - fit.origin) @ fit.frame.T
    side = max(float(np.ptp(points[:, :2], axis=0).max()) / _CELLS, 1e-9)
    key = np.floor(points[:, :2] / side).astype(np.int64)
    _, label, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    label = label.ravel()
    least = min(_LEAST_IN_CELL, int(count.max()))
    mean = np.bincount(label, weights=fit.residual) / count
    square = np.bincount(label, weights=(fit.residual - mean[label]) ** 2)
    good = count >= least
    spread = float(np.sqrt(square[good].sum() / max(int((count[good] - 1).sum()), 1)))
    of_mean = spread / np.sqrt(float(np.median(count[good])))
    value = float(np.ptp(mean[good]))
    # the range of n means of pure noise is about 2 sqrt(2 ln n) of their deviation: it is part of what is measured
    noise = 2.0 * float(np.sqrt(2.0 * np.log(max(int(good.sum()), 2)))) * of_mean
    uncertainty = 2.0 * float(np.hypot(np.sqrt(2.0) * of_mean, noise / 2.0))
    decision = decide(value, limit, uncertainty)
    return Value(
        feature.name, "flatness", 0.0, value, uncertainty, "mm", limit, decision, len(fit.rows), uncertainty / 2, 0.0
    )


def _hole(
    feature: Wanted, fit: Fitted, ideal: _Nominal, limit: float | None, usual: float | None, pose: Array | None
) -> list[Value]:
    scatter = 2.0 * float(np.sqrt(fit.random[2, 2]))
    shared = 2.0 * float(np.hypot(np.linalg.norm(fit.shared[2]), fit.local))
    u = 2.0 * float(np.hypot(scatter, shared))
    nominal, size = feature.nominal or 2.0 * ideal.radius, 2.0 * float(fit.value[2])
    found = [Value(feature.name, "diameter", nominal, size, u, "mm", limit, decide(size - nominal, limit, u), len(fit.rows), scatter, shared)]  # fmt: skip
    # position: diameter of the zone about the true place (ISO 1101), in the frame of the whole part's best fit
    off = float(np.linalg.norm(fit.value[:2]))
    towards = fit.value[:2] / off if off > 1e-12 else np.array([1.0, 0.0])
    scatter = 2.0 * float(np.sqrt(towards @ fit.random[:2, :2] @ towards))
    shared = 2.0 * float(np.hypot(np.linalg.norm(towards @ fit.shared[:2]), fit.local))
    if pose is not None:
        direction = towards @ fit.frame[:2]
        moved = np.concatenate([direction, np.cross(fit.origin, direction)])
        shared = float(np.hypot(shared, 2.0 * np.sqrt(max(float(moved @ pose @ moved), 0.0))))
    u = 2.0 * float(np.hypot(scatter, shared))
    zone = feature.position_tolerance if feature.position_tolerance is not None else usual
    found.append(
        Value(f"{feature.name} position", "position", 0.0, 2.0 * off, u, "mm", zone, decide(2.0 * off, zone, u), len(fit.rows), scatter, shared)
    )  # fmt: skip
    return found


def _distance(
    feature: Wanted, pair: tuple[Fitted, Fitted], ideal: tuple[_Nominal, _Nominal], limit: float | None
) -> Value:
    first, second = pair
    if first.kind == "plane":
        normal = first.normal
        at = second.origin + second.value[0] * second.frame[2]
        arm = at - first.origin
        value = float(arm @ normal - first.value[0] * (first.frame[2] @ normal))
        by_first = -np.array([1.0, arm @ first.frame[0], arm @ first.frame[1]])
        by_second = np.array([float(second.frame[2] @ normal), 0.0, 0.0])
        nominal = float((ideal[1].point - ideal[0].point) @ ideal[0].direction)
        if abs(float(ideal[0].direction @ ideal[1].direction)) < 0.999:  # not parallel: at the middle of what was seen
            nominal = float(_on_plane(at, ideal[1]) @ ideal[0].direction - ideal[0].point @ ideal[0].direction)
    else:
        axis = first.frame[2]
        centre = [f.origin + f.value[0] * f.frame[0] + f.value[1] * f.frame[1] for f in pair]
        arm = centre[1] - centre[0]
        arm = arm - (arm @ axis) * axis
        value = float(np.linalg.norm(arm))
        unit = arm / max(value, 1e-12)
        by_first = np.array([-unit @ first.frame[0], -unit @ first.frame[1], 0.0])
        by_second = np.array([unit @ second.frame[0], unit @ second.frame[1], 0.0])
        between = ideal[1].point - ideal[0].point
        nominal = float(np.linalg.norm(between - (between @ axis) * axis))
    if feature.nominal is not None:
        nominal = feature.nominal
    if nominal < 0 or (nominal == 0 and value < 0):
        value, nominal = -value, -nominal
    scatter = float(np.sqrt(by_first @ first.random @ by_first + by_second @ second.random @ by_second))
    moved = by_first @ first.shared + by_second @ second.shared
    shared = float(np.sqrt((moved**2).sum() + first.local**2 + second.local**2))
    u = 2.0 * float(np.hypot(scatter, shared))
    points = len(first.rows) + len(second.rows)
    return Value(
        feature.name,
        feature.kind,
        nominal,
        value,
        u,
        "mm",
        limit,
        decide(value - nominal, limit, u),
        points,
        scatter,
        shared,
    )


def _on_plane(point: Array, plane: _Nominal) -> Array:
    return np.asarray(point - ((point - plane.point) @ plane.direction) * plane.direction)


def _angle(
    feature: Wanted, pair: tuple[Fitted, Fitted], ideal: tuple[_Nominal, _Nominal], limit: float | None
) -> Value:
    """Angle between outward normals, degrees."""
    first, second = pair
    cosine = float(np.clip(first.normal @ second.normal, -1, 1))
    value = float(np.degrees(np.arccos(cosine)))
    nominal = float(np.degrees(np.arccos(np.clip(ideal[0].direction @ ideal[1].direction, -1, 1))))
    if feature.nominal is not None:
        nominal = feature.nominal
    sine = max(float(np.sin(np.radians(value))), 1e-3)
    by = [
        np.array([0.0, float(one.frame[0] @ other.normal), float(one.frame[1] @ other.normal)]) / sine
        for one, other in ((first, second), (second, first))
    ]
    scatter = float(np.degrees(np.sqrt(by[0] @ first.random @ by[0] + by[1] @ second.random @ by[1])))
    moved = by[0] @ first.shared + by[1] @ second.shared
    local = [
        f.local / max(f.extent, 1e-9) for f in pair
    ]  # what differs from place to place, over the plane's own extent
    shared = float(np.degrees(np.sqrt((moved**2).sum() + local[0] ** 2 + local[1] ** 2)))
    u = 2.0 * float(np.hypot(scatter, shared))
    points = len(first.rows) + len(second.rows)
    return Value(
        feature.name,
        "angle",
        nominal,
        value,
        u,
        "deg",
        limit,
        decide(value - nominal, limit, u),
        points,
        scatter,
        shared,
    )
