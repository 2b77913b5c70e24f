"""Corrects stripe positions for what the surface's slope and curvature do across the width of the stripe.

A sheet of light has a width. Across it a sloping or curved surface is not lit evenly (Lambert's cosine) and does not
leave the sheet at an even rate, so that the stripe's profile is skewed and its peak displaced. With t the pixel across the
stripe, a t + b t^2 / 2 the distance of the surface from the middle of the sheet, g the relative growth of irradiance,
and w the width of the sheet, the profile before the lens is, to first order,

    exp(-t^2 / 2 s0^2) (1 + g t - b t^3 / (2 a s0^2)),    s0 = w / |a|,

which in Hermite polynomials of t / s0 is 1 + h1 He1 + h3 He3, h3 = -b s0 / (2 a), h1 = g s0 + 3 h3. A blur c makes it wider,
S^2 = s0^2 + c^2, and leaves h1 s0 and h3 s0^3 as they are. A weighted least squares fit of a Gaussian is displaced by

    s0 h1 + rho s0 (s0 / S)^2 h3,

rho being the answer of the fit to He3: 0 where shot noise rules the weights, -3/2 where they are even. The blur also acts
along the stripe: where the stripe is curved or its light M grows along it, a line receives its neighbours' light, which adds
c^2 (v'' / 2 + v' M' / M), v(u) being the stripe's course.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from calibration.geometry import Array, Bools
from ranging import surface
from ranging.course import follow
from ranging.lattice import CONTEXT, Lattice


SPAN = 2.7  # standard deviations of the stripe's width, over which the surface is taken as a paraboloid, to either side
STEEP = 0.35  # of h1 or h3: beyond, first order does not hold
DOUBT = 0.15  # of a correction, for what is not known: the surface need not be Lambert's
MOST = 2, 6  # frames and lines, at most, from one point of a patch to the next
BLUR = 0.36, 0.25  # px^2: a lens of half a pixel and the pixel's own 1/12; how far that may be wrong


@dataclass(frozen=True, slots=True)
class Beam:
    """The light before and after the lens."""

    width: float  # mm, one sigma of the sheet
    blur: float  # px^2, variance of lens and pixel


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What to take off the positions of a lattice."""

    shift: Array  # (F, L) px; 0 where the surface is not known well enough
    sigma: Array  # (F, L) px, of what is left
    width: Array  # (F, L) px, that the stripe should have there; NaN where the surface is not known
    table: Array  # (F, L, surface.COLUMNS)
    beam: Beam


def correct(lattice: Lattice, first: int, last: int) -> Correction:
    """Displacement of the stripe in frames ``first`` to ``last`` - 1 of a lattice.

    Parameters
    ----------
    lattice : Lattice
        With up to `CONTEXT` frames before and after those asked for. Other frames' rows of the result are NaN.
    first, last : int
        Rows of the lattice.

    Returns
    -------
    Correction
        Zero, with no sigma of its own, where fewer than a dozen neighbours tell the surface: at its borders, and in a
        capture without motion. Where the neighbours lie on no paraboloid (edges, roughness finer than the stripe), too.
    """
    stride = _stride(lattice)
    margin = surface.NEAREST * stride[0]
    patches = np.full((*lattice.sigma.shape, surface.PATCH), np.nan)
    table = np.full((*lattice.sigma.shape, surface.COLUMNS), np.nan)
    surface.fit_patches(
        lattice.points, lattice.view, lattice.sigma, stride, max(0, first - margin),
        min(len(lattice.source), last + margin), patches,
    )  # fmt: skip
    surface.see_surfaces(
        lattice.points, lattice.view, lattice.moved, lattice.sheet, lattice.source, lattice.camera, lattice.sigma,
        stride, first, last, patches, table,
    )  # fmt: skip
    course = follow(lattice.position, lattice.peak * lattice.width)
    beam = estimate_beam(table, lattice.width, course[..., 0])
    shift, noise, width = displacement(table, course, beam, lattice)
    known = np.isfinite(shift) & (table[..., surface.MISFIT] < surface.SMOOTH)
    variance = lattice.sigma_px**2
    share = np.where(known, variance / (variance + noise**2), 0.0)
    full = np.where(known, shift, 0.0)
    left = np.hypot((1.0 - share) * full, DOUBT * full)
    return Correction(share * full, np.where(known, np.hypot(left, share * noise), 0.0), width, table, beam)


def displacement(table: Array, course: Array, beam: Beam, lattice: Lattice) -> tuple[Array, Array, Array]:
    """Displacement, its noise, and the width of the stripe, (F, L) px each; NaN where first order does not hold."""
    a, b, g = (table[..., k] for k in (surface.LEAVING, surface.BENDING, surface.SHADING))
    tilt, bow, growth = (course[..., k] for k in range(3))
    with np.errstate(invalid="ignore", divide="ignore"):
        s0 = beam.width / np.abs(a)
        square = s0**2 + beam.blur * (1.0 + tilt**2)
        h3 = -0.5 * b * s0 / a
        h1 = g * s0 + 3.0 * h3
        noise = s0**2 * table[..., surface.NOISE]
        rho = answer_to_skew(lattice.peak, *lattice.noise.T[:, :, None])
        shift = s0 * h1 + rho * s0 * h3 * s0**2 / square + beam.blur * (0.5 * bow + tilt * growth)
        valid = (np.abs(h1) < STEEP) & (np.abs(h3) < STEEP)
    return np.where(valid, shift, np.nan), np.where(valid, noise, np.nan), np.sqrt(square)


