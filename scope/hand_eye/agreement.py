"""Whether the passes of a hand-eye calibration by stripes agree, and what to say of it; sphere and planes alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from calibration.stages import Pass, Repeatability
from scope.session import HandEyePlan

_APART = 10.0  # mm, between passes and poses: more is a wrong convention


class Fit(Protocol):
    """What both solutions tell of their passes."""

    @property
    def used(self) -> Sequence[bool]:
        """Of each pass."""

    @property
    def loo_mm(self) -> Sequence[float]:
        """Rms of each pass from where the others put the object."""

    @property
    def robot(self) -> Repeatability:
        """As the passes scatter."""


@dataclass(frozen=True)
class Wording:
    """What depends on the object that the stripes lie on."""

    contradicts: str  # where the other passes put the object, and what may be wrong with a pass that does not
    few_agree: str  # what to check besides units and notation
    apart: str  # likewise
    least: int  # passes that tell whether one of them is wrong
    wanted: int


def judged(
    plan: HandEyePlan, fit: Fit, passes: Sequence[Pass], dropped: list[dict[str, Any]], words: Wording
) -> tuple[bool, str, float]:
    """Whether the passes pass, why, and their median rms distance left out, mm; adds those that contradict to ``dropped``."""
    used = int(sum(fit.used))
    for p, use, off in zip(passes, fit.used, fit.loo_mm, strict=True):
        if not use:
            reason = f"its points are {off:.3g} mm (rms) from {words.contradicts}"
            dropped.append({"part": "view", "name": p.name, "reason": reason, "count": 1})
    loo = float(np.median([v for v, u in zip(fit.loo_mm, fit.used, strict=True) if u]))
    agree = f"{used} of {len(passes)} passes agree"
    if used < 0.6 * len(passes) + 1e-9 and used < len(passes):
        return False, f"only {agree}: check units, notation and gives, and {words.few_agree}", loo
    if fit.robot.mm > _APART:
        apart = f"the passes contradict the poses by {fit.robot.mm:.3g} mm"
        return False, f"{apart}: check units, notation and gives of the log{words.apart}", loo
    if used < words.least:
        few = f"{used} passes leave too little to tell whether one of them is wrong"
        return False, f"{few}; add passes, {words.wanted} are wanted", loo
    if plan.loo_mm is not None and not loo <= plan.loo_mm:
        far = f"left out in turn, passes are off by {loo:.3g} mm (median)"
        return False, f"{far}; accept.loo_mm allows {plan.loo_mm:g}", loo
    return True, f"{agree}; left out in turn they are off by {loo:.2g} mm (median)", loo
