"""Speckle: multiplicative noise, correlated from pixel to pixel, recognised and weighed.

Coherent light on a rough surface, and texture of the surface itself, multiply the stripe by a random field of mean 1,
contrast C and correlation rho(d) = exp(-(d / grain)^2) (Goodman, Speckle Phenomena in Optics, 2007, chapters 2 and 4;
Dorsch, Hausler & Herrmann, Appl. Opt. 33, 1306, 1994, for its effect on the centroid). The weight that is best against
shot noise is then worse than a plain centre of mass. Here the covariance of a line's pixels is

    S_ij = delta_ij (read^2 + 1/12 + m_i / gain) + C^2 m_i m_j rho(i - j),    m = A exp(-(x - p)^2 / 2 s^2),

and the parameters of the line follow from generalised least squares under it (quasi-likelihood: Wedderburn, Biometrika
61, 439, 1974). C, grain, gain and read noise themselves are read from how the pixels of neighbouring lines differ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import compiled
from calibration.geometry import Array
from ranging.background import Noise
from ranging.stripe._gaussian import FAR, LONGEST
from ranging.stripe._table import (
    FLOOR,
    GOOD,
    NO_FLANK,
    PEAK,
    POSITION,
    SIGMA,
    STATE,
    WIDTH,
    CameraNoise,
    Lines,
    is_clipped,
)

GRAINS = (0.3, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6)  # px, trial values of the correlation length
LAGS = 5  # px, farthest products of residuals that are looked at
REACH = 9  # px, half window of the analysis
STEP = 4.0  # px from line to line, beyond which a stripe does not go on
UNLIKE = 20.0  # times the squared residuals of the lines about it: beyond, chance has no part in one line of 400
HOLD = 25.0  # 1 / 0.2^2: of its logarithm, how far the width of a speckled line may be from that of the lines about it
FAINTEST = 20.0  # times fewer electrons than usual at which a camera may clip
DEEPEST, QUIETEST = 5.0, 3.0  # times more electrons, and less read noise, than usual
FLANKS = 0.003  # of the squared slope of a stripe that must be left of it where it is clipped
HIDDEN = 4.0  # times the level of clipping, beyond which a speckled peak is anyone's guess
ABSURD = 16.0  # times the level of clipping, which no fit may exceed
LEAST_LINES = 40  # lines, fewer tell nothing about the noise


@dataclass(frozen=True, slots=True)
class Speckle:
    """Multiplicative noise of a stripe."""

    contrast: float  # standard deviation over mean, after integration over a pixel
    grain: float  # px, 1/e length of the correlation across the stripe


class Grains(NamedTuple):
    """What a fit under the covariance of speckle must know besides the contrast."""

    grain: float  # px
    hold: float  # weight with which the logarithm of the width is held; 0: not at all


@compiled
def refit_lines(
    lines: Lines, camera: CameraNoise, contrast: Array, speckle: Grains, usual_width: Array, table: Array
) -> None:
    """Fit the lines that are GOOD in ``table`` and have a ``contrast`` (N,) again, under the covariance of speckle.

    A grain can pass for a narrow stripe: where the width is less than two thirds of the ``usual_width`` (N,) px, the
    line starts anew from the centre of mass of the usual width; all widths are held near it. A clipped pixel
    tells only that it lies above what was recorded. Sigma becomes that of the covariance S. Longer than a screen: each step of the loop works on the whitened rows of the one before.
    """
    pixels, dark, (count, length, line_step, pixel_step), saturation, _ = lines
    gain_e, variance = camera
    has_dark = dark.size > 0
    most = LONGEST
    y = np.empty(most)
    rows = np.empty((5, most))
    low = np.empty((most, most))
    alike = np.empty(most)
    full = np.empty(most, np.bool_)
    more = np.empty(most)
    for d in range(most):
        alike[d] = math.exp(-((d / speckle.grain) ** 2))
    f = np.empty((4, 4))
    t = np.empty(4)
    for i in range(count):
        if table[STATE, i] != GOOD or contrast[i] <= 0.0:
            continue
        c2 = contrast[i] * contrast[i]
        p, s, a, b = table[POSITION, i], table[WIDTH, i], table[PEAK, i], table[FLOOR, i]
        if s < 0.67 * usual_width[i] or s > 1.5 * usual_width[i]:
            s = usual_width[i]
            for _ in range(3):
                total, moment = 0.0, 0.0
                for j in range(max(0, int(p - 2.0 * s + 0.5)), min(length, int(p + 2.0 * s + 1.5))):
                    at = i * line_step + j * pixel_step
                    value = np.float64(pixels[at]) - b
                    if has_dark:
                        value -= dark[at]
                    total += max(value, 0.0)
                    moment += max(value, 0.0) * j
                if total > 0.0:
                    p = moment / total
            a = total / (2.4 * s)
        if not (0.0 <= p <= length - 1.0 and 0.0 < s < FAR and math.isfinite(a + b)):
            continue  # a fit that ran away has no window
        wing = min(FAR, int(3.5 * s) + 2)
        middle = int(p + 0.5)
        first, last = max(0, middle - wing), min(length - 1, middle + wing)
        n = last - first + 1
        if n < 7:
            continue
        clipped = False
        for k in range(n):
            at = i * line_step + (first + k) * pixel_step
            full[k] = is_clipped(lines, at)
            clipped = clipped or full[k]
            y[k] = min(np.float64(pixels[at]), saturation)
            if has_dark:
                y[k] -= dark[at]
        good = True
        for _ in range(20 if clipped else 6):
            for k in range(n):
                u = (first + k - p) / s
                g = math.exp(-0.5 * u * u)
                rows[0, k] = a * g * u / s
                rows[1, k] = g
                rows[2, k] = a * g * u * u / s
                rows[3, k] = 1.0
                rows[4, k] = y[k] - b - a * g
                more[k] = 0.0
                if full[k]:
                    square = variance + a * g / gain_e + c2 * a * a * g * g
                    rows[4, k], more[k] = _censored(y[k] - 0.5 - b - a * g, square)
            # Cholesky factor of the covariance, and the whitened derivatives and residuals.
            for k in range(n):
                for j in range(k + 1):
                    total = c2 * alike[k - j] * a * a * rows[1, k] * rows[1, j]
                    if j == k:
                        total += variance + a * rows[1, k] / gain_e + more[k]
                    for q in range(j):
                        total -= low[k, q] * low[j, q]
                    low[k, j] = math.sqrt(total) if j == k else total / low[j, j]
            for r in range(5):
                for k in range(n):
                    total = rows[r, k]
                    for q in range(k):
                        total -= low[k, q] * rows[r, q]
                    rows[r, k] = total / low[k, k]
            for r in range(4):
                t[r] = 0.0
                for k in range(n):
                    t[r] += rows[r, k] * rows[4, k]
                for c in range(4):
                    f[r, c] = 0.0
                    for k in range(n):
                        f[r, c] += rows[r, k] * rows[c, k]
            if speckle.hold > 0.0:
                t[2] += speckle.hold * math.log(usual_width[i] / s) / s
                f[2, 2] += speckle.hold / (s * s)
            good = _solve(f, t)
            if not good:
                break
            step = min(max(t[0], -s), s)
            p += step
            a = max(a + t[1], 0.3 * a)
            s = min(max(s + t[2], 0.7 * s), 1.4 * s)
            b += t[3]
            if not (abs(p - middle) <= wing and abs(b) + a < ABSURD * saturation and s > 0.0):
                good = False
                break
            if abs(step) < 0.002 * s and abs(t[2]) < 0.01 * s:
                break
        if clipped and not (good and a < HIDDEN * saturation):
            table[STATE, i] = NO_FLANK  # what is left of it does not tell where it is
        elif good:
            table[POSITION, i] = p
            table[SIGMA, i] = math.sqrt(f[0, 0])
            table[WIDTH, i] = s
            table[PEAK, i] = a
            table[FLOOR, i] = b


@compiled
def _censored(level: float, square: float) -> tuple[float, float]:
    """Residual, and variance to be added, with which least squares has the score and curvature of a clipped pixel.

    ``level`` is the least that the pixel can exceed its mean by, ``square`` its variance.
    """
    deviation = math.sqrt(square)
    z = level / deviation
    if z > 6.0:
        hazard = z + 1.0 / z
    else:
        hazard = math.exp(-0.5 * z * z) * 0.7978845608028654 / max(math.erfc(z * 0.7071067811865476), 1e-30)
    weight = min(max(hazard * (hazard - z), 1e-4), 1.0)
    return min(hazard * deviation / weight, 4.0 * deviation), square * (1.0 / weight - 1.0)


@compiled
def _solve(f: Array, t: Array) -> bool:
    """Replace the symmetric f (4, 4) by its inverse and t by f^-1 t (Gauss-Jordan); False where f is singular."""
    for r in range(4):
        pivot = f[r, r]
        if not pivot > 1e-12:
            return False
        f[r, r] = 1.0
        for c in range(4):
            f[r, c] /= pivot
        t[r] /= pivot
        for o in range(4):
            if o == r:
                continue
            factor = f[o, r]
            f[o, r] = 0.0
            for c in range(4):
                f[o, c] -= factor * f[r, c]
            t[o] -= factor * t[r]
    return True


def usual_widths(table: Array) -> Array:
    """Follow the widths (N,) px by a running median over the lines that have one, carried over to those between."""
    good = np.flatnonzero(np.isfinite(table[WIDTH]))
    if len(good) == 0:
        return np.ones(table.shape[1])
    return np.asarray(np.interp(np.arange(table.shape[1]), good, running_median(table[WIDTH, good])))


@dataclass(frozen=True, slots=True, eq=False)
class Leftover:
    """What the pixels of steady lines leave over when each line takes the running medians of its neighbours."""

    line: NDArray[np.int64]  # (M,) line of the image
    left: Array  # (M, 2 REACH + 1) grey levels, scaled to the common peak; 0 where they are not seen
    seen: NDArray[np.bool_]  # (2 REACH + 1,) pixels that tell: not those at which the stripe is clipped on most lines
    peak: float  # grey levels, common to all
    width: float  # px, median


def leftover(lines: Lines, table: Array) -> Leftover | None:
    """Amplitude, width and floor of every line are replaced by their running medians; the position stays its own.

    Lines whose peak stands alone show no stripe: the highest pixel of a dark line is anywhere, and its fit tells of the noise
    of maxima. Lines of far more than the usual residual lie at an edge, and are no speckle. ``None`` where fewer than ``LEAST_LINES`` lines are usable.
    """
    pixels, dark, (_, length, line_step, pixel_step), saturation, masked = lines
    sane = np.abs(table[FLOOR]) + np.abs(table[PEAK]) < ABSURD * saturation
    good = np.flatnonzero(
        (table[STATE] == GOOD) & (table[PEAK] > 0) & np.isfinite(table[SIGMA]) & sane & _goes_on(table)
    )
    if len(good) < LEAST_LINES:
        return None
    p = table[POSITION, good]
    peak, s, floor = (running_median(table[row, good]) for row in (PEAK, WIDTH, FLOOR))
    middle = np.rint(p).astype(np.int64)
    steady = (np.abs(table[PEAK, good] / peak - 1) < 1.5) & (np.abs(table[WIDTH, good] / s - 1) < 0.8)
    steady &= (middle >= REACH) & (middle < length - REACH) & (peak > 0)
    where = middle[:, None] + np.arange(-REACH, REACH + 1)
    at = good[:, None] * line_step + np.clip(where, 0, length - 1) * pixel_step
    y = pixels[at].astype(np.float64)
    clipped = y >= saturation
    if masked.size:
        clipped |= masked[at]
    seen = np.ones(y.shape[1], np.bool_)
    if np.count_nonzero(steady & ~clipped.any(axis=1)) < max(LEAST_LINES, 0.25 * np.count_nonzero(steady)):
        if not steady.any():
            return None
        seen = clipped[steady].mean(axis=0) < 0.02
        square = (np.arange(-REACH, REACH + 1) / np.median(s[steady])) ** 2
        if not np.sum((square * np.exp(-square))[seen]) > FLANKS * np.sum(square * np.exp(-square)):
            return None
    steady &= ~clipped[:, seen].any(axis=1)
    if dark.size:
        y -= dark[at]
    if np.count_nonzero(steady) < LEAST_LINES:
        return None
    u = (where - p[:, None]) / s[:, None]
    left = (y - floor[:, None] - peak[:, None] * np.exp(-0.5 * u * u))[steady]
    left -= np.median(left, axis=0)  # a constant shape that is not Gaussian is no noise
    common = float(np.median(peak[steady]))
    left *= (common / peak[steady])[:, None]
    left[:, ~seen] = 0.0
    energy = (left**2).sum(axis=1)
    alike = energy <= UNLIKE * running_median(energy)
    return Leftover(good[steady][alike], left[alike], seen, common, float(np.median(s[steady])))


def _goes_on(table: Array) -> NDArray[np.bool_]:
    """Lines (N,) near whose position at least two of the four lines about them have theirs."""
    place = np.pad(np.where(table[STATE] == GOOD, table[POSITION], np.nan), 2, constant_values=np.nan)
    here = place[2:-2]
    near = [np.abs(place[2 + d : len(place) - 2 + d] - here) < STEP * abs(d) for d in (-2, -1, 1, 2)]
    return np.asarray(np.sum(near, axis=0) >= 2)


def analyse(found: Leftover, known: Noise | None, usual: Noise) -> tuple[Noise, Speckle]:
    """Noise of the camera and speckle of the light, from how a stripe differs from its own running median.

    The residuals have the covariance S above, less the part that the position took up: products of residuals up to
    ``LAGS`` pixels apart are linear in read^2, 1 / gain and C^2 for every grain. The noise is what the quieter half of
    the stripe shows (the median over blocks of lines, since texture is local); the speckle is the mean of all lines
    under that noise. Where all of a stripe is speckled, that could pass for the shot noise of few electrons: no camera is
    taken to clip at fewer than a `FAINTEST` of the ``usual`` one's.
    """
    if known is None:
        blocks = np.array_split(found.left, max(1, len(found.left) // 32))
        quiet = np.median([_products(block) for block in blocks], axis=0)
        known, _ = _solve_noise(quiet, found, None, FAINTEST / usual.gain_e)
    return known, _solve_noise(_products(found.left, 0.005), found, known, math.inf)[1]


def within_reason(learnt: Noise, usual: Noise) -> Noise:
    """Noise of a speckled stripe, which tells little of the camera's own: the usual where it says what no camera has."""
    gain = learnt.gain_e if usual.gain_e / FAINTEST < learnt.gain_e < usual.gain_e * DEEPEST else usual.gain_e
    return Noise(gain, learnt.read_noise if learnt.read_noise > usual.read_noise / QUIETEST else usual.read_noise)


