"""Profiles of one direction with what is known of their noise: each parameter raw, and with the noise taken out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from calibration.geometry import Array, Bools
from scope.heightmap import ALPHA, SAMPLES_PER_INDEX, gaussian
from scope.roughness.attenuation import Attenuation, attenuation_of
from scope.roughness.extras import Joint, profile_depths
from scope.roughness.noise import Noise, denoised
from scope.roughness.profile import Profiles, profile_elements, profile_extremes, profile_parameters, roughness_profiles

SCALED = frozenset({"Ra", "Rz", "Rt", "Rc", "MPD"})
OF_ELEMENTS = frozenset({"RSm", "Rc"})
LARGEST_NOISE_SHARE = 0.8  # of the variance: beyond, shapes and scaled heights are not given
_SHAPE_NOISE = 0.5  # of the variance: a profile's skewness and kurtosis rest on fewer heights than an area's
_QUIET = 0.5  # share of the variance: more noise than this makes elements of its own even when it is smoothed
_GROUPS = 8  # of profiles, whose scatter tells how sure the attenuation_of of slopes is
_QUIET_SLOPES = 0.05  # share of the squared slopes that is subtracted without smoothing


class Found(NamedTuple):
    """A parameter's mean over the profiles."""

    raw: float  # with the noise in it; NaN where no profile gives one
    value: float  # without; NaN where there is a reason
    reason: str  # why there is none


