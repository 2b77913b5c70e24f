"""Wide stripes: how wide a frame's stripe is, and its lines with pixels taken together, so that it is measured as a narrow one.

The sum of b pixels has b times the mean and, of pixels that vary independently, b times the variance: photon transfer stays what
it is, with the same gain and b times the variance of a dark pixel. A Gaussian stays one, its width 1 / b of that in pixels; from
2 new pixels on, little of what the line tells of its place is lost (1 %, since a pixel's own width adds 1 / 12 to its square).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import compiled
from calibration.geometry import Array
from ranging.background import Noise
from ranging.stripe._table import GOOD, NO_FLANK, PEAK, STATE, WIDTH, Lines, is_clipped

DOUBTED = 5.5  # px, one sigma, from which a line asks for pixels taken together
WIDE = 4.0  # px, one sigma, from which a clean stripe is measured so
UNEVEN = 2.8  # px, one sigma, from which a speckled one is
SIZES = (2, 4, 8)  # px taken together: so many that the stripe is narrower than
NEW_WIDTH = 3.5  # of the new pixels, one sigma
LEAST = 8  # lines that must show a wide stripe
SHARE = 0.3  # of the lit lines, likewise
SAMPLED = 64  # lines that tell the width
REACH = 100  # px from the brightest pixel, as far as it is looked for
FLAT = 8  # px, over which the light beside a stripe is averaged
GAP = 8  # px, within clipped light, that speckle darkens
BEST_BOX = 1.4  # sigma: half the width of the box in which a Gaussian stands out most from white noise


class Binned(NamedTuple):
    """Lines with pixels taken together."""

    lines: Lines
    size: int  # px taken together
    unit: float  # new grey levels a grey level

    def noise(self, noise: Noise) -> Noise:
        """Noise of the camera, as the new pixels have it."""
        share = self.unit * self.unit / self.size
        return Noise(
            noise.gain_e * self.size / self.unit, math.sqrt(max(share * (noise.read_noise**2 + 1 / 12) - 1 / 12, 0.0))
        )

    def noise_of_pixels(self, noise: Noise) -> Noise:
        """Noise of the camera from that of the new pixels."""
        share = self.size / (self.unit * self.unit)
        return Noise(
            noise.gain_e * self.unit / self.size, math.sqrt(max(share * (noise.read_noise**2 + 1 / 12) - 1 / 12, 0.0))
        )


def size_for(lines: Lines, places: NDArray[np.int32], table: Array, threshold: float, *, uneven: bool) -> int:
    """How many pixels to take together: 1 for a narrow stripe.

    Few frames are looked into: those with lines on which a fit pixel by pixel found no flank, and ``uneven`` ones, on which grains of
    speckle may pass for a stripe. There the median tells over lines how wide the light is about the brightest pixel.
    """
    bright = table[PEAK] >= threshold
    wide = ((table[STATE] == NO_FLANK) & (table[PEAK] >= 2.0 * threshold)) | (
        (table[STATE] == GOOD) & (table[WIDTH] > DOUBTED) & bright
    )
    lit = wide | ((table[STATE] == GOOD) & bright)
    least = WIDE
    if np.count_nonzero(wide) < max(LEAST, SHARE * np.count_nonzero(lit)):
        if not uneven:
            return 1
        wide, least = lit, UNEVEN
    some = np.flatnonzero(wide)
    some = some[:: max(1, len(some) // SAMPLED)].astype(np.int64)
    if len(some) < LEAST:
        return 1
    half = np.empty(len(some))
    middles = places.copy()
    to_middle(lines, middles)
    _measure_boxes(lines, some, middles, half)
    sigma = float(np.median(half)) / BEST_BOX
    return 1 if sigma < least else next((size for size in SIZES if sigma < NEW_WIDTH * size), SIZES[-1])


@compiled
def to_middle(lines: Lines, places: NDArray[np.int32]) -> None:
    """Move the places (N,) px of clipped peaks, which are the first of their pixels, to the middle of those clipped."""
    length, line_step, pixel_step = lines.layout[1], lines.layout[2], lines.layout[3]
    for i in range(len(places)):
        first = places[i]
        if first < 0 or not is_clipped(lines, i * line_step + first * pixel_step):
            continue
        last = first
        for k in range(first + 1, min(first + REACH, length)):
            if is_clipped(lines, i * line_step + k * pixel_step):
                last = k
            elif k - last > GAP:
                break
        for k in range(first - 1, max(first - REACH, -1), -1):
            if is_clipped(lines, i * line_step + k * pixel_step):
                first = k
            elif first - k > GAP:
                break
        middle = (first + last) // 2
        for k in range(last - first + 1):  # of what is clipped, the nearest
            near = middle + (k + 1) // 2 * (1 if k % 2 else -1)
            if first <= near <= last and is_clipped(lines, i * line_step + near * pixel_step):
                places[i] = near
                break


@compiled
def _measure_boxes(lines: Lines, some: NDArray[np.int64], places: NDArray[np.int32], half: Array) -> None:
    """Half the width ``half`` (n,) px of the box with the brightest pixel of some lines that stands out most from white noise.

    Each half of a box counts as the poorer of the two, above the darkest quarter of the brighter side: a bright area on one
    side of a stripe makes it no wider. The brightest pixel may be a grain of speckle anywhere in the box.
    """
    length, line_step, pixel_step = lines.layout[1], lines.layout[2], lines.layout[3]
    light = np.empty(2 * REACH + 1)
    total = np.empty(2 * REACH + 2)
    mean = np.empty(REACH // FLAT)
    for n in range(len(some)):
        place = places[some[n]]
        low, high = max(0, place - REACH), min(length, place + REACH + 1)
        size, p = high - low, place - low
        for k in range(size):
            at = some[n] * line_step + (low + k) * pixel_step
            light[k] = np.float64(lines.pixels[at])
            if lines.dark.size > 0:
                light[k] -= lines.dark[at]
        floor = -1e30
        for way in range(2):
            blocks = (p if way == 0 else size - 1 - p) // FLAT
            for k in range(blocks):
                first = p - (k + 1) * FLAT if way == 0 else p + 1 + k * FLAT
                mean[k] = light[first : first + FLAT].mean()
            if blocks > 0:
                floor = max(floor, np.sort(mean[:blocks])[blocks // 4])
        total[0] = 0.0
        for k in range(size):
            total[k + 1] = total[k] + light[k] - floor
        best, half[n], h = 0.0, 1.5, 1
        while h <= REACH // 2:
            for c in range(max(h, p - h), min(size - 1 - h, p + h) + 1):
                poorer = min(total[c] - total[c - h], total[c + 1 + h] - total[c + 1])
                score = (2.0 * poorer + light[c] - floor) / math.sqrt(2.0 * h + 1.0)
                if score > best:
                    best, half[n] = score, h + 0.5
            h = max(h + 1, h * 5 // 4)


def binned(lines: Lines, size: int) -> Binned:
    """Take ``size`` px of each line together; what is left over at its end is left out.

    New pixels are sums, or means where 16 bits do not hold the sums; one that holds a clipped pixel is marked as such.
    """
    count, length = lines.layout[:2]
    top = max(int(lines.pixels.max()), int(lines.dark.max()) if lines.dark.size else 0)
    unit = float(size) if top * size <= 65535 else 1.0
    shape = (count, length // size)
    pixels = np.empty(shape, np.uint16)
    dark = np.empty(shape if lines.dark.size else (0, 0), np.uint16)
    clipped = np.empty(shape if top >= lines.saturation else (0, 0), np.bool_)
    _add_up(lines, size, unit / size, pixels, dark, clipped)
    saturation = unit * lines.saturation
    layout = (count, shape[1], shape[1], 1)
    return Binned(Lines(pixels.ravel(), dark.ravel(), layout, saturation, clipped.ravel()), size, unit)


@compiled
def _add_up(
    lines: Lines, size: int, share: float, pixels: NDArray[np.uint16], dark: NDArray[np.uint16],
    clipped: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Sums of ``size`` px, times ``share``; lines run side by side, since they may lie so in memory."""
    count, _, line_step, pixel_step = lines.layout
    total, off = np.empty(count), np.empty(count)
    full = np.empty(count, np.bool_)
    for b in range(pixels.shape[1]):
        total[:] = 0.5  # rounded
        off[:] = 0.5
        full[:] = False
        for k in range(size):
            start = (b * size + k) * pixel_step
            for i in range(count):
                total[i] += share * np.float64(lines.pixels[start + i * line_step])
            if dark.size > 0:
                for i in range(count):
                    off[i] += share * np.float64(lines.dark[start + i * line_step])
            if clipped.size > 0:
                for i in range(count):
                    full[i] = full[i] or is_clipped(lines, start + i * line_step)
        for i in range(count):
            pixels[i, b] = np.uint16(total[i])
            if dark.size > 0:
                dark[i, b] = np.uint16(off[i])
            if clipped.size > 0:
                clipped[i, b] = full[i]
