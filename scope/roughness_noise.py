"""What of a height map is the sensor's noise: from a repeated scan, or from the points' own sigma."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibration.geometry import Array, Bools
from scope.errors import MeasurementError
from scope.heightmap import HeightMap
from scope.heightmap_filter import ALPHA, gaussian
from scope.roughness_texture import autocorrelation

SIGMA_TRUST = 0.05  # relative standard uncertainty of a predicted sigma
_LEAST_CORRELATION = 0.1  # of two scans of one surface
_BY_CHANCE = 3.5  # standard errors that the best of many shifts of unrelated surfaces seldom reaches
_SHIFT_REACH = 16  # samples within which an unreported displacement is looked for


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """The noise of a height map and how it is known."""

    source: Literal["repeat", "sigma", "unknown"]
    floor: float  # mm, rms of the noise of the heights; NaN where unknown
    trust: float  # relative standard uncertainty of the floor that averaging does not remove
    second: Array | None = None  # (rows, columns) mm, the repeat on the lattice of the first scan
    sample: Array | None = None  # (rows, columns) mm, noise alone behind the filters of the map; None: white
    displacement: float = math.nan  # mm by which the repeat's sampling lies displaced
    correlation: float = math.nan  # of the two scans
    notes: tuple[str, ...] = ()


def added_noise(noise: Noise, known: Bools, rng: np.random.Generator) -> Array:
    """As much independent noise (rows, columns) mm as known heights have; as the filters of the map passed it, if any.

    Filtered noise is the one sample that there is, set off by a random number of rows and columns; 0 where it has gaps.
    """
    if noise.sample is None:
        return noise.floor * rng.standard_normal(known.shape)
    shift = (int(rng.integers(known.shape[0])), int(rng.integers(known.shape[1])))
    return np.nan_to_num(np.roll(noise.sample, shift, axis=(0, 1)))


def calmed(z: Array, floor: float, *, against: float = math.inf) -> Array:
    """Heights (rows, columns) mm with white noise of ``floor`` mm rms smoothed away to a fiftieth of their variance.

    By the shortest Gaussian that does it; the smoothed heights are stretched to the variance that the surface has. With
    ``against`` (mm2) the noise must fall to a fiftieth of that, if it is less. Level where the noise is all that there is.
    """
    known = np.isfinite(z)
    clean = float(z[known].var()) - floor**2
    least = min(clean, against)
    if least <= 0.0:
        return np.where(known, 0.0, np.nan)
    # a Gaussian passes 1 / (sqrt 2 alpha index) of white noise's variance along each direction
    index = math.sqrt(floor**2 / (2.0 * ALPHA**2 * 0.02 * least))
    index = min(index, min(z.shape) / 4.0)
    if index < 1.5:
        return z
    smooth = np.where(known, gaussian(z, (1.0, 1.0), (index, index)).z, np.nan)
    middle, spread = float(np.nanmean(smooth)), float(np.nanstd(smooth))
    return np.asarray(middle + (smooth - middle) * (math.sqrt(clean) / spread if spread > 0.0 else 0.0))


def predicted_noise(heights: HeightMap, *, trust: float = SIGMA_TRUST) -> Noise:
    """Noise from the heights' sigma; ``unknown`` where they carry none.

    A sigma that is wrong by ``trust`` is an error that no amount of points averages out. Independent noise also shows in
    the heights' own scatter from neighbour to neighbour, to which the surface can only add: a sigma beyond that is
    proved too large, and the scatter is taken instead.
    """
    floor = heights.noise
    if math.isnan(floor):
        return Noise("unknown", math.nan, math.nan)
    bound, count = neighbour_scatter(heights.z)
    if count >= 300 and floor > bound * (1.0 + 3.0 / math.sqrt(count)):
        told = (
            f"warning: the points' sigma predicts noise of {floor:.3g} mm, more than the {bound:.3g} mm by which "
            "neighbouring heights scatter; the smaller is used"
        )
        return Noise("sigma", bound, trust, notes=(told,))
    return Noise("sigma", floor, trust)


def neighbour_scatter(z: Array) -> tuple[float, int]:
    """Upper bound (mm) on the independent noise of heights (rows, columns) mm, and the differences it rests on.

    Third differences hold 20 times the variance of independent noise, and of a surface smooth over four samples next to
    nothing. The smaller of both directions; infinite where no four neighbours are known.
    """
    best = (math.inf, 0)
    for axis in (0, 1):
        third = np.diff(z, n=3, axis=axis)
        third = third[np.isfinite(third)]
        if len(third) > 0:
            best = min(best, (math.sqrt(float(np.mean(third**2)) / 20.0), len(third)))
    return best


def repeat_noise(first: HeightMap, repeat: HeightMap, *, stripe_width: float = math.nan) -> Noise:
    """Noise from a second scan of the same patch, brought onto the lattice of the first.

    What the two have in common is surface; what the first has beyond that, over the places both saw, is noise. Speckle and the phase of the pixels recur in a repeat whose sampling is not displaced by
    more than the stripe's width; such a floor is temporal noise only and is labelled so. A displacement that the clouds
    do not know of is found by correlation, up to 16 samples.

    Parameters
    ----------
    first, repeat : HeightMap
        Form removed, the same region, with ``points``.
    stripe_width : float
        One sigma of the stripe's profile on the surface, mm. Its full width is taken as 2.4 of that, or as twice the
        coarser pitch where it is not known.

    Raises
    ------
    MeasurementError
        The scans share too little of the patch, or no surface.
    ValueError
        A map without points.
    """
    if first.points is None or repeat.points is None:
        raise ValueError("maps need their points to be compared")
    if np.array_equal(first.points, repeat.points, equal_nan=True):
        raise MeasurementError("the repeat is the very same scan, whose noise recurs in it: scan the patch once more")
    moved = onto_lattice(first, repeat)
    shift, correlation = _best_shift(first.z, moved)
    if correlation < 0.5:  # a cloud that does not know its sensor may have its heights the other way up
        other, reverse = _best_shift(first.z, -moved)
        if reverse > max(correlation, 2.0 * _LEAST_CORRELATION):
            repeat = repeat.with_heights(-repeat.z)
            moved, shift, correlation = -moved, other, reverse
    pitch = np.array(first.pitch)
    if np.any(shift != 0.0):
        moved = onto_lattice(first, repeat, shift=(float(shift[0]), float(shift[1])))
    both = first.known & np.isfinite(moved)
    if both.sum() < 0.25 * first.known.sum():
        raise MeasurementError(
            f"the repeat covers {100.0 * both.sum() / max(first.known.sum(), 1):.0f} % of the patch; 25 % are needed: "
            "repeat the scan over the same region"
        )
    least = max(_LEAST_CORRELATION, _BY_CHANCE / math.sqrt(independent_products(first.z, first.pitch)))
    if correlation < least:
        raise MeasurementError(
            f"the repeat shows another surface, or only noise (correlation {correlation:.2f}, needed {least:.2f}); "
            "scan the same patch again"
        )
    a, b = first.z[both], moved[both]
    common = float(((a - a.mean()) * (b - b.mean())).mean())
    floor = math.sqrt(max(float(a.var()) - common, 0.0))  # not their difference: interpolation calms the repeat
    displacement = float(np.hypot(*((_sampling_offset(first, repeat) + shift) * pitch)))
    if not (first.in_order and repeat.in_order):
        displacement = math.nan
    width = 2.0 * max(first.pitch) if math.isnan(stripe_width) else 2.4 * stripe_width
    told = "that may be displaced or not" if math.isnan(displacement) else f"displaced by {displacement:.3g} mm"
    notes = [f"noise from a repeat {told}, correlation {correlation:.3f}"]
    if displacement <= width:
        notes.append(
            f"warning: the repeat is displaced by less than a stripe's width ({width:.3g} mm): speckle and pixel phase "
            "recur in it, so the noise floor is temporal noise only"
        )
    return Noise(
        "repeat", floor, 0.0, second=moved, displacement=displacement, correlation=correlation, notes=tuple(notes)
    )


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


def _sampling_offset(first: HeightMap, repeat: HeightMap) -> Array:
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


def _best_shift(first: Array, second: Array) -> tuple[Array, float]:
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
