"""What of a height map is the sensor's noise: from a repeated scan, or from the points' own sigma."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from calibration.geometry import Array, Bools
from scope.errors import MeasurementError
from scope.heightmap import ALPHA, HeightMap, gaussian
from scope.roughness.align import best_shift, independent_products, onto_lattice, sampling_offset

SIGMA_TRUST = 0.05  # relative standard uncertainty of a predicted sigma
_LEAST_CORRELATION = 0.1  # of two scans of one surface
_BY_CHANCE = 3.5  # standard errors that the best of many shifts of unrelated surfaces seldom reaches


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


def denoised(z: Array, floor: float, *, against: float = math.inf) -> Array:
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
    proved too large, and the scatter is taken instead. Heights that scatter alike over two samples and over three, but
    less over one, have noise that is not independent (speckle), or a texture as fine as that: sigma is then trusted less.
    """
    floor = heights.noise
    if math.isnan(floor):
        return Noise("unknown", math.nan, math.nan)
    one, two, three = (neighbour_scatter(heights.z, every=every) for every in (1, 2, 3))
    count = min(one.differences, two.differences)
    bound = min(max(pair) for pair in zip(one.scatter, two.scatter, strict=True))
    if count >= 300 and floor > bound * (1.0 + 3.0 / math.sqrt(count)):
        told = (
            f"warning: the points' sigma predicts noise of {floor:.3g} mm, more than the {bound:.3g} mm by which "
            "neighbouring heights scatter; the smaller is used"
        )
        return Noise("sigma", bound, trust, notes=(told,))
    level = min(two.scatter)
    correlated = min(one.scatter) < 0.9 * level and abs(min(three.scatter) - level) < 0.05 * level
    if count >= 300 and correlated and level > 1.05 * floor:
        told = (
            f"warning: over two samples and more heights scatter by {level:.3g} mm, over one by {min(one.scatter):.3g} mm, "
            f"where sigma predicts {floor:.3g} mm: their noise is not independent from point to point (speckle), or there is "
            "texture as fine as that; only a displaced repeat scan (--noise) can tell"
        )
        return Noise("sigma", floor, math.hypot(trust, level / floor - 1.0), notes=(told,))
    return Noise("sigma", floor, trust)


class Scatter(NamedTuple):
    """Upper bounds on the independent noise of heights."""

    scatter: tuple[float, float]  # mm, down and along; infinite where no four neighbours are known
    differences: int  # that the lesser rests on


def neighbour_scatter(z: Array, *, every: int = 1) -> Scatter:
    """Scatter of heights (rows, columns) mm about their neighbours, ``every`` so many samples away.

    Third differences hold 20 times the variance of independent noise, and of a surface smooth over four samples next to
    nothing.
    """
    found = []
    for axis in (0, 1):
        a = np.moveaxis(z, axis, 0)
        if len(a) <= 3 * every:
            found.append((math.inf, 0))
            continue
        third = a[3 * every :] - 3.0 * a[2 * every : -every] + 3.0 * a[every : -2 * every] - a[: -3 * every]
        third = third[np.isfinite(third)]
        found.append((math.sqrt(float(np.mean(third**2)) / 20.0), len(third)) if len(third) else (math.inf, 0))
    return Scatter((found[0][0], found[1][0]), min(found)[1])


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
    shift, correlation = best_shift(first.z, moved)
    if correlation < 0.5:  # a cloud that does not know its sensor may have its heights the other way up
        other, reverse = best_shift(first.z, -moved)
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
    displacement = float(np.hypot(*((sampling_offset(first, repeat) + shift) * pitch)))
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
