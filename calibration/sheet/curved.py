"""The sheet of light: a plane, or curved behind a window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calibration.geometry import Array, Plane, Ranged, Rays
from calibration.reason import Reason


class Sheet(Protocol):
    """Anything that rays can be intersected with; `Plane` is the simplest."""

    def intersect(self, rays: Rays, *, min_incidence: float = 0.02) -> Ranged:
        """Points (N, 3) mm where N rays meet the sheet; NaN and a reason where they do not."""
        ...

    def distance(self, points: Array) -> Array:
        """Signed distances (N,) mm of points (N, 3), along the normal of the sheet's plane."""
        ...

    def normal_at(self, points: Array) -> Array:
        """Unit normals (N, 3) of the sheet below points (N, 3)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class SheetFrame:
    """Coordinates within a sheet: where parameters of a sheet and their covariance are expressed.

    A sheet near the plane through ``centre`` spanned by ``axes`` is moved along the normal by
    ``terms(points) @ parameters``: tilt about both axes, offset, and, where curved, a^2, a b, b^2, a^3, a^2 b ...
    """

    centre: Array  # (3,) mm
    axes: Array  # (2, 3) unit, within the plane
    reach: float  # mm, by which the coordinates a and b are divided

    def coordinates(self, points: Array) -> Array:
        """(N, 2) of points (N, 3), about -1 to 1 over what was measured."""
        return np.asarray((points - self.centre) @ self.axes.T / self.reach)

    def terms(self, points: Array, *, order: int) -> Array:
        """(N, 3) for order 1, else up to that order in a and b: (N, 6), (N, 10), (N, 14)."""
        a, b = self.coordinates(points).T
        return np.stack([a, b, np.ones_like(a), *(a**i * b**j for i, j in bends(order))], axis=1)


def bends(order: int) -> list[tuple[int, int]]:
    """Exponents of a and b in the terms of orders 2 to ``order``, at most 4: a^2, a b, b^2, a^3 ...

    Without b^4: b is the shorter axis, mostly that of depth, on which few planes tell anything.
    """
    return [(n - j, j) for n in range(2, order + 1) for j in range(min(n, 3) + 1)]


def order_of(terms: int) -> int:
    """Order of a sheet with so many terms, tilts and offset included; ``ValueError`` for a number that none has."""
    orders = {3: 1, 6: 2, 10: 3, 14: 4}
    if terms not in orders:
        raise ValueError(f"a sheet of {terms} terms; 3, 6, 10 or 14 are possible")
    return orders[terms]


@dataclass(frozen=True, slots=True, eq=False)
class CurvedSheet:
    """A plane with a departure along its normal: n . x = offset + k . (a^2, a b, b^2), and up to the fourth order."""

    plane: Plane
    frame: SheetFrame
    curvature: Array  # (3,), (7,) or (11,) mm

    @property
    def normal(self) -> Array:
        """Unit normal (3,) of the base plane."""
        return self.plane.normal

    @property
    def offset(self) -> float:
        """Offset of the base plane, mm."""
        return self.plane.offset

    @property
    def order(self) -> int:
        """Of the departure in a and b: 2, 3 or 4."""
        return order_of(3 + len(self.curvature))

    def departure(self, points: Array) -> Array:
        """Height (N,) mm of the sheet above its base plane at points (N, 3)."""
        return np.asarray(self.frame.terms(points, order=self.order)[:, 3:] @ self.curvature)

    def distance(self, points: Array) -> Array:
        """Signed distances (N,) mm along the base plane's normal."""
        return np.asarray(self.plane.distance(points) - self.departure(points))

    def normal_at(self, points: Array) -> Array:
        """Unit normals (N, 3): gradient of `distance`."""
        a, b = self.frame.coordinates(points).T
        along = np.zeros((len(points), 2))
        for k, (i, j) in zip(self.curvature / self.frame.reach, bends(self.order), strict=True):
            along[:, 0] += k * i * a ** max(i - 1, 0) * b**j
            along[:, 1] += k * j * a**i * b ** max(j - 1, 0)
        normals = self.plane.normal - along @ self.frame.axes
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def intersect(self, rays: Rays, *, min_incidence: float = 0.02) -> Ranged:
        """Intersect by Newton's method from the base plane.

        The departure is small beside the distance, so three steps reach rounding error; a row that has not converged to
        a micrometre gets ``Reason.SHALLOW``.
        """
        first = self.plane.intersect(rays, min_incidence=min_incidence)
        points = first.points
        for _ in range(3):
            slope = np.einsum("ni,ni->n", rays.direction, self.normal_at(points))
            points = points - (self.distance(points) / np.where(np.abs(slope) > 1e-9, slope, np.nan))[:, None] * (
                rays.direction
            )
        lost = (first.reason == Reason.RANGED) & ~(np.abs(self.distance(points)) < 1e-3)
        reason = np.where(lost, Reason.SHALLOW, first.reason).astype(np.uint8)
        points[lost] = np.nan
        incidence = np.abs(np.einsum("ni,ni->n", rays.direction, self.normal_at(points)))
        return Ranged(points, np.where(np.isfinite(incidence), incidence, first.incidence), reason)
