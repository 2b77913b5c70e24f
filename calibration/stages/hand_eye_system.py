"""The adjustment of hand and eye: what each view says about both unknowns, in six numbers with their covariance.

The marks' pixels of a view, linearised where the unknowns put them, give by least squares the error e of the robot's pose
that would explain them: z - K d for a change d of the unknowns, with the covariance C of the marks. The robot's own error
adds to C. All views together are then one generalised least squares problem, from which a view can be left out in closed
form. To first order this is the bundle adjustment with one error of the robot a view as further unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Pose
from calibration.stages.hand_eye_start import Mount, SeenTarget


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """What n views say about the 12 unknowns: turn (rad) and shift (mm) of X, then of Y, in the frame they lead to."""

    z: Array  # (n, 6) error of the robot's pose that explains the marks: turn rad, shift mm, flange frame
    k: Array  # (n, 6, 12)
    c: Array  # (n, 6, 6) covariance of z from the marks
    by_camera: Array | None  # (n, 6, P) change of z, a unit of each parameter of the camera
    pixel_variance: Array  # (n,) of the marks about the pose that explains them best, px^2, or over the stated one

    def select(self, keep: Bools) -> Said:
        """Some of the views."""
        return Said(
            self.z[keep], self.k[keep], self.c[keep], None if self.by_camera is None else self.by_camera[keep], self.pixel_variance[keep]
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """Solution of the linear system."""

    step: Array  # (12,)
    covariance: Array  # (12, 12) from marks and robot
    by_camera: Array | None  # (12, P)
    chi2: float  # of the residuals
    left_out: Array  # (n, 12) the step without each view
    chi2_left_out: Array  # (n,) of each view about the others, 6 degrees of freedom


def predicted(view: SeenTarget, x: Pose, y: Pose, mount: Mount) -> Pose:
    """Pose camera_from_target that the unknowns and the robot give."""
    middle = view.base_from_flange.inverse if mount == "hand" else view.base_from_flange
    return x.inverse @ middle @ y


def said(views: Sequence[SeenTarget], x: Pose, y: Pose, mount: Mount) -> Said:
    """What views, one pose each, say where the unknowns are at x and y.

    Where the covariance of marks is unknown they count alike; how much follows from what they leave over about the pose
    that explains each view best, of which the median over the views is taken.
    """
    rows = [_of_view(view, x, y, mount) for view in views]
    known = all(np.isfinite(view.covariance).all() for view in views)
    variance = np.array([row[4] for row in rows])
    scale = float(np.median(variance))
    scale = max(scale, 1.0) if known else scale
    return Said(
        np.stack([row[0] for row in rows]), np.stack([row[1] for row in rows]), scale * np.stack([row[2] for row in rows]),
        None if any(row[3] is None for row in rows) else np.stack([row[3] for row in rows if row[3] is not None]), variance,
    )  # fmt: skip


def _of_view(view: SeenTarget, x: Pose, y: Pose, mount: Mount) -> tuple[Array, Array, Array, Array | None, float]:
    points = y.apply(view.points[0])
    arm = points - y.translation
    by_y = np.concatenate([-_cross(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3))], axis=2)
    turn, shift = view.base_from_flange.rotation, view.base_from_flange.translation
    if mount == "hand":
        at = (points - shift) @ turn  # flange frame
        by_y = np.einsum("ji,njk->nik", turn, by_y)
        by_e = np.concatenate([_cross(at), -np.broadcast_to(np.eye(3), (len(at), 3, 3))], axis=2)
    else:
        at = points @ turn.T + shift  # base frame
        by_e = np.concatenate([-_cross(points), np.broadcast_to(np.eye(3), (len(at), 3, 3))], axis=2)
        by_y, by_e = np.einsum("ij,njk->nik", turn, by_y), np.einsum("ij,njk->nik", turn, by_e)
    lever = at - x.translation
    by_x = np.concatenate([_cross(lever), -np.broadcast_to(np.eye(3), (len(at), 3, 3))], axis=2)
    into = np.einsum("nij,kj->nik", view.to_pixels, x.rotation)  # to_pixels R_x^T
    gap = np.einsum("nij,nj->ni", view.to_pixels, lever @ x.rotation - view.origin)
    weight = _weights(view.covariance)
    e = into @ by_e
    normal = np.einsum("nia,nij,njb->ab", e, weight, e)
    solve = np.linalg.solve(normal, np.einsum("nia,nij->anj", e, weight).reshape(6, -1))
    unknowns = (into @ np.concatenate([by_x, by_y], axis=2)).reshape(-1, 12)
    z = -solve @ gap.ravel()
    left = gap + e @ z
    variance = float(np.einsum("ni,nij,nj->", left, weight, left)) / max(2 * len(gap) - 6, 1)
    camera = None if view.by_camera is None else solve @ view.by_camera.reshape(2 * len(gap), -1)
    return z, solve @ unknowns, np.linalg.inv(normal), camera, variance


def adjust(views: Said, robot: Array) -> Adjusted:
    """Generalised least squares of what the views say; ``robot`` (6, 6) is the covariance of its poses."""
    whole = views.c + robot
    weight = np.linalg.inv(whole)
    kw = np.einsum("nij,nik->njk", views.k, weight)  # K^T V
    each = kw @ views.k
    right = np.einsum("njk,nk->nj", kw, views.z)
    normal = each.sum(axis=0)
    covariance = _inverse(normal)
    step = covariance @ right.sum(axis=0)
    residual = views.z - views.k @ step
    chi2 = float(np.einsum("ni,nij,nj->", residual, weight, residual))
    left_out, away = np.empty((len(right), 12)), np.empty(len(right))
    for i in range(len(right)):
        rest = _inverse(normal - each[i])
        left_out[i] = rest @ (right.sum(axis=0) - right[i])
        off = views.z[i] - views.k[i] @ left_out[i]
        away[i] = off @ np.linalg.solve(whole[i] + views.k[i] @ rest @ views.k[i].T, off)
    camera = None if views.by_camera is None else covariance @ np.einsum("njk,nkp->jp", kw, views.by_camera)
    return Adjusted(step, covariance, camera, chi2, left_out, away)


def robot_covariance(sigma_mm: float, sigma_rad: float) -> Array:
    """Covariance (6, 6) of one pose of the robot: turns rad, shifts mm."""
    return np.diag([sigma_rad**2] * 3 + [sigma_mm**2] * 3)


def scatter_of_robot(views: Said, least: tuple[float, float]) -> tuple[float, float]:
    """Standard deviations (mm, rad) of the robot's poses that the views tell, not below ``least``.

    Restricted maximum likelihood (Patterson and Thompson, Biometrika 58, 1971), so that the 12 unknowns cost no bias.
    """
    from scipy.optimize import minimize

    def evidence(logs: Array) -> float:
        whole = views.c + robot_covariance(float(np.exp(logs[0])), float(np.exp(logs[1])))
        weight = np.linalg.inv(whole)
        normal = np.einsum("nji,njk,nkl->il", views.k, weight, views.k)
        step = _inverse(normal) @ np.einsum("nji,njk,nk->i", views.k, weight, views.z)
        residual = views.z - views.k @ step
        even, scale = _scaled(normal)
        return float(
            np.linalg.slogdet(whole)[1].sum()
            + np.linalg.slogdet(even)[1]
            - 2.0 * np.log(scale).sum()
            + np.einsum("ni,nij,nj->", residual, weight, residual)
        )

    low = np.log(np.maximum(least, [1e-4, 1e-7]))
    spread = np.sqrt(np.median(views.z**2, axis=0))
    start = np.maximum(np.log([spread[3:].max() + 1e-3, spread[:3].max() + 1e-6]), low)
    found = minimize(
        evidence, start, method="Nelder-Mead", bounds=[(low[0], np.log(1e3)), (low[1], np.log(1.0))],
        options={"xatol": 0.01, "fatol": 0.01, "maxiter": 200},
    )  # fmt: skip
    sigma = np.exp(found.x)
    return float(sigma[0]), float(sigma[1])


def moved(pose: Pose, step: Array) -> Pose:
    """Pose after a turn (rad) and a shift (mm) in the frame that it leads to: R' = exp(w) R, t' = t + d."""
    return Pose(Pose.from_rotation_vector(step[:3], np.zeros(3)).rotation @ pose.rotation, pose.translation + step[3:])


def _scaled(normal: Array) -> tuple[Array, Array]:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return normal * np.outer(scale, scale), scale


def _inverse(normal: Array) -> Array:
    """Inverse of a normal matrix whose unknowns have different units; directions that nothing holds become very unsure."""
    even, scale = _scaled(normal)
    values, vectors = np.linalg.eigh(even)
    values = np.maximum(values, 1e-13 * values[-1])
    return np.asarray((vectors / values) @ vectors.T * np.outer(scale, scale))


def _weights(covariance: Array) -> Array:
    if np.isfinite(covariance).all():
        return np.asarray(np.linalg.inv(covariance))
    return np.broadcast_to(np.eye(2), covariance.shape)


def _cross(v: Array) -> Array:
    """Matrices (n, 3, 3) of v x."""
    k = np.zeros((len(v), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return k - k.transpose(0, 2, 1)
