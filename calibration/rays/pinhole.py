"""A pinhole with lens distortion, for targets held by hand whose poses are estimated with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Pose, Rays
from calibration.grouping import grouped
from calibration.rays.bundle import Adjusted, Term, adjust, columns
from calibration.rays.lens_terms import choose_terms, lens_covariance
from calibration.rays.plane_map import PlaneMarks, rms
from calibration.volume import Volume

_NEWTON = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-13)


@dataclass(frozen=True, slots=True, eq=False)
class PinholeCamera:
    """OpenCV's camera: matrix and distortion k1 k2 p1 p2 k3; C is its own frame unless a pose is given."""

    matrix: Array  # (3, 3) px
    distortion: Array  # (5,)
    c_from_camera: Pose
    size: tuple[int, int]  # px
    volume: Volume
    covariance: Array  # (9, 9) of fx fy cx cy k1 k2 p1 p2 k3
    sigma: float  # px, of one coordinate of a mark about the model

    @property
    def model(self) -> str:
        """Always ``pinhole``."""
        return "pinhole"

    def rays(self, pixels: Array, *, near: Array | float | None = None) -> Rays:  # noqa: ARG002  (one depth is as good as another)
        """RaySource rays in C from the one centre; ``near`` makes no difference."""
        direction = self.directions(pixels, self.matrix, self.distortion)
        origin = np.broadcast_to(self.c_from_camera.translation, direction.shape)
        return Rays(origin, direction @ self.c_from_camera.rotation.T)

    def shift(self, pixels: Array, points: Array) -> Array:
        """Movement (N, 3, 2) mm/px of points on the rays of pixels, by central differences over one pixel."""
        distance = np.linalg.norm(points - self.c_from_camera.translation, axis=1)
        moved = [
            self.rays(pixels + 0.5 * step).direction - self.rays(pixels - 0.5 * step).direction for step in np.eye(2)
        ]
        return np.stack([distance[:, None] * d for d in moved], axis=-1)

    def sigma_at(self, pixels: Array, points: Array) -> Array:
        """Standard deviation (N,) mm across the ray from the covariance of the intrinsics, by differences."""
        moved = self.jacobian(pixels, points)
        variance = np.einsum("nik,kl,nil->n", moved, self.covariance, moved) / 2
        return np.asarray(np.sqrt(np.maximum(variance, 0)))

    def jacobian(self, pixels: Array, points: Array) -> Array:
        """Movement (N, 3, 9) mm of the rays of pixels at points (N, 3), a unit of each intrinsic, by differences.

        Intrinsics that were held fixed, whose variance is 0, move nothing.
        """
        distance = np.linalg.norm(points - self.c_from_camera.translation, axis=1)
        scale = np.sqrt(np.diag(self.covariance))
        moved = np.zeros((len(pixels), 3, 9))
        for k in np.flatnonzero(scale > 0):
            ahead, behind = (
                self.directions(pixels, *_perturbed(self, int(k), step)) for step in (0.5 * scale[k], -0.5 * scale[k])
            )
            moved[:, :, k] = (ahead - behind) @ self.c_from_camera.rotation.T * (distance / scale[k])[:, None]
        return moved

    @staticmethod
    def directions(pixels: Array, matrix: Array, distortion: Array) -> Array:
        """Unit directions (N, 3) in the camera's own frame; NaN for NaN pixels."""
        if len(pixels) == 0:
            return np.zeros((0, 3))
        known = np.asarray(np.isfinite(pixels).all(axis=1))
        safe = np.where(known[:, None], pixels, 0.0)
        flat = cv2.undistortPoints(safe[:, None, :], matrix, distortion, None, None, None, _NEWTON)[:, 0]
        direction = np.column_stack([flat, np.ones(len(flat))])
        direction[~known] = np.nan
        return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True), dtype=np.float64)


def _perturbed(camera: PinholeCamera, k: int, step: float) -> tuple[Array, Array]:
    matrix, distortion = camera.matrix.copy(), camera.distortion.copy()
    if k < 4:
        matrix[[(0, 0), (1, 1), (0, 2), (1, 2)][k]] += step
    else:
        distortion[k - 4] += step
    return matrix, distortion


