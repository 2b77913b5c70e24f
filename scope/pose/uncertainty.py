"""Covariance of a pose: the points' noise averages out, the calibration does not, and some directions are not held at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints
from scope.model import patches
from scope.refinement import Estimate, Seen

LOOSE_MM = 0.12  # a direction known worse than this (or its turn at half a diameter) is not determined


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Covariance (6, 6) of (x, y, z mm; turns about x, y, z of the cloud at the model's origin, rad)."""

    covariance: Array  # (6, 6), the sum of the two
    random: Array  # (6, 6) of the points' own noise
    shared: Array  # (6, 6) of the calibration
    loose: tuple[str, ...]  # directions that the scan does not hold, in words
    loose_motions: Array  # (L, 6) the same as unit motions, turns as mm at half a diameter


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """What the points of a scan share through the calibration."""

    camera: Array | None  # (N, 3) mm, where the camera was for each point; without it nothing is shared
    sigma_cal: Array  # (N,) mm along the sighting ray, one standard deviation
    parameters: (
        Array | None
    )  # (N, K) mm along the ray for K independent unit errors of the calibration (`shared_errors`)

    @property
    def basis(self) -> Array:
        """(N, K) mm along the ray; all points together, each by its ``sigma_cal``, where the parameters are unknown."""
        if self.parameters is not None:
            return self.parameters
        return np.nan_to_num(self.sigma_cal).astype(np.float64)[:, None]


def uncertainty(estimate: Estimate, seen: Seen, calibration: Shared, *, centre: Array, radius: float) -> Uncertainty:
    """Covariance of a refined pose.

    Parameters
    ----------
    estimate : Estimate
        The pose, with the gain of every residual.
    seen : Seen
        The points (N), and their lines of the image where known.
    calibration : Shared
        What these points share.
    centre, radius : (3,) mm, mm
        Middle of the part in the cloud and half its diameter: a turn is judged by what it moves there.

    Notes
    -----
    The estimate is that of weighted least squares, x = A e, so that its covariance is A cov(e) A^T. For the points' own errors
    cov(e) is taken from the residuals, those of one patch (a twentieth of the diameter) being allowed any correlation (the
    cluster-robust estimate of Liang & Zeger 1986), and those of one line of the image, too (two ways at once: Cameron, Gelbach &
    Miller 2011): the noise of a background image that is taken off all frames stays on its line. Claimed sigmas that are too small,
    facets and errors of form then show. What the points of a face share enters with the size that the faces show. The part of the
    calibration has rank K. A bias that is the same over the whole part does not show.
    """
    points, gain = seen.scan.points, estimate.gain
    push = gain * estimate.left
    used = np.flatnonzero(np.abs(gain).sum(axis=0) > 0)
    patch = patches(points[used], radius / 10)
    random = _clustered(push[:, used], patch)
    if seen.line is not None and len(used):
        both = np.unique(np.column_stack([patch, seen.line[used]]), axis=0, return_inverse=True)[1].ravel()
        more = _clustered(push[:, used], seen.line[used]) - _clustered(push[:, used], both)
        value, vector = np.linalg.eigh(more)
        random = random + (vector * np.maximum(value, 0.0)) @ vector.T
    alike = np.stack([np.bincount(estimate.group, weights=row) for row in gain])
    random = random + estimate.shared**2 * alike @ alike.T + estimate.fixed
    shared = np.zeros((6, 6))
    if calibration.camera is not None:
        ray = points - calibration.camera
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        along = (ray * estimate.normal).sum(axis=1)  # residual for 1 mm along the ray
        move = gain @ (along[:, None] * calibration.basis)  # (6, K)
        shared = move @ move.T
    total = random + shared
    loose_motions, words = _loose(random)
    scale = np.array([1.0, 1.0, 1.0, 1 / radius, 1 / radius, 1 / radius])
    unscale = _shift_reference(centre - estimate.pose.translation) * scale  # back to the model's origin, rad
    total, random, shared = (unscale @ c @ unscale.T for c in (total, random, shared))
    return Uncertainty(total, random, shared, words, loose_motions)


def _clustered(push: Array, key: Ints) -> Array:
    """Covariance (6, 6) of a sum of pushes (6, N) that are alike in any way within the groups of ``key`` (N,)."""
    if push.shape[1] == 0:
        return np.zeros((6, 6))
    number = np.unique(key, return_inverse=True)[1].ravel()
    sums = np.stack([np.bincount(number, weights=row) for row in push])
    many = sums.shape[1]
    return np.asarray(many / max(many - 6.0, 1.0) * sums @ sums.T)


def shared_errors(points: Array, camera: Array, normal: Array, sigma_cal: Array) -> Array | None:
    """Movement along the ray (N, 3) for three independent unit errors of the sheet of visibility, from ``sigma_cal`` (N,).

    A sheet with normal ``normal`` that errs in its offset and two tilts moves the point q along its ray d by
    (1, a, b) . theta / (n . d), with a, b the place of q in the sheet. The covariance of theta is found from the
    ``sigma_cal`` of all points, whose square is linear in it (least squares, then the nearest positive matrix).
    None where there are too few points or sigma_cal is zero or unknown.
    """
    good = np.isfinite(sigma_cal) & (sigma_cal > 0)
    if good.sum() < 50:
        return None
    ray = points - camera
    local = ray - ray.mean(axis=0)
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    axes = np.linalg.svd(normal[None])[2][1:]
    size = max(float(np.abs(local).max()), 1e-9)
    place = np.concatenate([np.ones((len(points), 1)), local @ axes.T / size], axis=1)
    cosine = ray @ normal
    slope = place / np.where(np.abs(cosine) < 1e-3, 1e-3, cosine)[:, None]
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    columns = np.stack([slope[:, i] * slope[:, k] * (1.0 if i == k else 2.0) for i, k in pairs], axis=1)
    target = sigma_cal.astype(np.float64) ** 2
    weight = np.where(good, 1 / np.maximum(target, 1e-30), 0.0)
    solution = np.linalg.lstsq(columns[good] * weight[good, None], target[good] * weight[good], rcond=1e-10)[0]
    covariance = np.zeros((3, 3))
    for (i, k), value in zip(pairs, solution, strict=True):
        covariance[i, k] = covariance[k, i] = value
    value, vector = np.linalg.eigh(covariance)
    basis = slope @ (vector * np.sqrt(np.maximum(value, 0.0)))
    # keep what the cloud claims, point by point
    size_of = np.linalg.norm(basis, axis=1)
    claimed = np.nan_to_num(sigma_cal).astype(np.float64)
    return np.asarray(basis * np.divide(claimed, size_of, out=np.ones_like(size_of), where=size_of > 0)[:, None])


def _shift_reference(arm: Array) -> Array:
    """Matrix (6, 6): motion about the middle of the part -> motion about the model's origin, ``arm`` = middle - origin."""
    m = np.eye(6)
    x, y, z = arm
    m[:3, 3:] = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return m


def _loose(covariance: Array) -> tuple[Array, tuple[str, ...]]:
    value, vector = np.linalg.eigh(covariance)
    motions = vector.T[np.sqrt(np.maximum(value, 0.0)) > LOOSE_MM]
    words = []
    for motion in motions:
        shift, turn = motion[:3], motion[3:]
        kind, direction = (
            ("slides along", shift) if np.linalg.norm(shift) > np.linalg.norm(turn) else ("turns about", turn)
        )
        unit = direction / max(float(np.linalg.norm(direction)), 1e-12)
        words.append(f"{kind} ({unit[0]:.2f}, {unit[1]:.2f}, {unit[2]:.2f})")
    return motions, tuple(words)
