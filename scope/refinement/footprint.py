"""What the sheet of light shows of the model near its edges: how far the middle of the stripe is shifted there."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, Bools, Pose
from scope.model import Surface
from scope.refinement.stripe import Stripe

RAYS = 41  # over four widths of the stripe either side
LIFT = 0.02  # mm above the surface, where the way to the laser begins
SOFT = 0.04  # mm that ranging takes off by itself: smaller shifts leave nothing
MOST = 0.6  # mm


def shift_of_stripe(
    surface: Surface, pose: Pose, points: Array, camera: Array, stripe: Stripe, normal: Array, residual: Array
) -> Array:
    """Shift (N,) mm across the surface that the edges of a model give to the middle of the stripe at each point.

    The line of the image across the stripe is looked along with rays; each meets the model (or passes it), where the light is a
    Gaussian of the distance from the sheet times the cosine to the laser, none in the shade. The mean of the rays, weighted with
    the light, is where a stripe's middle is seen; how far it is from where the sheet cuts the surface is what an edge does to it.

    Parameters
    ----------
    surface, pose : Surface, Pose
        Of the model, cloud_from_model.
    points, camera, stripe : (N, 3) mm, (N, 3) mm, Stripe of N
        Each point lies on its sheet of light.
    normal, residual : (N, 3), (N,) mm
        Of the surface at each point's foot, and the point's distance from it.

    Notes
    -----
    Ranging corrects most of this from the neighbours of a point; what is left is a share that the scan itself shows (see
    `scope.refinement.system`). Weak where two surfaces are lit at once: real methods take the brighter peak.
    """
    ray = points - camera
    distance = np.linalg.norm(ray, axis=1)
    ray /= distance[:, None]
    aside = stripe.across - (stripe.across * ray).sum(axis=1, keepdims=True) * ray
    steep = distance * (aside * stripe.sheet).sum(axis=1)  # mm across the sheet for one of aside
    steep = np.where(np.abs(steep) < 1e-6, 1e-6, steep)
    reach = 4.0 * stripe.width / np.abs(steep)
    step = np.linspace(-1.0, 1.0, RAYS)
    way = ray[:, None] + (reach[:, None] * step)[:, :, None] * aside[:, None]
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    inverse = pose.inverse
    origin = np.broadcast_to(inverse.apply(camera)[:, None], way.shape).reshape(-1, 3)
    local_way = way.reshape(-1, 3) @ pose.rotation
    hit = surface.first_hit(origin, local_way)
    met = np.isfinite(hit)
    at = origin + np.where(met, hit, 0.0)[:, None] * local_way
    height = ((pose.apply(at).reshape(way.shape) - points[:, None]) * stripe.sheet[:, None]).sum(axis=2).ravel()
    some = np.flatnonzero(met & (np.abs(height) < 4.0 * stripe.width))
    light = np.zeros(len(hit))
    light[some] = np.exp(-0.5 * (height[some] / stripe.width) ** 2)
    if stripe.laser is not None:
        light[some] *= _lit(surface, at[some], inverse.apply(np.repeat(stripe.laser, RAYS, axis=0)[some]))
    shown = light.reshape(len(points), RAYS)
    total = shown.sum(axis=1)
    turned = reach * (shown @ step) / np.maximum(total, 1e-12)
    along = -turned * steep / (ray * stripe.sheet).sum(axis=1)
    moved = aside * (distance * turned)[:, None] + ray * along[:, None]
    shift = (moved * normal).sum(axis=1) + residual
    return np.clip(np.where(total > 0, shift, 0.0), -MOST, MOST)


def soft(shift: Array) -> Array:
    """What is left of shifts (N,) mm beyond those that ranging takes off."""
    return np.asarray(np.sign(shift) * np.maximum(np.abs(shift) - SOFT, 0.0))


def _lit(surface: Surface, at: Array, laser: Array) -> Array:
    """Cosine (M,) between surface and laser, 0 in the shade."""
    if len(at) == 0:
        return np.zeros(0)
    normal = surface.nearest(at)[1]
    way = laser - at
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    cosine = (way * normal).sum(axis=1)
    open_: Bools = np.isinf(surface.first_hit(at + LIFT * normal, way))
    return np.where(open_, np.maximum(cosine, 0.0), 0.0)
