"""A repeated scan brought onto the lattice of the first."""

from __future__ import annotations

import math

import numpy as np

from calibration.geometry import Array, Bools
from scope.heightmap import HeightMap, autocorrelation

_SHIFT_REACH = 16  # samples within which an unreported displacement is looked for


def independent_products(z: Array, pitch: tuple[float, float]) -> float:
    """How many unrelated products two maps like z (rows, columns) mm hold: heights over the sum of squared correlation."""
    acf = autocorrelation(z, pitch)
    squared = np.nan_to_num(acf.covariance / acf.variance) ** 2
    return float(np.isfinite(z).sum()) / max(1.0, float(squared.sum()))


def onto_lattice(first: HeightMap, repeat: HeightMap, *, shift: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Heights of ``repeat`` at the lattice points of ``first`` (rows, columns) mm, NaN where it does not reach.

    The place of each point in the repeat's lattice follows from a polynomial of order 2 through its points; between them
    cubic convolution (Keys 1981), or bilinear interpolation beside a gap. ``shift`` moves the sampling by (rows, columns).
    """
    if first.points is None or repeat.points is None:
        raise ValueError("maps need their points to be compared")
    origin, axes = _axes(first)
    own = (first.points - origin) @ axes
    other = ((repeat.points - origin) @ axes)[repeat.known]
    scale = float(np.abs(other).max()) or 1.0
    target = np.argwhere(repeat.known).astype(np.float64)
    place = np.full((*first.z.shape, 2), np.nan)
    known = first.known
    coefficients = np.linalg.lstsq(_quadratic(other / scale), target, rcond=None)[0]
    place[known] = _quadratic(own[known] / scale) @ coefficients + np.array(shift)
    return interpolated(repeat.z, place)


def interpolated(z: Array, place: Array) -> Array:
    """Heights (rows, columns) mm at fractional (row, column) places (..., 2); NaN outside and beside gaps."""
    rows, columns = z.shape
    inside: Bools = np.asarray(np.isfinite(place).all(axis=-1))
    safe = np.where(inside[..., None], place, 0.0)
    base = np.floor(safe + 1e-6).astype(np.int64)
    part: Array = safe - base.astype(np.float64)
    part[np.abs(part) < 1e-3] = 0.0
    cubic = np.zeros(inside.shape)
    linear = np.zeros(inside.shape)
    weights = [_keys(part[..., k]) for k in (0, 1)]
    flat = [np.stack([0.0 * p, 1.0 - p, p, 0.0 * p]) for p in (part[..., 0], part[..., 1])]
    for i in range(4):
        for j in range(4):
            r, c = base[..., 0] + i - 1, base[..., 1] + j - 1
            within = (r >= 0) & (r < rows) & (c >= 0) & (c < columns)
            value = np.where(within, z[np.clip(r, 0, rows - 1), np.clip(c, 0, columns - 1)], np.nan)
            for total, weight in ((cubic, weights[0][i] * weights[1][j]), (linear, flat[0][i] * flat[1][j])):
                total += np.where(weight == 0.0, 0.0, weight * value)
    return np.where(inside, np.where(np.isfinite(cubic), cubic, linear), np.nan)


def _keys(t: Array) -> Array:
    """Weights (4, ...) of Keys' cubic convolution at a fraction t."""
    return np.stack(
        [
            ((-0.5 * t + 1.0) * t - 0.5) * t,
            (1.5 * t - 2.5) * t * t + 1.0,
            ((-1.5 * t + 2.0) * t + 0.5) * t,
            (0.5 * t - 0.5) * t * t,
        ]
    )


def _quadratic(uv: Array) -> Array:
    u, v = uv[:, 0], uv[:, 1]
    return np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v], axis=1)


def _axes(heights: HeightMap) -> tuple[Array, Array]:
    """Centroid (3,) mm and two directions (3, 2) of the plane of a map's points."""
    if heights.points is None:
        raise ValueError("the map has no points")
    points = heights.points[heights.known]
    centre = points.mean(axis=0)
    _, directions = np.linalg.eigh((points - centre).T @ (points - centre))
    return centre, directions[:, :0:-1]


def sampling_offset(first: HeightMap, repeat: HeightMap) -> Array:
    """By how many rows and columns the same place of the object lies apart in the two scans (2,)."""
    if first.points is None or repeat.points is None:
        raise ValueError("maps need their points to be compared")
    origin, axes = _axes(first)
    fits = []
    for heights in (first, repeat):
        known = heights.known
        local = (heights.points[known] - origin) @ axes  # type: ignore[index]
        place = np.argwhere(known) + np.array(heights.origin)
        fits.append(np.linalg.lstsq(_quadratic(local), place, rcond=None)[0][0])
    return np.asarray(fits[1] - fits[0])


def best_shift(first: Array, second: Array) -> tuple[Array, float]:
    """Shift (rows, columns) to be added to the repeat's places, and the correlation there; none unless it gains 1 %."""
    both = np.isfinite(first) & np.isfinite(second)
    if both.sum() < 100:
        return np.zeros(2), 0.0
    known = [np.isfinite(first), np.isfinite(second)]
    a, b = (np.where(k, z - z[k].mean(), 0.0) for k, z in zip(known, (first, second), strict=True))
    norm = math.sqrt(float(a[known[0]].var()) * float(b[known[1]].var()))
    reach = [min(_SHIFT_REACH, n // 4) for n in first.shape]
    from scipy import fft

    size = tuple(fft.next_fast_len(n + k, real=True) for n, k in zip(first.shape, reach, strict=True))

    def lags(p: Array, q: Array) -> Array:
        circular = fft.irfft2(np.conj(fft.rfft2(p, s=size)) * fft.rfft2(q, s=size), s=size)
        return np.asarray(circular[np.ix_(*(np.arange(-k, k + 1) for k in reach))])

    pairs = lags(known[0].astype(float), known[1].astype(float))
    covariance = lags(a, b) / np.maximum(pairs, 1.0)
    i, j = np.unravel_index(int(np.argmax(covariance)), covariance.shape)
    here, there = float(covariance[reach[0], reach[1]]), float(covariance[i, j])
    if there <= 1.01 * here:
        return np.zeros(2), here / max(norm, 1e-300)
    peak = np.array([i - reach[0], j - reach[1]], dtype=np.float64)
    if 0 < i < 2 * reach[0] and 0 < j < 2 * reach[1]:
        peak += [_vertex(covariance[i - 1 : i + 2, j]), _vertex(covariance[i, j - 1 : j + 2])]
    return peak, there / max(norm, 1e-300)


def _vertex(three: Array) -> float:
    """Place of the vertex of the parabola through three values, from the middle one."""
    bend = float(three[0] - 2.0 * three[1] + three[2])
    return 0.5 * float(three[0] - three[2]) / bend if bend < 0.0 else 0.0
