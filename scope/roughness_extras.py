"""What engineers ask of a profile beside ISO: Z2 and JRC of rock joints, mean profile depth of pavements."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array

# Joint roughness coefficient from Z2 at a sampling step (mm): slope and offset of the line, after Yu and Vayssade (1991).
_JRC = {0.25: (60.32, -4.51), 0.5: (61.79, -3.47), 1.0: (64.22, -2.31)}
_BASE = 100.0  # mm, base length of a mean profile depth (ISO 13473-1)


@dataclass(frozen=True, slots=True)
class JointRoughness:
    """Z2 of a direction and the joint roughness coefficient that goes with it."""

    Z2: float  # rms slope at the step
    JRC: float  # NaN where the formula was not made for this
    step: float  # mm
    formula: str
    reason: str = ""  # why there is no JRC


def joint_roughness(z: Array, pitch: float, *, noise_variance: float = 0.0) -> JointRoughness:
    """Z2 (rms first difference over step; Myers 1962) and JRC of profiles (profiles, samples) mm.

    ``noise_variance`` (mm2) of independent noise is taken out of the squared slopes, twice over the step squared; where
    it is more than half of them, both are NaN.

    The step is the multiple of the pitch (mm) nearest to one of the steps that the lines of Yu and Vayssade (1991) were
    made for: 0.25, 0.5, 1 mm. It must be within 20 % of it, and the JRC within 0 to 20, else there is none.
    """
    tried = [(abs(math.log(max(1, round(nominal / pitch)) * pitch / nominal)), nominal) for nominal in _JRC]
    _, nominal = min(tried)
    every = max(1, round(nominal / pitch))
    step = every * pitch
    slope = (z[:, every:] - z[:, :-every]) / step
    known = np.isfinite(slope)
    square = float(np.mean(slope[known] ** 2)) if known.any() else math.nan
    noise = 2.0 * noise_variance / step**2
    z2 = math.sqrt(square - noise) if noise <= 0.5 * square else math.nan
    factor, offset = _JRC[nominal]
    value = factor * z2 + offset
    formula = f"JRC = {factor:g} Z2 {offset:+g}, step {step:.3g} mm (Yu & Vayssade 1991, {nominal:g} mm)"
    if math.isnan(z2):
        return JointRoughness(z2, z2, step, formula, "noise makes more than half of the squared slopes")
    if abs(step / nominal - 1.0) > 0.2:
        return JointRoughness(z2, math.nan, step, formula, f"no formula for a step of {step:.3g} mm (0.25, 0.5 or 1)")
    if not 0.0 <= value <= 20.0:
        return JointRoughness(z2, math.nan, step, formula, f"Z2 {z2:.3g} gives {value:.1f}, outside 0 to 20")
    return JointRoughness(z2, value, step, formula)


def mean_profile_depth(z: Array, pitch: float) -> float:
    """MPD (mm) of profiles (profiles, samples) mm: ISO 13473-1; NaN where no 100 mm of a profile are whole enough.

    Each base length of 100 mm is levelled by its own regression line; its depth is the mean of the highest points of
    its two halves above its average level. Base lengths with more than 10 % missing are left out.
    """
    samples = round(_BASE / pitch)
    depths = []
    place = np.linspace(-0.5, 0.5, samples)
    for start in range(0, z.shape[1] - samples + 1, samples):
        part = z[:, start : start + samples]
        for row in part[np.isfinite(part).mean(axis=1) >= 0.9]:
            known = np.isfinite(row)
            slope, level = np.polyfit(place[known], row[known], 1)
            rest = row - slope * place - level
            half = samples // 2
            depths.append(0.5 * (np.nanmax(rest[:half]) + np.nanmax(rest[half:])))
    return float(np.mean(depths)) if depths else math.nan
