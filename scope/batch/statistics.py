"""A day in figures: control charts, capability, and the gauge study that parts repeatability from reproducibility."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array

_D2 = 1.128379167  # expected range of two normal values, in standard deviations: 2 / sqrt(pi)


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A control chart of single values with its moving range."""

    values: Array  # (N,)
    centre: float
    sigma: float  # from the mean moving range, so that a drift does not widen the limits
    outside: tuple[int, ...]  # values beyond three sigma
    run: tuple[int, ...]  # ends of eight values or more on one side of the centre

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper limit."""
        return self.centre - 3.0 * self.sigma, self.centre + 3.0 * self.sigma


def control_chart(values: Sequence[float]) -> Chart:
    """Chart of N values in order of time; ``ValueError`` for fewer than two or values that are not finite.

    Source: ISO 7870-2 (Shewhart charts for individuals and moving ranges; rule of eight on one side).
    """
    held = np.asarray(values, dtype=np.float64)
    if held.ndim != 1 or len(held) < 2 or not np.isfinite(held).all():
        raise ValueError(f"a control chart needs two finite values or more; found shape {held.shape}")
    centre = float(held.mean())
    sigma = float(np.abs(np.diff(held)).mean()) / _D2
    side, length, run = np.sign(held - centre), 0, []
    for k in range(len(held)):
        length = length + 1 if k and side[k] == side[k - 1] != 0 else 1
        if length >= 8:
            run.append(k)
    outside = np.flatnonzero(np.abs(held - centre) > 3.0 * sigma + 1e-12 * abs(centre))
    return Chart(held, centre, sigma, tuple(int(k) for k in outside), tuple(run))


def capability(values: Sequence[float], low: float, high: float) -> tuple[float, float]:
    """Cp and Cpk of values against limits: their width, and the nearer limit, over three standard deviations.

    ``ValueError`` for fewer than two values or limits in the wrong order. Infinite without scatter. Source: ISO 22514-2.
    """
    held = np.asarray(values, dtype=np.float64)
    if len(held) < 2 or not low < high:
        raise ValueError(f"capability needs two values and limits in order; found {len(held)}, {low:g} and {high:g}")
    spread, mean = 3.0 * float(held.std(ddof=1)), float(held.mean())
    if spread == 0.0:
        return float("inf"), float("inf") if low < mean < high else float("-inf")
    return (high - low) / (2.0 * spread), min(high - mean, mean - low) / spread


@dataclass(frozen=True, slots=True)
class GaugeStudy:
    """Variances of a crossed study, in squared units of the figure; never negative."""

    repeatability: float  # the same part by the same operator (or rig) again
    operators: float  # between operators
    interaction: float  # between operators, differently from part to part
    parts: float  # between parts

    @property
    def gauge(self) -> float:
        """Repeatability and reproducibility together, one standard deviation."""
        return float(np.sqrt(self.repeatability + self.operators + self.interaction))

    @property
    def total(self) -> float:
        """All of it, one standard deviation."""
        return float(np.sqrt(self.repeatability + self.operators + self.interaction + self.parts))

    @property
    def percent(self) -> float:
        """Gauge over total, percent of the standard deviation."""
        return 100.0 * self.gauge / self.total if self.total > 0.0 else 0.0


def gauge_study(values: Array) -> GaugeStudy:
    """Gauge repeatability and reproducibility of values (P parts, O operators, N repeats), by the analysis of variance.

    Method of moments from the mean squares of a balanced crossed design with random effects; a variance that comes out negative is 0.
    Weak with few operators: their variance has O - 1 degrees of freedom. ``ValueError`` for fewer than two of anything or gaps.

    Source: AIAG, Measurement Systems Analysis, 4th edition, chapter III B and appendix A; ISO 22514-7.
    """
    held = np.asarray(values, dtype=np.float64)
    if held.ndim != 3 or min(held.shape) < 2 or not np.isfinite(held).all():
        raise ValueError(
            f"a gauge study is (parts, operators, repeats), two or more of each and no gaps; found {held.shape}"
        )
    p, o, n = held.shape
    mean, cell = held.mean(), held.mean(axis=2)
    part, operator = cell.mean(axis=1), cell.mean(axis=0)
    of_parts = o * n * float(((part - mean) ** 2).sum()) / (p - 1)
    of_operators = p * n * float(((operator - mean) ** 2).sum()) / (o - 1)
    crossed = cell - part[:, None] - operator[None, :] + mean
    of_crossed = n * float((crossed**2).sum()) / ((p - 1) * (o - 1))
    within = float(((held - cell[..., None]) ** 2).sum()) / (p * o * (n - 1))
    return GaugeStudy(
        repeatability=within,
        operators=max(0.0, (of_operators - of_crossed) / (p * n)),
        interaction=max(0.0, (of_crossed - within) / n),
        parts=max(0.0, (of_parts - of_crossed) / (o * n)),
    )
