"""Marks too small or too faint to have an edge of their own: a blurred disc on a sloping ground, fitted where it is known to be.

A disc of radius r behind a Gaussian of b px looks, at the distance d from its centre, like the probability that a
two-dimensional normal vector of mean d falls within r: one minus Marcum's Q function (Marcum 1950), whose derivatives are
Bessel functions. A point is the disc of no radius. All marks are fitted together, an array operation a step.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array

# px, one sigma, that a camera may have: radius and blur of a small disc look alike
_BLURS = (0.42, 0.48, 0.54, 0.6, 0.67, 0.75, 0.85, 1.0, 1.2, 1.5)
_TURNS = 14
_SOFT = 5  # turns in which a pixel may be off by a part of the contrast
_CUT = 4.0  # standard deviations beyond which a pixel belongs to something else
_LEAST_RADIUS = 0.05  # px
LEAST_DIAMETER = 2.0  # px, as fitted, of marks of 2.5 px
LEAST_SIGNIFICANCE = 6.0  # contrast over its standard error
_SHARP = 30.0  # significance from which the diameter is known well enough to be too small
_MOST_SIGMA = 0.7  # px, of a centre
_MOST_MISFIT = 0.6  # of the contrast: more is no disc
_SAMPLE = 40  # marks that are enough to tell the blur
_MODEL_ERROR = 0.004  # of the contrast: how well the profile is known


class Points(NamedTuple):
    """K blurred discs; NaN where no fit converged."""

    centre: Array  # (K, 2) px (u, v)
    covariance: Array  # (K, 2, 2) px^2
    diameter: Array  # (K,) px, of the disc before the blur
    contrast: Array  # (K,) grey levels over the ground
    blur: Array  # (K,) px, the same for all
    significance: Array  # (K,) contrast over its standard error
    misfit: Array  # (K,) rms of the residuals within the mark over the contrast
    rise: float  # by which the variance of a pixel grows a grey level of the mark, over that of the ground


class _Windows(NamedTuple):
    """Square windows about K starts."""

    level: Array  # (K, M) grey levels
    u: Array  # (K, M) px from the start
    v: Array
    inside: Array  # (K, M) 0 where the window leaves the image


def fit_points(light: NDArray[np.float32], start: Array, diameter: float) -> Points:
    """Fit blurred discs near starts (K, 2) px that are right to a pixel or two.

    Parameters
    ----------
    light : (H, W) array
        Grey levels; marks are lighter than their ground.
    start : (K, 2) array, px
    diameter : float, px
        About that of the marks.

    Notes
    -----
    Noise is that of the residuals in each window; pixels that belong to something else (a bright part beside the mark) lose
    their weight. The ground is a plane. Perspective makes discs elliptic, which moves no centre. Weak where another mark is
    nearer than two diameters.
    """
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # windows that leave the image, marks that are none: NaN
        return _with_best_blur(light, np.asarray(start, dtype=np.float64), diameter)


def _with_best_blur(light: NDArray[np.float32], start: Array, diameter: float) -> Points:
    """The fit with the blur that leaves least, and with the growth of the noise that it shows."""
    half = int(np.clip(np.ceil(1.3 * diameter + 3.0), 5, 14))
    some = np.linspace(0, len(start) - 1, min(len(start), _SAMPLE)).astype(np.intp)
    middle: Array = np.rint(start).astype(np.float64)
    blur, least = _BLURS[len(_BLURS) // 2], np.inf
    for trial in _BLURS:
        if trial > 0.6 * diameter and np.isfinite(least):
            break
        misfit = _fit(_cut_out(light, middle[some], half), trial, diameter, (start - middle)[some]).misfit
        worth = float(np.nanmedian(misfit)) if np.isfinite(misfit).any() else np.inf
        if worth < 0.99 * least:
            blur, least = trial, worth
    best = _fit(_cut_out(light, middle, half), blur, diameter, start - middle)
    best = best._replace(centre=best.centre + middle)
    if best.rise > 0.0:  # photons make the mark noisier than its ground
        start = np.where(np.isfinite(best.centre), best.centre, start)
        middle = np.rint(start).astype(np.float64)
        best = _fit(_cut_out(light, middle, half), blur, diameter, start - middle, best.rise)
        best = best._replace(centre=best.centre + middle)
    return best


def _cut_out(light: NDArray[np.float32], middle: Array, half: int) -> _Windows:
    height, width = light.shape
    v, u = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    column, row = middle[:, :1].astype(int) + u, middle[:, 1:].astype(int) + v
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    level = light[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].astype(np.float64)
    shape = (len(middle), u.size)
    return _Windows(level, np.broadcast_to(u, shape), np.broadcast_to(v, shape), inside.astype(np.float64))


def _disc(distance: Array, radius: Array, blur: float) -> tuple[Array, Array, Array]:
    """Profile of the blurred disc and its derivatives by distance and radius, each (K, M), for a peak of 1 of a wide disc."""
    from scipy.special import chndtr, i0e, i1e

    r, d = np.broadcast_to(radius[:, None] / blur, distance.shape), distance / blur
    near = d < r + 6.0  # beyond, nothing is left
    r, d = r[near], d[near]
    fall = r * np.exp(-0.5 * (d - r) ** 2) / blur
    found = np.zeros((3, *distance.shape))
    found[:, near] = chndtr(r**2, 2.0, d**2), -fall * i1e(d * r), fall * i0e(d * r)
    return found[0], found[1], found[2]


def _fit(window: _Windows, blur: float, diameter: float, offset: Array, rise: float = 0.0) -> Points:
    """Gauss-Newton in centre, contrast at the middle, radius and the three numbers of the ground, with weights that cut off."""
    k = len(offset)
    x, y = offset[:, 0].copy(), offset[:, 1].copy()
    radius = np.full(k, 0.5 * diameter)
    far = np.hypot(window.u - x[:, None], window.v - y[:, None])
    outer = np.where((far > 0.5 * diameter + 2.0 * blur) & (window.inside > 0), window.level, np.nan)
    inner = np.where((far <= max(0.4 * diameter, 1.0)) & (window.inside > 0), window.level, np.nan)
    ground, top = np.nanmedian(outer, axis=1), np.nanmean(inner, axis=1)
    spread = 1.4826 * np.nanmedian(np.abs(outer - ground[:, None]), axis=1)
    linear = np.column_stack([top - ground, ground, np.zeros(k), np.zeros(k)])
    sigma = np.maximum(spread, 0.3)
    covariance = np.full((k, 7, 7), np.nan)
    residual = np.zeros_like(window.level)
    for turn in range(_TURNS):
        du, dv = window.u - x[:, None], window.v - y[:, None]
        d = np.maximum(np.hypot(du, dv), 1e-9)
        profile, by_d, by_r = _disc(d, radius, blur)
        peak, _, peak_by_r = _disc(np.zeros((k, 1)), radius, blur)
        shape = profile / peak  # 1 in the middle: contrast and radius of a point do not run away together
        slope = linear[:, :1] * by_d / peak
        wider = linear[:, :1] * (by_r - shape * peak_by_r) / peak
        columns = np.stack(
            [-slope * du / d, -slope * dv / d, wider, shape, np.ones_like(d), window.u, window.v], axis=2
        )
        model = np.einsum("kmp,kp->km", columns[:, :, 3:], linear)
        residual = window.level - model
        loud = np.sqrt(1.0 + rise * np.maximum(linear[:, :1] * shape, 0.0))
        kept = window.inside * (np.abs(residual) < _CUT * loud * np.maximum(sigma, _soft(linear, turn))[:, None])
        kept = kept / loud**2
        weighted = columns * kept[:, :, None]
        normal = np.swapaxes(weighted, 1, 2) @ columns
        scale = np.sqrt(np.maximum(np.einsum("kpp->kp", normal), 1e-12))
        normal = normal / (scale[:, :, None] * scale[:, None, :]) + 1e-6 * np.eye(7)
        covariance = np.linalg.inv(normal) / (scale[:, :, None] * scale[:, None, :])
        step = np.einsum("kpq,kq->kp", covariance, np.einsum("kmp,km->kp", weighted, residual))
        x += np.clip(step[:, 0], -0.7, 0.7)
        y += np.clip(step[:, 1], -0.7, 0.7)
        radius = np.clip(radius + np.clip(step[:, 2], -0.3 * radius, 0.5 * radius), _LEAST_RADIUS, 2.0 * diameter)
        linear = linear + step[:, 3:]
        freedom = np.maximum((kept > 0).sum(axis=1) - 7.0, 1.0)
        sigma = np.sqrt(np.maximum((kept * residual**2).sum(axis=1) / freedom, 1.0 / 12.0))
        if turn >= _SOFT and np.quantile(np.abs(step[:, :2]).max(axis=1), 0.95) < 1e-3:
            break
    core = window.inside * (np.hypot(window.u - x[:, None], window.v - y[:, None]) < (radius + 1.5 * blur)[:, None])
    off = np.sqrt((core * residual**2).sum(axis=1) / np.maximum(core.sum(axis=1), 1.0))
    # the profile counts where it is steep, half way up
    noise2 = sigma**2 + (_MODEL_ERROR * linear[:, 0]) ** 2 / (1.0 + 0.5 * rise * np.maximum(linear[:, 0], 0.0))
    chi2 = (core * (residual / loud) ** 2).sum(axis=1) / np.maximum(core.sum(axis=1) - 4.0, 1.0) / sigma**2
    covariance = covariance * (noise2 * np.clip(chi2, 1.0, 9.0))[:, None, None]
    found = Points(
        np.column_stack([x, y]), covariance[:, :2, :2], 2.0 * radius, linear[:, 0], np.full(k, blur),
        linear[:, 0] / np.sqrt(covariance[:, 3, 3]), off / np.maximum(np.abs(linear[:, 0]), 1e-9),
        _rise(residual, linear[:, :1] * shape, sigma, core),
    )  # fmt: skip
    lost = ~(np.hypot(x - offset[:, 0], y - offset[:, 1]) < diameter + 2.0) | ~np.isfinite(covariance).all(axis=(1, 2))
    for each in found[:-1]:
        each[lost] = np.nan
    return found


def _rise(residual: Array, above: Array, sigma: Array, core: Array) -> float:
    """Growth of the variance with the grey level above the ground, pooled over the marks; 0 where it does not show."""
    square = core * ((residual / sigma[:, None]) ** 2 - 1.0)
    good = np.isfinite(square).all(axis=1) & np.isfinite(above).all(axis=1)
    square = np.minimum(square[good], 30.0)
    total = float((core[good] * above[good] ** 2).sum())
    rise = float((square * above[good]).sum()) / max(total, 1e-12)
    return rise if rise * np.sqrt(total) > 4.0 * np.sqrt(2.0) else 0.0


def _soft(linear: Array, turn: int) -> Array:
    """(K,) grey levels that a pixel may be off while the shape is still a guess."""
    return np.asarray(np.abs(linear[:, 0]) * max(0.5 - 0.5 / _SOFT * turn, 0.0))


def judged(points: Points, *, moved: Array, reach: float, fitted_for: float) -> list[str]:
    """Why each of K fits is no mark, empty where it is one; ``moved`` (K,) px from where it was looked for."""
    sigma = np.sqrt(np.trace(points.covariance, axis1=1, axis2=2) / 2.0)
    told = []
    for k in range(len(moved)):
        if not np.isfinite(sigma[k]) or points.contrast[k] <= 0.0 or points.significance[k] < LEAST_SIGNIFICANCE:
            told.append("nothing there stands out of its surroundings")
        elif points.significance[k] > _SHARP and points.diameter[k] < LEAST_DIAMETER:
            told.append(
                f"{points.diameter[k]:.1f} px across: too small, 2.5 px are needed; move nearer or use larger marks"
            )
        elif moved[k] > reach:
            told.append(f"the nearest blob is {moved[k]:.1f} px away")
        elif sigma[k] > _MOST_SIGMA or points.misfit[k] > _MOST_MISFIT or points.diameter[k] > 1.95 * fitted_for:
            told.append("what stands out there is no round mark")
        else:
            told.append("")
    return told


def matched_start(light: NDArray[np.float32], asked: Array, diameter: float) -> Array:
    """Where (K, 2) a blob of about this diameter stands out most within its radius, three pixels at least, of each pixel."""
    import cv2

    small, wide = (cv2.GaussianBlur(light, (0, 0), factor * diameter) for factor in (0.25, 0.7))
    response = small - wide
    height, width = light.shape
    reach = max(3, int(np.ceil(0.6 * diameter)))
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    inside = np.hypot(u, v) <= reach
    u, v = u[inside], v[inside]
    column = np.clip(np.round(asked[:, :1]).astype(int) + u, 0, width - 1)
    row = np.clip(np.round(asked[:, 1:]).astype(int) + v, 0, height - 1)
    best = response[row, column].argmax(axis=1)
    rows = np.arange(len(asked))
    return np.column_stack([column[rows, best], row[rows, best]]).astype(np.float64)
