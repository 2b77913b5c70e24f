"""Maximum likelihood of a Gaussian stripe on each line: position, width, peak and background, shot and read noise.

A pixel of the stripe has the mean m = b + A exp(-(x - p)^2 / 2 s^2) and the variance of photon transfer,
v = A g / gain + read^2. Fisher scoring (iterated, Gaussian-weighted least squares) solves for p and for (A, s, b), which
are nearly orthogonal. A clipped pixel tells only that it is above the clipping level: it enters with the score and the
curvature of the normal tail (a censored likelihood, Tobin 1958). Integration over a pixel adds 1/12 to s^2 and moves
nothing.
"""

from __future__ import annotations

import math

import numpy as np

from calibration.geometry import Array
from ranging.kernels import Pixels, compiled

HALF = 24  # px; the longest half window
LANES = 2 * HALF + 16  # a multiple of the vector width that holds the longest window
MASKED = 1e-6  # weight of a pixel that tells nothing

# Columns of the table of results.
POSITION, SIGMA, WIDTH, PEAK, FLOOR, ASYMMETRY, MISFIT, CLIPPED, STATE = range(9)
COLUMNS = 9
# States.
GOOD, NO_FLANK, CUT, DIVERGED = range(4)


@compiled
def fit_lines(
    lines: Pixels,
    dark: Pixels,
    has_dark: bool,
    place: Pixels,
    gain_e: float,
    variance: float,
    saturation: float,
    narrowest: float,
    widest: float,
    out: Array,
) -> None:
    """Fit every line that has a place (>= 0); ``lines`` is (N, length), ``out`` (N, COLUMNS)."""
    count, length = lines.shape
    y = np.zeros(LANES, np.float32)
    known = np.zeros(LANES, np.float32)
    for i in range(count):
        for c in range(COLUMNS):
            out[i, c] = np.nan
        if place[i] < 0:
            continue
        _fit(
            lines[i], dark[i] if has_dark else lines[i], has_dark, place[i], length,
            gain_e, variance, saturation, narrowest, widest, y, known, out[i],
        )  # fmt: skip


@compiled
def _value(line: Pixels, off: Pixels, has_dark: bool, j: int) -> float:
    value = np.float32(line[j])
    if has_dark:
        value -= np.float32(off[j])
    return value


