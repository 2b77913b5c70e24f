"""What every camera can do, whatever its model."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from calibration.geometry import Array, Rays
from calibration.volume import Volume


class Camera(Protocol):
    """A calibrated camera. Nobody may assume that its rays meet in one point."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images, px."""
        ...

    @property
    def volume(self) -> Volume:
        """Where the calibration holds."""
        ...

    @property
    def model(self) -> str:
        """``two-plane``, ``joint`` or ``pinhole``."""
        ...

    def rays(self, pixels: Array, *, near: Array | float | None = None) -> Rays:
        """RaySource rays in C of pixels (N, 2) px; ``near`` is the depth, mm, at which they should be best."""
        ...

    def shift(self, pixels: Array, points: Array) -> Array:
        """Movement (N, 3, 2) mm/px of the points (N, 3) on the rays of pixels when the pixel moves in u and in v."""
        ...

    def sigma_at(self, pixels: Array, points: Array) -> Array:
        """Standard deviation (N,) mm of the rays across their direction at points (N, 3), from the calibration."""
        ...

    @property
    def covariance(self) -> Array:
        """Covariance (P, P) of the parameters."""
        ...

    def jacobian(self, pixels: Array, points: Array) -> Array:
        """Movement (N, 3, P) mm of the rays of pixels at points (N, 3) on them, a unit of each parameter."""
        ...


def centre_of(rays: Rays) -> Array:
    """Point (3,) mm nearest to all rays in the least squares sense; rows of NaN do not count.

    Nearly parallel rays leave it undetermined along themselves: it is then taken nearest to their origins.
    """
    known = np.isfinite(rays.origin).all(axis=1)
    o, d = rays.origin[known], rays.direction[known]
    across = np.eye(3) - np.einsum("ni,nj->nij", d, d)
    matrix, rhs = across.sum(axis=0), np.einsum("nij,nj->i", across, o)
    middle = o.mean(axis=0)
    return np.asarray(middle + np.linalg.lstsq(matrix, rhs - matrix @ middle, rcond=1e-9)[0])


GRID = (48, 64)  # rows and columns of the pixels that pictures of the whole image sample


def pixel_grid(size: tuple[int, int], grid: tuple[int, int]) -> Array:
    """Pixels (R, C, 2) at the centres of R x C equal blocks of an image of ``size`` (width, height) px."""
    rows, columns = grid
    u = (np.arange(columns) + 0.5) * size[0] / columns - 0.5
    v = (np.arange(rows) + 0.5) * size[1] / rows - 0.5
    return np.stack(np.meshgrid(u, v), axis=-1)
