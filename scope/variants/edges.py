"""Where a scan ends at the part's edges: how far before or beyond each edge its last points lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Ints, Pose
from scope.model import Edges, Surface

REACH = 3.0  # mm either side of an edge in which the end of the scan is looked for
LEAST_OWN = 0.25  # cosine to camera and laser above which a face is seen up to its edge
MOST_OTHER = 0.17  # cosine below which the face beyond the edge is not seen
FEWEST = 4  # points before an edge, below which its end is not measured
LOSS = 0.15  # mm, one sigma: what all edges together may lose of the stripe or gain by its smear
OWN_LOSS = 0.08  # mm, one sigma: the same of one edge beside the others
LAST = 1.6  # mean gaps between an edge and the second last point before it
SCATTER = 0.7  # mean gaps, one sigma of that


@dataclass(frozen=True, slots=True, eq=False)
class Rims:
    """Edges of visible faces beyond which nothing is seen, one row a sample."""

    at: Array  # (M, 3) mm on the edge, model frame
    out: Array  # (M, 3) unit, in the face, away from it, model frame
    beyond: Array  # (M,) mm by which the scan reaches beyond the edge
    sigma: Array  # (M,) mm, of one sample by its points' gaps
    triangle: Ints  # (M,) of the face
    other: Ints  # (M,) of the wall beyond
    wall: Ints  # (M,) number of this wall: all of one flat face or round feature have one

    @property
    def variance(self) -> Array:
        """(M,) mm2 of each sample, such that all samples of one side of a wall together know it no better than `OWN_LOSS`."""
        side = np.column_stack(
            [self.wall, np.round(1.3 * self.out)]
        )  # eight sides of a round hole, one of a straight edge
        number = np.unique(side, axis=0, return_inverse=True)[1].ravel() if len(side) else np.zeros(0, dtype=np.int64)
        return np.asarray(self.sigma**2 + np.bincount(number)[number] * OWN_LOSS**2)


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Points of a scan in the model's frame, with where camera and laser stood; None where unknown."""

    points: Array  # (N, 3) mm
    camera: Array | None  # (N, 3) mm
    laser: Array | None  # (N, 3) mm

    @staticmethod
    def of(pose: Pose, points: Array, camera: Array | None, laser: Array | None) -> Sight:
        """From points, camera and laser of the cloud's frame, at a pose cloud_from_model."""
        back = pose.inverse
        return Sight(
            back.apply(points),
            None if camera is None else back.apply(camera),
            None if laser is None else back.apply(laser),
        )


