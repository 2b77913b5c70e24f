"""Conformity under uncertainty: ISO 14253-1, the default rule for the one who proves it."""

from __future__ import annotations

import math
from typing import Literal

Decision = Literal["pass", "fail", "undecided"]


def decide(excess: float, tolerance: float | None, uncertainty: float) -> Decision | None:
    """Decision on a value that may be ``tolerance`` at most in magnitude.

    Conformity is proven where |excess| + U stays within the tolerance, non-conformity where |excess| - U exceeds it (ISO
    14253-1:2017, 5.2 and 5.3, with guard bands of the whole expanded uncertainty, k = 2); between them nothing is proven. None without a tolerance.
    """
    if tolerance is None:
        return None
    if math.isnan(abs(excess) + uncertainty):  # not measured
        return "undecided"
    if abs(excess) + uncertainty <= tolerance:
        return "pass"
    return "fail" if abs(excess) - uncertainty > tolerance else "undecided"


def overall(decisions: list[Decision]) -> Decision:
    """One failure fails the part; otherwise one that is undecided leaves it undecided, and so does having none."""
    if "fail" in decisions:
        return "fail"
    return "undecided" if not decisions or "undecided" in decisions else "pass"