@dataclass(frozen=True, slots=True, eq=False)
class Direction:
    """Sums over each of N profiles, from which the parameters of any part of them follow."""

    values: dict[str, Array]  # (N,) each, NaN where a profile has too little
    square: Array  # (N, 2): sum of the squared roughness heights, and their number
    product: Array | None  # (N, 3): sums over what both scans saw: z1 z2, z1 z1, and their number
    noise_variance: float  # mm2, of the roughness heights, predicted; 0 where unknown or repeated
    slope: Array  # (N, 2): sum of the products of slopes behind the S-filter of three pitches, and their number
    attenuation_of: Attenuation  # what that filter takes from Rdq
    slope_noise: float  # variance of unsmoothed slopes that noise predicts
    joint: Joint
    elements: dict[str, Array]  # (N,) each: RSm and Rc of the profiles with their noise smoothed away
    doubt: dict[str, float]  # relative: by how much these change when they are smoothed 1.4 times as far
    answers: dict[str, float]  # factors of Rz, Rt and MPD beyond the ratio of Rq, see `_answers`
    depths: Array  # (N, 2) mm: sum of the profile depths of whole base lengths, and their number

    @classmethod
    def gather(cls, z: Array, second: Array | None, profiles: Profiles, noise: Noise, added: Array) -> Direction:
        """Sums of primary profiles ``z`` (N, samples) mm, their repeat and their roughness profiles.

        ``added`` (N, samples) mm is as much noise again as lies on the primary profiles, behind their filters if any.
        """
        rough, pitch = profiles.z, profiles.pitch
        again = None if second is None else _roughness(np.where(np.isfinite(z), second, np.nan), profiles)
        floor = 0.0 if math.isnan(noise.floor) else noise.floor**2
        predicted = 0.0
        if noise.source == "sigma":
            weight = pitch / (ALPHA * profiles.cutoff)  # of the Gaussian's middle sample
            passed = floor * (1.0 - 2.0 * weight + weight / math.sqrt(2.0))
            predicted = passed if noise.sample is None else float(np.nanvar(_roughness(added, profiles)))
        other = rough if again is None else again
        lone = 2.0 * floor / pitch**2
        if noise.sample is not None:
            lone = float(np.mean(np.square(np.diff(added, axis=1)))) / pitch**2
        slope, smoother = (_smooth_slopes(rough, other, pitch, longer) for longer in (1.0, math.sqrt(2.0)))
        everything = np.ones(len(z), dtype=np.bool_)
        groups = np.arange(len(z)) * _GROUPS // len(z)
        before, after = (
            np.bincount(groups, sums[:, 0], minlength=_GROUPS).astype(np.float64) for sums in (slope, smoother)
        )
        made = cls(
            values=profile_parameters(profiles),
            square=_sums(rough * rough),
            product=None if again is None else np.column_stack([_sums(rough * again), _sums(rough * rough + 0.0 * again)[:, 0]]),
            noise_variance=predicted,
            slope=slope,
            attenuation_of=attenuation_of(before, after),
            slope_noise=lone,
            joint=Joint.gather(z, pitch, second=second, noise_variance=floor, sample=None if noise.sample is None else added),
            elements={},
            doubt={},
            answers={},
            depths=profile_depths(z, pitch),
        )  # fmt: skip
        left = made.share(everything)
        if floor == 0.0 or not left > 0.0:
            return made
        against = left * float(np.nanvar(rough))
        calm, calmer = (denoised(z, longer * noise.floor, against=against) for longer in (1.0, math.sqrt(2.0)))
        found = [profile_elements(replace(profiles, z=_roughness(heights, profiles))) for heights in (calm, calmer)]
        doubt = {key: abs(_middle(found[1][key]) / _middle(found[0][key]) - 1.0) for key in found[0]}
        return replace(made, elements=found[0], doubt=doubt, answers=_answers(calm, profiles, added))

    def share(self, keep: Bools, *, more: float = 1.0) -> float:
        """How much of the variance of the profiles in a mask (N,) is surface: 1 where the noise is not known.

        ``more`` multiplies the predicted noise variance.
        """
        total, count = self.square[keep].sum(axis=0)
        if count == 0.0 or total == 0.0:
            return math.nan
        if self.product is None:
            return 1.0 - more * self.noise_variance * float(count) / float(total)
        common, pairs, own = self.product[keep].sum(axis=0)
        return float(common / own) if pairs > 0.0 and own > 0.0 else math.nan

    def parameters(self, keep: Bools, *, more: float = 1.0) -> dict[str, Found]:
        """Every parameter as the mean over the profiles in a mask (N,); see `share`."""
        share = self.share(keep, more=more)
        found = {}
        for key, each in self.values.items():
            raw = _middle(each[keep])
            value, reason = self._slope(raw, keep, more) if key == "Rdq" else _clean(key, raw, share)
            value *= self.answers.get(key, 1.0)
            if key in self.elements and not reason:
                value = _middle(self.elements[key][keep])
            if not reason and not math.isfinite(value):
                reason = "no whole profile element" if key in OF_ELEMENTS else "no profile is half complete"
            found[key] = Found(raw, math.nan if reason else value, reason)
        z2, jrc = self.joint.of(keep, more=more)
        found["Z2"], found["JRC"] = Found(z2.raw, z2.value, z2.reason), Found(jrc.raw, jrc.value, jrc.reason)
        total, count = self.depths[keep].sum(axis=0)
        if count:
            depth = float(total / count)
            value, reason = _clean("MPD", depth, share)
            found["MPD"] = Found(depth, value * self.answers.get("MPD", 1.0), reason)
        else:
            found["MPD"] = Found(
                math.nan, math.nan, "not applicable: no profile is 100 mm long and nine tenths complete"
            )
        return found

    def smoothed_slopes(self) -> bool:
        """Whether Rdq rests on smoothed slopes."""
        return self.product is not None and not self._slope_share(_middle(self.values["Rdq"]), 1.0) < _QUIET_SLOPES

    def _slope_share(self, raw: float, more: float) -> float:
        return more * self.slope_noise / max(raw**2, 1e-300)

    def _slope(self, raw: float, keep: Bools, more: float) -> tuple[float, str]:
        """Rdq: as measured where noise is next to nothing of it, else behind an S-filter of three pitches and without noise."""
        share = self._slope_share(raw, more)
        if share < _QUIET_SLOPES:
            return raw * math.sqrt(1.0 - share), ""
        if self.product is None:
            told = (
                f"noise is {100.0 * min(share, 1.0):.0f} % of the squared slopes of single profiles; give a repeat scan"
            )
            return math.nan, told
        square = _mean(self.slope, keep)
        return (
            (self.attenuation_of.factor * math.sqrt(square), "")
            if square > 0.0
            else (math.nan, "noise is all of the measured slopes")
        )


