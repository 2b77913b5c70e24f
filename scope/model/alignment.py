"""The last hundredth of a millimetre: weighted robust point-to-plane alignment on the exact mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.geometry import Array, Bools, Ints, Pose
from scope.model.surface import Surface

TAILS = 6.0
SLANT = 0.3  # cosine of the slant beyond which a surface is not taken to be known better still across it
GRAZING = 0.1  # cosine of the slant beyond which nothing is ranged
STEP = 0.3  # mm, one sigma of a step's prior: motions that nothing holds are not run away with
EDGE = 3.0  # standard deviations from a sharp edge within which noise may put a point on the wrong face


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A refined pose and the linear system it solves."""

    pose: Pose  # cloud_from_model
    jacobian: Array  # (N, 6) d residual / d (x, y, z mm; turn about x, y, z of the cloud at the model's origin, rad)
    weight: Array  # (N,) 1/mm2, robust; 0 where a point takes no part
    variance: Array  # (N,) mm2 of the residuals
    residual: Array  # (N,) mm, signed, outside positive
    used: Bools  # (N,) points that the model explains
    normal: Array  # (N, 3) of the surface there, cloud frame


@dataclass(frozen=True, slots=True, eq=False)
class Scanned:
    """Points of a scan as alignment sees them."""

    points: Array  # (N, 3) mm, cloud frame
    sigma: Array  # (N,) mm along the sighting ray; across the surface where the camera is unknown
    camera: Array | None  # (N, 3) mm, where the camera was for each point
    line: Array | None = None  # (N, 3) its motion for 1 mm along the sighting ray when its stripe is misjudged

    def only(self, rows: Any) -> Scanned:
        """Some of them."""
        camera, line = (None if values is None else values[rows] for values in (self.camera, self.line))
        return Scanned(self.points[rows], self.sigma[rows], camera, line)


@dataclass(frozen=True, slots=True)
class Weighting:
    """What a point's weight in the alignment follows from, beside its sigma."""

    floor: float  # mm, one sigma, that no residual is better than (form of the part, facets)
    tails: float = (
        TAILS  # where Tukey's weight ends, in standard deviations (more where residuals exceed what is claimed)
    )
    edge: float = 0.0  # mm: points with their foot nearer to a sharp edge than this and three sigma take no part
    borders: bool = False  # points that hang over an edge pull the edge towards them


def refine(surface: Surface, pose: Pose, scan: Scanned, *, reach: tuple[float, ...], weighting: Weighting) -> Fit:
    """Iterated point-to-plane alignment (Chen & Medioni 1991) with Tukey weights and the points' own sigma.

    Parameters
    ----------
    surface : Surface
        Of the model.
    pose : Pose
        cloud_from_model to begin with, within about the first ``reach``.
    scan : Scanned
        Its sigma is along the sighting ray, so that a surface seen at a slant is known better across it: by what its line of
        motion moves across the surface where that is known, else by the slant, which leaves out that a stripe moves in its sheet.
    reach : tuple of float, mm
        Points further from the surface have no weight, one value a step.
    weighting : Weighting
        With ``borders``, faces are stopped from sliding in themselves on the way to the pose; the last steps do without,
        since a stripe is smeared at an edge.

    Returns
    -------
    Fit
        Points beyond an edge, whose nearest surface point is not straight below them, have no weight without ``borders``.
    """
    for cut in reach:
        fit = evaluate(surface, pose, scan, cut=cut, weighting=weighting)
        root = np.sqrt(fit.weight)[:, None]
        rows = np.concatenate([root * fit.jacobian * _SCALE, np.eye(6) / STEP])
        x = np.linalg.lstsq(rows, np.append(-root[:, 0] * fit.residual, np.zeros(6)), rcond=None)[0] * _SCALE
        moved = Pose.from_rotation_vector(x[3:], np.zeros(3)).rotation
        pose = Pose(moved @ pose.rotation, pose.translation + x[:3])
    return evaluate(surface, pose, scan, cut=reach[-1], weighting=weighting)


_SCALE = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])  # 1 mm and 0.02 rad move a point 50 mm away alike


def evaluate(surface: Surface, pose: Pose, scan: Scanned, *, cut: float, weighting: Weighting) -> Fit:
    """Residuals, weights and derivatives at one pose; points further than ``cut`` mm have no weight; see `refine`."""
    points, sigma, camera, floor = scan.points, scan.sigma, scan.camera, weighting.floor
    closest, normal = surface.nearest(pose.inverse.apply(points))
    on = closest @ pose.rotation.T
    normal = normal @ pose.rotation.T
    gap = points - (on + pose.translation)
    residual = (gap * normal).sum(axis=1)
    aside = np.sqrt(np.maximum((gap * gap).sum(axis=1) - residual**2, 0.0))
    slope = np.ones(len(points))
    facing = np.ones(len(points), dtype=np.bool_)
    if camera is not None:
        ray = camera - points
        slope = (ray * normal).sum(axis=1) / np.linalg.norm(ray, axis=1)
        facing = slope > GRAZING
    across = np.maximum(slope, SLANT)
    if scan.line is not None:
        across = np.maximum(np.abs((scan.line * normal).sum(axis=1)), GRAZING)
    variance = (sigma * across) ** 2 + floor**2
    below = aside < 0.3 * sigma + 0.01  # the nearest surface is straight below, not an edge
    margin = EDGE * sigma + weighting.edge
    far = surface.crease_distance(closest, float(margin.max())) > margin
    if weighting.borders:
        length = np.linalg.norm(gap, axis=1)
        over = ~below & (length > 1e-9)
        normal = np.where(over[:, None], gap / np.maximum(length, 1e-9)[:, None], normal)
        residual = np.where(over, length, residual)
        variance = np.where(over, sigma**2 + floor**2, variance)
        facing |= over
        far |= over
        below |= over
    used = (np.abs(residual) < cut) & facing & below & far
    deviate = residual / np.sqrt(variance)
    usual = 1.4826 * float(np.median(np.abs(deviate[used]))) if used.any() else 1.0
    share = (deviate / (weighting.tails * max(usual, 1.0))) ** 2
    weight = np.where(used & (share < 1.0), (1.0 - np.minimum(share, 1.0)) ** 2 / variance, 0.0)
    # the point turns by -w about the model's origin, seen from the model
    jacobian = np.concatenate([-normal, -np.cross(on, normal)], axis=1)
    return Fit(pose, jacobian, weight, variance, residual, used, normal)


def patches(points: Array, side: float) -> Ints:
    """Number (N,) of the cube of side ``side`` mm that each point lies in, from 0 without gaps: those whose errors may be alike."""
    cell = (
        np.floor((points - points.min(axis=0)) / side).astype(np.int64) if len(points) else np.zeros((0, 3), np.int64)
    )
    size = cell.max(axis=0, initial=0) + 1
    return np.asarray(
        np.unique((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], return_inverse=True)[1]
    ).ravel()
