"""What the smoothing of slopes took from them, from what more smoothing takes again."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from calibration.geometry import Array

_BEYOND = 0.6  # of what is put back, in doubt: a second smoothing does not take quite what the first took

_SURE = 2.0  # standard errors that an excess must have before any of it is put back


class Attenuation(NamedTuple):
    """How much a rms slope behind an S-filter is to be enlarged."""

    factor: float = 1.0
    doubt: float = 0.0  # relative standard uncertainty of the slope from that; infinite where noise hides the slopes


def attenuation_of(before: Array, after: Array) -> Attenuation:
    """Factor for a rms slope from its squares behind the filter and behind 1.4 times the filter, in groups (M,) of places.

    A Gaussian that is 1.4 times as long has twice the variance and takes about as much again as the first did, of slopes
    whose waves are long against it. What the scatter between the groups (by the jackknife) shows to be noise is not put
    back.
    """
    total, again = float(before.sum()), float(after.sum())
    if not (total > 0.0 and again > 0.0):
        return Attenuation(1.0, math.inf)
    excess = math.sqrt(total / again) - 1.0
    without = [(total - b, again - a) for b, a in zip(before, after, strict=True)]
    factors = np.array([math.sqrt(b / a) for b, a in without if b > 0.0 and a > 0.0])
    if len(factors) < 2 or len(factors) < len(before):
        return Attenuation(1.0, math.inf)
    error = math.sqrt((len(factors) - 1) * float(factors.var()))
    share = max(0.0, 1.0 - (_SURE * error / excess) ** 2) if excess > 0.0 else 0.0
    return Attenuation(
        1.0 + share * excess, math.hypot(_BEYOND * share * excess, (1.0 - share) * max(abs(excess), error))
    )
