"""What two scans say of the same surface: where they overlap, how far they are apart, and whether they contradict each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Ints, Pose
from scope.merge.patch import Patch

_MEAN_OF = 6  # points of the other scan about a foot
_ALIKE = 0.7  # cosine between normals of the same surface
_TIGHT = 4.0  # standard deviations
_FIRM = 1.5  # times the noise: what edges add, up to which a gap is compared
_CURVED = 0.03  # of the spacing: what curvature does between neighbours


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Points of one scan that lie over the surface of another."""

    rows: Ints  # (K,) of the first scan's points
    foot: Array  # (K, 3) mm, on the second, its frame
    normal: Array  # (K, 3) of the second, its frame
    gap: Array  # (K,) mm, along that normal: the first lies outside where positive
    noise: Array  # (K,) mm, of the gap, from what is independent from point to point
    sigma: Array  # (K,) mm, the same with what edges add, by which it is weighted
    shared: Array  # (K,) mm, of the gap, through both calibrations
    tried: int  # points that were looked at

    @property
    def tight(self) -> Bools:
        """Gaps that noise explains."""
        return np.abs(self.gap) < _TIGHT * self.noise

    @property
    def share(self) -> float:
        """Part of the points tried that lie on the other surface."""
        return float(self.tight.sum()) / max(self.tried, 1)

    @property
    def purity(self) -> float:
        """Part of the points over the other surface that lie on it; two scans of one part at the right place: nearly all."""
        return float(self.tight.mean()) if len(self.gap) else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class PairOverlap:
    """Two scans compared."""

    first: str
    second: str
    share: float  # part of the smaller one that overlaps
    points: int  # over each other's surface
    offset_mm: float  # median gap: the first lies outside where positive
    rms_mm: float  # of the gaps
    expected_mm: float  # rms that noise and calibration explain
    shared_mm: float  # median of what the calibrations explain

    @property
    def within(self) -> bool:
        """Whether the offset is within k = 2 of both calibrations (and 0.2 of the noise, which averages out)."""
        return abs(self.offset_mm) <= 2.0 * self.shared_mm + 0.2 * self.expected_mm


def contact(first: Patch, second: Patch, second_from_first: Pose, *, reach: float, rows: Ints | None = None) -> Contact:
    """Where the first scan lies over the second: within ``reach`` mm along the normal, a spacing aside, normals alike.

    Surfaces that face each other's back, as both sides of a sheet do, are no contact. Feet at the rim of the second scan are
    none either, since beyond it nothing is known.
    """
    chosen = first.few if rows is None else rows
    points = second_from_first.apply(first.points[chosen])
    normals = first.normals[chosen] @ second_from_first.rotation.T
    count = min(_MEAN_OF, len(second.points))
    aside = 2.0 * max(second.spacing, 1e-9)
    away, index = second.tree.query(points, k=count, distance_upper_bound=float(np.hypot(reach, aside)), workers=1)
    hit = np.flatnonzero(np.isfinite(away[:, -1]))
    near = index[hit]
    normal = second.normals[near].mean(axis=1)
    length = np.linalg.norm(normal, axis=1)
    normal = normal / np.maximum(length, 1e-9)[:, None]
    gap = (points[hit, None] - second.points[near]) @ normal[:, :, None]
    gap = gap[:, :, 0].mean(axis=1)
    foot = points[hit] - gap[:, None] * normal
    lateral = np.linalg.norm(foot - second.points[near].mean(axis=1), axis=1)
    good = (length > 0.8) & (np.abs(gap) < reach) & (lateral < 0.75 * aside) & second.inner[near[:, 0]]
    good &= (normals[hit] * normal).sum(axis=1) > _ALIKE
    hit, near = hit[good], near[good]
    noise = np.sqrt(
        first.sigma[chosen[hit]] ** 2 + (second.sigma[near] ** 2).mean(axis=1) / count + (_CURVED * second.spacing) ** 2
    )
    sigma = np.sqrt(noise**2 + first.rough[chosen[hit]] ** 2 + (second.rough[near] ** 2).mean(axis=1))
    shared = np.hypot(first.shared[chosen[hit]], second.shared[near[:, 0]])
    return Contact(chosen[hit], foot[good], normal[good], gap[good], noise, sigma, shared, len(chosen))


def compared(first: Patch, second: Patch, second_from_first: Pose, *, reach: float) -> PairOverlap | None:
    """Both ways; None where they do not overlap."""
    one = contact(first, second, second_from_first, reach=reach)
    other = contact(second, first, second_from_first.inverse, reach=reach)
    if len(one.gap) + len(other.gap) < 30:
        return None
    firm = np.concatenate([one.sigma < _FIRM * one.noise, other.sigma < _FIRM * other.noise])  # not on an edge
    if firm.sum() < 30:
        firm[:] = True
    gap = np.concatenate([one.gap, -other.gap])[firm]
    sigma = np.concatenate([one.noise, other.noise])[firm]
    shared = np.concatenate([one.shared, other.shared])[firm]
    return PairOverlap(
        first.name, second.name, max(len(one.gap) / one.tried, len(other.gap) / other.tried), len(gap),
        float(np.median(gap)), float(np.sqrt(np.mean(gap**2))), float(np.sqrt(np.mean(sigma**2 + shared**2))),
        float(np.median(shared)),
    )  # fmt: skip
