"""A pinhole with lens distortion, for targets held by hand whose poses are estimated with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Pose, Rays
from calibration.grouping import grouped
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
    """Fit a pinhole to freehand views with OpenCV's calibrateCamera (Zhang 2000), leaving out views that do not belong.

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
    while True:
        if len(kept) < 3:
            reasons = grouped(dropped, asked, "views", longest=150)
            raise CalibrationError(
                f"{len(kept)} usable freehand view(s) of {asked}; a camera needs three or more, tilted differently: "
                f"take more views{' (' + reasons + ')' if reasons else ''}"
            )
        fit = _calibrate(kept, size, list(dropped))
        each = np.array([rms(r) for r in fit.residuals])
        worst = int(np.argmax(each))
        if each[worst] <= max(outlier * float(np.median(each)), 0.05):
            _check_tilts(fit)
            return fit
        reason = f"rms {each[worst]:.2f} px where the median view has {np.median(each):.2f} px"
        dropped = [*dropped, (kept[worst].name, reason)]
        kept = [v for k, v in enumerate(kept) if k != worst]


def refit_without(fit: FreehandFit, left_out: int) -> PinholeCamera:
    """The pinhole fitted again to all views but one, from where all of them put it."""
    kept = [view for k, view in enumerate(fit.views) if k != left_out]
    return _calibrate(kept, fit.camera.size, [], start=fit.camera).camera


def _usable(views: list[PlaneMarks]) -> tuple[list[PlaneMarks], list[tuple[str, str]]]:
    kept, dropped = [], []
    for view in views:
        if len(view) < 6:
            dropped.append((view.name, f"{len(view)} marks, 6 needed"))
        else:
            kept.append(view)
    return kept, dropped


def _calibrate(
    views: list[PlaneMarks],
    size: tuple[int, int],
    dropped: list[tuple[str, str]],
    start: PinholeCamera | None = None,
) -> FreehandFit:
    objects = [np.column_stack([v.points, np.zeros(len(v))]).astype(np.float32) for v in views]
    images = [v.pixels.astype(np.float32) for v in views]
    first = (
        (None, None, 0)
        if start is None
        else (start.matrix.copy(), start.distortion.copy(), cv2.CALIB_USE_INTRINSIC_GUESS)
    )
    try:
        _, matrix, distortion, rotations, translations = cv2.calibrateCamera(
            objects, images, size, first[0], first[1], flags=first[2]
        )[:5]
    except cv2.error as error:
        raise CalibrationError(
            f"OpenCV could not calibrate from {len(views)} views ({str(error.err)[:80]}): take views tilted differently"
        ) from error
    matrix, distortion = np.asarray(matrix, dtype=np.float64), np.asarray(distortion, dtype=np.float64).ravel()[:5]
    poses, residuals, jacobians = [], [], []
    for view, model, r, t in zip(views, objects, rotations, translations, strict=True):
        seen, jacobian = cv2.projectPoints(model.astype(np.float64), r, t, matrix, distortion)
        poses.append(Pose.from_rotation_vector(np.ravel(r), np.ravel(t)))
        residuals.append(view.pixels - seen[:, 0])
        jacobians.append(jacobian)
    everything = np.concatenate(residuals)
    freedom = max(2 * len(everything) - 9 - 6 * len(views), 1)
    sigma = float(np.sqrt((everything**2).sum() / freedom))
    placed = tuple(
        PlaneMarks(v.name, v.pixels, v.points, pose, v.mark, v.covariance) for v, pose in zip(views, poses, strict=True)
    )
    camera = PinholeCamera(
        matrix,
        distortion,
        Pose.identity(),
        size,
        _view_volume(placed, matrix, distortion),
        sigma**2 * _intrinsic_inverse(jacobians),
        sigma,
    )
    return FreehandFit(camera, placed, tuple(residuals), tuple(dropped))


def _intrinsic_inverse(jacobians: list[Array]) -> Array:
    """Inverse (9, 9) of the normal matrix of the intrinsics once each view's pose is eliminated (Schur complement)."""
    normal = np.zeros((9, 9))
    for jacobian in jacobians:
        pose, inner = jacobian[:, :6], jacobian[:, 6:15]
        normal += inner.T @ inner - inner.T @ pose @ np.linalg.lstsq(pose, inner, rcond=None)[0]
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-12) / np.outer(scale, scale))


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
    if widest < 3.0 or focal > 0.1 * fit.camera.matrix[0, 0]:
        raise CalibrationError(
            f"the {len(fit.views)} views differ by {widest:.1f} degrees of tilt: focal length (here "
            f"{fit.camera.matrix[0, 0]:.0f} +- {focal:.0f} px) and distance cannot be told apart; tilt the target by 20 "
            "degrees or more about both axes"
        )
