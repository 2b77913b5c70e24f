"""What engineers ask of a profile beside ISO: Z2 and JRC of rock joints, mean profile depth of pavements."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calibration.geometry import Array, Bools

# Joint roughness coefficient from Z2 at a sampling step (mm): slope and offset of the line, after Yu and Vayssade (1991).
_JRC = {0.25: (60.32, -4.51), 0.5: (61.79, -3.47), 1.0: (64.22, -2.31)}
_FEWEST_SAMPLES = 20  # of a base length: fewer miss its peaks
_BASE = 100.0  # mm, base length of a mean profile depth (ISO 13473-1)


class Extra(NamedTuple):
    """A parameter with the noise in it and without, or why there is none."""

    raw: float
    value: float
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """Squared slopes of N profiles at a step, for Z2 and the joint roughness coefficient (JRC) that goes with it.

    Z2 is the rms first difference over the step (Myers 1962). The step is the multiple of the pitch nearest to one of the
    steps that the lines of Yu and Vayssade (1991) were made for: 0.25, 0.5, 1 mm. It must be within 20 % of it, and the JRC
    within 0 to 20, else there is no JRC.
    """

    squares: Array  # (N, 3): sums of the squared slopes, of what two scans have of them in common, and their number
    noise: float  # variance of a slope that noise predicts; 0 where there is a repeat
    step: float  # mm
    nominal: float  # mm, that the line was made for

    @classmethod
    def gather(
        cls, z: Array, pitch: float, *, second: Array | None = None, noise_variance: float = 0.0, sample: Array | None = None
    ) -> Joint:  # fmt: skip
        """Slopes of profiles (N, samples) mm at ``pitch`` mm.

        The noise is what the products with a repeat ``second`` (N, samples) mm lack; without one that of independent
        heights of ``noise_variance`` (mm2), or of ``sample`` (N, samples) mm, noise alone.
        """
        nominal = min(_JRC, key=lambda one: abs(math.log(max(1, round(one / pitch)) * pitch / one)))
        every = max(1, round(nominal / pitch))
        step = every * pitch

        def slopes(heights: Array) -> Array:
            return np.asarray((heights[:, every:] - heights[:, :-every]) / step)

        slope = slopes(z)
        common = slope * (slope if second is None else slopes(second))
        known = np.isfinite(common)
        squares = np.stack(
            [np.where(known, values, 0.0).sum(axis=1) for values in (slope * slope, common)] + [known.sum(axis=1)],
            axis=1,
        )
        noise = 2.0 * noise_variance / step**2
        if sample is not None:
            square = slopes(sample) ** 2
            noise = float(square[np.isfinite(square)].mean()) if np.isfinite(square).any() else 0.0
        return cls(squares, 0.0 if second is not None else noise, step, nominal)

    @property
    def formula(self) -> str:
        """Line, step and source, as they are printed beside the values."""
        factor, offset = _JRC[self.nominal]
        return f"JRC = {factor:g} Z2 {offset:+g}, step {self.step:.3g} mm (Yu & Vayssade 1991, for {self.nominal:g} mm)"

    def of(self, keep: Bools, *, more: float = 1.0) -> tuple[Extra, Extra]:
        """Z2 and JRC of the profiles in a mask (N,); ``more`` multiplies the predicted noise variance."""
        squares, common, count = self.squares[keep].sum(axis=0)
        raw = float(squares / count) if count else math.nan
        clean = float(common / count) - more * self.noise if count else math.nan
        factor, offset = _JRC[self.nominal]
        root = math.sqrt(raw) if raw >= 0.0 else math.nan
        jrc = factor * root + offset
        if not count:
            why = f"no two heights are {self.step:.3g} mm apart"
            return Extra(math.nan, math.nan, why), Extra(math.nan, math.nan, why)
        if raw > 0.0 and clean < 0.5 * raw:
            why = f"noise makes {100.0 * min(1.0, 1.0 - clean / raw):.0f} % of the squared slopes (limit 50 %)"
            return Extra(root, math.nan, why), Extra(jrc, math.nan, why)
        z2 = math.sqrt(max(clean, 0.0))
        value, why = factor * z2 + offset, ""
        if abs(self.step / self.nominal - 1.0) > 0.2:
            why = f"no formula for a step of {self.step:.3g} mm (0.25, 0.5 or 1)"
        elif not 0.0 <= value <= 20.0:
            why = f"Z2 {z2:.3g} gives {value:.1f}, outside 0 to 20"
        return Extra(root, z2, ""), Extra(jrc, math.nan if why else value, why)


def joint_roughness(z: Array, pitch: float, *, noise_variance: float = 0.0) -> tuple[Extra, Extra]:
    """Z2 and JRC of all profiles (N, samples) mm; see `Joint`."""
    return Joint.gather(z, pitch, noise_variance=noise_variance).of(np.ones(len(z), dtype=np.bool_))


def profile_depths(z: Array, pitch: float) -> Array:
    """Sum of the profile depths (mm) of each profile's whole base lengths, and their number (N, 2): ISO 13473-1.

    Each base length of 100 mm is levelled by its own regression line; its depth is the mean of the highest points of
    its two halves above its average level. Base lengths with more than 10 % missing are left out.
    """
    samples = round(_BASE / pitch)
    result = np.zeros((len(z), 2))
    if samples < _FEWEST_SAMPLES:
        return result
    place = np.linspace(-0.5, 0.5, samples)
    half = samples // 2
    for start in range(0, z.shape[1] - samples + 1, samples):
        part = z[:, start : start + samples]
        for row in np.flatnonzero(np.isfinite(part).mean(axis=1) >= 0.9):
            known = np.isfinite(part[row])
            slope, level = np.polyfit(place[known], part[row][known], 1)
            rest = part[row] - slope * place - level
            result[row] += (0.5 * (np.nanmax(rest[:half]) + np.nanmax(rest[half:])), 1.0)
    return result


def mean_profile_depth(z: Array, pitch: float) -> float:
    """MPD (mm) of profiles (N, samples) mm; NaN where no 100 mm of a profile are whole enough. See `profile_depths`."""
    total, count = profile_depths(z, pitch).sum(axis=0)
    return float(total / count) if count else math.nan