def local_contrast(found: Leftover, noise: Noise, grain: float, count: int) -> Array:
    """Contrast (count,) of every line from the lines about it; 0 where shot and read noise explain the residuals."""
    _, constant, linear, square = _expected(found, grain, noise)
    quiet = (noise.read_noise**2 + 1 / 12) * constant[0] + linear[0] / noise.gain_e
    total = quiet + 0.01 * square[0]
    weight = np.where(found.seen, square[0] / total**2, 0.0)
    excess = ((found.left**2 - quiet) @ weight) / float(square[0] @ weight)
    kernel = np.ones(25) / 25.0
    mean = np.convolve(np.pad(excess, 12, mode="edge"), kernel, mode="valid")
    at_peak = (noise.read_noise**2 + 1 / 12 + found.peak / noise.gain_e) / found.peak**2
    spread = np.where(mean > max(0.5 * at_peak, 1e-3), np.sqrt(np.maximum(mean, 0.0)), 0.0)
    lines = np.arange(count)
    return np.asarray(spread[np.clip(np.searchsorted(found.line, lines), 0, len(found.line) - 1)])


def _products(left: Array, share: float = 0.0) -> Array:
    """Mean products (LAGS, pixels) of residuals 0, 1, 2 ... px apart."""
    n = left.shape[1]
    products = np.zeros((LAGS, n))
    for d in range(LAGS):
        products[d, : n - d] = _trimmed_mean(left[:, : n - d] * left[:, d:], share)
    return products


