"""Spheres, cylinders and planes through points: geometric least squares with the noise cut off, and what is known of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Bools, Ints
from scope.errors import MeasurementError
from scope.model import patches

CUT = 3.5  # robust standard deviations beyond which a point is no part of the artefact
LEAST = 50  # points
TRIALS = 600  # planes through three points that are tried as levels


@dataclass(frozen=True, slots=True, eq=False)
class PlaceErrors:
    """What is known of a fitted centre; along an axis nothing is."""

    scatter: Array  # (3, 3) mm2, covariance from the scatter, neighbours' errors alike
    shared: Array  # (3, K) mm, movement by each of the K errors of the calibration, one sigma
    slope: Array  # (3,) mm, movement by what slopes do to a stripe, one sigma


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A fitted sphere, cylinder or plane."""

    kind: str  # "sphere" | "cylinder" | "plane"
    point: Array  # (3,) mm: centre, a point of the axis, a point of the plane
    direction: Array  # (3,) unit: axis or normal; zero for a sphere
    radius: float  # mm; 0 for a plane
    radius_se: float  # mm, standard error of the radius from the scatter, neighbours' errors alike; 0 for a plane
    radius_shared: float  # mm, standard deviation of the radius through the calibration
    radius_slope: float  # mm, the same through what slopes do to a stripe
    used: Bools  # (N,) points that took part
    residual: Array  # (N,) mm, outside positive
    place: PlaceErrors | None = None  # of the centre of a sphere or cylinder

    def nearest(self, points: Array) -> Array:
        """Nearest points (N, 3) mm on the shape."""
        residual, normal = _residual(self.kind, points, self.point, self.direction, self.radius)
        return np.asarray(points - residual[:, None] * normal)


def fit_shape(
    kind: str,
    points: Array,
    start: tuple[Array, Array, float],
    ray: Array | None,
    shared: Array,
    sigma: Array,
    *,
    reach: float,
) -> Shape:
    """Least squares of the distances from a shape, beginning near it; see `Shape`.

    Parameters
    ----------
    kind : str
        "sphere", "cylinder" or "plane".
    points : (N, 3) mm
        More than the artefact may be among them.
    start : (point, direction, radius)
        Within about ``reach`` of the truth.
    ray : (N, 3), optional
        Unit sighting rays.
    shared : (N, 3, K) mm
        How K independent errors of the calibration move each point, one sigma.
    sigma : (N,) mm
        Of the points themselves. On a slope a stripe is displaced by what its width and brightness do there: this is taken
        to be one sigma at grazing sight, nothing where the surface faces the camera, and alike all over.
    reach : float, mm
        Points further away than this never take part.

    Raises
    ------
    MeasurementError
        Fewer than 50 points near the shape, or, but for a plane, no crowding of them on it.
    """
    point, direction, radius = start
    limit, spread = reach, 0.0
    residual, used = np.zeros(len(points)), np.zeros(len(points), dtype=np.bool_)
    jacobian = np.zeros((0, 7))
    for _ in range(25):
        residual, normal = _residual(kind, points, point, direction, radius)
        used = np.abs(residual) < limit
        if used.sum() < LEAST:
            raise MeasurementError(
                f"only {int(used.sum())} points lie within {limit:.2g} mm of the {kind}, {LEAST} needed; "
                "give its region, or check its size"
            )
        jacobian = _jacobian(kind, points[used], normal[used], point, direction)
        step = np.linalg.lstsq(jacobian, -residual[used], rcond=1e-10)[0]
        point = point + step[:3]
        direction = _unit(direction + step[3:6]) if direction.any() else direction
        radius = radius + float(step[6])
        spread = 1.4826 * float(np.median(np.abs(residual[used] - np.median(residual[used]))))
        narrower = min(reach, max(CUT * spread, 1e-6))
        if np.linalg.norm(step) < 1e-9 and abs(narrower - limit) < 1e-3 * limit:
            break
        limit = narrower
    residual, normal = _residual(kind, points, point, direction, radius)
    errors, place = (0.0, 0.0, 0.0), None
    if kind != "plane":
        if spread > 0.55 * reach:  # 0.74 of it where points are spread evenly
            raise MeasurementError(
                f"the points nearest to a {kind} spread over the whole {2 * reach:.2g} mm about it that were looked at; "
                f"no {kind} of this size is there: give its region, or check its size"
            )
        patch = patches(points[used], radius / 5)
        sight = None if ray is None else ray[used]
        errors, place = _errors(jacobian, residual[used], normal[used], patch, sight, shared[used], sigma[used])
    return Shape(kind, point, direction, radius, *errors, used, residual, place)


def _residual(kind: str, points: Array, point: Array, direction: Array, radius: float) -> tuple[Array, Array]:
    offset = points - point
    if kind == "plane":
        return offset @ direction, np.broadcast_to(direction, points.shape)
    if kind == "cylinder":
        offset = offset - (offset @ direction)[:, None] * direction
    length = np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
    return length - radius, offset / length[:, None]


