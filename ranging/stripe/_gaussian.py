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
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import compiled
from calibration.geometry import Array
from ranging.stripe._table import (
    ASYMMETRY,
    ASYMMETRY_SIGMA,
    CLIPPED,
    CUT,
    DIVERGED,
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
    CameraNoise,
    Lines,
    is_clipped,
)

Single: TypeAlias = Any  # a float32 of the machine
Lanes: TypeAlias = NDArray[np.float32]

BATCH = 16  # lines
NEAR = 6  # px; half window in which the flanks of most stripes are found
FAR = 24  # px; the longest half window
WINGS = 3.0  # sigma; half window of the fit, before it is rounded up
LONGEST = 2 * FAR + 1
MASKED = 1e-6  # least weight of a clipped pixel


class _Window(NamedTuple):
    """Pixels of sixteen lines, side by side."""

    y: Lanes  # (LONGEST, BATCH) grey levels, the laser-off image subtracted
    known: Lanes  # (LONGEST, BATCH) weight: 1 where there is a pixel
    clipped: NDArray[np.int64]  # (BATCH,) pixels
    low: Lanes  # (BATCH,) first place of the window within the image
    high: Lanes  # (BATCH,) last


@compiled
def fit_lines(lines: Lines, place: NDArray[np.int32], camera: CameraNoise, table: Array) -> None:
    """Fit every line that has a place (>= 0), ``place`` (N,) px.

    ``table`` (ROWS, N) receives the answers. Where the state is not GOOD they are NaN, but for the peak and floor of what
    was seen. Longer than a screen, since its three steps share the buffers of sixteen lines and every value in them.
    """
    count, length = lines.layout[0], lines.layout[1]
    y = np.zeros((LONGEST, BATCH), np.float32)
    known = np.zeros((LONGEST, BATCH), np.float32)
    p = np.zeros(BATCH, np.float32)
    s = np.zeros(BATCH, np.float32)
    a = np.zeros(BATCH, np.float32)
    b = np.zeros(BATCH, np.float32)
    f = np.zeros((10, BATCH), np.float32)
    moved = np.zeros(BATCH, np.float32)
    low_left = np.zeros(BATCH, np.float32)
    low_right = np.zeros(BATCH, np.float32)
    half = np.zeros(BATCH, np.float32)
    centre = np.zeros(BATCH, np.float32)
    state = np.zeros(BATCH, np.int64)
    clipped = np.zeros(BATCH, np.int64)
    window = _Window(y, known, clipped, half, centre)
    inverse_gain = np.float32(1.0 / camera.gain_e)
    noise = np.float32(camera.variance)
    reach, wing = NEAR, NEAR
    for start in range(0, count, BATCH):
        # 1. Windows and first values, from what stands above half of the peak; lines near by are as wide as the last.
        reach = min(reach, max(NEAR, wing + 1))
        while True:
            _gather(lines, place, start, reach, window)
            for m in range(BATCH):
                low_left[m] = 1e9
                low_right[m] = 1e9
                a[m] = y[reach, m]
            for k in range(reach):
                for m in range(BATCH):
                    low_left[m] = min(low_left[m], y[k, m] + np.float32(1e9) * (np.float32(1.0) - known[k, m]))
            for k in range(reach + 1, 2 * reach + 1):
                for m in range(BATCH):
                    low_right[m] = min(low_right[m], y[k, m] + np.float32(1e9) * (np.float32(1.0) - known[k, m]))
            for m in range(BATCH):
                left, right = min(low_left[m], np.float32(1e8)), min(low_right[m], np.float32(1e8))
                left, right = (left if left < 1e8 else right), (right if right < 1e8 else left)
                b[m] = np.float32(0.5) * (left + right)
                a[m] = max(a[m] - b[m], np.float32(1e-3))
                p[m] = 0.0
                s[m] = 0.0
            for k in range(2 * reach + 1):
                for m in range(BATCH):
                    above = known[k, m] * max(y[k, m] - b[m] - np.float32(0.5) * a[m], np.float32(0.0))
                    p[m] += np.float32(k) * above
                    s[m] += above
            wing = 4
            for m in range(BATCH):
                i = start + m
                p[m] = p[m] / max(s[m], np.float32(1e-6))
                s[m] = max(s[m] / (np.float32(0.7302) * a[m]), np.float32(0.5))
                state[m] = GOOD
                if i >= count or place[i] < 0 or known[reach, m] == 0.0:
                    state[m] = NO_PEAK
                else:
                    middle = place[i] - reach + p[m]
                    if middle < 1.5 * s[m] or middle > length - 1 - 1.5 * s[m]:
                        state[m] = CUT
                    elif s[m] > 0.27 * FAR:
                        state[m] = NO_FLANK
                if state[m] == GOOD:
                    wing = max(wing, int(WINGS * s[m]) + 2)
            wing = min(wing, FAR)
            if wing <= reach:
                break
            reach = wing
        any_clipped = False
        for m in range(BATCH):
            if state[m] != GOOD:  # a lane that does nothing
                clipped[m] = 0
                p[m], s[m] = reach, 1.5
            any_clipped = any_clipped or clipped[m] > 0
            half[m] = np.float32(int(WINGS * s[m]) + 2)
            centre[m] = np.float32(int(p[m] + 0.5))
        for k in range(2 * reach + 1):
            for m in range(BATCH):
                inside = abs(np.float32(k) - centre[m]) <= half[m]
                known[k, m] = known[k, m] if inside else np.float32(0.0)
        begin, end = reach - wing, reach + wing + 1
        # 2. Fisher scoring.
        for _ in range(25 if any_clipped else 5):
            if any_clipped:
                for m in range(BATCH):
                    if clipped[m]:
                        offset = place[start + m] - reach
                        _impute(
                            lines, window, m, (start + m, offset), (begin, end), (p[m], s[m], a[m], b[m]),
                            (inverse_gain, noise),
                        )  # fmt: skip
            for t in range(10):
                for m in range(BATCH):
                    f[t, m] = 0.0
            for k in range(begin, end):
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
                moved[m] = (
                    max(abs(dp), np.float32(0.2) * max(abs(dw), abs(da) / a[m]))
                    if state[m] == GOOD
                    else np.float32(0.0)
                )
                p[m] += s[m] * dp
                s[m] = min(max(s[m] * (np.float32(1.0) + dw), np.float32(0.3)), np.float32(FAR))
                a[m] = max(a[m] + da, np.float32(0.2) * a[m]) if state[m] == GOOD else a[m]
                b[m] = b[m] + db if state[m] == GOOD else b[m]
            most = np.float32(0.0)
            for m in range(BATCH):
                most = max(most, moved[m])
            if most < (0.004 if any_clipped else 0.008):  # of sigma: the next step would be its square
                break
        # 3. What is left over: Fisher information of p, third Hermite term, chi squared.
        for t in range(6):
            for m in range(BATCH):
                f[t, m] = 0.0
        for k in range(begin, end):
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
                f[5, m] += known[k, m]
        for m in range(BATCH):
            i = start + m
            if i >= count:
                continue
            for t in range(ROWS):
                table[t, i] = np.nan
            table[STATE, i] = state[m]
            table[PEAK, i] = a[m]
            table[FLOOR, i] = b[m]
            if state[m] != GOOD:
                continue
            if not (abs(p[m] - centre[m]) < half[m] and f[0, m] > 0.0):
                table[STATE, i] = DIVERGED
                continue
            table[POSITION, i] = place[i] - reach + p[m]
            table[SIGMA, i] = s[m] / (a[m] * math.sqrt(f[0, m]))
            table[WIDTH, i] = s[m]
            odd = f[2, m] - f[1, m] * f[1, m] / f[0, m]
            table[ASYMMETRY, i] = f[3, m] / (a[m] * odd)
            table[ASYMMETRY_SIGMA, i] = 1.0 / (a[m] * math.sqrt(odd))
            table[MISFIT, i] = f[4, m] / max(np.float32(1.0), f[5, m] - np.float32(4.0))
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
def _gather(lines: Lines, place: NDArray[np.int32], start: int, reach: int, window: _Window) -> None:
    """Pixels of sixteen lines within ``reach`` of their places; ``known`` is 0 where there are none."""
    pixels, dark, layout = lines.pixels, lines.dark, lines.layout
    y, known, clipped, low, high = window
    count, length, line_step, pixel_step = layout
    has_dark = dark.size > 0
    for m in range(BATCH):
        clipped[m] = 0
        low[m], high[m] = 1.0, 0.0
        i = start + m
        if i >= count or place[i] < 0:
            continue
        offset = place[i] - reach
        first, last = max(0, -offset), min(2 * reach + 1, length - offset)
        low[m], high[m] = first, last - 1
        at = i * line_step + offset * pixel_step
        if has_dark:
            for k in range(first, last):
                y[k, m] = np.float32(pixels[at + k * pixel_step]) - np.float32(dark[at + k * pixel_step])
        else:
            for k in range(first, last):
                y[k, m] = np.float32(pixels[at + k * pixel_step])
        if lines.clipped.size > 0 or pixels[at + reach * pixel_step] >= lines.saturation:
            for k in range(first, last):
                clipped[m] += 1 if is_clipped(lines, at + k * pixel_step) else 0
    for k in range(2 * reach + 1):
        for m in range(BATCH):
            inside = np.float32(k) >= low[m] and np.float32(k) <= high[m]
            known[k, m] = np.float32(1.0) if inside else np.float32(0.0)


