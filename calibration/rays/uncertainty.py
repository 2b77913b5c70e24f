"""How sure the sighting rays are, by the covariance of the fit that gave them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.camera import GRID, pixel_grid
from calibration.geometry import Array
from calibration.rays.two_plane import TwoPlaneCamera


@dataclass(frozen=True, slots=True, eq=False)
class RayUncertainty:
    """Standard deviation of the rays from the noise of the calibration's own marks, over a grid of pixels."""

    depth: float  # mm
    pixels: Array  # (R, C, 2) px
    sigma_mm: Array  # (R, C) of one coordinate across depth; NaN outside the calibrated volume


def ray_uncertainty(
    camera: TwoPlaneCamera, depths: Sequence[float], *, grid: tuple[int, int] = GRID
) -> tuple[RayUncertainty, ...]:
    """Maps of ray uncertainty at chosen stand-offs, in closed form from the covariance of the fit.

    Parameters
    ----------
    camera : TwoPlaneCamera
        Its ``model`` decides whose rays: the joint field's, or those through the two nearest planes, whose covariance is
        that of (1 - t) S1 + t S2 with t = (z - z1) / (z2 - z1).
    depths : sequence of float
        Stand-offs, mm along the depth axis.
    """
    pixels = pixel_grid(camera.size, grid)
    flat = pixels.reshape(-1, 2)
    found = []
    for depth in depths:
        at = np.full(len(flat), float(depth))
        if camera.model == "joint":
            sigma = camera.field.sigma_at(flat, at)
        else:
            sigma = _two_plane_sigma(camera, flat, float(depth))
        points = np.column_stack([camera.field.crossing(flat, at), at]) @ camera.field.c_from_d.T
        sigma = np.where(camera.volume.contains(points), sigma, np.nan)
        found.append(RayUncertainty(float(depth), pixels, sigma.reshape(grid)))
    return tuple(found)


def _two_plane_sigma(camera: TwoPlaneCamera, pixels: Array, depth: float) -> Array:
    """Standard deviation (N,) mm across depth of the rays through the two planes nearest to a depth."""
    nearest = sorted(np.argsort(np.abs(camera.field.depths - depth))[:2])
    first, second = (camera.maps[i] for i in nearest)
    z1, z2 = (camera.field.depth(m.points(pixels)) for m in (first, second))
    t = (depth - z1) / (z2 - z1)
    return np.asarray(np.hypot((1 - t) * first.sigma_at(pixels), t * second.sigma_at(pixels)))