def _jacobian(kind: str, points: Array, normal: Array, point: Array, direction: Array) -> Array:
    """Derivatives (N, 7) of the residuals by point, direction and radius."""
    j = np.zeros((len(points), 7))
    j[:, :3] = -normal
    if kind == "cylinder":
        j[:, 3:6] = -normal * ((points - point) @ direction)[:, None]
    elif kind == "plane":
        offset = points - point
        j[:, :3] = -direction
        j[:, 3:6] = offset - (offset @ direction)[:, None] * direction  # a turn, no stretching
    if kind != "plane":
        j[:, 6] = -1.0
    return j  # motion of the point along an axis or in a plane changes nothing: minimum-norm least squares leaves it


def _errors(
    jacobian: Array, residual: Array, normal: Array, patch: Ints, ray: Array | None, shared: Array, sigma: Array
) -> tuple[tuple[float, float, float], PlaceErrors]:
    """Of the radius: standard error from the scatter, standard deviations through the calibration and through slopes; the same of the centre.

    Residuals within a patch may be correlated in any way (Liang & Zeger 1986).
    """
    solve = np.linalg.pinv(jacobian, rcond=1e-10)[[0, 1, 2, 6]]  # (4, N): the centre, then the radius
    push = np.stack([np.bincount(patch, weights=row * residual) for row in solve])
    groups = push.shape[1]
    scatter = push @ push.T * groups / max(groups - 7, 1)
    moved, slope = np.zeros((4, 1)), np.zeros(4)
    if ray is not None:
        along = (normal * ray).sum(axis=1)  # -1 where the surface faces the camera
        moved = solve @ np.einsum("ni,nik->nk", normal, np.nan_to_num(shared))
        slope = solve @ (np.nan_to_num(sigma) * (1.0 - np.abs(along)))
    radius = (float(np.sqrt(scatter[3, 3])), float(np.linalg.norm(moved[3])), float(abs(slope[3])))
    return radius, PlaceErrors(scatter[:3, :3], moved[:3], slope[:3])


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def find_sphere(points: Array, normals: Array, radius: float) -> Array:
    """Centre (3,) mm of the sphere of about this radius on which most points lie, from their outward normals.

    Each point with a normal votes for a centre one radius below it; the fullest cube of a twentieth of the radius wins.
    """
    votes = (points - radius * normals)[normals.any(axis=1)]
    return _fullest(votes, radius / 10)