@dataclass(frozen=True, slots=True, eq=False)
class FreehandFit:
    """A pinhole and the poses of the views it was fitted to."""

    camera: PinholeCamera
    views: tuple[PlaneMarks, ...]  # with their poses
    residuals: tuple[Array, ...]  # (n, 2) px a view, seen minus projected
    dropped: tuple[tuple[str, str], ...]  # name and reason of the views that were left out
    terms: frozenset[Term]  # of the lens that the views have earned; the others are held
    adjusted: Adjusted  # what each view says of the lens

    @property
    def fit_px(self) -> float:
        """Root mean square residual over all marks, px."""
        return rms(np.concatenate(self.residuals))


def fit_freehand(
    views: list[PlaneMarks],
    size: tuple[int, int],
    *,
    outlier: float = 4.0,
    dropped: Sequence[tuple[str, str]] = (),
) -> FreehandFit:
    """Fit a pinhole to freehand views (Zhang 2000), with the terms they have earned, leaving out views that do not belong.

    OpenCV's calibrateCamera finds the focal length and the poses to start from; principal point, aspect and the terms of
    distortion are let free one by one, as long as views left out are foretold better by them
    (`calibration.rays.lens_terms`). What is not earned is held (the principal point in the middle of the image, one focal
    length for both axes, no distortion) and counts in the covariance as lenses are uncertain of it.

    Parameters
    ----------
    views : list of PlaneMarks
        Marks in target coordinates; the poses they carry are ignored.
    size : (width, height)
        Of the images, px.
    outlier : float
        A view whose rms is more than this many times the median of the views' rms is dropped, worst first.
    dropped : sequence of (name, reason)
        Views that were left out before; they are told with those left out here.

    Raises
    ------
    CalibrationError
        Fewer than three usable views, or views all parallel, from which focal length and distance cannot be told apart.
    """
    asked = len(views) + len(dropped)
    kept, few = _usable(views)
    dropped = [*dropped, *few]
    found: Adjusted | None = None
    terms: frozenset[Term] = frozenset()
    stale = True  # terms were chosen beside a view that is gone
    while True:
        if len(kept) < 3:
            reasons = grouped(dropped, asked, "views", longest=150)
            raise CalibrationError(
                f"{len(kept)} usable freehand view(s) of {asked}; a camera needs three or more, tilted differently: "
                f"take more views{' (' + reasons + ')' if reasons else ''}"
            )
        if stale or found is None:
            found, terms = choose_terms(kept, _start(kept, size))
        stale = False
        each = np.array([rms(r) for r in found.residuals])
        worst = int(np.argmax(each))
        if each[worst] > max(outlier * float(np.median(each)), 0.05):
            reason = f"rms {each[worst]:.2f} px where the median view has {np.median(each):.2f} px"
            dropped = [*dropped, (kept[worst].name, reason)]
            kept = [v for k, v in enumerate(kept) if k != worst]
            stale = True
            continue
        fit = _fitted(kept, size, dropped, found, terms)
        _check_tilts(fit)
        return fit


def refit_without(fit: FreehandFit, left_out: int) -> PinholeCamera:
    """The pinhole fitted again to all views but one, from where all of them put it."""
    kept = [k for k in range(len(fit.views)) if k != left_out]
    views = [fit.views[k] for k in kept]
    found = adjust(views, fit.adjusted.lens, fit.adjusted.poses[kept], fit.terms)
    return _fitted(views, fit.camera.size, [], found, fit.terms).camera


def _usable(views: list[PlaneMarks]) -> tuple[list[PlaneMarks], list[tuple[str, str]]]:
    kept, dropped = [], []
    for view in views:
        if len(view) < 6:
            dropped.append((view.name, f"{len(view)} marks, 6 needed"))
        else:
            kept.append(view)
    return kept, dropped


_HELD = (
    cv2.CALIB_FIX_PRINCIPAL_POINT
    | cv2.CALIB_FIX_ASPECT_RATIO
    | cv2.CALIB_ZERO_TANGENT_DIST
    | cv2.CALIB_FIX_K1
    | cv2.CALIB_FIX_K2
    | cv2.CALIB_FIX_K3
)


