"""Parts of a cloud: boxes, and what stands on a polygon."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calibration.geometry import Array, Bools

Interval = tuple[float, float]
_ALL: Interval = (-math.inf, math.inf)


class Region(Protocol):
    """Anything that says which points it holds."""

    def contains(self, points: Array) -> Bools:
        """Mask (N,) of points (N, 3) mm in the cloud frame."""
        ...


@dataclass(frozen=True, slots=True)
class Box:
    """An axis-parallel box in the cloud frame; a side left out is unbounded. Borders belong to it."""

    x: Interval = _ALL  # mm
    y: Interval = _ALL
    z: Interval = _ALL

    def __post_init__(self) -> None:
        for name in ("x", "y", "z"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"box {name} runs from {low} to {high}; the first must be the smaller")

    def contains(self, points: Array) -> Bools:
        """Mask (N,) of points (N, 3) mm inside or on the border."""
        low = np.array([self.x[0], self.y[0], self.z[0]])
        high = np.array([self.x[1], self.y[1], self.z[1]])
        return np.asarray(((points >= low) & (points <= high)).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Polygon:
    """The prism over a polygon (M, 2) mm in x and y of the cloud frame; even-odd rule, either sense of turn."""

    corners: Array

    def __post_init__(self) -> None:
        if self.corners.ndim != 2 or self.corners.shape[1] != 2 or len(self.corners) < 3:
            raise ValueError("a polygon needs three corners (x, y) or more")
        if not np.isfinite(self.corners).all():
            raise ValueError("a corner is not finite")

    def contains(self, points: Array) -> Bools:
        """Mask (N,) of points (N, 3) mm: crossings of a line towards +x are counted."""
        inside = np.zeros(len(points), dtype=np.bool_)
        x, y = points[:, 0], points[:, 1]
        for (x0, y0), (x1, y1) in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            if y0 != y1:
                crossed = (y0 > y) != (y1 > y)
                inside ^= crossed & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        return inside
