"""Which lines have an answer, and why the others have none."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Codes
from calibration.reason import Reason
from ranging.kernels import compiled
from ranging.stripe_gaussian import (
    ASYMMETRY,
    ASYMMETRY_SIGMA,
    CLIPPED,
    CUT,
    FLOOR,
    GOOD,
    MISFIT,
    NO_FLANK,
    NO_PEAK,
    PEAK,
    ROWS,
    SIGMA,
    STATE,
    WIDTH,
)

RANGED = int(Reason.RANGED)
NO_LIGHT = int(Reason.NO_LIGHT)
TOO_NARROW = int(Reason.TOO_NARROW)
TOO_WIDE = int(Reason.TOO_WIDE)
SATURATED = int(Reason.SATURATED)
TWO_PEAKS = int(Reason.TWO_PEAKS)
EDGE = int(Reason.EDGE)
OUT_OF_VIEW = int(Reason.OUT_OF_VIEW)

OVEREXPOSED = 4.0  # times the clipping level: beyond, a plateau of 3.3 sigma hides all but the tails
SIGNIFICANT = 4.0  # standard deviations by which an asymmetry must exceed what is allowed


@compiled
def judge(
    table: Array,
    peaks: NDArray[np.int32],
    threshold: float,
    saturation: float,
    narrowest: float,
    widest: float,
    two_peaks: float,
    edge: float,
    reason: Codes,
) -> None:
    """Give every line a reason and strike out the lines that have no answer.

    ``table`` (ROWS, N) is changed in place: sigma grows with the misfit of the profile and by the shift that its
    asymmetry allows; lines without an answer become NaN. ``reason`` (N,) receives the codes.
    """
    for i in range(table.shape[1]):
        state, peak, width = table[STATE, i], table[PEAK, i], table[WIDTH, i]
        top, second = np.float64(peaks[1, i]), np.float64(peaks[2, i])
        code = RANGED
        if state == NO_PEAK or not peak >= threshold:
            code = NO_LIGHT
        elif state == CUT:
            code = OUT_OF_VIEW
        elif state == NO_FLANK:
            if peak < 2.0 * threshold:  # the floor of noise that is looked for far and wide lies deeper
                code = NO_LIGHT
            else:
                code = SATURATED if top >= saturation else TOO_WIDE
        elif state != GOOD:
            code = EDGE
        elif width > widest:
            code = TOO_WIDE
        elif width < narrowest:
            code = TOO_NARROW
        elif table[CLIPPED, i] > 0 and peak > OVEREXPOSED * saturation:
            code = SATURATED
        elif second - table[FLOOR, i] > two_peaks * min(peak, top - table[FLOOR, i]):
            code = TWO_PEAKS
        elif abs(table[ASYMMETRY, i]) > edge + SIGNIFICANT * table[ASYMMETRY_SIGMA, i]:
            code = EDGE
        reason[i] = code
        if code != RANGED:
            for row in range(ROWS):
                if row != STATE:
                    table[row, i] = np.nan
            continue
        if table[MISFIT, i] > 2.0:
            table[SIGMA, i] *= np.sqrt(0.5 * table[MISFIT, i])
