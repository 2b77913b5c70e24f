"""How a stripe runs along the lines of a frame: tilt, bow, and how its light grows."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, Bools

REACH = 4  # lines to either side
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
    told = np.zeros(position.shape, dtype=bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        log_light = np.log(light)
        bent = np.abs(position[:, 2:] - 2.0 * position[:, 1:-1] + position[:, :-2])
        smooth = np.zeros(position.shape, dtype=bool)
        smooth[:, 1:-1] = bent < STRAIGHT
    smooth &= np.isfinite(log_light)
    lines = position.shape[1]
    for reach in (2, REACH):
        if lines < 2 * reach + 1:
            continue
        x = np.arange(-reach, reach + 1, dtype=np.float64)
        slope = x / np.sum(x * x)
        curve = x * x - np.mean(x * x)
        curve = 2.0 * curve / np.sum(curve * curve)
        inner = slice(reach, lines - reach)
        whole = np.ones((len(position), lines - 2 * reach), dtype=bool)
        sums = np.zeros((3, *whole.shape))
        middle = position[:, inner]
        level = log_light[:, inner]
        for k in range(2 * reach + 1):
            at = slice(k, lines - 2 * reach + k)
            if 0 < k < 2 * reach:
                whole &= smooth[:, at]
            else:
                whole &= np.isfinite(log_light[:, at])
            moved = position[:, at] - middle
            sums[0] += slope[k] * moved
            sums[1] += curve[k] * moved
            sums[2] += slope[k] * (log_light[:, at] - level)
        found[:, inner][whole] = np.moveaxis(sums, 0, -1)[whole]
        told[:, inner] |= whole
    _prolong(found, told, position)
    return found


def _prolong(found: Array, told: Bools, position: Array) -> None:
    """Let a course go on to its ends, two lines at most, as it came: tilt and growth change by the bow."""
    for _ in range(2):
        fresh = told.copy()
        for sign, here, beside in ((-1.0, slice(None, -1), slice(1, None)), (1.0, slice(1, None), slice(None, -1))):
            tilt, bow, growth = (found[:, beside, k] for k in range(3))
            with np.errstate(invalid="ignore"):
                step = sign * (position[:, here] - position[:, beside])
                goes_on = ~told[:, here] & told[:, beside] & (np.abs(step - tilt) < STRAIGHT + np.abs(bow))
            found[:, here][goes_on] = np.stack([tilt + sign * bow, bow, growth], axis=-1)[goes_on]
            fresh[:, here] |= goes_on
        told[:] = fresh
