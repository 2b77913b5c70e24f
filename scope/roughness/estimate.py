"""All areal parameters of a map, with what is known of its noise taken out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from calibration.geometry import Array, Bools
from scope.heightmap import SAMPLES_PER_INDEX, HeightMap, Texture, gaussian, texture
from scope.roughness.abbott import AbbottCurve, core_parameters, percentile_parameters, volume_parameters
from scope.roughness.areal import developed_area_ratio, gradient_products, height_parameters
from scope.roughness.attenuation import Attenuation, attenuation_of
from scope.roughness.noise import Noise, added_noise, denoised

LINEAR = (
    "Sa", "Sp", "Sv", "Sz", "Sxp", "Sz99", "Sk", "Spk", "Svk", "Vmp", "Vmc", "Vvv", "Vvc",
)  # fmt: skip
SHARES = ("Smr1", "Smr2")
_DRAWS = 4  # of noise that is added
_BANDS = 8  # of rows, whose scatter tells how sure the attenuation_of of slopes is
_QUIET_SLOPES = 0.5  # noise below this share of the slopes' variance needs no smoothing before it is subtracted


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredMap:
    """A map of heights and all that is known of its noise, ready to be evaluated as a whole or in part."""

    z: Array  # (rows, columns) mm, about zero
    pitch: tuple[float, float]  # mm
    second: Array | None  # the repeat on the same lattice, mm
    noise_variance: float  # mm2, predicted; 0 where there is a repeat, or where the noise is not known
    slope_maps: tuple[Array, Array]  # what slopes are taken of: z and its repeat (or z again), smoothed where needed
    slope_noise: Array  # (2,) variance of the slopes that noise predicts, down and along; 0 with a repeat
    slope_index: tuple[float, float]  # nesting index (mm, down and along) of that smoothing, 0 for none
    stripe_width: float = 0.0  # mm, one sigma of the stripe's profile, down the rows; 0 where it is not known
    slope_attenuation: Attenuation = field(default_factory=Attenuation)  # what the smoothing took from Sdq
    answers: Mapping[str, float] = field(default_factory=dict)  # see `answers_to_noise`
    stripe_left: float = 1.0  # share of what that width averages that is still missing in the heights

    @classmethod
    def gather(
        cls, heights: HeightMap, noise: Noise, rng: np.random.Generator, *, stripe_width: float = math.nan
    ) -> MeasuredMap:
        """Put together a map and its noise (see `Noise`).

        Where noise makes more than half of the slopes' variance they are taken behind a Gaussian S-filter of three
        pitches, which costs a surface of correlation length 10 pitches 1 % and white noise two thirds of its slopes.
        """
        z, pitch = heights.z, heights.pitch
        variance = 0.0 if math.isnan(noise.floor) else noise.floor**2
        raw = float(gradient_products(z, z, pitch).sum())
        noisy = 2.0 * variance * (pitch[0] ** -2 + pitch[1] ** -2) > _QUIET_SLOPES * raw
        smoothed = noisy and not heights.filters
        index = (SAMPLES_PER_INDEX * pitch[0], SAMPLES_PER_INDEX * pitch[1]) if smoothed else (0.0, 0.0)

        def smooth(values: Array) -> Array:
            return _smoothed(values, pitch, index)

        first = smooth(z)
        second = first if noise.second is None else smooth(noise.second)
        slope_noise = np.zeros(2)
        if noise.source == "sigma":
            draw = noise.sample
            if draw is None:
                draw = np.where(heights.known, noise.floor * rng.standard_normal(z.shape), np.nan)
            slope_noise = gradient_products(smooth(draw), smooth(draw), pitch)
        made = cls(
            z=z,
            pitch=pitch,
            second=noise.second,
            noise_variance=variance if noise.source == "sigma" else 0.0,
            slope_maps=(first, second),
            slope_noise=slope_noise,
            slope_index=index,
            answers=answers_to_noise(z, noise, rng),
            stripe_width=0.0 if math.isnan(stripe_width) or noise.source == "unknown" else stripe_width,
            stripe_left=1.0 - heights.stripe_corrected,
        )
        return replace(made, slope_attenuation=made.unattenuated())

    def stripe_loss(self, sq: float) -> float:
        """Share of Sq (mm) that a stripe of this width averages away: to first order, width and slope squared over 2 Sq squared."""
        slopes = gradient_products(*self.slope_maps, self.pitch) - self.slope_noise
        return 0.5 * self.stripe_width**2 * max(float(slopes[0]), 0.0) / sq**2 if sq > 0.0 else 0.0

    def unattenuated(self) -> Attenuation:
        """What the smoothing took from Sdq; see `attenuation_of`."""
        if self.slope_index == (0.0, 0.0):
            return Attenuation()
        first, second = self.slope_maps
        more = [_smoothed(values, self.pitch, self.slope_index) for values in (first, second)]
        bands = [slice(*ends) for ends in pairwise(np.linspace(0, len(first), _BANDS + 1).astype(int))]
        # white noise of slopes falls with the fourth power of the window: to a quarter behind twice its variance
        before, after = (
            np.array([(gradient_products(a[band], b[band], self.pitch) - noise).sum() for band in bands])
            for (a, b), noise in (((first, second), self.slope_noise), (more, self.slope_noise / 4.0))
        )
        return attenuation_of(before, after)

    def part(self, keep: Bools) -> MeasuredMap:
        """MeasuredMap with the heights outside a mask (rows, columns) turned into gaps."""
        first, second = (np.where(keep, values, np.nan) for values in self.slope_maps)
        return replace(
            self,
            z=np.where(keep, self.z, np.nan),
            second=None if self.second is None else np.where(keep, self.second, np.nan),
            slope_maps=(first, first if self.slope_maps[1] is self.slope_maps[0] else second),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Parameters as measured and with the noise taken out; NaN where nothing follows."""

    raw: dict[str, float]
    clean: dict[str, float]
    texture: Texture


