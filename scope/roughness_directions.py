"""Profile parameters along and across the stripe, noise taken out, with their uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array
from scope.errors import MeasurementError
from scope.heightmap import HeightMap
from scope.heightmap_filter import ALPHA, SAMPLES_PER_INDEX, gaussian
from scope.roughness_extras import JointRoughness, joint_roughness, mean_profile_depth
from scope.roughness_noise import Noise
from scope.roughness_profile import SECTIONS, Profiles, profile_parameters, roughness_profiles
from scope.roughness_table import PROFILE, Parameter

_SCALED = frozenset({"Ra", "Rz", "Rt", "Rc"})
LARGEST_NOISE_SHARE = 0.8  # of the variance: beyond, shapes and scaled heights are not given
_QUIET = 0.2  # share of the variance: more noise than this makes elements of its own
_ANGLES = {"along": 1, "across": 0}


@dataclass(frozen=True, slots=True)
class Told:
    """What was set and what must be known of the profiles."""

    settings: dict[str, str]
    cutoffs: dict[str, float]  # mm
    notes: tuple[str, ...]


def direction_parameters(
    heights: HeightMap,
    noise: Noise,
    *,
    cutoff: float | None,
    slope_reason: str = "",
    with_uncertainty: bool = True,
) -> tuple[dict[str, dict[str, Parameter]], Told]:
    """Profile parameters ``along`` the stripe and ``across`` it, each the mean over all profiles of the map.

    ``slope_reason`` withholds Rdq for the reason that Sdq was. The uncertainty is that of the mean, with as many
    independent profiles as there are correlation lengths across them.

    Raises
    ------
    MeasurementError
        A cut-off (mm) that does not fit the patch.
    """
    tables: dict[str, dict[str, Parameter]] = {}
    settings: dict[str, str] = {}
    cutoffs: dict[str, float] = {}
    notes: list[str] = []
    for way, axis in _ANGLES.items():
        z = heights.z if axis == 1 else heights.z.T
        second = None if noise.second is None else (noise.second if axis == 1 else noise.second.T)
        pitch = heights.pitch[axis]
        try:
            profiles = roughness_profiles(z, pitch, cutoff)
        except ValueError as error:
            raise MeasurementError(
                f"{way} the stripe, {error}; choose a larger region or another --l-filter"
            ) from error
        joint = joint_roughness(z, pitch, noise_variance=0.0 if math.isnan(noise.floor) else noise.floor**2)
        tables[way] = _table(profiles, _second(second, profiles, z), noise, slope_reason, with_uncertainty)
        tables[way] |= _extras(joint, mean_profile_depth(z, pitch))
        cutoffs[way] = profiles.cutoff
        settings[f"profile {way}"] = (
            f"cut-off {profiles.cutoff:g} mm, {profiles.sections} sections, "
            f"end effects on {100.0 * profiles.end_effect:.1f} % of the heights"
        )
        settings[f"JRC {way}"] = joint.formula
        if profiles.sections < SECTIONS:
            notes.append(
                f"warning: the profiles {way} the stripe hold {profiles.sections} sections of {profiles.cutoff:g} mm; "
                f"the standard asks for {SECTIONS}"
            )
    return tables, Told(settings, cutoffs, tuple(notes))


def _second(second: Array | None, profiles: Profiles, z: Array) -> Array | None:
    """The repeat's roughness profiles, filtered and cut as the first scan's."""
    return (
        None
        if second is None
        else roughness_profiles(np.where(np.isfinite(z), second, np.nan), profiles.pitch, profiles.cutoff).z
    )


def _table(
    profiles: Profiles, second: Array | None, noise: Noise, slope_reason: str, with_uncertainty: bool
) -> dict[str, Parameter]:
    values = profile_parameters(profiles)
    surface = _surface_share(profiles, second, noise)
    independent = _independent(profiles.z)
    table = {}
    for key, each in values.items():
        known = each[np.isfinite(each)]
        raw = float(known.mean()) if len(known) else math.nan
        value, reason = _clean(key, raw, surface.share)
        if key == "Rdq":
            value, reason = _slope(raw, profiles, second, noise, slope_reason)
        if not reason and not math.isfinite(value):
            reason = "no whole profile element" if key in {"RSm", "Rc"} else "no profile is half complete"
        expanded = None
        if with_uncertainty and not reason and len(known) > 1:
            spread = float(known.std(ddof=1)) / math.sqrt(min(independent, len(known)))
            model = 0.1 * abs(raw - value) if key in _SCALED else 0.0
            scaled = 0.5 * surface.error * abs(value) if key in _SCALED or key == "Rq" else 0.0
            expanded = 2.0 * math.sqrt(spread**2 * min(1.0, (value / raw) ** 2 if raw else 1.0) + scaled**2 + model**2)
        table[key] = Parameter(
            value=None if reason else value,
            uncertainty=expanded,
            unit=PROFILE[key].unit,
            reason=reason,
            raw=raw if math.isfinite(raw) else None,
            clause=PROFILE[key].clause,
        )
    return table


@dataclass(frozen=True, slots=True)
class _Surface:
    """How much of the profiles' variance is surface."""

    share: float  # 0 to 1; 1 where the noise is not known
    error: float  # relative standard uncertainty of the variance that is left


