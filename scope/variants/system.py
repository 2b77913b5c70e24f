"""The linear system of a pose and of the variants of its part: rows of a scan, columns, and its robust solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Pose
from scope.model import Model, Scanned, Surface, patches
from scope.variants.edges import LOSS, OWN_LOSS, Sight, rims_of
from scope.variants.hypotheses import Rows

CAP = 8.0  # nats: a point that is not explained
WIDE = 3.0  # mm: a face further off is no dimension of this part
FORM = 0.01  # mm, one sigma, of single points beside their noise
SURE = 3.0  # standard errors
SLANT = 0.3  # cosine to the camera below which a surface is not taken to be known better still across it
EDGE_MM = 0.6  # mm from a sharp edge within which a stripe is smeared
FEW_ROWS = 20
MOST_ROWS = 4000


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """A scan of a part at its best pose, and by how much the part may differ from its mesh."""

    model: Model
    surface: Surface
    pose: Pose  # cloud_from_model
    scan: Scanned  # (N) points
    laser: Array | None  # (N, 3) mm
    shared: Array  # (N, K) mm along the sighting ray, for unit errors of the calibration; K may be 0
    all_points: Array  # (A, 3) mm of the whole cloud
    tolerance: float  # mm


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """Rows of the linear system: the points on the surface, then the ends of the scan at edges."""

    rows: Rows
    residual: Array  # (R,) mm
    variance: Array  # (R,) mm2, of single rows
    group: Array  # (R,) mm2: what rows of one face share, times their number
    base: Array  # (R, 7) motion (mm at half a diameter) and the loss at edges
    shared: Array  # (R, K)
    patch: Array  # (R,) number of the patch whose errors may be alike
    edge: Bools  # (R,) which are ends at edges


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """The system solved with the columns of one hypothesis."""

    size: Array  # (k,)
    covariance: Array  # (k, k)
    effect: (
        float  # mm: half of the range that it moves rows apart, the pose free, a score of rows left out at either end
    )
    residual: Array  # (R,) mm left


def system_of(evidence: Evidence) -> tuple[System, Sight, Array]:
    """The linear system at the pose, the scan in the model's frame, and its feet's signed distances (N,)."""
    surface, radius, centre = evidence.surface, evidence.model.diameter / 2, evidence.model.centre
    sight = Sight.of(evidence.pose, evidence.scan.points, evidence.scan.camera, evidence.laser)
    closest, normal, triangle = surface.foot(sight.points)
    gap = sight.points - closest
    residual = (gap * normal).sum(axis=1)
    aside = np.sqrt(np.maximum((gap * gap).sum(axis=1) - residual**2, 0.0))
    slope, along = _slope(sight, normal)
    clear = surface.crease_distance(closest, EDGE_MM) > np.minimum(3 * evidence.scan.sigma, EDGE_MM)
    good = (np.abs(residual) < WIDE) & (aside < 0.3 * evidence.scan.sigma + 0.01) & (slope > 0.1) & clear
    chosen = np.flatnonzero(good)
    chosen = (
        chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), MOST_ROWS)).astype(np.int64)] if len(chosen) else chosen
    )
    rims = rims_of(surface, surface.features.edges, sight, max(1.0, evidence.model.diameter / 150))
    rows = Rows(
        np.concatenate([closest[chosen], rims.at]),
        np.concatenate([normal[chosen], rims.out]),
        np.concatenate([triangle[chosen], rims.other]),
    )
    single = (evidence.scan.sigma[chosen] * np.maximum(slope[chosen], SLANT)) ** 2 + FORM**2
    face = surface.features.face_of[triangle[chosen]]
    patch = patches(closest[chosen], radius / 10)
    of = np.where(face >= 0, face, patch + len(surface.features.faces))
    shares = np.unique(of, return_inverse=True)[1].ravel()
    group = np.bincount(shares)[shares] * (0.5 * evidence.tolerance) ** 2 if len(chosen) else np.zeros(0)
    edge = np.arange(len(rows.at)) >= len(chosen)
    base = np.column_stack([-rows.normal, -np.cross(rows.at - centre, rows.normal) / radius, -edge.astype(np.float64)])
    shared = np.zeros((len(rows.at), evidence.shared.shape[1]))
    shared[: len(chosen)] = along[chosen, None] * evidence.shared[chosen]
    walls = patches(rims.at, radius / 10) + (patch.max(initial=-1) + 1)
    system = System(
        rows,
        np.concatenate([residual[chosen], rims.beyond]),
        np.concatenate([single, rims.sigma**2]),
        np.concatenate([group, rims.variance - rims.sigma**2]),
        base,
        shared,
        np.concatenate([patch, walls]),
        edge,
    )
    distance = np.linalg.norm(gap, axis=1)
    inside = np.where(aside < 0.3 * evidence.scan.sigma + 0.01, residual < 0, False)
    doubtful = np.flatnonzero((aside >= 0.3 * evidence.scan.sigma + 0.01) & (distance > 0.05))
    inside[doubtful] = surface.inside(sight.points[doubtful]) if len(doubtful) else False
    return system, sight, np.where(inside, -distance, distance)


def _slope(sight: Sight, normal: Array) -> tuple[Array, Array]:
    """Cosine (N,) between surface and the way to the camera (1 where unknown), and the residual for 1 mm along the ray."""
    if sight.camera is None:
        return np.ones(len(normal)), np.zeros(len(normal))
    ray = sight.camera - sight.points
    cosine = (ray * normal).sum(axis=1) / np.linalg.norm(ray, axis=1)
    return cosine, -cosine


_WIDE = (WIDE, WIDE, 0.6 * WIDE, 0.4 * WIDE, 0.3 * WIDE, 0.2 * WIDE)
_SCHEDULES = (
    (_WIDE, True),
    (_WIDE, False),
    ((), True),
)  # cuts on the way, and whether a face counts once or by its points


def solved(system: System, columns: Array, tolerance: float) -> Fitted:
    """Iterated least squares of motion, loss at edges and the numbers of a hypothesis: the best of three ways to it."""
    k = columns.shape[1]
    unit = np.append(np.ones(7), np.maximum(np.abs(columns).max(axis=0, initial=0.0), 1e-9))  # all in mm
    full = np.column_stack([system.base, columns]) / unit
    prior = np.append(np.full(6, 3.0), [LOSS, *[3.0] * k])  # mm
    least, best = np.inf, (np.zeros(7 + k), np.zeros(len(full)))
    for cuts, grouped in _SCHEDULES:
        x, weight = _iterated(system, full, prior, (*cuts, *[_last(system, tolerance)] * 3), grouped)
        cost = cost_of(system, system.residual + full @ x, tolerance) + 0.5 * float((x[6:] ** 2 / prior[6:] ** 2).sum())
        if cost < least:
            least, best = cost, (x, weight)
    return _told(system, full, prior, *best, unit[7:])


def _last(system: System, tolerance: float) -> float:
    usual = float(np.median(np.sqrt(system.variance))) if len(system.variance) else 0.1
    return max(4 * usual, 2.5 * tolerance)


def _iterated(system: System, full: Array, prior: Array, cuts: tuple[float, ...], grouped: bool) -> tuple[Array, Array]:
    x = np.zeros(full.shape[1])
    variance = system.variance + (system.group if grouped else np.where(system.edge, system.group, 0.0))
    wide = 4 * np.sqrt(system.variance)
    weight, left = np.zeros(len(full)), system.residual
    for cut in cuts:
        weight = (1 - np.minimum((left / np.maximum(cut, wide)) ** 2, 1.0)) ** 2 / variance
        weighted = full * weight[:, None]
        x = np.linalg.solve(full.T @ weighted + np.diag(1 / prior**2), -weighted.T @ system.residual)
        left = system.residual + full @ x
    return x, weight


def _told(system: System, full: Array, prior: Array, x: Array, weight: Array, unit: Array) -> Fitted:
    """Sizes with their covariance: errors of one patch alike in any way, those of the calibration shared by all."""
    k, left = len(unit), system.residual + full @ x
    if k == 0 or not (weight > 0).any():
        return Fitted(np.zeros(k), np.full((k, k), 1e6) * np.eye(k), 0.0, left)
    h = full.T @ (weight[:, None] * full) + np.diag(1 / prior**2)
    inverse = np.linalg.inv(h)
    a = inverse @ (full * weight[:, None]).T
    pushes = np.stack([np.bincount(system.patch, weights=row) for row in a * left])
    move = a @ system.shared
    noise = (a * (system.variance + np.where(system.edge, system.group, 0.0))) @ a.T
    many = len(pushes.T)
    total = max(1.0, many / max(many - len(x), 1.0)) * pushes @ pushes.T + move @ move.T
    total = total + noise + inverse @ np.diag(1 / prior**2) @ inverse
    # the hypothesis as the pose cannot undo it
    free = full[:, 7:] - full[:, :7] @ np.linalg.solve(h[:7, :7], full[:, :7].T @ (weight[:, None] * full[:, 7:]))
    moved = np.sort(free[weight * (system.variance + system.group) > 0.1] @ x[7:])
    effect = 0.5 * float(moved[-FEW_ROWS] - moved[FEW_ROWS - 1]) if len(moved) > 4 * FEW_ROWS else 0.0
    return Fitted(x[7:] / unit, total[7:, 7:] / np.outer(unit, unit), effect, left)


def along(fit: Fitted) -> float:
    """Variance of the length of the fitted size."""
    length = np.linalg.norm(fit.size)
    unit = fit.size / length if length > 0 else np.ones(len(fit.size)) / np.sqrt(len(fit.size))
    return float(unit @ fit.covariance @ unit)


def cost_of(system: System, residual: Array, tolerance: float) -> float:
    """Nats of the rows, those at edges by the length of edge that they stand for."""
    variance = system.variance + (0.5 * tolerance) ** 2 + np.where(system.edge, OWN_LOSS**2, 0.0)
    return float(np.minimum(residual**2 / (2 * variance), CAP).sum())