def raw_parameters(z: Array, pitch: tuple[float, float]) -> Estimate:
    """All areal parameters of heights (rows, columns) mm with gaps, as they are: nothing taken for noise.

    Lengths in mm, volumes in mm3/mm2, Smr1 and Smr2 in percent, Sdr in percent, Std in degrees.
    """
    values = _distribution(z)
    found = texture(z, pitch)
    values |= {
        "Sdq": float(np.sqrt(gradient_products(z, z, pitch).sum())),
        "Sdr": 100.0 * developed_area_ratio(z, pitch),
        "Sal": found.Sal,
        "Str": found.Str,
        "Std": found.Std,
    }
    return Estimate(values, values, found)


def estimate(measured: MeasuredMap, *, with_raw: bool = True) -> Estimate:
    """All areal parameters, raw and with the noise taken out.

    Sq and the slopes by subtraction of variances (or as products of two scans); Ssk and Sku by cumulants, which add
    for independent noise and of which Gaussian noise has none beyond the second; Sal, Str and Std from the
    autocorrelation without its noise peak; the heights and volumes of the material ratio curve by the ratio of
    Sq and by what more noise does to each (`answers_to_noise`). A stripe of known width averages the surface across
    itself: to the first order that takes width squared times the squared slope across from Sq squared, of which is put
    back what ranging has not. ``with_raw`` false saves the time of what only the raw values need.
    """
    z, pitch, second = measured.z, measured.pitch, measured.second
    raw = _distribution(z)
    variance = raw["Sq"] ** 2 - measured.noise_variance
    if second is not None:
        both = np.isfinite(z) & np.isfinite(second)
        a, b = z[both], second[both]
        common = float(((a - a.mean()) * (b - b.mean())).mean())
        variance = common * raw["Sq"] ** 2 / float(a.var())  # the gaps of the repeat are no reason to change the map
    first, other = measured.slope_maps
    slopes = gradient_products(first, other, pitch) - measured.slope_noise
    noise_free = variance
    variance += measured.stripe_left * measured.stripe_width**2 * max(float(slopes[0]), 0.0)
    clean = dict(raw)
    clean["Sq"] = math.sqrt(variance) if noise_free > 0.0 else math.nan
    shrink = clean["Sq"] / raw["Sq"] if raw["Sq"] > 0.0 else math.nan
    for name in LINEAR:
        clean[name] = shrink * measured.answers.get(name, 1.0) * raw[name]
    for name in SHARES:
        clean[name] = min(100.0, max(0.0, raw[name] + measured.answers.get(name, 0.0)))
    if raw["Sq"] > 0.0:
        without = math.sqrt(noise_free) / raw["Sq"] if noise_free > 0.0 else math.nan
        clean["Ssk"] = raw["Ssk"] / without**3
        clean["Sku"] = 3.0 + (raw["Sku"] - 3.0) / without**4
    found = texture(z, pitch, second=second, noise_variance=measured.noise_variance)
    clean |= {"Sal": found.Sal, "Str": found.Str, "Std": found.Std}
    smoothed = gradient_products(first, first, pitch).sum()
    surface = float(slopes.sum())
    clean["Sdq"] = measured.slope_attenuation.factor * math.sqrt(surface) if surface > 0.0 else math.nan
    less = clean["Sdq"] / math.sqrt(smoothed) if smoothed > 0.0 else math.nan
    clean["Sdr"] = 100.0 * developed_area_ratio(first, pitch, scale=less)
    if with_raw:
        raw = raw_parameters(z, pitch).raw
    return Estimate(raw, clean, found)


def answers_to_noise(z: Array, noise: Noise, rng: np.random.Generator) -> dict[str, float]:
    """What noise does to the material ratio curve of heights (rows, columns) mm beyond what it does to Sq.

    Found by doing it: noise is added to the heights as they look with theirs smoothed away (a parametric bootstrap;
    Efron and Tibshirani 1993). For Gaussian heights there is nothing beyond; but of extremes white noise has more than a
    smooth surface. Gives for each of `LINEAR` a factor to undo it, for Smr1 and Smr2 what is to be added (percent);
    nothing where there is no noise, or nothing else.
    """
    if math.isnan(noise.floor) or noise.floor == 0.0:
        return {}
    known = np.isfinite(z)
    calm = denoised(z, noise.floor)[known]
    if calm.std() == 0.0:
        return {}
    before = _distribution(calm)
    after = dict.fromkeys(before, 0.0)
    for _ in range(_DRAWS):
        for name, value in _distribution(calm + added_noise(noise, known, rng)[known]).items():
            after[name] += value / _DRAWS
    answers = {name: before[name] - after[name] for name in SHARES}
    grown = after["Sq"] / before["Sq"]
    return answers | {
        name: grown * before[name] / after[name] if before[name] > 0.0 and after[name] > 0.0 else 1.0 for name in LINEAR
    }


def _smoothed(values: Array, pitch: tuple[float, float], index: tuple[float, float]) -> Array:
    """Values behind a Gaussian of a nesting index, their gaps kept."""
    if index == (0.0, 0.0):
        return values
    return np.where(np.isfinite(values), gaussian(values, pitch, index).z, np.nan)


def _distribution(z: Array) -> dict[str, float]:
    known = z.ravel()
    if not math.isfinite(float(known.sum())):
        known = known[np.isfinite(known)]
    curve = AbbottCurve.from_heights(known)
    return {
        **height_parameters(curve.heights),
        **percentile_parameters(curve),
        **core_parameters(curve),
        **volume_parameters(curve),
    }