def rims_of(surface: Surface, edges: Edges, sight: Sight, pitch: float) -> Rims:
    """Measure the end of the scan at all edges of visible faces beyond which nothing is seen.

    Parameters
    ----------
    surface, edges : Surface, Edges
        Of the model.
    sight : Sight
        All points of the part, at about the right pose: a face may be 2 mm off, an edge ``REACH``.
    pitch : float, mm
        Length of edge that makes one sample.

    Notes
    -----
    The points of the face in the strip before a piece of the edge have a mean gap g along the way out (strip over number);
    the second last lies 1.6 g before the end, 1.5 on a lattice and 2 where points lie at random, and the last is not
    asked: it may be a stray. Where camera and laser are known, the face must turn to both and the wall beyond away from one, and
    the model itself must not shade the place; else the wall must show no point.
    """
    at, out, normal, beyond, index = _samples(edges, pitch)
    keep = np.ones(len(at), dtype=np.bool_)
    if len(at) == 0 or len(sight.points) == 0:
        return _none()
    for eyes in (sight.camera, sight.laser):
        if eyes is not None:
            keep &= _side(surface, at - 0.4 * out, normal, eyes.mean(axis=0))
    if sight.camera is not None:
        away = np.zeros(len(at), dtype=np.bool_)
        for eyes in (sight.camera, sight.laser):
            if eyes is not None:
                way = eyes.mean(axis=0) - at
                away |= (way * beyond).sum(axis=1) < MOST_OTHER * np.linalg.norm(way, axis=1)
        keep &= away
    at, out, normal, index = at[keep], out[keep], normal[keep], index[keep]
    if len(at) == 0:
        return _none()
    point, sample = _assigned(sight.points, at)
    offset = sight.points[point] - at[sample]
    height, way = (offset * normal[sample]).sum(axis=1), (offset * out[sample]).sum(axis=1)
    usual = _middle(height, sample, len(at), way < -0.3 * REACH)
    height = height - usual[sample]
    wall = np.bincount(sample[(height < -1.0) & (way > -1.0)], minlength=len(at))
    flat = np.abs(height) < 0.3
    sample, way = sample[flat], way[flat]
    order = np.lexsort((way, sample))
    sample, way = sample[order], way[order]
    count = np.bincount(sample, minlength=len(at))
    good = np.flatnonzero((count >= FEWEST) & (wall < 2) & np.isfinite(usual))
    last = np.cumsum(count)[good] - 1
    second, first = way[last - 1], way[last - count[good] + 1]
    gap = (second + REACH) / np.maximum(count[good] - 1, 1)
    end = second + LAST * gap
    fair = (gap < 0.25 * REACH) & (first < -0.5 * REACH) & (second > -0.8 * REACH) & (end < 0.9 * REACH)
    row = good[fair]
    other = edges.other[index[row]]
    features = surface.features
    wall = np.where(
        features.face_of[other] >= 0, features.face_of[other], len(features.faces) + features.feature_of[other]
    )
    wall = np.where((features.face_of[other] < 0) & (features.feature_of[other] < 0), -1 - other, wall)
    return Rims(at[row], out[row], end[fair], SCATTER * gap[fair], edges.triangle[index[row]], other, wall)


def _none() -> Rims:
    empty, whole = np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    return Rims(empty, empty, np.zeros(0), np.zeros(0), whole, whole, whole)


def _samples(edges: Edges, pitch: float) -> tuple[Array, Array, Array, Array, Ints]:
    """Middles of pieces of all edges about ``pitch`` mm long, and the edge that each is of."""
    length = np.linalg.norm(edges.end - edges.start, axis=1)
    count = np.maximum(np.round(length / pitch), 1).astype(np.int64)
    index = np.repeat(np.arange(len(length)), count)
    step = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
    part = ((step + 0.5) / count[index])[:, None]
    at = edges.start[index] + part * (edges.end - edges.start)[index]
    return at, edges.out[index], edges.normal[index], edges.beyond[index], index


def _side(surface: Surface, at: Array, normal: Array, eye: Array) -> Bools:
    """Whether places (M, 3) on faces turn to an eye (3,) and see it past the model."""
    way = eye - at
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    turned = (way * normal).sum(axis=1) > LEAST_OWN
    rows = np.flatnonzero(turned)
    turned[rows] = np.isinf(surface.first_hit(at[rows] + 0.05 * normal[rows], way[rows]))
    return np.asarray(turned)


def _assigned(points: Array, at: Array) -> tuple[Ints, Ints]:
    """Points within reach of an edge and the sample that each is nearest to; both faces of an edge get theirs."""
    from scipy.spatial import cKDTree

    gap, near = cKDTree(at).query(points, k=min(2, len(at)), distance_upper_bound=REACH, workers=1)
    gap, near = gap.reshape(len(points), -1), near.reshape(len(points), -1)
    own = np.isfinite(gap)
    own[:, 1:] &= gap[:, 1:] < np.where(own[:, :1], gap[:, :1], 0.0) + 1e-9
    point, column = np.nonzero(own)
    return point, near[point, column]


def _middle(values: Array, group: Ints, count: int, chosen: Bools) -> Array:
    """Median (count,) of the chosen values of each group, NaN without any."""
    values, group = values[chosen], group[chosen]
    order = np.lexsort((values, group))
    values, group = values[order], group[order]
    size = np.bincount(group, minlength=count)
    first = np.cumsum(size) - size
    middle = np.full(count, np.nan)
    some = size > 0
    middle[some] = values[(first + size // 2)[some]]
    return middle
