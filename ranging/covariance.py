"""How a point moves when its pixel, a ray or the sheet of light moves: its covariance, and its Jacobian to the calibration.

A ray that moves by d where it meets the sheet, and a sheet that moves by h along its normal n, move the point by

    dX = d - v (n . d - h) / (n . v),

v being the ray: the point runs along the ray until it is on the sheet again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.camera import Camera
from calibration.geometry import Array
from calibration.sheet import Laser

BATCH = 2048  # points


@dataclass(frozen=True, slots=True, eq=False)
class PointCovariance:
    """Covariance of N points, in two parts that must not be added where points are averaged.

    ``parameters`` is the covariance of the P parameters of the calibration: those of the camera (`Camera.covariance`), then
    those of the lasers (`Laser.covariance`); the camera's move a laser too, by its ``coupling``. Points i and k share the covariance
    ``jacobian[i] @ parameters @ jacobian[k].T``.
    """

    noise: Array  # (N, 3, 3) mm^2, of the stripe: independent from point to point
    calibration: Array  # (N, 3, 3) mm^2, of camera and sheet: shared by all points
    parameters: Array  # (P, P)
    jacobian: Array | None = None  # (N, 3, P) mm a unit of each parameter, where it was asked for


def propagate(
    camera: Camera, laser: Laser, pixels: Array, points: Array, sigma: Array, across: int, *, jacobian: bool = False
) -> PointCovariance:
    """Covariance of ranged points of one laser, in C.

    Parameters
    ----------
    camera, laser : Camera, Laser
        As the points were ranged with.
    pixels, points : (N, 2) px and (N, 3) mm arrays
        Of the stripe, and where it was ranged to. All finite.
    sigma : (N,) array, mm
        Along the ray, from the noise of the stripe.
    across : 0 or 1
        Which coordinate of a pixel runs across the stripe: 0 for u.
    jacobian : bool
        Whether to hand over the derivatives by all parameters: 24 N P bytes.

    Returns
    -------
    PointCovariance
        Both matrices of a point are singular where fewer than three causes move it: the noise of the stripe moves it within
        the sheet, along one line.
    """
    kept = np.full((len(points), 3, len(camera.covariance) + len(laser.covariance)), np.nan) if jacobian else None
    parameters = joined(camera.covariance, laser.covariance)
    noise, calibration = np.empty((len(points), 3, 3)), np.empty((len(points), 3, 3))
    for begin in range(0, len(points), BATCH):
        rows = slice(begin, begin + BATCH)
        seen, x = pixels[rows], points[rows]
        near = x[:, 2] if camera.model == "two-plane" else None
        view, normal = camera.rays(seen, near=near).direction, laser.sheet.normal_at(x)
        steep = np.einsum("ni,ni->n", normal, view)
        moved = camera.shift(seen, x)[:, :, across]
        slide = np.einsum("ni,ni->n", normal, moved) / steep
        line = moved / slide[:, None] - view  # of the point, for a millimetre along the ray
        noise[rows] = (sigma[rows] ** 2)[:, None, None] * line[:, :, None] * line[:, None, :]
        rays = camera.jacobian(seen, x)
        by_camera = rays - view[:, :, None] * (np.einsum("ni,nip->np", normal, rays) / steep[:, None])[:, None, :]
        by_laser = view[:, :, None] * (laser.lift(x) / steep[:, None])[:, None, :]
        if laser.coupling.size:
            by_camera += by_laser @ laser.coupling
        by_all = np.concatenate([by_camera, by_laser], axis=2)
        calibration[rows] = by_all @ parameters @ by_all.transpose(0, 2, 1)
        if kept is not None:
            kept[rows] = by_all
    return PointCovariance(noise, calibration, parameters, kept)


def joined(*covariances: Array) -> Array:
    """Covariance of parameters that were found independently of each other."""
    size = sum(len(part) for part in covariances)
    whole, at = np.zeros((size, size)), 0
    for part in covariances:
        whole[at : at + len(part), at : at + len(part)] = part
        at += len(part)
    return whole
