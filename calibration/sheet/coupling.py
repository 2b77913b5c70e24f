"""What camera and sheet share: a sheet that was found with a camera errs with it, and partly makes good for it.

The sheet is fitted to points that the camera put on its targets. Where a parameter of the camera is wrong, a target held by hand is
placed wrongly, the stripe on it too, and the sheet moves along; a point that is ranged with both is then wrong by far less than
either alone would make it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.camera import Camera
from calibration.geometry import Array
from calibration.sheet.curved import order_of
from calibration.sheet.laser import TUKEY, Laser, StripePoints

_MAD = 1.4826


def moved_stripe(
    camera: Camera, stripe: tuple[Array, Array], normal: Array, marks: tuple[Array, Array] | None, centre: Array
) -> Array:
    """Movement (n, 3, P) mm of a stripe's points on a target, a unit of each of the P parameters of the camera.

    Parameters
    ----------
    camera : Camera
    stripe : (pixels (n, 2), points (n, 3))
        px, and mm in C on the target.
    normal, centre : (3,) arrays
        Of the target's plane, and a point about which it turns, mm in C.
    marks : (pixels (m, 2), points (m, 3)), optional
        Of a target held by hand, whose pose was found by them and so moves with the camera: the rigid motion that brings them
        nearest to their moved rays, to first order. None where a jig holds the target.
    """
    pixels, points = stripe
    rays = camera.jacobian(pixels, points)  # (n, 3, P)
    view = camera.rays(pixels).direction
    lift = np.zeros((len(points), rays.shape[2]))
    if marks is not None:
        motion = followed(camera, *marks, centre)  # (6, P)
        arm = points - centre
        lift = np.cross(arm, normal) @ motion[:3] + normal @ motion[3:]
    steep = view @ normal
    gap = (np.einsum("i,nip->np", normal, rays) - lift) / np.where(np.abs(steep) < 1e-6, np.nan, steep)[:, None]
    return np.asarray(rays - view[:, :, None] * gap[:, None, :])


def followed(camera: Camera, pixels: Array, points: Array, centre: Array) -> Array:
    """Turn about ``centre`` (rad) and shift (mm), (6, P), of a target that follows the rays of its marks, a unit of each parameter."""
    moved = camera.jacobian(pixels, points)
    view = camera.rays(pixels).direction
    known = np.isfinite(moved).all(axis=(1, 2)) & np.isfinite(view).all(axis=1)
    moved, view, arm = moved[known], view[known], points[known] - centre
    across = np.eye(3) - np.einsum("ni,nj->nij", view, view)
    x, y, z = arm.T
    zero = np.zeros_like(x)
    turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)  # d(point)/d(turn)
    system = np.concatenate([across @ turned, across], axis=2).reshape(-1, 6)
    return np.asarray(np.linalg.lstsq(system, (across @ moved).reshape(len(system), -1), rcond=None)[0])


def coupled(laser: Laser, stripes: list[StripePoints], moved: list[Array]) -> Laser:
    """Return the laser with how its parameters follow those of the camera.

    Parameters
    ----------
    laser : Laser
        As fitted to the stripes.
    stripes : list of StripePoints
    moved : list of (n, 3, P) arrays
        `moved_stripe` of each.
    """
    points, by = np.concatenate([s.points for s in stripes]), np.concatenate(moved)
    residual = laser.sheet.distance(points)
    scale = max(_MAD * float(np.median(np.abs(residual))), 1e-9)
    weight = np.where(np.abs(residual) < TUKEY * scale, 1 - (residual / (TUKEY * scale)) ** 2, 0.0)  # root of Tukey's
    weight[~np.isfinite(by).all(axis=(1, 2))] = 0.0
    terms = laser.frame.terms(points, order=order_of(len(laser.covariance)))
    off = np.einsum("ni,nip->np", laser.sheet.normal_at(points), np.nan_to_num(by))
    found = np.linalg.lstsq(terms * weight[:, None], off * weight[:, None], rcond=None)[0]
    return replace(laser, coupling=np.asarray(found))
