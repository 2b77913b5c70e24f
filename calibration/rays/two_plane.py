"""The camera of the method of planes: sighting rays through a pixel's points on several planes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Rays
from calibration.rays.plane_map import MAX_ORDER, Order, PlaneFit, PlaneMap, PlaneMarks, fit_plane_map
from calibration.rays.polynomial import exponents
from calibration.rays.ray_field import RayField, RayFieldFit, depth_frame, fit_ray_field
from calibration.volume import Volume

BETTER = 0.98  # of the left-out error, by which other terms than planes choose must be better
MANY = 4.0  # marks a term, beyond which a plane chooses its degree well by itself
SAME_DEPTH = 1e-3  # of the depths' own size: planes closer than this stand at the same stand-off


@dataclass(frozen=True, slots=True, eq=False)
class TwoPlaneCamera:
    """Plane maps, the joint field of rays through all planes, and where both hold."""

    maps: tuple[PlaneMap, ...]  # by depth, ascending
    field: RayField
    size: tuple[int, int]  # px, width and height
    volume: Volume
    model: Literal["two-plane", "joint"]  # which of the two ranging should use

    def rays(self, pixels: Array, *, near: Array | float | None = None) -> Rays:
        """RaySource rays in C.

        Parameters
        ----------
        pixels : (N, 2) array
            px (u, v).
        near : scalar or (N,) array, optional
            Depth, mm. With it, each ray goes through the pixel's points on the two planes nearest to that depth
            (DePiero & Kress, equation 1), its origin on the plane nearer to the camera. Without it, the joint field.
        """
        if near is None:
            return self.field.rays(pixels)
        depths = self.field.depths
        near = np.broadcast_to(np.asarray(near, dtype=np.float64), len(pixels))
        middle = (depths[:-1] + depths[1:]) / 2
        # the two planes nearest to z are neighbours: i, i + 1 with z between the midpoints around them
        outer = (depths[:-2] + depths[2:]) / 2 if len(depths) > 2 else middle[:0]
        first = np.searchsorted(outer, near)
        origin, direction = np.full((len(pixels), 3), np.nan), np.full((len(pixels), 3), np.nan)
        for i in np.unique(first):
            rows = (first == i) & np.isfinite(near)
            s1, s2 = self.maps[i].points(pixels[rows]), self.maps[i + 1].points(pixels[rows])
            if self.field.forward < 0:
                s1, s2 = s2, s1
            origin[rows] = s1
            direction[rows] = (s2 - s1) / np.linalg.norm(s2 - s1, axis=1, keepdims=True)
        return Rays(origin, direction)

    def shift(self, pixels: Array, points: Array) -> Array:
        """Movement (N, 3, 2) mm/px, across depth, of points on the rays of pixels when the pixel moves."""
        across = self.field.jacobian(pixels, self.field.depth(points))
        turn = self.field.c_from_d
        moved = np.zeros((len(across), 3, 2))
        for i, j in zip(*np.nonzero(turn[:, :2]), strict=True):  # two of six where depth is z
            moved[:, i] += turn[i, j] * across[:, j]
        return moved

    def sigma_at(self, pixels: Array, points: Array) -> Array:
        """Standard deviation (N,) mm of the rays across depth at points (N, 3), from the noise of the marks."""
        return self.field.sigma_at(pixels, self.field.depth(points))

    @property
    def covariance(self) -> Array:
        """Covariance (P, P) of the coefficients of the joint field, those of its x before those of its y.

        The joint field stands for the plane maps, too: both were fitted to the same marks.
        """
        return np.asarray(np.kron(np.eye(2), self.field.sigma**2 * self.field.inverse), dtype=np.float64)

    def jacobian(self, pixels: Array, points: Array) -> Array:
        """Movement (N, 3, P) mm, across depth, of the rays of pixels at points (N, 3), a unit of each coefficient."""
        row = self.field.design(pixels, self.field.depth(points))
        return np.concatenate([self.field.c_from_d[:, k, None] * row[:, None, :] for k in range(2)], axis=2)


@dataclass(frozen=True, slots=True, eq=False)
class TwoPlaneFit:
    """A camera and the intra-plane analysis of its planes."""

    camera: TwoPlaneCamera
    planes: tuple[PlaneFit, ...]  # as the camera's maps
    marks: tuple[PlaneMarks, ...]  # as the camera's maps
    joint: RayFieldFit


def fit_two_plane(
    planes: list[PlaneMarks],
    size: tuple[int, int],
    *,
    order: Order = "auto",
    model: Literal["two-plane", "joint"] = "joint",
) -> TwoPlaneFit:
    """Fit every plane's map and the joint field.

    Parameters
    ----------
    planes : list of PlaneMarks
        Two or more, at different stand-offs (by the mean depth of their marks).
    size : (width, height)
        Of the images, px.
    order : Order
        Of the plane maps. Within "auto", the same terms serve all planes: those, of all that may be asked for, with the least
        leave-one-out error over all, so that planes do not differ by their order.
    model : "two-plane" or "joint"
        Which rays the camera gives to ranging.

    Raises
    ------
    CalibrationError
        One plane only, two at the same stand-off, too few marks for the order.
    """
    if len(planes) < 2:
        names = ", ".join(p.name for p in planes) or "none"
        raise CalibrationError(
            f"one plane is not enough: found {len(planes)} ({names}); the method of planes needs two or more stand-offs: "
            "add a [[plane]] at another stand-off"
        )
    axis = depth_frame(planes)[:, 2]
    depth = np.array([(p.world @ axis).mean() for p in planes])
    rank = np.argsort(depth)
    ordered = [planes[k] for k in rank]
    _check_depths(ordered, depth[rank])
    joint = fit_ray_field(planes)
    fits = [_fit(p, order, joint.field) for p in ordered]
    if order == "auto":
        common = _common_order(ordered, fits, joint.field)
        fits = [_fit(p, common, joint.field) for p in ordered]
    volume = Volume.around(np.concatenate([p.world for p in planes]), axis)
    camera = TwoPlaneCamera(tuple(f.map for f in fits), joint.field, size, volume, model)
    return TwoPlaneFit(camera, tuple(fits), tuple(ordered), joint)


def with_model(camera: TwoPlaneCamera, model: Literal["two-plane", "joint"]) -> TwoPlaneCamera:
    """Camera that gives the other rays to ranging."""
    return replace(camera, model=model)


def _fit(plane: PlaneMarks, order: Order, field: RayField) -> PlaneFit:
    projective = bool(np.abs(field.domain.homography - np.eye(3)).max() > 0)
    tilted = abs(float(plane.c_from_plane.rotation[:, 2] @ field.c_from_d[:, 2])) < np.cos(np.deg2rad(2.0))
    return fit_plane_map(plane, order=order, tilted=projective or tilted)


def _common_order(planes: list[PlaneMarks], fits: list[PlaneFit], field: RayField) -> Order:
    """Terms with the least left-out sum of squares over all planes, of all that a user may ask for.

    Degrees that planes chose for themselves come first; another set (the paper's, or a degree that none chose) takes their
    place where it foretells left-out marks by more than 2 % better.
    """

    def total(order: Order) -> float:
        try:
            return float(sum(_fit(p, order, field).loo_px ** 2 * len(p) for p in planes))
        except CalibrationError:
            return float("inf")

    chosen = sorted({f.map.terms for f in fits if isinstance(f.map.terms, int)})
    totals = {degree: total(degree) for degree in chosen}
    least = min(totals.values())
    best: Order = next(degree for degree in chosen if totals[degree] == least)
    others: list[Order] = ["paper", *(n for n in range(1, MAX_ORDER + 1) if n not in totals)]
    for other in others:
        fewest = min(len(p) for p in planes)
        if fewest <= len(exponents(other)) or (other != "paper" and fewest > MANY * len(exponents(other))):
            continue  # too few marks; or so many that planes would have chosen it themselves
        squares = total(other)
        if squares < BETTER**2 * least:
            best, least = other, squares
    return best


def _check_depths(planes: list[PlaneMarks], depth: Array) -> None:
    reach = float(np.ptp(depth))
    for k in range(1, len(planes)):
        if depth[k] - depth[k - 1] <= max(SAME_DEPTH * reach, 1e-9):
            raise CalibrationError(
                f"planes {planes[k - 1].name} and {planes[k].name} both stand at {depth[k]:.4g} mm (mean depth of their "
                "marks); every plane needs a stand-off of its own: correct `origin` or leave one plane out"
            )
