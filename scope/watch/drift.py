"""Whether an artefact's figures have moved, beside those of earlier scans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from scope.history import Record, chart_of


@dataclass(frozen=True, slots=True)
class Drift:
    """A figure that is no longer what it was."""

    figure: str
    value: float
    low: float  # limits of the earlier ones; NaN where only the trend speaks
    high: float
    slope: float  # a day; NaN where no trend is clear
    scans: int  # earlier ones

    @property
    def text(self) -> str:
        """In one line."""
        trend = "" if np.isnan(self.slope) else f", moving by {self.slope:+.3g} a day"
        where = "" if np.isnan(self.low) else f" outside {self.low:.4g} to {self.high:.4g}"
        return f"{self.figure} {self.value:.4g}{where} of {self.scans} earlier scans{trend}"


def drift_of(now: Mapping[str, float], earlier: Sequence[Record]) -> tuple[Drift, ...]:
    """Figures outside the control limits of the earlier scans of the same artefact, the oldest first.

    Five earlier ones are needed for limits (individuals chart, ISO 7870-2).
    """
    found = []
    for name, value in now.items():
        chart = chart_of(name, earlier)
        if np.isfinite(chart.low) and not chart.low <= value <= chart.high:
            found.append(Drift(name, value, chart.low, chart.high, chart.slope, len(chart.values)))
    return tuple(found)