def find_cylinder(points: Array, normals: Array, radius: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Point and direction of the axis of the cylinder of about this radius on which most points lie.

    Each point with a normal votes for a place on the axis; the line through two votes with most others near it wins.
    """
    votes = (points - radius * normals)[normals.any(axis=1)]
    if len(votes) < LEAST:
        raise MeasurementError(f"only {len(votes)} points have a normal, {LEAST} needed; scan more densely")
    some = votes[rng.permutation(len(votes))[:1500]]
    best, answer = -1, (votes[0], np.array([0.0, 0.0, 1.0]))
    for _ in range(400):
        a, b = some[rng.integers(len(some), size=2)]
        length = float(np.linalg.norm(b - a))
        if length < 0.2 * radius:
            continue
        axis = (b - a) / length
        offset = some - a
        gap = np.linalg.norm(offset - (offset @ axis)[:, None] * axis, axis=1)
        count = int((gap < 0.05 * radius).sum())
        if count > best:
            best, answer = count, (a, axis)
    point, axis = answer
    offset = votes - point
    near = np.linalg.norm(offset - (offset @ axis)[:, None] * axis, axis=1) < 0.1 * radius
    middle = votes[near].mean(axis=0)
    return middle, np.linalg.svd(votes[near] - middle, full_matrices=False)[2][0]


def _fullest(votes: Array, side: float) -> Array:
    if len(votes) < LEAST:
        raise MeasurementError(f"only {len(votes)} points have a normal, {LEAST} needed; scan more densely")
    cell, count = np.unique(np.floor(votes / side).astype(np.int64), axis=0, return_counts=True)
    centre = (cell[np.argmax(count)] + 0.5) * side
    for _ in range(5):
        near = np.linalg.norm(votes - centre, axis=1) < side
        if not near.any():
            break
        centre = votes[near].mean(axis=0)
    return np.asarray(centre)


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Parallel planes: a base and steps on it."""

    normal: Array  # (3,) unit, from the base towards the camera
    offset: Array  # (K,) mm, normal . x of each level, the base first
    covariance: Array  # (K, K) mm2 of the offsets, from the scatter
    level: NDArray[np.int64]  # (N,) of each point, -1 for none
    residual: Array  # (N,) mm from its level, 0 for none


def fit_levels(
    points: Array,
    seeds: Array,
    normals: Array,
    towards: Array,
    heights: Array,
    rng: np.random.Generator,
    *,
    sigma: Array | None = None,
) -> Levels:
    """Parallel planes at about these heights (K - 1,) mm above a base, among points (N, 3) that may lie on none of them.

    ``seeds`` (M, 3) are some of the points, with their normals (M, 3) out of the surface, zero where unknown.
    Planes through three points, that a point's normal says may lie on one level, are tried as each of the levels; the one
    at whose comb of heights most points lie is refined: one normal and an offset a level, by least squares with the noise
    cut off; points less certain than most, by their ``sigma`` (N,) mm, weigh less.

    Raises
    ------
    MeasurementError
        A level with fewer than 50 points, or one that is not flat.
    """
    levels = np.concatenate([[0.0], heights])
    window = min(0.4 * float(np.diff(np.sort(levels)).min()), 1.0)
    flat = normals.any(axis=1)
    seeds, normals = seeds[flat], normals[flat]
    if len(seeds) < LEAST:
        raise MeasurementError(f"only {len(seeds)} points have a normal, {LEAST} needed; scan more densely")
    best, normal, base = -1, towards, 0.0
    for _ in range(TRIALS):
        k = int(rng.integers(len(seeds)))
        level = np.flatnonzero(np.abs((seeds - seeds[k]) @ normals[k]) < window)
        a, (b, c) = seeds[k], seeds[rng.choice(level, 2)]
        cross = np.cross(b - a, c - a)
        length = float(np.linalg.norm(cross))
        if length < 1e-6:
            continue
        trial = cross / length * (1.0 if cross @ towards > 0 else -1.0)
        along = seeds @ trial
        for height in levels:
            offset = float(a @ trial) - height
            held = [int((np.abs(along - offset - h) < 0.15 * window).sum()) for h in levels]
            count = sum(held) if min(held) > 0 else 0
            if count > best:
                best, normal, base = count, trial, offset
    weight = np.ones(len(points))
    if sigma is not None and (known := np.isfinite(sigma) & (sigma > 0)).any():
        usual = float(np.median(sigma[known]))
        weight = np.where(known, usual / np.maximum(sigma, usual), 1.0)
    found = _refined_levels(points, normal, base + levels, window, weight)
    measured = found.offset - found.offset[0]
    if (np.abs(measured - levels) > 2 * window).any():
        bad = int(np.argmax(np.abs(measured - levels)))
        raise MeasurementError(
            f"the step of {levels[bad]:g} mm is not there (what comes nearest is {measured[bad]:.3g} mm high); name only steps "
            "that were scanned, or give their region"
        )
    return found


def _refined_levels(points: Array, normal: Array, offset: Array, window: float, weight: Array) -> Levels:
    limit = np.full(len(offset), window)
    level = np.zeros(len(points), dtype=np.int64)
    residual, covariance = np.zeros(len(points)), np.zeros((len(offset), len(offset)))
    for _ in range(20):
        gap = (points @ normal)[:, None] - offset
        level = np.argmin(np.abs(gap), axis=1)
        residual = gap[np.arange(len(points)), level]
        level = np.where(np.abs(residual) < limit[level], level, -1)
        count = np.bincount(level[level >= 0], minlength=len(offset))
        if count.min() < LEAST:
            bad = int(np.argmin(count))
            name = "the base" if bad == 0 else f"the step of {offset[bad] - offset[0]:.3g} mm"
            raise MeasurementError(
                f"{name} has {int(count[bad])} points, {LEAST} needed; name only steps that were scanned, or give a region "
                "that holds them and their base"
            )
        rows = np.flatnonzero(level >= 0)
        axes = np.linalg.svd(normal[None])[2][1:]
        centre = points[rows].mean(axis=0)
        j = np.concatenate([(points[rows] - centre) @ axes.T, -np.eye(len(offset))[level[rows]]], axis=1)
        w = weight[rows]
        step = np.linalg.lstsq(w[:, None] * j, -w * residual[rows], rcond=None)[0]
        local = offset - normal @ centre + step[2:]
        normal = _unit(normal + step[:2] @ axes)
        offset = local + normal @ centre
        for k in range(len(offset)):
            mine = residual[level == k]
            spread = 1.4826 * float(np.median(np.abs(mine - np.median(mine))))
            limit[k] = min(window, max(CUT * spread, 1e-6))
        push = np.linalg.pinv(w[:, None] * j)[2:] * (w * (residual[rows] + j @ step))  # neighbours' errors may be alike
        patch = patches(points[rows], float(np.ptp(points[rows], axis=0).max()) / 40)
        pushes = np.stack([np.bincount(patch, weights=row) for row in push])
        covariance = pushes @ pushes.T * len(pushes.T) / max(len(pushes.T) - j.shape[1], 1)
        if np.abs(step).max() < 1e-9:
            break
    if (limit > 0.8 * window).any():
        bad = int(np.argmax(limit))
        name = "the base" if bad == 0 else f"the step of {offset[bad] - offset[0]:.3g} mm"
        raise MeasurementError(
            f"{name} is not flat: its points spread over the whole {window:.2g} mm about it; these are not the steps named, "
            "or more than the steps is in the region"
        )
    return Levels(normal, offset, covariance, level, np.where(level >= 0, residual, 0.0))
