"""What freehand views determine of a lens: the part of the image they cover, where it folds, and the view that would help most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import cv2
import numpy as np

from calibration.camera import GRID, pixel_grid
from calibration.geometry import Array, Bools, Pose
from calibration.rays.bundle import LENS, information_of
from calibration.rays.pinhole import FreehandFit, PinholeCamera
from calibration.rays.plane_map import PlaneMarks

FOCAL_KNOWN = 0.05  # of the focal length: two of its standard errors must be less
TILT = 30.0  # degrees, of the views that are advised
FILLED = 0.7  # of the image's shorter side, by a target that is brought near
_PLACES = {
    (0, 0): "in the middle", (-1, 0): "at the left edge", (1, 0): "at the right edge", (0, -1): "at the top edge",
    (0, 1): "at the bottom edge", (-1, -1): "in the top left corner", (1, -1): "in the top right corner",
    (-1, 1): "in the bottom left corner", (1, 1): "in the bottom right corner",
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Where the views have marks, over a grid of R x C blocks of the image."""

    pixels: Array  # (R, C, 2) px, the middles of the blocks
    covered: Bools  # (R, C) between the marks of a view
    sigma_px: (
        Array  # (R, C) px, one sigma of the lens there that no pose of a target would hide; beyond the marks a guess
    )

    @property
    def share(self) -> float:
        """Part of the image that is covered."""
        return float(self.covered.mean())

    @property
    def worst_px(self) -> float:
        """Largest sigma of the covered part, px."""
        return float(self.sigma_px[self.covered].max()) if self.covered.any() else float("nan")


@dataclass(frozen=True, slots=True)
class NextView:
    """A view to add."""

    axis: Literal["u", "v"]  # about which the target is tilted
    place: str  # where in the image
    distance: float  # mm, of its middle
    nearer: bool  # than the views that there are
    gain: float  # by which it multiplies what is uncertain most

    @property
    def advice(self) -> str:
        """What to do, in words."""
        near = f"bring the target to about {self.distance:.0f} mm and " if self.nearer else ""
        return f"{near}tilt {'it' if near else 'the target'} by {TILT:.0f} degrees about {self.axis}, {self.place}"


def coverage_of(fit: FreehandFit, *, grid: tuple[int, int] = GRID) -> Coverage:
    """Blocks of the image that lie between the marks of a view, and how well the lens is known there.

    ``sigma_px`` is root mean square over both coordinates, once the best shift, turn and scale of the whole image (which a pose
    takes up nearly) are taken off.
    """
    pixels = pixel_grid(fit.camera.size, grid)
    covered = np.zeros(grid, dtype=bool)
    for view in fit.views:
        hull = cv2.convexHull(view.pixels.astype(np.float32))[:, 0].astype(np.float64)
        along = np.roll(hull, -1, axis=0) - hull
        away = pixels[:, :, None] - hull
        side = along[:, 0] * away[..., 1] - along[:, 1] * away[..., 0]
        covered |= (side >= 0).all(axis=2) | (side <= 0).all(axis=2)
    return Coverage(pixels, covered, _sigma(fit.camera, pixels.reshape(-1, 2), fit.camera.covariance).reshape(grid))


def _shapes(camera: PinholeCamera, pixels: Array) -> Array:
    """Movement (N, 2, 9) px of the image by each parameter of the lens, similarities of the whole image taken off."""
    directions = PinholeCamera.directions(pixels, camera.matrix, camera.distortion)
    lens = np.array([*camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *camera.distortion])
    matrix = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
    jacobian = cv2.projectPoints(directions[:, None], np.zeros(3), np.zeros(3), matrix, lens[4:])[1][:, 6 : 6 + LENS]
    x, y = (pixels - pixels.mean(axis=0)).T
    one, none = np.ones(len(x)), np.zeros(len(x))
    similar = np.stack([np.stack([one, none, x, -y], axis=1), np.stack([none, one, y, x], axis=1)], axis=1)
    q = np.linalg.qr(similar.reshape(-1, 4))[0]
    return np.asarray((jacobian - q @ (q.T @ jacobian)).reshape(-1, 2, LENS))


def _sigma(camera: PinholeCamera, pixels: Array, covariance: Array) -> Array:
    shapes = _shapes(camera, pixels)
    return np.asarray(np.sqrt(np.maximum(np.einsum("nki,ij,nkj->n", shapes, covariance, shapes) / 2, 0.0)))


def folds(fit: FreehandFit) -> float:
    """Radius, px from the principal point, at which the distortion folds the image between its marks; infinite where it does not.

    A lens maps directions to pixels one to one: the derivative of its distortion is positive. It counts as folded where it is not
    by two of its standard errors, so that a distortion is told that only might fold.
    """
    k1, k2, _, _, k3 = fit.camera.distortion
    focal = float(fit.camera.matrix[[0, 1], [0, 1]].mean())
    reach = max(float(_radius(view).max()) for view in fit.views)
    r = np.linspace(0.0, reach, 200)
    powers = np.stack([3 * r**2, 5 * r**4, 7 * r**6], axis=1)
    slope = 1.0 + powers @ [k1, k2, k3]
    covariance = fit.camera.covariance[np.ix_([4, 5, 8], [4, 5, 8])]
    doubt = np.sqrt(np.einsum("ri,ij,rj->r", powers, covariance, powers))
    bad = np.flatnonzero(slope - 2.0 * doubt <= 0.0)
    if not len(bad):
        return float("inf")
    at = r[bad[0]]
    return float(focal * at * abs(1 + k1 * at**2 + k2 * at**4 + k3 * at**6))


