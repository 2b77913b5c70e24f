"""Points and edges that the mesh does not explain, and the places where material is missing or added."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools
from scope.model import RoundFeature
from scope.variants.edges import OWN_LOSS, Sight
from scope.variants.system import EDGE_MM, FEW_ROWS, SURE, WIDE, Evidence, Fitted, System
from scope.variants.variant import Variant

LEAST_CLUSTER = 0.008  # of the points, in one place


@dataclass(frozen=True, slots=True, eq=False)
class Misfits:
    """Points that the mesh does not explain."""

    rows: Bools  # (surface rows,) at the robust or the least-squares pose, whichever leaves fewer
    away: Bools  # (N,) points that are no row and lie further off
    hanging: Bools  # (N,) those of them that hang over an edge
    far: Bools  # (N,) all points that lie further off, at the pose as it is
    scale: float  # rows a point

    @property
    def share(self) -> float:
        """Of the points."""
        return float(self.rows.mean() if len(self.rows) else 0.0) + float(self.away.mean())


def misfits_of(evidence: Evidence, sight: Sight, local: Array, nominal: Fitted, system: System) -> Misfits:
    """Misfits of points: limits are three sigma and the tolerance for rows, a little more for single places."""
    surface_rows = ~system.edge
    limit = SURE * np.sqrt(system.variance[surface_rows]) + evidence.tolerance
    full, weight = system.base[surface_rows], 1 / (system.variance + system.group)[surface_rows]
    residual = system.residual[surface_rows]
    h = full[:, :6].T @ (weight[:, None] * full[:, :6]) + np.eye(6) / WIDE**2
    square = residual - full[:, :6] @ np.linalg.solve(h, full[:, :6].T @ (weight * residual))
    rows = min((np.abs(r) > limit for r in (nominal.residual[surface_rows], square)), key=lambda b: int(b.sum()))
    apart = SURE * evidence.scan.sigma + 1.5 * evidence.tolerance
    far = np.abs(local) > apart + 0.05
    far &= evidence.surface.crease_distance(sight.points, EDGE_MM + 0.01) > EDGE_MM
    far &= ~_clutter(evidence, sight, local, far)
    count = len(local)
    away = far & (np.abs(local) > WIDE)
    hanging = far & ~away & _hanging(evidence, sight)
    return Misfits(rows, away | hanging, hanging, far, float(surface_rows.sum()) / max(count, 1))


def _hanging(evidence: Evidence, sight: Sight) -> Bools:
    """Points whose nearest place on the mesh is an edge and not straight below them."""
    closest, normal, _ = evidence.surface.foot(sight.points)
    gap = sight.points - closest
    along = (gap * normal).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum((gap * gap).sum(axis=1) - along**2, 0)) > 0.3 * evidence.scan.sigma + 0.01)


def _clutter(evidence: Evidence, sight: Sight, local: Array, far: Bools) -> Bools:
    """Points (N,) of things that reach out of the part's box by more than its tolerance explains, or stand apart from it."""
    clutter = np.zeros(len(far), dtype=np.bool_)
    if not far.any():
        return clutter
    from scipy.ndimage import label

    low, high = evidence.model.vertices.min(axis=0), evidence.model.vertices.max(axis=0)
    margin = max(4.0, 0.04 * evidence.model.diameter)
    everything = evidence.pose.inverse.apply(evidence.all_points)
    near = ((everything > low - 4 * margin) & (everything < high + 4 * margin)).all(axis=1)
    others = everything[near]
    gap = np.linalg.norm(evidence.surface.nearest(others)[0] - others, axis=1)
    others = others[gap > 0.5]
    cell = max(evidence.model.diameter / 80, 0.5)
    both = np.concatenate([sight.points[far], others])
    index = np.floor((both - both.min(axis=0)) / cell).astype(np.int64) + 1
    full = np.zeros(index.max(axis=0) + 2, dtype=np.bool_)
    full[tuple(index.T)] = True
    number = label(full, structure=np.ones((3, 3, 3)))[0][tuple(index.T)]
    outside = ((both < low - margin) | (both > high + margin)).any(axis=1)
    count = np.bincount(number[outside], minlength=int(number.max()) + 1)
    foreign = count > 5
    inner = local[far] < 0  # nothing else can be inside of the part
    clutter[far] = foreign[number[: int(far.sum())]] & ~inner
    return clutter


