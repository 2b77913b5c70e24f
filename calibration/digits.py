"""As many digits as are true: a value is written to the place of its uncertainty's second digit."""

from __future__ import annotations

import math

MOST = 6  # decimals


def decimals(uncertainty: float, *, usual: int = 4) -> int:
    """Decimals at which the second significant digit of an uncertainty stands (GUM 7.2.6), 0 to 6; ``usual`` where it is not known."""
    if not (math.isfinite(uncertainty) and uncertainty > 0.0):
        return usual
    return min(max(0, 1 - math.floor(math.log10(float(f"{uncertainty:.1e}")))), MOST)


def rounded(value: float, uncertainty: float, *, sign: bool = False, usual: int = 4) -> str:
    """Value written to the place of its uncertainty's second digit; "-" for one that is not finite."""
    if not math.isfinite(value):
        return "-"
    return f"{value:{'+' if sign else ''}.{decimals(uncertainty, usual=usual)}f}"


def two_digits(value: float) -> str:
    """An uncertainty: two significant digits, without an exponent; "-" for one that is not finite."""
    return f"{value:.{decimals(abs(value), usual=0)}f}" if math.isfinite(value) else "-"
