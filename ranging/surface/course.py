"""How a stripe runs along the lines of a frame: tilt, bow, and how its light grows."""

from __future__ import annotations

import math

import numpy as np

from calibration.compiled import compiled
from calibration.geometry import Array

REACH = 4  # lines to either side
NEAR = 2  # the same beside a gap or jump
STRAIGHT = 0.5  # px; a larger second difference is a jump


def follow(position: Array, light: Array) -> Array:
    """First and second derivative of the stripe's course, and first of the logarithm of its light, along the lines.

    Parameters
    ----------
    position : (F, L) array, px across the stripe
    light : (F, L) array
        Peak times width, or anything in proportion to the light on the line.

    Returns
    -------
    (F, L, 3) array
        px/line, px/line^2, 1/line: least squares over nine lines, over five beside a gap or jump; the last two lines
        before one go on as the course came, and are zero where there is none.
    """
    found = np.zeros((*position.shape, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        _follow(position, np.log(light), found)
    return found


@compiled
def _follow(position: Array, light: Array, found: Array) -> None:
    frames, lines = position.shape
    straight = np.empty(lines, np.bool_)
    told = np.empty(lines, np.int8)
    for f in range(frames):
        p, g = position[f], light[f]
        for i in range(lines):
            told[i] = 0
            straight[i] = False
            if 0 < i < lines - 1 and math.isfinite(g[i]):
                straight[i] = abs(p[i + 1] - 2.0 * p[i] + p[i - 1]) < STRAIGHT
        for reach in (NEAR, REACH):
            n = 2 * reach + 1
            square = reach * (reach + 1) * n / 3.0
            mean = square / n
            fourth = square * (3.0 * reach * (reach + 1) - 1.0) / 5.0 - n * mean * mean  # of x^2 about its mean
            for i in range(reach, lines - reach):
                whole = math.isfinite(g[i - reach]) and math.isfinite(g[i + reach])
                for k in range(i - reach + 1, i + reach):
                    whole = whole and straight[k]
                if not whole:
                    continue
                tilt = bow = growth = 0.0
                for x in range(-reach, reach + 1):
                    step = p[i + x] - p[i]
                    tilt += x * step
                    bow += (x * x - mean) * step
                    growth += x * (g[i + x] - g[i])
                found[f, i, 0], found[f, i, 1], found[f, i, 2] = tilt / square, 2.0 * bow / fourth, growth / square
                told[i] = 1
        for lap in (1, 2):  # tilt changes by the bow
            for i in range(lines):
                if told[i] or not math.isfinite(p[i]):
                    continue
                for way in (-1, 1):
                    j = i - way
                    if not 0 <= j < lines or told[j] == 0 or told[j] > lap or told[i]:
                        continue
                    tilt, bow = found[f, j, 0], found[f, j, 1]
                    if abs(way * (p[i] - p[j]) - tilt) < STRAIGHT + abs(bow):
                        found[f, i, 0], found[f, i, 1], found[f, i, 2] = tilt + way * bow, bow, found[f, j, 2]
                        told[i] = lap + 1