def _surface_share(profiles: Profiles, second: Array | None, noise: Noise) -> _Surface:
    """From the products of two scans, or from the predicted noise that the L-filter lets through."""
    z = profiles.z
    measured = float(np.nanvar(z))
    if second is None and noise.source != "sigma":
        return _Surface(1.0, 0.0)
    if second is None:
        weight = profiles.pitch / (ALPHA * profiles.cutoff)  # of the Gaussian's middle sample
        floor = noise.floor**2 * (1.0 - 2.0 * weight + weight / math.sqrt(2.0))
        left = measured - floor
        return _Surface(left / measured, 2.0 * noise.trust * floor / left if left > 0.0 else math.inf)
    product = z * second
    both = np.isfinite(product)
    each = np.where(both, product, 0.0).sum(axis=1) / np.maximum(both.sum(axis=1), 1)
    each = each[both.any(axis=1)]
    left = float(product[both].mean())
    error = float(each.std(ddof=1)) / math.sqrt(min(_independent(z), len(each))) / left if left > 0.0 else math.inf
    return _Surface(left / float(np.var(z[both])), error)


def _clean(key: str, raw: float, share: float) -> tuple[float, str]:
    """Return a parameter without the noise's part, or why there is none."""
    if share <= 0.0:
        return math.nan, "noise is all of the measured variance"
    told = f"noise is {100.0 * (1.0 - share):.0f} % of the variance"
    shrink = math.sqrt(min(share, 1.0))
    if key == "Rq":
        return shrink * raw, ""
    if key == "RSm":
        return raw, f"{told} and makes elements of its own" if 1.0 - share > _QUIET else ""
    if key == "Rc" and 1.0 - share > _QUIET:
        return raw, f"{told} and makes elements of its own"
    if 1.0 - share > LARGEST_NOISE_SHARE:
        return math.nan, f"{told} (limit {100.0 * LARGEST_NOISE_SHARE:g} %)"
    if key in _SCALED:
        return shrink * raw, ""
    if key == "Rsk":
        return raw / shrink**3, ""
    if key == "Rku":
        return 3.0 + (raw - 3.0) / shrink**4, ""
    return raw, ""


def _slope(raw: float, profiles: Profiles, second: Array | None, noise: Noise, reason: str) -> tuple[float, str]:
    """Rdq: as measured where noise is next to nothing of it, else behind an S-filter of three pitches and without noise."""
    if reason:
        return math.nan, reason
    z, pitch = profiles.z, profiles.pitch
    share = 0.0 if math.isnan(noise.floor) else 2.0 * noise.floor**2 / pitch**2 / max(raw**2, 1e-300)
    if share < 0.05:
        return raw * math.sqrt(1.0 - share), ""
    if second is None:
        return (
            math.nan,
            f"noise is {100.0 * min(share, 1.0):.0f} % of the squared slopes of single profiles; give a repeat scan",
        )
    index = SAMPLES_PER_INDEX
    a, b = (np.diff(gaussian(values, (1.0, 1.0), (index, index)).z, axis=1) / pitch for values in (z, second))
    product = a * b
    square = float(product[np.isfinite(product)].mean())
    return (math.sqrt(square), "") if square > 0.0 else (math.nan, "noise is all of the measured slopes")


def _independent(z: Array) -> float:
    """How many unrelated profiles there are: their number over the correlation's reach across them, at least 2."""
    centred = np.nan_to_num(z - np.nanmean(z))
    known = np.isfinite(z).astype(np.float64)
    variance = float((centred**2).sum() / known.sum())
    reach = 1.0
    for lag in range(1, len(z) // 2):
        pairs = float((known[lag:] * known[:-lag]).sum())
        correlation = float((centred[lag:] * centred[:-lag]).sum()) / max(pairs, 1.0) / variance
        if correlation < 0.05:
            break
        reach += 2.0 * correlation**2
    return max(2.0, len(z) / reach)


def _extras(joint: JointRoughness, depth: float) -> dict[str, Parameter]:
    """Z2, JRC and MPD as they stand in the table of a direction."""
    no_depth = "not applicable: no profile is 100 mm long and nine tenths complete"
    made = {
        "Z2": (joint.Z2, joint.reason, joint.formula.split(", ", 1)[1]),
        "JRC": (joint.JRC, joint.reason, joint.formula),
        "MPD": (depth, no_depth, "base length 100 mm"),
    }
    return {
        key: Parameter(
            value=value if math.isfinite(value) else None,
            uncertainty=None,
            unit=PROFILE[key].unit,
            reason="" if math.isfinite(value) else reason,
            note=note,
            clause=PROFILE[key].clause,
        )
        for key, (value, reason, note) in made.items()
    }
