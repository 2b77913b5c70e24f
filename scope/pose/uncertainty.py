"""Covariance of a pose: the points' noise averages out, the calibration does not, and some directions are not held at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array
from scope.model import Fit, patches

LOOSE_MM = 0.12  # a direction known worse than this (or its turn at half a diameter) is not determined
FEW = 12.0  # points or fewer in effect hold nothing: they may all lie on an edge
PRIOR_MM = 100.0  # a direction that nothing holds is given about this much


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


def uncertainty(
    fit: Fit, points: Array, calibration: Shared, *, centre: Array, radius: float, held: Array | None = None
) -> Uncertainty:
    """Covariance of a refined pose.

    Parameters
    ----------
    fit : Fit
        The pose and its linear system.
    points : (N, 3)
        mm, cloud frame.
    calibration : Shared
        What these points share.
    centre, radius : (3,) mm, mm
        Middle of the part in the cloud and half its diameter: a turn is judged by what it moves there.
    held : (L, 6), optional
        Further rows of the linear system in these units, each divided by its standard deviation (mm): motions that the
        borders of the surface stop (`scope.pose.borders`).

    Notes
    -----
    The estimate is that of weighted least squares, x = A e with A = H^-1 J^T W, so that its covariance is A cov(e) A^T.
    For the points' own errors cov(e) is taken from the residuals, those of one patch (a twentieth of the diameter) being
    allowed any correlation (the cluster-robust estimate of Liang & Zeger 1986): claimed sigmas that are too small, facets
    and errors of form then show. The shared part has rank K. A bias that is the same over the whole part does not show.
    """
    j, w, used = fit.jacobian, fit.weight, fit.weight > 0
    j, w = j[used], w[used]
    scale = np.array([1.0, 1.0, 1.0, 1 / radius, 1 / radius, 1 / radius])
    # parameters at the middle of the part and in mm: (shift of the middle, turn times radius)
    to_origin = _shift_reference(centre - fit.pose.translation)
    js = (j @ to_origin) * scale
    extra = np.zeros((0, 6)) if held is None else held
    h = js.T @ (w[:, None] * js) + extra.T @ extra
    value, vector = np.linalg.eigh(h)
    share = (
        w[:, None] * (js @ vector) ** 2 / np.maximum(value, 1e-12 * value[-1])
    )  # of what is known of a direction, by point
    many = (share**2).sum(axis=0) < 1 / FEW
    many |= ((extra @ vector) ** 2).sum(axis=0) > 1 / LOOSE_MM**2  # or a border holds it
    held = many & (value > len(w) * 1e-12 * value[-1])
    spread = np.where(held, 1 / np.sqrt(np.maximum(value, 1e-300)), PRIOR_MM)
    spread = np.minimum(spread, PRIOR_MM)
    inverse = (vector * spread**2) @ vector.T
    a = inverse @ (js * w[:, None]).T  # (6, N)
    patch = patches(points[used], radius / 10)
    pushes = np.stack([np.bincount(patch, weights=row) for row in a * fit.residual[used]])  # (6, patches)
    few = len(pushes.T) / max(len(pushes.T) - 6.0, 1.0)
    random = (
        few * pushes @ pushes.T
        + inverse @ extra.T @ extra @ inverse
        + (vector * np.where(spread >= PRIOR_MM, PRIOR_MM**2, 0.0)) @ vector.T
    )
    shared = np.zeros((6, 6))
    if calibration.camera is not None:
        ray = points[used] - calibration.camera[used]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        along = (ray * fit.normal[used]).sum(axis=1)  # residual for 1 mm along the ray
        move = a @ (along[:, None] * calibration.basis[used])  # (6, K)
        shared = move @ move.T
    total = random + shared
    loose_motions, words = _loose(random)
    unscale = to_origin * scale  # back to the model's origin, rad
    total, random, shared = (unscale @ c @ unscale.T for c in (total, random, shared))
    return Uncertainty(total, random, shared, words, loose_motions)


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
