"""Where sighting rays meet the sheet of light, and how certain that is."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from calibration.camera import Camera
from calibration.geometry import Array, Codes
from calibration.laser import Laser
from calibration.reason import Reason


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
        sheet's along its normal, both over |n . d|.
    """
    n = len(pixels)
    points = np.full((n, 3), np.nan)
    sigma, sigma_cal = np.full(n, np.nan), np.full(n, np.nan)
    view, moved, slide, sheet = (np.full((n, 3), np.nan) for _ in range(4))
    reason = np.full(n, Reason.NO_LIGHT, dtype=np.uint8)
    rows = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    if len(rows) == 0:
        return Triangulated(points, sigma, sigma_cal, reason, view, moved, slide, sheet)
    seen = pixels[rows]
    rays = camera.rays(seen)
    ranged = laser.sheet.intersect(rays, min_incidence=min_incidence)
    if camera.model == "two-plane":
        near = np.where(np.isfinite(ranged.points[:, 2]), ranged.points[:, 2], 0.0)
        rays = camera.rays(seen, near=near)
        ranged = laser.sheet.intersect(rays, min_incidence=min_incidence)
    code = ranged.reason.copy()
    inside = camera.volume.contains(ranged.points, margin=extrapolate)
    code[(code == Reason.RANGED) & ~inside] = Reason.OUTSIDE_CALIBRATION
    good = code == Reason.RANGED
    reason[rows] = code
    kept, found, x = rows[good], seen[good], ranged.points[good]
    normal = laser.sheet.normal_at(x)
    view[kept], sheet[kept] = rays.direction[good], normal
    shift = camera.shift(found, x)
    moved[kept], slide[kept] = shift[:, :, across], shift[:, :, 1 - across]
    slope = np.abs(np.einsum("ni,ni->n", normal, view[kept]))
    points[kept] = x
    sigma[kept] = np.abs(np.einsum("ni,ni->n", normal, moved[kept])) * sigma_px[kept] / slope
    # the ray's own uncertainty lies across depth: only its part along the sheet's normal moves the point
    lateral = camera.sigma_at(found, x) * np.sqrt(np.maximum(1 - normal[:, 2] ** 2, 0))
    sigma_cal[kept] = np.hypot(lateral, laser.sigma_at(x)) / slope
    return Triangulated(points, sigma, sigma_cal, reason, view, moved, slide, sheet)