def _start(views: list[PlaneMarks], size: tuple[int, int]) -> Adjusted:
    """Focal length and poses alone, by OpenCV and then settled."""
    objects = [np.column_stack([v.points, np.zeros(len(v))]).astype(np.float32) for v in views]
    images = [v.pixels.astype(np.float32) for v in views]
    try:
        _, matrix, _, rotations, translations = cv2.calibrateCamera(objects, images, size, None, None, flags=_HELD)[:5]
    except cv2.error as error:
        raise CalibrationError(
            f"OpenCV could not calibrate from {len(views)} views ({str(error.err)[:80]}): take views tilted differently"
        ) from error
    focal = float(np.asarray(matrix)[[0, 1], [0, 1]].mean())
    poses = np.array([[*np.ravel(r), *np.ravel(t)] for r, t in zip(rotations, translations, strict=True)])
    if 0.1 * max(size) < focal < 100 * max(size):
        return adjust(views, _plain_lens(focal, size), poses, frozenset())
    tried = [_from_focal(views, share * max(size), size) for share in (0.6, 1.0, 1.7, 3.0, 6.0)]
    return min(tried, key=lambda found: float(found.squares.sum()))


def _plain_lens(focal: float, size: tuple[int, int]) -> Array:
    """Parameters (9,) of a lens without distortion about the middle of the image."""
    return np.array([focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, 0.0, 0.0, 0.0, 0.0, 0.0])


def _from_focal(views: list[PlaneMarks], focal: float, size: tuple[int, int]) -> Adjusted:
    """Settled from a focal length that was assumed, each view's pose by OpenCV."""
    lens, poses = _plain_lens(focal, size), []
    for view in views:
        points = np.column_stack([view.points, np.zeros(len(view))])
        flat = (view.pixels - lens[2:4]) / focal
        done, r, t = cv2.solvePnP(points, flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        if not done:
            raise CalibrationError(f"view {view.name}: its {len(view)} marks give no pose; take the view again")
        poses.append([*np.ravel(r), *np.ravel(t)])
    return adjust(views, lens, np.array(poses), frozenset())


def _fitted(
    views: list[PlaneMarks],
    size: tuple[int, int],
    dropped: Sequence[tuple[str, str]],
    found: Adjusted,
    terms: frozenset[Term],
) -> FreehandFit:
    lens = found.lens
    matrix = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
    everything = np.concatenate(found.residuals)
    freedom = max(2 * len(everything) - columns(terms).shape[1] - 6 * len(views), 1)
    sigma = float(np.sqrt((everything**2).sum() / freedom))
    placed = tuple(
        PlaneMarks(v.name, v.pixels, v.points, Pose.from_rotation_vector(p[:3], p[3:]), v.mark, v.covariance)
        for v, p in zip(views, found.poses, strict=True)
    )
    camera = PinholeCamera(
        matrix,
        lens[4:],
        Pose.identity(),
        size,
        _view_volume(placed, matrix, lens[4:]),
        lens_covariance(found, terms, size, sigma),
        sigma,
    )
    return FreehandFit(camera, placed, found.residuals, tuple(dropped), terms, found)


def _view_volume(views: tuple[PlaneMarks, ...], matrix: Array, distortion: Array) -> Volume:
    """Where a pinhole is trusted: sighted between the marks of any view, from 10 % nearer to 10 % farther than they were.

    A lens model does not explode between and behind its marks as a polynomial does; only outside the part of the image
    that the marks cover is its distortion a guess.
    """
    pixels = np.concatenate([v.pixels for v in views])
    depth = np.concatenate([v.world[:, 2] for v in views])
    hull = cv2.convexHull(pixels.astype(np.float32))[:, 0].astype(np.float64)
    corner = PinholeCamera.directions(hull, matrix, distortion)
    normals = np.cross(corner, np.roll(corner, -1, axis=0))
    middle = PinholeCamera.directions(hull.mean(axis=0)[None], matrix, distortion)[0]
    normals *= -np.sign(normals @ middle)[:, None] / np.linalg.norm(normals, axis=1, keepdims=True)
    ends = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    offsets = np.array([-depth.min() / 1.1, depth.max() * 1.1])
    return Volume(np.concatenate([normals, ends]), np.concatenate([np.zeros(len(normals)), offsets]))


def _check_tilts(fit: FreehandFit) -> None:
    normals = np.array([v.c_from_plane.rotation[:, 2] for v in fit.views])
    widest = float(np.degrees(np.arccos(np.clip(np.abs(normals @ normals.T).min(), 0, 1))))
    focal = float(np.sqrt(max(fit.camera.covariance[0, 0], 0)))
    if widest < 3.0 or not focal < fit.camera.matrix[0, 0]:
        raise CalibrationError(
            f"the {len(fit.views)} views differ by {widest:.1f} degrees of tilt: focal length (here "
            f"{fit.camera.matrix[0, 0]:.0f} +- {focal:.0f} px) and distance cannot be told apart; tilt the target by 20 "
            "degrees or more about both axes"
        )
