"""Where sighting rays meet the sheet of light, and how certain that is."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from calibration.camera import Camera
from calibration.geometry import Array, Codes
from calibration.reason import Reason
from calibration.sheet import Laser


@dataclass(frozen=True, slots=True, eq=False)
class Triangulated:
    """Points of N pixels; row i belongs to pixel i."""

    points: Array  # (N, 3) mm in C, NaN where not ranged
    sigma: Array  # (N,) mm along the ray, from the noise of the stripe: independent from point to point
    sigma_cal: Array  # (N,) mm along the ray, from the calibration: shared
    reason: Codes  # (N,) a Reason
    view: Array  # (N, 3) unit sighting rays in C, away from the camera
    moved: Array  # (N, 3) mm/px, of the ray at the point when its pixel moves across the stripe
    slide: Array  # (N, 3) mm/px, the same when its pixel moves along the stripe
    sheet: Array  # (N, 3) unit normals of the sheet of light at the points

    def rows(self, begin: int, end: int) -> Triangulated:
        """Rows ``begin`` to ``end`` - 1."""
        return Triangulated(*(getattr(self, f.name)[begin:end] for f in fields(self)))


def triangulate(
    camera: Camera,
    laser: Laser,
    pixels: Array,
    sigma_px: Array,
    across: int,
    *,
    extrapolate: float = 0.0,
    min_incidence: float = 0.02,
) -> Triangulated:
    """Range stripe pixels: equation 1 of DePiero & Kress, solved for the sheet of light.

    Parameters
    ----------
    camera, laser : Camera, Laser
        Calibrated, in C.
    pixels : (N, 2) array
        px (u, v); NaN rows stay NaN and keep ``Reason.NO_LIGHT``, to be overwritten by the caller who knows why.
    sigma_px : (N,) array
        Standard deviation, px, of the coordinate across the stripe.
    across : 0 or 1
        Which coordinate that is: 0 for u (a stripe along columns), 1 for v.
    extrapolate : float
        mm outside the calibrated volume that are still ranged.
    min_incidence : float
        Least |cos| between ray and sheet normal.

    Returns
    -------
    Triangulated
        ``sigma`` is |n . dX/dp| sigma_px / |n . d|: moving the pixel moves the ray off the sheet, and the point runs along
        the ray until it is back on it. ``sigma_cal`` adds, in quadrature, the ray's own uncertainty across itself and the
        sheet's along its normal, both over |n . d|; of a sheet that follows the camera (`Laser.coupling`), what both together do.
    """
    known = np.isfinite(pixels[:, 0]) & np.isfinite(pixels[:, 1])
    rays = camera.rays(pixels)
    ranged = laser.sheet.intersect(rays, min_incidence=min_incidence)
    if camera.model == "two-plane":
        rays = camera.rays(pixels, near=ranged.points[:, 2])
        ranged = laser.sheet.intersect(rays, min_incidence=min_incidence)
    points, view = ranged.points, rays.direction
    reason = np.where(known, ranged.reason, Reason.NO_LIGHT).astype(np.uint8)
    inside = camera.volume.contains(points, margin=extrapolate)
    reason[(reason == Reason.RANGED) & ~inside] = Reason.OUTSIDE_CALIBRATION
    lost = reason != Reason.RANGED
    points[lost] = np.nan  # and with them all that follows from them
    sheet = np.array(laser.sheet.normal_at(points))
    shift = camera.shift(pixels, points)
    moved, slide = shift[:, :, across], shift[:, :, 1 - across]
    slope = np.abs(_dot(sheet, view))
    sigma = np.abs(_dot(sheet, moved)) * sigma_px / slope
    if laser.coupling.size:
        sigma_cal = _along_ray(camera, laser, pixels, points, view, sheet)
    else:  # the ray's own uncertainty lies across depth: only its part along the sheet's normal moves the point
        lateral = camera.sigma_at(pixels, points) * np.sqrt(np.maximum(1 - sheet[:, 2] ** 2, 0))
        sigma_cal = np.hypot(lateral, laser.sigma_at(points)) / slope
    for values in (view, sheet):
        values[lost] = np.nan
    return Triangulated(points, sigma, sigma_cal, reason, view, moved, slide, sheet)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def _along_ray(camera: Camera, laser: Laser, pixels: Array, points: Array, view: Array, normal: Array) -> Array:
    """Standard deviation (N,) mm along the rays of ranged points, camera and sheet together, for a sheet that follows the camera.

    ``view`` and ``normal`` (N, 3) are the unit rays and the sheet's normals at the points.
    """
    steep = _dot(normal, view)[:, None]
    lift = laser.lift(points) / steep
    by_camera = lift @ laser.coupling - np.einsum("ni,nip->np", normal, camera.jacobian(pixels, points)) / steep
    variance = ((by_camera @ camera.covariance) * by_camera).sum(axis=1) + ((lift @ laser.covariance) * lift).sum(
        axis=1
    )
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
