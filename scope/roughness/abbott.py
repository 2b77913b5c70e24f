"""The material ratio (Abbott) curve of heights, and the parameters read from it (ISO 25178-2, clause 4.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array

CENTRAL = 0.40  # width of the window in which the equivalent straight line is fitted (ISO 25178-2; ISO 21920-2)


@dataclass(frozen=True, slots=True, eq=False)
class AbbottCurve:
    """Heights against the share of the area that stands at or above them."""

    heights: Array  # (N,) mm, ascending, about their mean

    @classmethod
    def from_heights(cls, heights: Array) -> AbbottCurve:
        """Curve of heights (N,) mm, in any order, finite; their mean becomes zero. ``ValueError`` for fewer than 10."""
        if len(heights) < 10:
            raise ValueError("a material ratio curve needs 10 heights")
        ordered = np.sort(heights)
        return cls(ordered - ordered.mean())

    def height_at(self, ratio: float) -> float:
        """Smc: the height (mm) above which a share ``ratio`` (0 to 1) of the area stands."""
        n = len(self.heights)
        place = np.clip((1.0 - ratio) * n - 0.5, 0, n - 1)
        low = int(place)
        high = min(low + 1, n - 1)
        return float(self.heights[low] + (place - low) * (self.heights[high] - self.heights[low]))

    def ratio_at(self, height: float) -> float:
        """Smr: the share (0 to 1) of the area that stands above ``height`` mm."""
        h, n = self.heights, len(self.heights)
        left, right = int(np.searchsorted(h, height, "left")), int(np.searchsorted(h, height, "right"))
        if left < right:  # heights of exactly this value: half of them count
            return 1.0 - (left + right) / (2.0 * n)
        if left in (0, n):
            return 1.0 if left == 0 else 0.0
        part = (height - h[left - 1]) / (h[left] - h[left - 1])
        return float(1.0 - (left - 0.5 + part) / n)

    def material_above(self, height: float) -> float:
        """Volume of material above ``height`` (mm), per area: mm3/mm2."""
        first = int(np.searchsorted(self.heights, height))
        return float((self.heights[first:] - height).sum() / len(self.heights))

    def void_below(self, height: float) -> float:
        """Volume of voids below ``height`` (mm), per area: mm3/mm2."""
        last = int(np.searchsorted(self.heights, height))
        return float((height - self.heights[:last]).sum() / len(self.heights))

    def sampled(self, count: int = 201) -> tuple[Array, Array]:
        """Material ratio in percent (count,) and height in mm (count,), for a plot."""
        ratio = np.linspace(0.0, 1.0, count)
        return 100.0 * ratio, np.array([self.height_at(r) for r in ratio])


def core_parameters(curve: AbbottCurve) -> dict[str, float]:
    """Sk Spk Svk (mm) and Smr1 Smr2 (percent) from the equivalent straight line.

    The line is the least-squares fit to the 40 % of the curve whose secant is flattest; where several windows are
    equally flat (a plateau) the middle one is taken. The reduced peak is the triangle on base Smr1 with the area
    of the hills above the core, and so is the reduced dale on 100 % - Smr2. A curve that never leaves the core has
    Spk or Svk 0.
    """
    h, n = curve.heights, len(curve.heights)
    width = max(2, round(CENTRAL * n))
    secant = h[width - 1 :] - h[: n - width + 1]
    flattest = np.flatnonzero(secant <= secant.min() * (1.0 + 1e-12))
    start = int(flattest[len(flattest) // 2])
    window = h[start : start + width]
    ratio = 1.0 - (np.arange(start, start + width) + 0.5) / n
    centred = ratio - ratio.mean()
    slope = float(centred @ window) / float(centred @ centred)
    top = float(window.mean()) - slope * float(ratio.mean())
    bottom = top + slope
    hills, dales = curve.ratio_at(top), 1.0 - curve.ratio_at(bottom)
    return {
        "Sk": top - bottom,
        "Spk": 2.0 * curve.material_above(top) / hills if hills > 0.0 else 0.0,
        "Svk": 2.0 * curve.void_below(bottom) / dales if dales > 0.0 else 0.0,
        "Smr1": 100.0 * hills,
        "Smr2": 100.0 * (1.0 - dales),
    }


def volume_parameters(curve: AbbottCurve, *, low: float = 0.10, high: float = 0.80) -> dict[str, float]:
    """Vmp Vmc Vvv Vvc (mm3/mm2) between the material ratios ``low`` and ``high`` (ISO 25178-3: 10 % and 80 %)."""
    upper, lower = curve.height_at(low), curve.height_at(high)
    peaks, dales = curve.material_above(upper), curve.void_below(lower)
    return {
        "Vmp": peaks,
        "Vmc": curve.material_above(lower) - peaks,
        "Vvv": dales,
        "Vvc": curve.void_below(upper) - dales,
    }


def percentile_parameters(curve: AbbottCurve) -> dict[str, float]:
    """Sxp (2.5 % to 50 %) and Sz99, the height between the material ratios 0.5 % and 99.5 % (mm).

    Sz99 holds 99 % of the area; unlike Sz it does not rest on two points.
    """
    return {
        "Sxp": curve.height_at(0.025) - curve.height_at(0.5),
        "Sz99": curve.height_at(0.005) - curve.height_at(0.995),
    }