def _radius(view: PlaneMarks) -> Array:
    """Tangent (n,) of the angle of each mark with the axis, as its pose says: no distortion has to be undone for it."""
    world = view.world
    return np.asarray(np.linalg.norm(world[:, :2], axis=1) / world[:, 2])


def next_view(fit: FreehandFit) -> NextView:
    """The view that would tell most about the lens: a target tilted about u or v, somewhere in the image.

    Judged is the focal length where it is not determined, else the lens over the whole image. Each candidate shows the
    target of the views at their usual distance or, where it fills little of the image, nearer; what it would add to their
    information is found without taking it.
    """
    camera = fit.camera
    focal = camera.matrix[0, 0]
    undetermined = 2.0 * np.sqrt(camera.covariance[0, 0]) > FOCAL_KNOWN * focal
    shapes = _shapes(camera, pixel_grid(camera.size, (12, 16)).reshape(-1, 2))
    spread = np.einsum("nki,nkj->ij", shapes, shapes) / (2 * len(shapes))

    def judged(covariance: Array) -> float:
        return float(np.sqrt(covariance[0, 0] if undetermined else (spread * covariance).sum()))

    scale = np.sqrt(np.maximum(np.diag(camera.covariance), 1e-300))
    known = np.linalg.pinv(camera.covariance / np.outer(scale, scale), rcond=1e-13, hermitian=True)
    before, found = judged(camera.covariance), []
    usual, full = _distances(fit)
    distances = (usual, full) if full < 0.75 * usual else (usual,)
    for distance, (place, name), axis in product(distances, _PLACES.items(), ("u", "v")):
        seen = _candidate(fit, place, axis, distance)
        if seen is None:
            continue
        more = seen / max(camera.sigma, 1e-9) ** 2 * np.outer(scale, scale)
        covariance = np.linalg.pinv(known + more, rcond=1e-13, hermitian=True) * np.outer(scale, scale)
        gain = judged(covariance) / max(before, 1e-300)
        found.append(NextView(axis, name, distance, distance < usual, gain))  # type: ignore[arg-type]
    return min(found, key=lambda view: view.gain, default=NextView("u", _PLACES[0, 0], usual, False, 1.0))


def _distances(fit: FreehandFit) -> tuple[float, float]:
    """Usual distance of the views, mm, and that at which the target would fill `FILLED` of the image, half of it at least."""
    extent = np.median([np.ptp(view.points, axis=0) for view in fit.views], axis=0)
    usual = float(np.median([view.world[:, 2].mean() for view in fit.views]))
    full = float(fit.camera.matrix[0, 0] * extent.max() / (FILLED * min(fit.camera.size)))
    return usual, max(full, usual / 2)


def _candidate(fit: FreehandFit, place: tuple[int, int], axis: str, distance: float) -> Array | None:
    """What a view would say of the lens (9, 9), px^2; None where fewer than half of its marks would be in the image."""
    camera, size = fit.camera, np.array(fit.camera.size, dtype=np.float64)
    largest = max(fit.views, key=len)
    points = largest.points - (largest.points.min(axis=0) + largest.points.max(axis=0)) / 2
    reach = 0.5 * camera.matrix[0, 0] * np.ptp(points, axis=0) / distance
    room = np.maximum(size / 2 - reach, 0.0)  # by which the middle of the target may stand off that of the image
    where = (size - 1) / 2 + np.array(place) * room
    ray = PinholeCamera.directions(where[None], camera.matrix, camera.distortion)[0]
    tilt = np.deg2rad(TILT) * (np.array([1.0, 0.0, 0.0]) if axis == "u" else np.array([0.0, 1.0, 0.0]))
    upright = np.median([_turn(view.c_from_plane) for view in fit.views])
    turned = Pose.from_rotation_vector(tilt, np.zeros(3)) @ Pose.from_rotation_vector([0.0, 0.0, upright], np.zeros(3))
    vector = cv2.Rodrigues(turned.rotation)[0].ravel()
    pose = np.array([*vector, *(ray * distance / ray[2])])
    lens = np.array([*camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *camera.distortion])
    information, pixels = information_of(points, pose, lens)
    inside = ((pixels >= 0) & (pixels <= size - 1)).all(axis=1)
    if inside.sum() < max(6, len(points) / 2):
        return None
    return information if inside.all() else information_of(points[inside], pose, lens)[0]


def _turn(pose: Pose) -> float:
    """Angle, rad, by which the target's x points away from u in the image."""
    return float(np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0]))


def undetermined(fit: FreehandFit, advice: str) -> Sequence[str]:
    """Reasons why a freehand camera does not pass: what its views leave open."""
    reasons = []
    focal, sigma = float(fit.camera.matrix[0, 0]), float(np.sqrt(fit.camera.covariance[0, 0]))
    if not 2.0 * sigma <= FOCAL_KNOWN * focal:
        reasons.append(
            f"the {len(fit.views)} views do not determine the focal length to {100 * FOCAL_KNOWN:.0f} % (it is {focal:.0f} +- {sigma:.0f} px, "
            f"one sigma): add views; next {advice}"
        )
    folded = folds(fit)
    if np.isfinite(folded):
        reasons.append(
            f"the distortion {_written(fit)} folds, or may fold, the image {folded:.0f} px from its principal point, where there are "
            f"marks: the views do not determine it; next {advice}"
        )
    return reasons


def _written(fit: FreehandFit) -> str:
    names = ("k1", "k2", "p1", "p2", "k3")
    return ", ".join(f"{n} {d:.3g}" for n, d in zip(names, fit.camera.distortion, strict=True) if d)