def estimate_beam(table: Array, width: Array, tilt: Array) -> Beam:
    """Width of the sheet and blur of the lens, from stripes on surfaces of different slopes.

    The stripe's variance is w^2 / a^2 + c^2 (1 + v'^2); a surface of a single slope cannot tell w from c, and c then
    stays near what lenses do.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        x, t, y = 1.0 / table[..., surface.LEAVING] ** 2, 1.0 + tilt**2, width**2
        good: Bools = (table[..., surface.MISFIT] < 2.0) & np.isfinite(x + t + y) & (t < 5.0)
    if np.count_nonzero(good) < 50:
        return Beam(0.0, BLUR[0])
    x, t, y = x[good], t[good], y[good]
    usual = float(np.median(x))
    near = x < 9.0 * usual
    x, t, y = x[near] / usual, t[near], y[near]
    weight = 1.0 / np.maximum(y, 0.1) ** 2
    solution = np.array([1.0, BLUR[0]])
    for _ in range(6):
        confidence = 50.0 / (0.1**2 * len(y))  # of model and data together: a tenth of the variance, fifty times told
        w = weight * confidence
        matrix = np.array([[np.sum(w * x * x), np.sum(w * x * t)], [np.sum(w * x * t), np.sum(w * t * t)]])
        right = np.array([np.sum(w * x * y), np.sum(w * t * y)])
        matrix[1, 1] += 1.0 / BLUR[1] ** 2
        right[1] += BLUR[0] / BLUR[1] ** 2
        solution = np.linalg.solve(matrix, right)
        residual = (y - x * solution[0] - t * solution[1]) / np.maximum(y, 0.1)
        scale = 3.0 * max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        weight = np.maximum(1.0 - (residual / scale) ** 2, 0.0) ** 2 / np.maximum(y, 0.1) ** 2
    blur = float(np.clip(solution[1], 1.0 / 12.0, 0.9 * np.median(y)))
    if blur != solution[1]:
        solution[0] = float(np.median((y - blur * t) / x))
    return Beam(float(np.sqrt(max(solution[0], 0.0) / usual)), blur)


def answer_to_skew(peak: Array, gain: Array, dark: Array, speckle: Array) -> Array:
    """rho: displacement of a Gaussian fit, in sigma, by a unit of He3 in the profile.

    The weights are 1 / (dark + peak G / gain + (speckle peak G)^2); the answer depends on both ratios to ``dark``.
    """
    ratio, rough = _skews()[0], _skews()[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        q = np.log10(np.clip(peak / (gain * dark), 1e-3, 1e3))
        r = np.clip((speckle * peak) ** 2 / dark, 0.0, 1e3)
        r = np.log10(np.maximum(r, 1e-3))
    k = np.clip((q + 3.0) / 6.0 * (len(ratio) - 1), 0, len(ratio) - 1.001)
    m = np.clip((r + 3.0) / 6.0 * (len(rough) - 1), 0, len(rough) - 1.001)
    k, m = np.nan_to_num(k), np.nan_to_num(m)
    i, j = k.astype(np.intp), m.astype(np.intp)
    values = _skews()[2]
    low = values[i, j] + (k - i) * (values[i + 1, j] - values[i, j])
    high = values[i, j + 1] + (k - i) * (values[i + 1, j + 1] - values[i, j + 1])
    return np.asarray(low + (m - j) * (high - low))


@cache
def _skews() -> tuple[Array, Array, Array]:
    """Table of `answer_to_skew` over the logarithms of both ratios, -3 to 3."""
    ratio = rough = np.linspace(-3.0, 3.0, 25)
    u = np.linspace(-4.0, 4.0, 401)
    g = np.exp(-0.5 * u**2)
    weight = g**2 / (1.0 + 10.0 ** ratio[:, None, None] * g + 10.0 ** rough[None, :, None] * g**2)
    return ratio, rough, np.asarray((weight * u * (u**3 - 3.0 * u)).sum(axis=2) / (weight * u * u).sum(axis=2))


def _stride(lattice: Lattice) -> tuple[int, int]:
    """Frames and lines from one point of a patch to the next."""
    with np.errstate(invalid="ignore"):
        spread = lattice.width * np.linalg.norm(lattice.moved, axis=2)
    known = np.isfinite(spread)
    wide = SPAN * float(np.median(spread[known])) if known.any() else 1.0
    frames, lines = (wide / max(lattice.step(axis), 1e-9) / surface.HALF for axis in (0, 1))
    return int(np.clip(np.rint(frames), 1, MOST[0])), int(np.clip(np.rint(lines), 1, MOST[1]))
