"""What the errors of the marks lead to: by how much planes may disagree, and how far the field of rays is open."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array
from calibration.rays import MAX_ORDER, TwoPlaneFit, fit_ray_field, polynomial
from calibration.verification.analysis import Interplane

_PIXELS = 400  # that are looked at, at most


def expected_interplane_px(fit: TwoPlaneFit, found: Interplane) -> float:
    """Root mean square of the inter-plane error, px, that the errors of the marks lead to through the maps.

    Parameters
    ----------
    fit : TwoPlaneFit
        Maps and marks.
    found : Interplane
        Of its camera: the same pixels and planes are joined.

    Returns
    -------
    float
        NaN for two planes, which always agree, for maps as free as their marks, and where no pixel is joined.

    Notes
    -----
    A map is linear in its marks: their errors move the point of a pixel on plane k by sum_i a_ki e_ki. Errors of one mark are
    alike on all planes as far as they are the plate's own: their covariance between planes l and m is taken from the residuals of
    the maps, s_lm = sum_i r_li . r_mi / (2 sqrt((n_l - d)(n_m - d))) over the marks seen on both. The line through the points
    takes its part of it (regression on the depth), and what is left is turned to px by the scale of each map.
    """
    maps, marks = fit.camera.maps, fit.marks
    free = [len(m) - len(polynomial.exponents(p.terms)) for m, p in zip(marks, maps, strict=True)]
    joined = np.isfinite(found.by_plane[..., 0]).reshape(len(maps), -1)
    at = np.flatnonzero(joined.sum(axis=0) >= 3)
    if len(maps) < 3 or min(free) < 1 or not len(at):
        return float("nan")
    at = at[:: -(-len(at) // _PIXELS)]
    pixels, joined = found.pixels.reshape(-1, 2)[at], joined[:, at]
    number = np.unique(np.concatenate([m.mark for m in marks]))
    pull, rest, depth, scale = [], [], [], []
    for m, plane, plane_map in zip(marks, fit.planes, maps, strict=True):
        design = polynomial.design(plane_map.domain.square(m.pixels), plane_map.terms)
        weight = polynomial.design(plane_map.domain.square(pixels), plane_map.terms) @ np.linalg.pinv(design)
        column = np.searchsorted(number, m.mark)
        pull.append(_spread(weight.T, column, len(number)).T)
        rest.append(_spread(plane.residuals_mm, column, len(number)))
        depth.append(fit.camera.field.depth(plane_map.points(pixels)))
        scale.append(1.0 / np.abs(np.linalg.det(plane_map.jacobian(pixels))))
    residual, weights, z = np.array(rest), np.array(pull), np.array(depth)
    covariance = np.einsum("lic,mic->lm", residual, residual) / (2 * np.sqrt(np.outer(free, free)))
    error = 2 * covariance[:, :, None] * np.einsum("lgi,mgi->lmg", weights, weights)
    square = np.zeros(len(at))
    for mask in np.unique(joined, axis=1).T:
        here, planes = np.flatnonzero((joined == mask[:, None]).all(axis=0)), np.flatnonzero(mask)
        for g in here:
            line = np.linalg.qr(np.column_stack([np.ones(len(planes)), z[planes, g]]))[0]
            off = np.eye(len(planes)) - line @ line.T
            left = np.diag(off @ error[np.ix_(planes, planes, [g])][:, :, 0] @ off)
            square[g] = float((left * np.array(scale)[planes, g]).mean())
    return float(np.sqrt(square.mean()))


def _spread(values: Array, rows: np.typing.NDArray[np.int64], count: int) -> Array:
    """Rows of values (n, k) put at their numbers among ``count``, 0 elsewhere."""
    found = np.zeros((count, values.shape[1]))
    found[rows] = values
    return found


class RayBound(NamedTuple):
    """How far the joint field of rays is open within the calibrated volume: the worst of all marks' pixels, one sigma."""

    mm: float
    px: float


def ray_bound(fit: TwoPlaneFit, *, untested: bool = False) -> RayBound:
    """Bound on the rays of the joint field at the pixels of all marks, at the depth of every plane, by the marks that fitted it.

    Where planes have no pixels in common (the levels of a stepped plate in one image) no plane can be left out to test the
    rays; they rest on the smoothness of the field. What is uncertain is the noise of the marks, by the covariance of the fit, and
    where the rays are ``untested`` the orders of the field, too: other orders of slope and origin that foretell left-out marks as well (to 5 %) move the rays, and
    the widest such movement counts as much as the noise.
    """
    field = fit.joint.field
    pixels = np.concatenate([m.pixels for m in fit.marks])
    others = []
    for slope, origin in product(range(field.slope_order, MAX_ORDER + 1), range(3)):
        if untested and origin <= slope:
            try:
                other = fit_ray_field(list(fit.marks), orders=(slope, origin))
            except CalibrationError:
                continue
            if other.loo_px < 1.05 * fit.joint.loo_px:
                others.append(other.field)
    worst = [RayBound(0.0, 0.0)]
    for depth in field.depths:
        at = np.full(len(pixels), float(depth))
        here = field.crossing(pixels, at)
        inside = fit.camera.volume.contains(np.column_stack([here, at]) @ field.c_from_d.T)
        if inside.any():
            apart = [np.linalg.norm(other.crossing(pixels, at) - here, axis=1) for other in others]
            moved = np.max([np.zeros(len(pixels)), *apart], axis=0) / np.sqrt(2.0)
            sigma = np.hypot(field.sigma_at(pixels, at), moved)[inside]
            scale = np.sqrt(np.abs(np.linalg.det(field.jacobian(pixels[inside], at[inside]))))
            worst.append(RayBound(float(sigma.max()), float((sigma / scale).max())))
    return RayBound(max(w.mm for w in worst), max(w.px for w in worst))
