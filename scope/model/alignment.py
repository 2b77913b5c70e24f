"""The last hundredth of a millimetre: weighted robust point-to-plane alignment on the exact mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Pose
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


def refine(
    surface: Surface,
    pose: Pose,
    points: Array,
    sigma: Array,
    camera: Array | None,
    *,
    reach: tuple[float, ...],
    floor: float,
    tails: float = TAILS,
    edge: float = 0.0,
    borders: bool = False,
) -> Fit:
    """Iterated point-to-plane alignment (Chen & Medioni 1991) with Tukey weights and the points' own sigma.

    Parameters
    ----------
    surface : Surface
        Of the model.
    pose : Pose
        cloud_from_model to begin with, within about the first ``reach``.
    points, sigma, camera : (N, 3), (N,), (N, 3)
        mm; sigma is along the sighting ray, so that a surface seen at a slant is known better across it. Without the
        camera, sigma is taken across the surface.
    reach : tuple of float, mm
        Points further from the surface have no weight, one value a step.
    tails : float
        Where Tukey's weight ends, in standard deviations (made larger where the residuals are larger than claimed).
    floor : float
        Standard deviation, mm, that no residual is better than (form of the part, facets).
    edge : float, mm
        Points with their foot within three standard deviations of a sharp edge, and this much more, take no part.
    borders : bool
        Points that hang over an edge pull the edge towards them. On the way to the pose this stops faces from sliding
        in themselves; the last steps do without, since a stripe is smeared at an edge.

    Returns
    -------
    Fit
        Points beyond an edge, whose nearest surface point is not straight below them, have no weight without ``borders``.
    """
    for cut in reach:
        fit = evaluate(
            surface, pose, points, sigma, camera, cut=cut, floor=floor, tails=tails, edge=edge, borders=borders
        )
        root = np.sqrt(fit.weight)[:, None]
        rows = np.concatenate([root * fit.jacobian * _SCALE, np.eye(6) / STEP])
        x = np.linalg.lstsq(rows, np.append(-root[:, 0] * fit.residual, np.zeros(6)), rcond=None)[0] * _SCALE
        moved = Pose.from_rotation_vector(x[3:], np.zeros(3)).rotation
        pose = Pose(moved @ pose.rotation, pose.translation + x[:3])
    return evaluate(
        surface, pose, points, sigma, camera, cut=reach[-1], floor=floor, tails=tails, edge=edge, borders=borders
    )


_SCALE = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])  # 1 mm and 0.02 rad move a point 50 mm away alike


def evaluate(
    surface: Surface,
    pose: Pose,
    points: Array,
    sigma: Array,
    camera: Array | None,
    *,
    cut: float,
    floor: float,
    tails: float = TAILS,
    edge: float = 0.0,
    borders: bool = False,
) -> Fit:
    """Residuals, weights and derivatives at one pose; see `refine`."""
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
    variance = (sigma * np.maximum(slope, SLANT)) ** 2 + floor**2
    below = aside < 0.3 * sigma + 0.01  # the nearest surface is straight below, not an edge
    margin = EDGE * sigma + edge
    far = surface.crease_distance(closest, float(margin.max())) > margin
    if borders:
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
    share = (deviate / (tails * max(usual, 1.0))) ** 2
    weight = np.where(used & (share < 1.0), (1.0 - np.minimum(share, 1.0)) ** 2 / variance, 0.0)
    # the point turns by -w about the model's origin, seen from the model
    jacobian = np.concatenate([-normal, -np.cross(on, normal)], axis=1)
    return Fit(pose, jacobian, weight, variance, residual, used, normal)
