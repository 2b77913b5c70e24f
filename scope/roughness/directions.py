"""Profile parameters along and across the stripe, noise taken out, with their uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array
from scope.errors import MeasurementError
from scope.heightmap import HeightMap
from scope.roughness.noise import Noise, added_noise
from scope.roughness.profile import SECTIONS, Profiles, profile_parameters, roughness_profiles
from scope.roughness.profile_noise import SCALED, Direction, Found
from scope.roughness.sampling import few
from scope.roughness.table import PROFILE, Parameter

_ANGLES = {"along": 1, "across": 0}
_BLOCKS = 24  # of neighbouring profiles, that the jackknife leaves out one at a time
_FEWEST_BLOCKS = 4
_FEW_GAPS = 0.01  # fewer need no looking into
_GAP_DRAWS = 3
_OVERLAP = 1.8  # gaps that are cut again fall in part on those that are there
_ELEMENT_DOUBT = 2.0  # times the change that more smoothing makes
_SHAPES = frozenset({"Rsk"})  # about zero: a relative change means nothing


@dataclass(frozen=True, slots=True)
class ProfileSettings:
    """What was set and what must be known of the profiles."""

    settings: dict[str, str]
    cutoffs: dict[str, float]  # mm
    notes: tuple[str, ...]


def direction_parameters(
    heights: HeightMap,
    noise: Noise,
    *,
    cutoff: float | None,
    rng: np.random.Generator,
    slope_reason: str = "",
    with_uncertainty: bool = True,
) -> tuple[dict[str, dict[str, Parameter]], ProfileSettings]:
    """Profile parameters ``along`` the stripe and ``across`` it, each the mean over all profiles of the map.

    ``slope_reason`` withholds Rdq for the reason that Sdq was.

    Raises
    ------
    MeasurementError
        A cut-off (mm) that does not fit the patch.
    """
    tables: dict[str, dict[str, Parameter]] = {}
    settings: dict[str, str] = {}
    cutoffs: dict[str, float] = {}
    notes: list[str] = []
    floor = 0.0 if math.isnan(noise.floor) else noise.floor
    added = added_noise(noise, heights.known, rng) if floor > 0.0 else np.zeros(heights.z.shape)
    for way, axis in _ANGLES.items():
        z = heights.z if axis == 1 else heights.z.T
        second = noise.second if noise.second is None or axis == 1 else noise.second.T
        try:
            profiles = roughness_profiles(z, heights.pitch[axis], cutoff, noise=floor if noise.sample is None else 0.0)
        except ValueError as error:
            raise MeasurementError(
                f"{way} the stripe, {error}; choose a larger region or another --l-filter"
            ) from error
        direction = Direction.gather(z, second, profiles, noise, added if axis == 1 else added.T)
        gaps = _gap_spread(z, profiles, direction, rng) if with_uncertainty else {}
        tables[way] = _table(direction, profiles, noise, slope_reason, with_uncertainty, gaps)
        cutoffs[way] = profiles.cutoff
        settings[f"profile {way}"] = (
            f"cut-off {profiles.cutoff:g} mm, {profiles.sections} sections, "
            f"end effects on {100.0 * profiles.end_effect:.1f} % of the heights"
        )
        settings[f"JRC {way}"] = direction.joint.formula
        if profiles.sections < SECTIONS:
            notes.append(
                f"warning: the profiles {way} the stripe hold {profiles.sections} sections of {profiles.cutoff:g} mm; "
                f"the standard asks for {SECTIONS}"
            )
    return tables, ProfileSettings(settings, cutoffs, tuple(notes))


def _table(
    direction: Direction,
    profiles: Profiles,
    noise: Noise,
    slope_reason: str,
    with_uncertainty: bool,
    gaps: dict[str, float],
) -> dict[str, Parameter]:
    everything = np.ones(len(profiles.z), dtype=np.bool_)
    found = direction.parameters(everything)
    spread = _spread(direction, profiles) if with_uncertainty else {}
    for key, moved_by in gaps.items():
        spread[key] = math.hypot(spread[key], moved_by * abs(found[key].value))
    trusting = noise.source == "sigma" and noise.trust > 0.0
    moved = direction.parameters(everything, more=(1.0 + noise.trust) ** 2) if trusting else found
    table = {}
    for key in PROFILE:
        one = found[key]
        reason = slope_reason if key == "Rdq" and slope_reason else one.reason
        expanded = None
        if not reason and key in spread and math.isfinite(spread[key]):
            trust = abs(moved[key].value - one.value)
            model = _model_error(key, one, direction)
            if math.isnan(trust):
                reason = "noise: a sigma wrong by its own uncertainty leaves nothing of it; give a repeat scan"
            elif math.isfinite(model):
                expanded = 2.0 * math.sqrt(spread[key] ** 2 + trust**2 + model**2)
        table[key] = Parameter(
            value=None if reason else one.value,
            uncertainty=expanded,
            unit=PROFILE[key].unit,
            reason=reason,
            raw=one.raw if math.isfinite(one.raw) else None,
            note=_note(key, direction),
            clause=PROFILE[key].clause,
        )
    return table


def _note(key: str, direction: Direction) -> str:
    if key == "MPD":
        return "base length 100 mm"
    if key == "Z2":
        return f"step {direction.joint.step:.3g} mm"
    return direction.joint.formula if key == "JRC" else ""


def _model_error(key: str, one: Found, direction: Direction) -> float:
    """Standard uncertainty of what taking the noise out takes for granted.

    Scaling by the ratio of Rq is exact for Gaussian heights; what noise adds to extremes was found on smoothed ones. What
    smoothing took from Rdq was put back, as twice the smoothing would take it again; elements of smoothed profiles may
    not change when they are smoothed further.
    """
    if key == "Rdq":
        return direction.attenuation_of.doubt * one.value if direction.smoothed_slopes() else 0.0
    if key in direction.doubt:
        return _ELEMENT_DOUBT * direction.doubt[key] * one.value
    if key not in SCALED:
        return 0.0
    return (0.1 if key == "Ra" else 0.25) * abs(one.raw - one.value)


def _spread(direction: Direction, profiles: Profiles) -> dict[str, float]:
    """Standard uncertainty of every parameter from patch to patch: the delete-a-block jackknife over runs of profiles.

    Blocks are as wide as the correlation across the profiles reaches, four at least; where they are narrower than that
    their spread is enlarged by what they have in common.
    """
    count = len(profiles.z)
    independent = _independent(profiles.z)
    blocks = int(np.clip(independent, _FEWEST_BLOCKS, min(_BLOCKS, count)))
    label = np.arange(count) * blocks // count
    parts = [direction.parameters(label != block) for block in range(blocks)]
    spread = {}
    for key in PROFILE:
        values = np.array([part[key].value for part in parts])
        values = values[np.isfinite(values)]
        if len(values) < max(_FEWEST_BLOCKS, blocks // 2):
            spread[key] = math.nan
            continue
        variance = (len(values) - 1) * float(np.mean((values - values.mean()) ** 2))
        spread[key] = few(len(values)) * math.sqrt(variance * max(1.0, blocks / independent))
    return spread


def _gap_spread(z: Array, profiles: Profiles, direction: Direction, rng: np.random.Generator) -> dict[str, float]:
    """Relative change that the gaps of primary profiles (N, samples) mm make when they are cut again at a random shift.

    Beside a gap the mean line follows the profile, as it does at its ends, and long elements do not fit between gaps.
    """
    known = np.isfinite(z)
    if known.mean() > 1.0 - _FEW_GAPS:
        return {}
    before = {key: float(np.nanmean(each)) for key, each in direction.values.items() if np.isfinite(each).any()}
    squares = dict.fromkeys(before, 0.0)
    for _ in range(_GAP_DRAWS):
        keep = np.roll(known, (int(rng.integers(len(z))), int(rng.integers(z.shape[1]))), axis=(0, 1))
        again = profile_parameters(roughness_profiles(np.where(keep, z, np.nan), profiles.pitch, profiles.cutoff))
        for key in squares:
            each = again[key][np.isfinite(again[key])]
            change = float(each.mean()) / before[key] - 1.0 if len(each) and before[key] != 0.0 else 0.0
            squares[key] += change**2 / _GAP_DRAWS
    return {key: _OVERLAP * math.sqrt(square) for key, square in squares.items() if key not in _SHAPES}


def _independent(z: Array) -> float:
    """How many unrelated profiles there are: their number over the correlation's reach across them, at least 2."""
    known = np.isfinite(z).astype(np.float64)
    if not known.any():
        return 2.0
    centred = np.nan_to_num(z - np.nanmean(z))
    variance = float((centred**2).sum() / known.sum())
    if variance == 0.0:
        return 2.0
    reach = 1.0
    for lag in range(1, len(z) // 2):
        pairs = float((known[lag:] * known[:-lag]).sum())
        correlation = float((centred[lag:] * centred[:-lag]).sum()) / max(pairs, 1.0) / variance
        if correlation < 0.05:
            break
        reach += 2.0 * correlation**2
    return max(2.0, len(z) / reach)
