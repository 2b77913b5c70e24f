"""How far the centroid of a circle's image lies from the image of its centre."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from calibration.geometry import Array


def eccentricity_of_homography(homography: Array, centres: Array, radius: ArrayLike) -> Array:
    """Centroid of the image of a circle less the image of its centre, under a plane-to-image homography.

    The image of a circle is an ellipse, whose centre is the pole of the line at infinity: exact for any tilt.

    Parameters
    ----------
    homography : (3, 3) array
        From the target's plane, mm, to the image, px.
    centres : (N, 2) array, mm
        Centres of the circles.
    radius : float or (N,), mm
        Their radii.

    Returns
    -------
    (N, 2) array, px
        To be subtracted from measured centroids; zero for a target parallel to the image.

    Notes
    -----
    With C the conic of the circle, the centre of H^-T C H^-1 is H C^-1 H' e3 (Heikkila, PAMI 22 (2000) 1066).
    """
    h = np.asarray(homography, dtype=np.float64)
    x, y = np.asarray(centres, dtype=np.float64).T
    r2 = np.broadcast_to(np.asarray(radius, dtype=np.float64) ** 2, x.shape)
    # adjoint of the circle's conic: centre centre' - radius^2 diag(1, 1, 0)
    adjoint = np.empty((len(x), 3, 3))
    adjoint[:, 0, 0], adjoint[:, 1, 1], adjoint[:, 2, 2] = x * x - r2, y * y - r2, 1.0
    adjoint[:, 0, 1] = adjoint[:, 1, 0] = x * y
    adjoint[:, 0, 2] = adjoint[:, 2, 0] = x
    adjoint[:, 1, 2] = adjoint[:, 2, 1] = y
    pole = (h @ adjoint @ h.T)[:, :, 2]
    centre = np.stack([x, y, np.ones_like(x)], axis=1) @ h.T
    return np.asarray(pole[:, :2] / pole[:, 2:] - centre[:, :2] / centre[:, 2:])


def eccentricity_of_map(
    plane_from_pixels: Callable[[Array], Array], pixels: Array, radius: ArrayLike, *, step: float = 2.0
) -> Array:
    """Centroid of the image of a circle less the image of its centre, for any smooth map, to second order.

    With f the map from plane to image, J its Jacobian determinant and r the radius, the centroid of the image of the
    disk is off by r^2/4 (1/2 laplacian f + grad f . grad ln J): perspective and lens distortion alike.

    Parameters
    ----------
    plane_from_pixels : callable
        Maps pixels (N, 2) to the plane (N, 2) or (N, 3), mm, of which x and y count; a fitted plane map, for instance.
    pixels : (N, 2) array, px
        Where the circles are seen.
    radius : float or (N,), mm
        Their radii.
    step : float
        Distance, px, over which the map is differentiated.

    Returns
    -------
    (N, 2) array, px
        To be subtracted from measured centroids. NaN where the map is singular. Its error is of fourth order in the
        radius: about (diameter / distance of the vanishing line) squared of the shift.
    """
    at = np.asarray(pixels, dtype=np.float64)
    du, dv = np.array([step, 0.0]), np.array([0.0, step])

    def plane(shift: Array) -> Array:
        return np.asarray(plane_from_pixels(at + shift))[:, :2]

    here, east, west, south, north = plane(0 * du), plane(du), plane(-du), plane(dv), plane(-dv)
    gradient = np.stack([(east - west), (south - north)], axis=2) / (2.0 * step)  # (N, 2, 2): d plane_i / d pixel_j
    curve = np.empty((len(at), 2, 2, 2))  # d2 plane_i / d pixel_j d pixel_k
    curve[:, :, 0, 0] = (east - 2.0 * here + west) / step**2
    curve[:, :, 1, 1] = (south - 2.0 * here + north) / step**2
    mixed = (plane(du + dv) - plane(du - dv) - plane(dv - du) + plane(-du - dv)) / (4.0 * step**2)
    curve[:, :, 0, 1] = curve[:, :, 1, 0] = mixed
    det = np.linalg.det(gradient)
    inverse = np.full_like(gradient, np.nan)
    sound = np.abs(det) > 0.0
    inverse[sound] = np.linalg.inv(gradient[sound])
    # derivatives of the inverse map f, from those of the map
    second = -np.einsum("nkl,nlab,nai,nbj->nkij", inverse, curve, inverse, inverse)
    log_jacobian = -np.einsum("nla,nalb,nbi->ni", inverse, curve.transpose(0, 1, 2, 3), inverse)
    laplacian = second[:, :, 0, 0] + second[:, :, 1, 1]
    r2 = np.asarray(radius, dtype=np.float64) ** 2 * np.ones(len(at))
    shift = 0.25 * r2[:, None] * (0.5 * laplacian + np.einsum("nki,ni->nk", inverse, log_jacobian))
    return np.asarray(shift)