def _answers(calm: Array, profiles: Profiles, added: Array) -> dict[str, float]:
    """What ``added`` noise (N, samples) mm does to the extremes of calm profiles beyond what it does to Rq.

    Factors that undo it, for Rz, Rt and MPD: the counterpart of `scope.roughness.estimate.answers_to_noise`.
    """
    before, after = (replace(profiles, z=_roughness(values, profiles)) for values in (calm, calm + added))
    grown = math.sqrt(float(np.nanvar(after.z)) / max(float(np.nanvar(before.z)), 1e-300))
    late = profile_extremes(after)
    pairs = {
        key: (float(np.nanmean(each)), float(np.nanmean(late[key])))
        for key, each in profile_extremes(before).items()
        if np.isfinite(each).any()
    }
    depths = [profile_depths(values, profiles.pitch).sum(axis=0) for values in (calm, calm + added)]
    if depths[0][1] and depths[1][1]:
        pairs["MPD"] = (float(depths[0][0] / depths[0][1]), float(depths[1][0] / depths[1][1]))
    return {key: grown * one / two for key, (one, two) in pairs.items() if one > 0.0 and two > 0.0}


def _clean(key: str, raw: float, share: float) -> tuple[float, str]:
    """Return a parameter without the noise's part, or why there is none."""
    if math.isnan(share):
        return math.nan, ""
    if share <= 0.0:
        return math.nan, "noise is all of the measured variance"
    told = f"noise is {100.0 * (1.0 - share):.0f} % of the variance"
    shrink = math.sqrt(min(share, 1.0))
    if key == "Rq":
        return shrink * raw, ""
    if key in OF_ELEMENTS and 1.0 - share > _QUIET:
        return math.nan, f"{told} and makes elements of its own (limit {100.0 * _QUIET:g} %)"
    limit = _SHAPE_NOISE if key in {"Rsk", "Rku"} else LARGEST_NOISE_SHARE
    if 1.0 - share > limit:
        return math.nan, f"{told} (limit {100.0 * limit:g} %)"
    if key in SCALED:
        return shrink * raw, ""
    if key == "Rsk":
        return raw / shrink**3, ""
    if key == "Rku":
        return 3.0 + (raw - 3.0) / shrink**4, ""
    return raw, ""


def _roughness(z: Array, profiles: Profiles) -> Array:
    """Heights (N, samples) mm filtered and cut as the roughness profiles were."""
    return roughness_profiles(z, profiles.pitch, profiles.cutoff).z


def _smooth_slopes(first: Array, second: Array, pitch: float, longer: float) -> Array:
    index = SAMPLES_PER_INDEX * longer
    a = np.diff(gaussian(first, (1.0, 1.0), (0.0, index)).z, axis=1) / pitch
    b = a if second is first else np.diff(gaussian(second, (1.0, 1.0), (0.0, index)).z, axis=1) / pitch
    return _sums(a * b)


def _sums(values: Array) -> Array:
    """Sum of the finite values of each row, and their number (N, 2)."""
    known = np.isfinite(values)
    return np.stack([np.where(known, values, 0.0).sum(axis=1), known.sum(axis=1)], axis=1)


def _middle(values: Array) -> float:
    """Mean of the finite values; NaN for none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else math.nan


def _mean(sums: Array, keep: Bools) -> float:
    total, count = sums[keep].sum(axis=0)
    return float(total / count) if count else math.nan
