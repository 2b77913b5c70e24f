"""A stripe image to sub-pixel positions, one a row or column."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibration.geometry import Array, Codes

Along = Literal["rows", "columns"]


@dataclass(frozen=True, slots=True, eq=False)
class Stripe:
    """One answer a line of the image: a column where the stripe runs along rows, a row where along columns."""

    along: Along  # the stripe runs along image rows (one answer a column) or columns (one a row)
    position: Array  # (N,) px across the line, NaN where there is none; N = all lines of the image
    sigma: Array  # (N,) px, one standard deviation, independent from line to line
    width: Array  # (N,) px, one sigma of the stripe's profile across the line
    peak: Array  # (N,) grey levels above the background
    reason: Codes  # (N,) a Reason

    @property
    def pixels(self) -> Array:
        """(N, 2) px as (u, v)."""
        lines = np.arange(len(self.position), dtype=np.float64)
        pair = (lines, self.position) if self.along == "rows" else (self.position, lines)
        return np.stack(pair, axis=1)