def _expected(found: Leftover, grain: float, noise: Noise) -> tuple[Array, Array, Array, Array]:
    """Profile m, and the products (LAGS, pixels) that a unit of read^2, of 1 / gain and of C^2 cause."""
    x = np.arange(-REACH, REACH + 1)
    u = x / found.width
    m = found.peak * np.exp(-0.5 * u * u)
    slope = m * u / found.width
    weight = np.where(found.seen, slope, 0.0) / (noise.read_noise**2 + 1 / 12 + m / noise.gain_e)
    n = len(x)
    left = np.eye(n) - np.outer(slope, weight) / np.sum(weight * slope)

    def products(covariance: Array) -> Array:
        covariance = left @ covariance @ left.T
        out = np.zeros((LAGS, n))
        for d in range(LAGS):
            out[d, : n - d] = np.diagonal(covariance, d)
        return out

    rho = np.exp(-(((x[:, None] - x[None, :]) / grain) ** 2))
    return m, products(np.eye(n)), products(np.diag(m)), products(rho * np.outer(m, m))


def _solve_noise(products: Array, found: Leftover, known: Noise | None, most: float) -> tuple[Noise, Speckle]:
    """Read noise, gain, contrast and grain that explain mean products of residuals (LAGS, pixels); 1 / gain is at ``most`` that."""
    n = products.shape[1]
    seen = np.pad(found.seen, (0, LAGS))
    valid = np.stack([found.seen & seen[d : d + n] for d in range(LAGS)])
    guess = known or Noise(30.0, 1.2)
    best = (math.inf, guess, Speckle(0.0, 1.0))
    for grain in GRAINS:
        _, constant, linear, square = _expected(found, grain, guess)
        total = np.maximum(products[0], 1e-3)
        for _ in range(3):
            weight = 1.0 / np.sqrt(total[None, :] * np.stack([np.roll(total, -d) for d in range(LAGS)]))
            use = valid
            columns = [square[use]] if known else [constant[use], linear[use], square[use]]
            target = products[use]
            if known:
                target = target - (known.read_noise**2 + 1 / 12) * constant[use] - linear[use] / known.gain_e
            design = np.stack(columns, axis=1) * weight[use][:, None]
            answer = _nonnegative(design, target * weight[use])
            if not known and answer[1] > most:
                rest = target * weight[use] - most * design[:, 1]
                answer = np.insert(_nonnegative(design[:, [0, 2]], rest), 1, most)
            terms = np.array([known.read_noise**2 + 1 / 12, 1 / known.gain_e, answer[0]]) if known else answer
            total = np.maximum(terms[0] * constant[0] + terms[1] * linear[0] + terms[2] * square[0], 1e-3)
        misfit = float(np.sum((design @ answer - target * weight[use]) ** 2))
        if misfit < best[0]:
            noise = known or Noise(float(1.0 / max(terms[1], 1e-4)), math.sqrt(max(terms[0] - 1 / 12, 0.04)))
            best = (misfit, noise, Speckle(math.sqrt(max(terms[2], 0.0)), grain))
    return best[1], best[2]


def _nonnegative(design: Array, target: Array) -> Array:
    """Least squares with no negative entry: negative entries are struck out one after the other."""
    active = np.ones(design.shape[1], dtype=bool)
    answer = np.zeros(design.shape[1])
    while active.any():
        answer[:] = 0.0
        answer[active] = np.linalg.lstsq(design[:, active], target, rcond=None)[0]
        if (answer >= 0.0).all():
            break
        active[int(np.argmin(answer))] = False
        answer = np.maximum(answer, 0.0)
    return answer


def running_median(values: Array, half: int = 10) -> Array:
    """Median over 2 half + 1 neighbours, mirrored at the ends; fewer where there are fewer."""
    half = min(half, max(0, len(values) - 1))
    padded = np.pad(values, half, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    return np.asarray(np.median(windows, axis=1))


def _trimmed_mean(values: Array, share: float) -> Array:
    """Mean of each column without its ``share`` lowest and highest values."""
    cut = int(len(values) * share)
    ordered = np.sort(values, axis=0)
    return np.asarray(ordered[cut : len(values) - cut].mean(axis=0))
