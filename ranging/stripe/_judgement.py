"""Which lines have an answer, and why the others have none."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import compiled
from calibration.geometry import Array, Codes
from calibration.reason import Reason
from ranging.stripe._peak_kernels import Pixels
from ranging.stripe._table import (
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
    POSITION,
    ROWS,
    SIGMA,
    STATE,
    WIDTH,
    Layout,
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
OVEREXPOSED_TOGETHER = (
    2.5  # the same where pixels are taken together, of which each that holds clipped light tells less
)
SIGNIFICANT = 4.0  # standard deviations by which an asymmetry must exceed what is allowed
JUMP = 1.25  # px, step between lines, unlike the steps before and after, at which a stretch of stripe ends
GAP = 3  # lines that may be missing within a stretch
BLOCK = 31  # lines over which the usual width is the median
COMB = 4  # px
ASIDE = 6  # lines
MIXED = 1.25  # times the width of most lines near by, beyond which a line sees two surfaces
PULL = 1.2  # shift of a cut Gaussian over its loss of width: 1.0 for a cut at 2 sigma, 1.4 at 1 sigma
LEAN = 2.0  # shift of the maximum likelihood position over sigma times asymmetry, in round numbers


class Limits(NamedTuple):
    """What a line must keep to have an answer."""

    threshold: float  # grey levels above the background
    saturation: float  # grey levels
    overexposed: float  # grey levels
    narrowest: float  # px, one sigma
    widest: float  # px, one sigma
    two_peaks: float  # share of the peak
    edge: float  # asymmetry


@compiled
def judge(table: Array, peaks: NDArray[np.int32], limits: Limits, reason: Codes) -> None:
    """Give every line a reason and strike out the lines that have no answer.

    ``table`` (ROWS, N) is changed in place: sigma grows with the misfit of the profile and by the shift that its
    asymmetry allows; lines without an answer become NaN. ``reason`` (N,) receives the codes.
    """
    threshold, saturation, overexposed, narrowest, widest, two_peaks, edge = limits
    for i in range(table.shape[1]):
        state, peak, width = table[STATE, i], table[PEAK, i], table[WIDTH, i]
        top, second = np.float64(peaks[1, i]), np.float64(peaks[2, i])
        code = RANGED
        if state == NO_PEAK or not peak >= threshold:
            code = SATURATED if top >= saturation else NO_LIGHT
        elif state == CUT:
            code = OUT_OF_VIEW
        elif state == NO_FLANK:
            # The floor of noise that is looked for far and wide lies deeper: hence twice the threshold.
            code = NO_LIGHT if peak < 2.0 * threshold else SATURATED if top >= saturation else TOO_WIDE
        elif state != GOOD:
            code = EDGE
        elif width > widest:
            code = TOO_WIDE
        elif width < narrowest:
            code = TOO_NARROW
        elif table[CLIPPED, i] > 0 and peak > overexposed:
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


@compiled
def darken(
    pixels: Pixels, dark: Pixels, layout: Layout, peaks: NDArray[np.int32], threshold: float, reason: Codes
) -> None:  # fmt: skip
    """Give the reason NO_LIGHT to lines without an answer whose highest pixel is not ``threshold`` above their median.

    The fit of a dark line runs anywhere: how wide or high it is says nothing. One pixel in `COMB` tells the median.
    """
    _, length, line_step, pixel_step = layout
    some = np.empty((length + COMB - 1) // COMB)
    for i in range(len(reason)):
        if reason[i] == RANGED or reason[i] == NO_LIGHT or reason[i] == SATURATED:
            continue
        for k in range(len(some)):
            at = i * line_step + k * COMB * pixel_step
            some[k] = np.float64(pixels[at])
            if dark.size > 0:
                some[k] = max(some[k] - np.float64(dark[at]), 0.0)
        if peaks[1, i] - np.median(some) < threshold:
            reason[i] = NO_LIGHT


@compiled
def part_mixed(table: Array, reason: Codes) -> None:
    """Give the reason EDGE to lines that see two surfaces: far wider than those a few lines before, and those behind.

    At an edge along the stripe's normal a line has some light of both surfaces. Where their stripes merge, the profile is
    symmetric, and lies at neither. Neighbours 2 to `ASIDE` lines away are asked, since the next one may be mixed, too; a
    line as wide as most of them, to one side at least, is where the surface is steep.
    """
    count, found = table.shape[1], False
    for i in range(count):
        if reason[i] != RANGED:
            continue
        least = (table[WIDTH, i] - SIGNIFICANT * table[SIGMA, i]) / MIXED
        if 2 <= i < count - 2 and table[WIDTH, i - 2] >= least and table[WIDTH, i + 2] >= least:
            continue  # nearly all lines
        alike, known = False, 0
        for way in (-1, 1):
            here, wide = 0, 0
            for d in range(2, ASIDE + 1):
                j = i + way * d
                if 0 <= j < count and table[WIDTH, j] > 0.0:
                    here += 1
                    wide += 1 if table[WIDTH, j] >= least else 0
            alike = alike or (here > 0 and 2 * wide >= here)
            known = max(known, here)
        if known >= 3 and not alike:
            reason[i], found = EDGE, True
    for i in range(count if found else 0):
        if reason[i] == EDGE:
            for row in range(ROWS):
                if row != STATE:
                    table[row, i] = np.nan


@compiled
def count_uneven(table: Array, threshold: float, misfit: float, roughness: float) -> tuple[int, int, int]:
    """Count the lines that are GOOD with a peak above ``threshold``, those that exceed ``misfit``, and those unlike the line before.

    Unlike: their peaks differ by more than the share ``roughness``. Dark lines tell nothing: all of them are unlike.
    """
    good, misfits, rough = 0, 0, 0
    for i in range(table.shape[1]):
        if table[STATE, i] != GOOD or not table[PEAK, i] >= threshold:
            continue
        good += 1
        misfits += 1 if table[MISFIT, i] > misfit else 0
        if i > 0 and abs(table[PEAK, i] - table[PEAK, i - 1]) > roughness * table[PEAK, i]:
            rough += 1
    return good, misfits, rough


@compiled
def stretches(table: Array, reason: Codes, begin: NDArray[np.int32], end: NDArray[np.int32]) -> int:
    """First and last lines of the unbroken stretches of stripe; returns how many there are.

    Two ranged lines belong together if they are at most ``GAP`` lines apart, and their step a line is below ``JUMP``
    px or like the step before or after it.
    """
    lines = np.flatnonzero(reason == RANGED)
    count = 0
    for k in range(len(lines)):
        broken = k == 0
        if not broken:
            here, before = lines[k], lines[k - 1]
            step = (table[POSITION, here] - table[POSITION, before]) / (here - before)
            broken = here - before > GAP
            if not broken and abs(step) > JUMP:
                unlike = abs(step)
                if k > 1:
                    other = (table[POSITION, before] - table[POSITION, lines[k - 2]]) / (before - lines[k - 2])
                    unlike = min(unlike, abs(step - other))
                if k + 1 < len(lines):
                    other = (table[POSITION, lines[k + 1]] - table[POSITION, here]) / (lines[k + 1] - here)
                    unlike = min(unlike, abs(step - other))
                broken = unlike > JUMP
        if broken:
            begin[count] = lines[k]
            count += 1
        end[count - 1] = lines[k]
    return count


@compiled
def compare(
    table: Array, reason: Codes, count: int, begin: NDArray[np.int32], end: NDArray[np.int32], narrowing: float
) -> None:
    """Find half-seen lines by their neighbours: at the ends of a stretch, and where it is narrower than usual.

    The first and the last line of a stretch mix what lies on either side of the edge, and have the reason EDGE unless
    they are the first or last of the image. A Gaussian of which an edge cuts off a part loses width before anything
    else: below ``narrowing`` times the median width of its stretch (by more than 1.5 standard deviations) a line has the
    reason EDGE; what it lost short of that enlarges sigma by the shift that such a cut causes, and asymmetry likewise.
    """
    total = table.shape[1]
    block = np.empty(BLOCK)
    for c in range(count):
        first, last = int(begin[c]), int(end[c])
        blocks = max(1, (last - first + 1) // BLOCK)
        medians = np.empty(blocks)
        centres = np.empty(blocks)
        for q in range(blocks):
            centre = first + (2 * q + 1) * (last - first + 1) // (2 * blocks)
            n = 0
            for i in range(max(first, centre - BLOCK // 2), min(last, centre + BLOCK // 2) + 1, 2):
                if reason[i] == RANGED:
                    block[n] = table[WIDTH, i]
                    n += 1
            medians[q] = np.median(block[:n]) if n > 0 else np.nan
            centres[q] = centre
        q = 0
        for i in range(first, last + 1):
            if reason[i] != RANGED:
                continue
            while q + 1 < blocks and i > centres[q + 1]:
                q += 1
            usual = medians[q]
            if q + 1 < blocks and i > centres[q]:
                share = (i - centres[q]) / (centres[q + 1] - centres[q])
                usual += share * (medians[q + 1] - medians[q])
            width, sigma = table[WIDTH, i], table[SIGMA, i]
            at_end = (i == first and first > 0) or (i == last and last < total - 1)
            if at_end or width + 1.5 * sigma < narrowing * usual:
                reason[i] = EDGE
            else:
                lost = max(0.0, usual - width - 2.0 * sigma)
                lean = max(0.0, abs(table[ASYMMETRY, i]) - 2.0 * table[ASYMMETRY_SIGMA, i])
                shift = max(PULL * lost, LEAN * lean * width)
                if shift > 0.0:
                    table[SIGMA, i] = np.sqrt(sigma * sigma + shift * shift)
            if reason[i] != RANGED:
                for row in range(ROWS):
                    if row != STATE:
                        table[row, i] = np.nan
