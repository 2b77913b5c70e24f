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

from calibration.geometry import Array, fit_plane
from ranging import surface
from ranging.course import follow
from ranging.lattice import Lattice

SPAN = 2.7  # standard deviations of the stripe's width, over which the surface is taken as a paraboloid, to either side
STEEP = 0.35  # of h1 or h3: beyond, first order does not hold
DOUBT = 0.15  # of a correction, for what is not known: the surface need not be Lambert's
MOST = 2, 6  # frames and lines, at most, from one point of a patch to the next
GROWTH = 1.0, 1.0  # see `estimate_beam`; how far that may be wrong
TELLING = 500.0  # a tenth of the variance, five times told: how much the widths of stripes are trusted
BLUR = 0.36, 0.25  # px^2: a lens of half a pixel and the pixel's own 1/12; how far that may be wrong


@dataclass(frozen=True, slots=True)
class Beam:
    """The light before and after the lens."""

    width: float  # mm, one sigma of the sheet at a distance of ``middle``
    growth: float  # of its square, over the growth of the distance
    middle: float  # mm
    blur: float  # px^2, variance of lens and pixel

    def width_at(self, distance: Array) -> Array:
        """One sigma of the sheet, mm, at distances from the camera."""
        return np.asarray(self.width * np.sqrt(np.maximum(1.0 + self.growth * (distance / self.middle - 1.0), 0.1)))


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What to take off the positions of a lattice."""

    shift: Array  # (F, L) px; 0 where the surface is not known well enough
    sigma: Array  # (F, L) px, of what is left
    width: Array  # (F, L) px, that the stripe should have there; NaN where the surface is not known
    table: Array  # (F, L, surface.COLUMNS)
    beam: Beam
    share: Array  # (F, L) of the displacement that ``shift`` is; 0 where it is not known


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
    light = lattice.peak * lattice.width
    table = _surfaces(lattice, light, first, last)
    course = follow(lattice.position, light)
    distance = np.linalg.norm(lattice.points - lattice.camera[:, None, :], axis=2)
    beam = estimate_beam(table, lattice.width, course[..., 0], distance)
    shift, noise, width = displacement(table, course, beam.width_at(distance), beam.blur, lattice)
    known = np.isfinite(shift) & (table[..., surface.MISFIT] < surface.SMOOTH)
    variance = lattice.sigma_px**2
    share = np.where(known, variance / (variance + noise**2), 0.0)
    full = np.where(known, shift, 0.0)
    left = np.hypot((1.0 - share) * full, DOUBT * full)
    return Correction(share * full, np.where(known, np.hypot(left, share * noise), 0.0), width, table, beam, share)


def _surfaces(lattice: Lattice, light: Array, first: int, last: int) -> Array:
    """Table of `surface.see_surfaces`; where no wide patch is smooth, of narrow ones."""
    with np.errstate(invalid="ignore", divide="ignore"):
        glow = np.log(light)
    table = np.full((*lattice.sigma.shape, surface.COLUMNS), np.nan)
    if not lattice.moves:
        return table
    wide = _stride(lattice)
    for stride in dict.fromkeys((wide, (wide[0], max(1, wide[1] // 2)), (1, 1))):
        margin = surface.NEAREST * stride[0]
        patches = np.full((*lattice.sigma.shape, surface.PATCH), np.nan)
        begin, end = max(0, first - margin), min(len(lattice.camera), last + margin)
        surface.fit_patches(lattice.points, lattice.view, lattice.sigma, glow, stride, begin, end, patches)
        surface.see_surfaces(
            lattice.points, lattice.view, lattice.moved, lattice.sheet, lattice.camera, lattice.sigma, stride, first, last,
            patches, table,
        )  # fmt: skip
    return table


def displacement(
    table: Array, course: Array, width: Array, blur: float, lattice: Lattice
) -> tuple[Array, Array, Array]:
    """Displacement, its noise, and the width of the stripe, (F, L) px each; NaN where first order does not hold."""
    a, b, g = (table[..., k] for k in (surface.LEAVING, surface.BENDING, surface.SHADING))
    tilt, bow, growth = (course[..., k] for k in range(3))
    with np.errstate(invalid="ignore", divide="ignore"):
        s0 = width / np.abs(a)
        square = s0**2 + blur * (1.0 + tilt**2)
        h3 = -0.5 * b * s0 / a
        h1 = g * s0 + 3.0 * h3
        noise = s0**2 * table[..., surface.NOISE]
        rho = answer_to_skew(lattice.peak, *lattice.noise.T[:, :, None])
        shift = s0 * h1 + rho * s0 * h3 * s0**2 / square + blur * (0.5 * bow + tilt * growth)
        valid = (np.abs(h1) < STEEP) & (np.abs(h3) < STEEP)
    return np.where(valid, shift, np.nan), np.where(valid, noise, np.nan), np.sqrt(square)


def estimate_beam(table: Array, width: Array, tilt: Array, distance: Array) -> Beam:
    """Width of the sheet and blur of the lens, from stripes on surfaces of different slopes.

    The stripe's variance is w^2 / a^2 + c^2 (1 + v'^2), with w^2 = w0^2 (1 + growth x), x being the distance over its
    median, less one: growth is 0 for a collimated sheet, 2 for one that widens with its range. All slopes and distances
    have the same say, however many points they have. What they cannot tell stays near what lasers and lenses do.

    Parameters
    ----------
    table : (F, L, COLUMNS) array
        Of `surface.see_surfaces`.
    width, tilt : (F, L) arrays
        px, of the stripe; px/line, of its course.
    distance : (F, L) array, mm
        From the camera.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        x, t, y = table[..., surface.LEAVING] ** -2, 1.0 + tilt**2, width**2
        good = (table[..., surface.MISFIT] < surface.SMOOTH) & (table[..., surface.AWAY] == 0.0)
        good &= np.isfinite(x + t + y) & (t < 5.0)
    if np.count_nonzero(good) < 50:
        return Beam(0.0, 0.0, 1.0, BLUR[0])
    x, t, y, d = x[good], t[good], y[good], distance[good]
    usual, middle = float(np.median(x)), float(np.median(d))
    near = x < 9.0 * usual
    x, t, y, z = x[near] / usual, t[near], y[near], d[near] / middle - 1.0
    cell = np.digitize(np.log2(x), np.linspace(-3.0, 3.0, 13)) * 64 + np.digitize(z, np.linspace(-0.3, 0.3, 31))
    balance = 1.0 / np.bincount(cell)[cell]
    terms = np.stack([x, x * z, t], axis=1) / y[:, None]
    start = max(float(np.median((y - BLUR[0] * t) / x)), 0.01)
    prior = np.array([start, start * GROWTH[0], BLUR[0]])
    tight = np.array([0.0, 1.0 / (start * GROWTH[1]) ** 2, 1.0 / BLUR[1] ** 2])
    weight, found = balance, prior
    for _ in range(6):
        scaled = terms * (weight * (TELLING / np.sum(weight)))[:, None]
        found = np.linalg.solve(scaled.T @ terms + np.diag(tight), scaled.sum(axis=0) + tight * prior)
        residual = 1.0 - terms @ found
        scale = 4.0 * max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        weight = balance * np.maximum(1.0 - (residual / scale) ** 2, 0.0) ** 2
    square = max(float(found[0]), 1e-6)
    blur = float(np.clip(found[2], 1.0 / 12.0, None))
    return Beam(float(np.sqrt(square / usual)), float(np.clip(found[1] / square, -1.0, 3.0)), middle, blur)


def footprint(found: Correction, lattice: Lattice) -> Array:
    """One sigma of the stripe on the surface (F, L), mm, in the direction in which its pixels cross it.

    The measured width without the lens's blur, in pixels, times how far a pixel moves on the surface. NaN where the surface
    is not known; where next to none of it is, as on a rough part alone, the plane through all points stands for it.
    """
    normal = found.table[..., surface.NORMAL : surface.NORMAL + 3]
    seen = np.isfinite(lattice.sigma)
    if lattice.moves and np.count_nonzero(np.isfinite(normal[..., 0])) < 0.05 * np.count_nonzero(seen):
        plane = fit_plane(lattice.points[seen])
        normal = np.broadcast_to(plane.normal, normal.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        rise = np.einsum("fli,fli->fl", normal, lattice.moved) / np.einsum("fli,fli->fl", normal, lattice.view)
        stride = np.linalg.norm(lattice.moved - rise[..., None] * lattice.view, axis=2)
        return np.asarray(np.sqrt(np.maximum(lattice.width**2 - found.beam.blur, 0.0)) * stride)


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