def edges_off(system: System, residual: Array, tolerance: float) -> float:
    """Share of the edges that end elsewhere than loss, scatter and tolerance explain."""
    if system.edge.sum() < FEW_ROWS:
        return 0.0
    limit = SURE * np.sqrt(system.variance[system.edge] + OWN_LOSS**2) + tolerance
    return float((np.abs(residual[system.edge]) > limit).mean())


def clusters(evidence: Evidence, sight: Sight, local: Array, off: Misfits) -> list[tuple[Variant, int]]:
    """Places where material is missing or added, with the number of points that say so."""
    rows = np.flatnonzero(off.far)
    if len(rows) == 0:
        return []
    from scipy.ndimage import label

    cell = max(evidence.model.diameter / 60, 1.0)
    found = []
    for inner in (True, False):
        mine = rows[(local[rows] < 0) == inner]
        if len(mine) == 0:
            continue
        index = np.floor((sight.points[mine] - sight.points[mine].min(axis=0)) / cell).astype(np.int64) + 1
        full = np.zeros(index.max(axis=0) + 2, dtype=np.bool_)
        full[tuple(index.T)] = True
        number = label(full, structure=np.ones((3, 3, 3)))[0][tuple(index.T)]
        for k in range(1, int(number.max()) + 1):
            cluster = mine[number == k]
            if len(cluster) >= max(LEAST_CLUSTER * len(local), 30):
                found.append((_place(evidence, sight, local, cluster, inner), len(cluster)))
    return found


def _place(evidence: Evidence, sight: Sight, local: Array, cluster: Array, inner: bool) -> Variant:
    points = sight.points[cluster]
    depth = float(np.median(np.abs(local[cluster])))
    error = float(np.median(evidence.scan.sigma[cluster])) / np.sqrt(len(cluster))
    at = np.median(points, axis=0)
    if inner and sight.camera is not None:
        way = points - sight.camera[cluster]
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        start = points - 3 * evidence.model.diameter * way
        hit = evidence.surface.first_hit(start, way)
        seen = np.isfinite(hit)
        if seen.any():
            there = start[seen] + hit[seen, None] * way[seen]
            normal = evidence.surface.nearest(there)[1]
            at, depth = np.median(there, axis=0), float(np.median(((there - points[seen]) * normal).sum(axis=1)))
    elif inner:
        at = np.median(evidence.surface.nearest(points)[0], axis=0)
    holes = [r for r in evidence.surface.features.rounds if r.hollow and _within(r, at, 0.6)]
    bosses = [r for r in evidence.surface.features.rounds if not r.hollow and _within(r, at, 1.3)]
    place = ", ".join(f"{x:.0f}" for x in at + 0.0)
    if inner:
        what = "boss" if bosses else "material"
        if bosses:
            place = ", ".join(f"{x:.0f}" for x in bosses[0].point + 0.0)
        told = f"the {what} near ({place}) mm of the mesh is not there ({depth:.2g} mm)"
        return Variant("missing", depth, error, "mm", told, at)
    if holes:
        place = ", ".join(f"{x:.0f}" for x in holes[0].point + 0.0)
        return Variant("missing", depth, error, "mm", f"the hole near ({place}) mm of the mesh is not there", at)
    told = f"something near ({place}) mm of the mesh is {depth:.2g} mm more than it has"
    return Variant("extra", depth, error, "mm", told, at)


def _within(feature: RoundFeature, at: Array, factor: float) -> bool:
    arm = at - feature.point
    along = float(arm @ feature.axis)
    across = float(np.linalg.norm(arm - along * feature.axis))
    return across < factor * feature.radius and abs(along) < feature.length + feature.radius