@compiled
def _impute(
    lines: Lines,
    window: _Window,
    m: int,
    corner: tuple[int, int],
    span: tuple[int, int],
    profile: tuple[Single, Single, Single, Single],
    camera: tuple[Single, Single],
) -> None:
    """Give clipped pixels the value and the weight with which least squares has the censored score and curvature.

    Lane ``m`` holds the line and the first pixel of ``corner``; looked at are the places ``span`` of the window. ``profile``
    is position in the window, sigma, amplitude and floor; ``camera`` 1 / gain and the variance of a dark pixel.
    """
    pixels, dark, layout, _, _ = lines
    y, known = window.y, window.known
    (i, offset), (begin, end), (p, s, a, b), (inverse_gain, noise) = corner, span, profile, camera
    for k in range(begin, end):
        at = i * layout[2] + (offset + k) * layout[3]
        if known[k, m] == 0.0 or not is_clipped(lines, at):
            continue
        u = (k - p) / s
        g = math.exp(-0.5 * u * u)
        deviation = math.sqrt(noise + a * inverse_gain * g)
        level = min(np.float64(pixels[at]), lines.saturation) - 0.5
        if dark.size > 0:
            level -= dark[at]
        z = (level - b - a * g) / deviation
        if z > 6.0:
            hazard = z + 1.0 / z
        else:
            hazard = math.exp(-0.5 * z * z) * 0.7978845608028654 / max(math.erfc(z * 0.7071067811865476), 1e-30)
        weight = min(max(hazard * (hazard - z), MASKED), 1.0)
        known[k, m] = weight
        y[k, m] = b + a * g + min(hazard * deviation / weight, 4.0 * deviation)
