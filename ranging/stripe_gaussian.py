"""Maximum likelihood of a Gaussian stripe on each line: position, width, peak and background, shot and read noise.

A pixel of the stripe has the mean m = b + A g, g = exp(-(x - p)^2 / 2 s^2), and the variance of photon transfer,
v = A g / gain + read^2 + 1/12. Fisher scoring (iterated, Gaussian-weighted least squares) solves for p and for (A, s, b);
on a symmetric profile the two are orthogonal. A pixel integrates the profile over its width, which adds 1/12 to s^2 and
moves nothing. A clipped pixel tells only that it lies above the clipping level: it enters with the score and the
curvature of the normal tail (censored likelihood: Tobin, Econometrica 26, 1958).

Sixteen lines are solved side by side, one in each lane of the vector unit, so that a loop over the pixels of the window
serves all of them; a lane whose window is shorter masks the rest.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array
from ranging.kernels import Pixels, compiled, light

Single: TypeAlias = Any  # a float32 of the machine
Lanes: TypeAlias = NDArray[np.float32]

BATCH = 16  # lines
NEAR = 8  # px; half window in which the flanks of most stripes are found
FAR = 24  # px; the longest half window
LONGEST = 2 * FAR + 1
MASKED = 1e-6  # least weight of a clipped pixel

# Rows of the table of results.
POSITION, SIGMA, WIDTH, PEAK, FLOOR, ASYMMETRY, MISFIT, CLIPPED, STATE = range(9)
ROWS = 9
# States of a line.
GOOD, NO_PEAK, NO_FLANK, CUT, DIVERGED = range(5)


@compiled
def fit_lines(
    lines: Pixels,
    dark: Pixels,
    has_dark: bool,
    place: NDArray[np.int32],
    gain_e: float,
    variance: float,
    saturation: float,
    table: Array,
) -> None:
    """Fit every line that has a place (>= 0).

    ``lines`` and ``dark`` are (N, length) of any layout, ``place`` (N,) px, ``variance`` the noise of a dark pixel in
    grey levels squared; ``table`` (ROWS, N) receives the answers, NaN where the state is not GOOD.
    """
    count, length = lines.shape
    y = np.zeros((LONGEST, BATCH), np.float32)
    known = np.zeros((LONGEST, BATCH), np.float32)
    p = np.zeros(BATCH, np.float32)
    s = np.zeros(BATCH, np.float32)
    a = np.zeros(BATCH, np.float32)
    b = np.zeros(BATCH, np.float32)
    f = np.zeros((10, BATCH), np.float32)
    moved = np.zeros(BATCH, np.float32)
    begin = np.zeros(BATCH, np.int64)
    size = np.zeros(BATCH, np.int64)
    state = np.zeros(BATCH, np.int64)
    clipped = np.zeros(BATCH, np.int64)
    inverse_gain = np.float32(1.0 / gain_e)
    noise = np.float32(variance)
    for start in range(0, count, BATCH):
        # 1. Windows and first values.
        longest = 0
        any_clipped = False
        for m in range(BATCH):
            p[m], s[m], a[m], b[m] = 4.0, 1.5, 1.0, 0.0
            state[m], size[m], clipped[m] = NO_PEAK, 0, 0
            i = start + m
            if i >= count or place[i] < 0:
                continue
            middle, width, top, floor, state[m] = _flanks(lines, dark, has_dark, i, place[i], length)
            if state[m] != GOOD:
                continue
            centre = int(middle + 0.5)
            wing = min(FAR, max(4, int(math.ceil(3.5 * width)) + 1))
            first, last = max(0, centre - wing), min(length - 1, centre + wing)
            if middle - first < 1.5 * width or last - middle < 1.5 * width:
                state[m] = CUT
                continue
            begin[m], size[m] = first, last - first + 1
            p[m], s[m], a[m], b[m] = middle - first, width, top - floor, floor
            longest = max(longest, size[m])
            for j in range(first, last + 1):
                if lines[i, j] >= saturation:
                    clipped[m] += 1
                    any_clipped = True
        for k in range(longest):
            for m in range(BATCH):
                y[k, m] = 0.0
                known[k, m] = 0.0
        for m in range(BATCH):
            i, first = start + m, begin[m]
            for k in range(size[m]):
                y[k, m] = light(lines, dark, has_dark, i, first + k)
                known[k, m] = 1.0
        # 2. Fisher scoring.
        for _ in range(10 if any_clipped else 5):
            if any_clipped:
                for m in range(BATCH):
                    if clipped[m]:
                        _impute(
                            lines, dark, has_dark, start + m, begin[m], size[m], saturation,
                            p[m], s[m], a[m], b[m], inverse_gain, noise, y, known, m,
                        )  # fmt: skip
            for t in range(10):
                for m in range(BATCH):
                    f[t, m] = 0.0
            for k in range(longest):
                for m in range(BATCH):
                    u = (np.float32(k) - p[m]) / s[m]
                    uu = min(u * u, np.float32(28.0))
                    g = bell(uu)
                    q = g * uu
                    w = known[k, m] / (noise + a[m] * inverse_gain * g)
                    wr = w * (y[k, m] - b[m] - a[m] * g)
                    f[0, m] += w * g * g
                    f[1, m] += w * g * q
                    f[2, m] += w * g
                    f[3, m] += w * q * q
                    f[4, m] += w * q
                    f[5, m] += w
                    f[6, m] += wr * g * u
                    f[7, m] += wr * g
                    f[8, m] += wr * q
                    f[9, m] += wr
            for m in range(BATCH):
                # Amplitude, width (as A ds / s) and background: Cramer's rule on the symmetric 3 x 3.
                c11 = f[3, m] * f[5, m] - f[4, m] * f[4, m]
                c12 = f[2, m] * f[4, m] - f[1, m] * f[5, m]
                c13 = f[1, m] * f[4, m] - f[2, m] * f[3, m]
                c22 = f[0, m] * f[5, m] - f[2, m] * f[2, m]
                c23 = f[1, m] * f[2, m] - f[0, m] * f[4, m]
                c33 = f[0, m] * f[3, m] - f[1, m] * f[1, m]
                scale = np.float32(1.0) / (f[0, m] * c11 + f[1, m] * c12 + f[2, m] * c13)
                da = (c11 * f[7, m] + c12 * f[8, m] + c13 * f[9, m]) * scale
                dw = (c12 * f[7, m] + c22 * f[8, m] + c23 * f[9, m]) * scale / a[m]
                db = (c13 * f[7, m] + c23 * f[8, m] + c33 * f[9, m]) * scale
                dp = f[6, m] / (a[m] * f[1, m])  # in units of s
                dp = min(max(dp, np.float32(-1.0)), np.float32(1.0))
                dw = min(max(dw, np.float32(-0.4)), np.float32(0.4))
                moved[m] = abs(dp) if known[0, m] > 0.0 else np.float32(0.0)
                p[m] += s[m] * dp
                s[m] = min(max(s[m] * (np.float32(1.0) + dw), np.float32(0.3)), np.float32(FAR))
                a[m] = max(a[m] + da, np.float32(0.2) * a[m])
                b[m] += db
            most = np.float32(0.0)
            for m in range(BATCH):
                most = max(most, moved[m])
            if most < 0.004:
                break
        # 3. What is left over: Fisher information of p, third Hermite term, chi squared.
        for t in range(5):
            for m in range(BATCH):
                f[t, m] = 0.0
        for k in range(longest):
            for m in range(BATCH):
                u = (np.float32(k) - p[m]) / s[m]
                uu = min(u * u, np.float32(28.0))
                g = bell(uu)
                w = known[k, m] / (noise + a[m] * inverse_gain * g)
                r = y[k, m] - b[m] - a[m] * g
                q = w * g * g * uu
                f[0, m] += q
                f[1, m] += q * uu
                f[2, m] += q * uu * uu
                f[3, m] += w * g * u * uu * r
                f[4, m] += w * r * r
        for m in range(BATCH):
            i = start + m
            if i >= count:
                continue
            for t in range(ROWS):
                table[t, i] = np.nan
            table[STATE, i] = state[m]
            if state[m] != GOOD:
                continue
            if not (p[m] > 0.5 and p[m] < size[m] - 1.5 and f[0, m] > 0.0):
                table[STATE, i] = DIVERGED
                continue
            table[POSITION, i] = begin[m] + p[m]
            table[SIGMA, i] = s[m] / (a[m] * math.sqrt(f[0, m]))
            table[WIDTH, i] = s[m]
            table[PEAK, i] = a[m]
            table[FLOOR, i] = b[m]
            table[ASYMMETRY, i] = f[3, m] / (a[m] * (f[2, m] - f[1, m] * f[1, m] / f[0, m]))
            table[MISFIT, i] = f[4, m] / max(1, size[m] - 4)
            table[CLIPPED, i] = clipped[m]


@compiled
def bell(uu: Single) -> Single:
    """exp(-uu / 2) for uu < 28: a polynomial of degree 4 in a sixteenth of it, squared four times; vectorises."""
    t = uu * np.float32(-1.0 / 32.0)
    e = np.float32(1.0) + t * (
        np.float32(1.0) + t * (np.float32(0.5) + t * (np.float32(1.0 / 6.0) + t * np.float32(1.0 / 24.0)))
    )
    e *= e
    e *= e
    e *= e
    return e * e


@compiled
def _flanks(lines: Pixels, dark: Pixels, has_dark: bool, i: int, at: int, length: int) -> tuple[Any, ...]:
    """Middle, width, top and floor from the half-maximum crossings about the highest pixel, and a state."""
    top = light(lines, dark, has_dark, i, at)
    reach = NEAR
    while True:
        first, last = max(0, at - reach), min(length - 1, at + reach)
        low_left, low_right = top, top
        for j in range(first, at):
            low_left = min(low_left, light(lines, dark, has_dark, i, j))
        for j in range(at + 1, last + 1):
            low_right = min(low_right, light(lines, dark, has_dark, i, j))
        floor = np.float32(0.5) * (low_left + low_right)
        half = np.float32(0.5) * (top + floor)
        left, here, before = at, top, top
        while left > first and here > half:
            left -= 1
            before, here = here, light(lines, dark, has_dark, i, left)
        left_found = here <= half
        cross_left = left + (half - here) / max(before - here, np.float32(1e-3))
        right, here, before = at, top, top
        while right < last and here > half:
            right += 1
            before, here = here, light(lines, dark, has_dark, i, right)
        right_found = here <= half
        cross_right = right - (half - here) / max(before - here, np.float32(1e-3))
        width = (cross_right - cross_left) / np.float32(2.3548)
        if (left_found and right_found and width < 0.27 * reach) or reach == FAR:
            break
        reach = FAR
    state = GOOD
    if not left_found:
        state = CUT if first == 0 else NO_FLANK
    elif not right_found:
        state = CUT if last == length - 1 else NO_FLANK
    middle = np.float32(0.5) * (cross_left + cross_right)
    return middle, max(width, np.float32(0.5)), top, floor, state


@compiled
def _impute(
    lines: Pixels, dark: Pixels, has_dark: bool, i: int, first: int, n: int, saturation: float,
    p: Single, s: Single, a: Single, b: Single, inverse_gain: Single, noise: Single, y: Lanes, known: Lanes, m: int,
) -> None:  # fmt: skip
    """Give clipped pixels the value and the weight with which least squares has the censored score and curvature."""
    for k in range(n):
        if lines[i, first + k] < saturation:
            continue
        u = (k - p) / s
        g = math.exp(-0.5 * u * u)
        deviation = math.sqrt(noise + a * inverse_gain * g)
        level = saturation - 0.5
        if has_dark:
            level -= dark[i, first + k]
        z = (level - b - a * g) / deviation
        if z > 6.0:
            hazard = z + 1.0 / z
        else:
            hazard = math.exp(-0.5 * z * z) * 0.7978845608028654 / max(math.erfc(z * 0.7071067811865476), 1e-30)
        weight = min(max(hazard * (hazard - z), MASKED), 1.0)
        known[k, m] = weight
        y[k, m] = b + a * g + min(hazard * deviation / weight, 4.0 * deviation)
