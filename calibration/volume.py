"""The calibrated volume: where marks surrounded the space, so that maps interpolate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools

BEYOND = 0.05  # of the range of depths, by which the volume reaches past the outer planes


@dataclass(frozen=True, slots=True, eq=False)
class Volume:
    """A convex volume: ``normals @ x <= offsets``."""

    normals: Array  # (K, 3) unit, outwards
    offsets: Array  # (K,) mm

    @classmethod
    def around(cls, points: Array, axis: Array) -> Volume:
        """Hull of points (N, 3) mm, its ends moved out along ``axis`` (3,) by 5 % of the range of depths.

        Points in one plane (freehand views of a single pose, say) have no volume: ``ValueError``.
        """
        from scipy.spatial import ConvexHull, QhullError

        centred = points - points.mean(axis=0)
        spread = np.linalg.svd(centred, compute_uv=False)
        if spread[-1] < 1e-9 * spread[0]:
            raise ValueError("the points lie in one plane")
        try:
            equations = ConvexHull(points).equations
        except QhullError as error:
            raise ValueError("the points enclose no volume") from error
        normals, offsets = equations[:, :3], -equations[:, 3]
        beyond = BEYOND * float(np.ptp(points @ axis))
        offsets = offsets + beyond * (np.abs(normals @ axis) > np.cos(np.deg2rad(45.0)))
        kept = np.unique(np.round(np.column_stack([normals, offsets]), 9), axis=0)
        return cls(kept[:, :3], kept[:, 3])

    @classmethod
    def everywhere(cls) -> Volume:
        """All of space."""
        return cls(np.zeros((0, 3)), np.zeros(0))

    def contains(self, points: Array, *, margin: float = 0.0) -> Bools:
        """Mask (N,) of points (N, 3) mm at most ``margin`` mm outside; False for NaN."""
        inside = np.asarray(np.isfinite(points).all(axis=1))
        for normal, offset in zip(self.normals, self.offsets, strict=True):
            inside &= points @ normal <= offset + margin
        return inside