@compiled
def _fit(
    line: Pixels, off: Pixels, has_dark: bool, at: int, length: int,
    gain_e: float, variance: float, saturation: float, narrowest: float, widest: float,
    y: Array, known: Array, out: Array,
) -> None:  # fmt: skip
    # 1. Half-maximum crossings give a first position and width.
    top = _value(line, off, has_dark, at)
    reach = min(HALF, int(math.ceil(4.0 * widest)))
    first, last = max(0, at - reach), min(length - 1, at + reach)
    low_left, low_right = top, top
    for j in range(first, at):
        low_left = min(low_left, _value(line, off, has_dark, j))
    for j in range(at + 1, last + 1):
        low_right = min(low_right, _value(line, off, has_dark, j))
    floor = np.float32(0.5) * (low_left + low_right)
    half = np.float32(0.5) * (top + floor)
    left = at
    before = top
    here = top
    while left > first and here > half:
        left -= 1
        before, here = here, _value(line, off, has_dark, left)
    if here > half:
        out[STATE] = CUT if first == 0 else NO_FLANK
        return
    cross_left = left + (half - here) / max(before - here, np.float32(1e-3))
    right = at
    before = top
    here = top
    while right < last and here > half:
        right += 1
        before, here = here, _value(line, off, has_dark, right)
    if here > half:
        out[STATE] = CUT if last == length - 1 else NO_FLANK
        return
    cross_right = right - (half - here) / max(before - here, np.float32(1e-3))
    s = np.float32(min(max((cross_right - cross_left) / 2.3548, 0.6), widest))
    middle = 0.5 * (cross_left + cross_right)
    # 2. The window: three and a half sigma, no more than the image has.
    centre = int(middle + 0.5)
    wing = min(HALF, max(4, int(math.ceil(3.5 * s)) + 1))
    first, last = max(0, centre - wing), min(length - 1, centre + wing)
    if middle - first < 1.0 * s or last - middle < 1.0 * s:
        out[STATE] = CUT
        return
    n = last - first + 1
    lanes = min(LANES, (n + 15) // 16 * 16)
    clipped = 0
    for k in range(lanes):
        known[k] = 0.0
        y[k] = 0.0
    for k in range(n):
        y[k] = _value(line, off, has_dark, first + k)
        known[k] = 1.0
    for k in range(n):
        if line[first + k] >= saturation:
            clipped += 1
    # 3. Fisher scoring.
    p = np.float32(middle - first)
    a = np.float32(top - floor)
    b = floor
    inverse_gain = np.float32(1.0 / gain_e)
    noise = np.float32(variance)
    for iteration in range(8 if clipped else 4):
        if clipped:
            _impute(line, off, has_dark, first, n, saturation, p, s, a, b, inverse_gain, noise, y, known)
        inverse = np.float32(1.0) / s
        f11 = np.float32(0.0)
        f12 = np.float32(0.0)
        f13 = np.float32(0.0)
        f22 = np.float32(0.0)
        f23 = np.float32(0.0)
        f33 = np.float32(0.0)
        t0 = np.float32(0.0)
        t1 = np.float32(0.0)
        t2 = np.float32(0.0)
        t3 = np.float32(0.0)
        for k in range(lanes):
            u = (np.float32(k) - p) * inverse
            uu = min(u * u, np.float32(28.0))
            g = _bell(uu)
            w = known[k] / (noise + a * inverse_gain * g)
            r = y[k] - b - a * g
            q = g * uu
            f11 += w * g * g
            f12 += w * g * q
            f13 += w * g
            f22 += w * q * q
            f23 += w * q
            f33 += w
            t0 += w * g * u * r
            t1 += w * g * r
            t2 += w * q * r
            t3 += w * r
        p += s / a * t0 / f12
        # Amplitude, width (as A ds / s) and background: Cramer's rule on the symmetric 3 x 3.
        c11 = f22 * f33 - f23 * f23
        c12 = f13 * f23 - f12 * f33
        c13 = f12 * f23 - f13 * f22
        determinant = f11 * c11 + f12 * c12 + f13 * c13
        if not determinant > 0.0:
            out[STATE] = DIVERGED
            return
        c22 = f11 * f33 - f13 * f13
        c23 = f12 * f13 - f11 * f23
        c33 = f11 * f22 - f12 * f12
        da = (c11 * t1 + c12 * t2 + c13 * t3) / determinant
        dw = (c12 * t1 + c22 * t2 + c23 * t3) / determinant
        db = (c13 * t1 + c23 * t2 + c33 * t3) / determinant
        ratio = min(max(dw / a, np.float32(-0.4)), np.float32(0.4))
        s = min(max(s * (np.float32(1.0) + ratio), np.float32(0.35)), np.float32(HALF))
        a = max(a + da, np.float32(0.2) * a)
        b += db
        if not (p > 0.0 and p < n - 1):
            out[STATE] = DIVERGED
            return
    # 4. What is left over: asymmetry (third Hermite term) and misfit.
    inverse = np.float32(1.0) / s
    f2 = np.float32(0.0)
    f4 = np.float32(0.0)
    f6 = np.float32(0.0)
    t3 = np.float32(0.0)
    chi = np.float32(0.0)
    for k in range(lanes):
        u = (np.float32(k) - p) * inverse
        uu = min(u * u, np.float32(28.0))
        g = _bell(uu)
        w = known[k] / (noise + a * inverse_gain * g)
        r = y[k] - b - a * g
        f2 += w * g * g * uu
        f4 += w * g * g * uu * uu
        f6 += w * g * g * uu * uu * uu
        t3 += w * g * u * uu * r
        chi += w * r * r
    skew = f6 - f4 * f4 / f2
    out[POSITION] = first + p
    out[SIGMA] = s / (a * math.sqrt(f2))
    out[WIDTH] = s
    out[PEAK] = a
    out[FLOOR] = b
    out[ASYMMETRY] = t3 / (a * skew)
    out[MISFIT] = chi / max(1, n - 4)
    out[CLIPPED] = clipped
    out[STATE] = GOOD


@compiled
def _bell(uu: float) -> float:
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
def _impute(
    line: Pixels, off: Pixels, has_dark: bool, first: int, n: int, saturation: float,
    p: float, s: float, a: float, b: float, inverse_gain: float, noise: float, y: Array, known: Array,
) -> None:  # fmt: skip
    """Give clipped pixels the value and the weight with which least squares has the censored score and curvature."""
    for k in range(n):
        if line[first + k] < saturation:
            continue
        u = (k - p) / s
        g = math.exp(-0.5 * u * u)
        deviation = math.sqrt(noise + a * inverse_gain * g)
        level = np.float32(saturation) - 0.5
        if has_dark:
            level -= np.float32(off[first + k])
        z = (level - b - a * g) / deviation
        if z > 6.0:
            hazard = z + 1.0 / z
        else:
            hazard = math.exp(-0.5 * z * z) * 0.7978845608028654 / max(math.erfc(z * 0.7071067811865476), 1e-30)
        weight = min(max(hazard * (hazard - z), MASKED), 1.0)
        known[k] = weight
        y[k] = b + a * g + min(hazard * deviation / weight, 4.0 * deviation)
