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
along the stripe: where the stripe is curved or its light M grows along it, a line receives its neighbours' light, which moves
its mean by c^2 (v'' / 2 + v' M' / M), v(u) being the stripe's course, and skews it by a third cumulant of 3 c^4 v'^2 v'', to
which a fit answers with rho / (6 S^2) of it, S^2 = s0^2 + c^2 (1 + v'^2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from calibration.compiled import compiled
from calibration.geometry import Array, Bools, fit_plane
from ranging.surface import patches as surface
from ranging.surface.course import follow
from ranging.surface.lattice import Lattice
from ranging.surface.spacetime import TAPS

SPAN = 2.7  # standard deviations of the stripe's width, over which the surface is taken as a paraboloid, to either side
STEEP = 0.35  # of h1 or h3: beyond, first order does not hold
DOUBT = 0.15  # of a correction, for what is not known: the surface need not be Lambert's
MOST = 2, 6  # frames and lines, at most, from one point of a patch to the next
GROWTH = 1.0, 1.0  # see `estimate_beam`; how far that may be wrong
TELLING = 500.0  # a tenth of the variance, five times told: how much the widths of stripes are trusted
BLUR_KNOWN = 0.15  # of the variance that spots show: how far the stripe's may differ
ENOUGH = 160  # lines of a frame that tell the beam and the footprint
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
class Slopes:
    """What the surfaces of n frames do to their stripes, (n, L) px each unless said otherwise; NaN where not known."""

    moves: bool  # see `Lattice.moves`
    table: Array  # (n, L, surface.COLUMNS)
    beam: Beam
    sheet: Array  # mm, one sigma of the sheet of light at the point
    profile: Array  # displacement of the profile on its line
    passage: Array  # displacement that the passage of the sheet (`ranging.surface.spacetime`) has in its place
    beside: Array  # part of both that comes from the lines beside
    noise: Array  # of the rest of both, one standard deviation
    variance: Array  # of a position, from which the displacement is to be taken off

    def correction(self, weight: Array | float = 0.0) -> tuple[Array, Array, Array]:
        """What to take off positions in which the passage has a ``weight`` (n, L): px, the sigma of what is left, the share.

        A displacement that is known less well than the position itself is taken off in part only: ``share`` (0 to 1) of
        what slope and curvature displaced. Zero where the surface is not known.
        """
        full = self.profile + weight * (self.passage - self.profile)
        known = np.isfinite(full)
        beside = np.where(known, self.beside, 0.0)
        full = np.where(known, full - beside, 0.0)
        noise = np.where(known, self.noise * (1.0 - weight), 0.0)
        with np.errstate(invalid="ignore"):
            share = np.where(known, self.variance / (self.variance + noise**2), 0.0)
        left = np.hypot((1.0 - share) * full, DOUBT * (full + beside))
        return share * full + beside, np.hypot(left, share * noise), share


def slopes(lattice: Lattice, first: int, last: int, *, blur_px: float = math.nan) -> Slopes:
    """Displacement of the stripe in frames ``first`` to ``last`` - 1 of a lattice.

    Parameters
    ----------
    lattice : Lattice
        With up to `CONTEXT` frames before and after those asked for.
    first, last : int
        Rows of the lattice.
    blur_px : float
        One sigma of lens and pixel, where the calibration has seen it; NaN: what lenses usually have.

    Returns
    -------
    Slopes
        NaN where fewer than a dozen neighbours tell the surface: at its borders, and in a
        capture without motion. Where the neighbours lie on no paraboloid (edges, roughness finer than the stripe), too.
    """
    moves = lattice.moves
    table = _surfaces(lattice, first, last, moves)
    asked = lattice.rows(first, last)
    course = follow(asked.position, asked.peak * asked.width)
    distance = np.linalg.norm(asked.points - asked.camera[:, None, :], axis=2)
    some = slice(None, None, max(1, asked.sigma.shape[1] // ENOUGH))
    known = blur_px**2, BLUR_KNOWN * blur_px**2
    beam = estimate_beam(
        table[:, some], asked.width[:, some], course[:, some, 0], distance[:, some], known if blur_px > 0.0 else BLUR
    )
    sheet = beam.width_at(distance)
    profile, passage, beside, noise = displacement(table, course, sheet, beam.blur, asked)
    return Slopes(moves, table, beam, sheet, profile, passage, beside, noise, asked.sigma_px**2)


def _surfaces(lattice: Lattice, first: int, last: int, moves: bool) -> Array:
    """Table of `surface.fit_patches`: of the point's own patch, wide or narrow, or of one beside it, narrow or wide."""
    frames, lines = lattice.sigma.shape
    table = np.full((last - first, lines, surface.COLUMNS), np.nan)
    if not moves:
        return table
    with np.errstate(invalid="ignore", divide="ignore"):
        glow = np.log(lattice.peak * lattice.width)
    wide = _stride(lattice)
    half = max(1, wide[0] // 2), max(1, wide[1] // 2)
    strides = list(dict.fromkeys((wide, (wide[0], half[1]), half, (1, 1))))
    patches = [np.empty((frames, lines, surface.PATCH)) for _ in strides]
    fitted = [np.zeros((frames, lines), dtype=bool) for _ in strides]
    scan = surface.Surface(
        lattice.points, lattice.view, lattice.moved, lattice.sheet, lattice.camera, lattice.sigma, glow
    )
    owns = [(k, 1.0 if k == 0 else 0.5) for k in range(len(strides))]
    for k, own in [*owns, *((k, 0.0) for k in reversed(range(len(strides))))]:
        surface.fit_patches(scan, surface.Patches(strides[k], patches[k], fitted[k]), first, last, own, table)
    return table


def displacement(
    table: Array, course: Array, width: Array, blur: float, lattice: Lattice
) -> tuple[Array, Array, Array, Array]:
    """Displacement of the profile, of the passage, the part of both from the lines beside, and the noise of the rest.

    (F, L) px each; NaN where first order does not hold.
    """
    found = np.empty((4, *width.shape))
    _displace(table, (course, width, lattice.peak), blur, lattice.noise, skews(), found)
    return found[0], found[1], found[2], found[3]


@compiled
def _displace(
    table: Array, stripe: tuple[Array, Array, Array], blur: float, camera: Array, answers: Array, found: Array
) -> None:
    course, width, peak = stripe
    profile, passage, beside, noise = found[0], found[1], found[2], found[3]
    for f in range(width.shape[0]):
        gain, dark, speckle = camera[f, 0], camera[f, 1], camera[f, 2]
        for i in range(width.shape[1]):
            row = table[f, i]
            a, b, g = row[surface.LEAVING], row[surface.BENDING], row[surface.SHADING]
            tilt, bow, growth = course[f, i, 0], course[f, i, 1], course[f, i, 2]
            s0 = width[f, i] / abs(a)
            h3 = -0.5 * b * s0 / a
            h1 = g * s0 + 3.0 * h3
            profile[f, i] = passage[f, i] = beside[f, i] = noise[f, i] = np.nan
            if not (row[surface.MISFIT] < surface.SMOOTH and abs(h1) < STEEP and abs(h3) < STEEP):
                continue
            rho = answer_to_skew(peak[f, i], gain, dark, speckle, answers)
            square = s0**2 + blur * (1.0 + tilt**2)
            lines = blur * (0.5 * bow + tilt * growth + 0.5 * rho * blur * tilt**2 * bow / square)
            beside[f, i] = lines
            profile[f, i] = s0 * h1 + rho * s0 * h3 * s0**2 / square + lines
            passage[f, i] = lines - (blur + TAPS) * (g + 0.5 * b / a)
            noise[f, i] = s0**2 * row[surface.NOISE]


def estimate_beam(table: Array, width: Array, tilt: Array, distance: Array, blur: tuple[float, float] = BLUR) -> Beam:
    """Width of the sheet and blur of the lens, from stripes on surfaces of different slopes.

    The stripe's variance is w^2 / a^2 + c^2 (1 + v'^2), with w^2 = w0^2 (1 + growth x), x being the distance over its
    median, less one: growth is 0 for a collimated sheet, 2 for one that widens with its range. All slopes and distances
    have the same say, however many points they have. What they cannot tell stays near what lasers and lenses do.

    Parameters
    ----------
    table : (F, L, COLUMNS) array
        Of `surface.fit_patches`.
    width, tilt : (F, L) arrays
        px, of the stripe; px/line, of its course.
    distance : (F, L) array, mm
        From the camera.
    blur : (value, sigma), px^2
        What is known of the variance of lens and pixel.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        x, t, y = table[..., surface.LEAVING] ** -2, 1.0 + tilt**2, width**2
        good = (table[..., surface.MISFIT] < surface.SMOOTH) & (table[..., surface.OWN] == 1.0)
        good &= np.isfinite(x + t + y) & (t < 5.0)
    if np.count_nonzero(good) < 50:
        return Beam(0.0, 0.0, 1.0, blur[0])
    x, t, y, d = x[good], t[good], y[good], distance[good]
    usual, middle = float(np.median(x)), float(np.median(d))
    near = x < 9.0 * usual
    x, t, y, z = x[near] / usual, t[near], y[near], d[near] / middle - 1.0
    cell = np.digitize(np.log2(x), np.linspace(-3.0, 3.0, 13)) * 64 + np.digitize(z, np.linspace(-0.3, 0.3, 31))
    balance = 1.0 / np.bincount(cell)[cell]
    terms = np.stack([x, x * z, t], axis=1) / y[:, None]
    start = max(float(np.median((y - blur[0] * t) / x)), 0.01)
    prior = np.array([start, start * GROWTH[0], blur[0]])
    tight = np.array([0.0, 1.0 / (start * GROWTH[1]) ** 2, 1.0 / blur[1] ** 2])
    weight, found = balance, prior
    for _ in range(6):
        scaled = terms * (weight * (TELLING / np.sum(weight)))[:, None]
        found = np.linalg.solve(scaled.T @ terms + np.diag(tight), scaled.sum(axis=0) + tight * prior)
        residual = 1.0 - terms @ found
        scale = 4.0 * max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        weight = balance * np.maximum(1.0 - (residual / scale) ** 2, 0.0) ** 2
    square = max(float(found[0]), 1e-6)
    variance = float(np.clip(found[2], 1.0 / 12.0, None))
    return Beam(float(np.sqrt(square / usual)), float(np.clip(found[1] / square, -1.0, 3.0)), middle, variance)


def footprint(found: Slopes, asked: Lattice, ranged: Bools) -> float:
    """One sigma of the stripe on the surface, mm, in the direction in which its pixels cross it: median of ``ranged`` (n, L).

    The measured width without the lens's blur, in pixels, times how far a pixel moves on the surface. Where the surface is
    next to nowhere known, as on a rough part alone, the plane through all points stands for it. NaN where nothing tells.
    ``asked`` holds the frames of ``found`` alone.
    """
    normal = found.table[..., surface.NORMAL : surface.NORMAL + 3]
    seen = ranged & np.isfinite(asked.sigma)
    if found.moves and np.count_nonzero(seen) >= 50 and np.isfinite(normal[seen][:, 0]).mean() < 0.05:
        normal = np.broadcast_to(fit_plane(asked.points[seen]).normal, normal.shape)
    seen &= np.isfinite(normal[..., 0])
    f, i = (place[:: max(1, seen.shape[1] // ENOUGH)] for place in np.nonzero(seen))
    if len(f) == 0:
        return float("nan")
    n, moved, view = normal[f, i], asked.moved[f, i], asked.view[f, i]
    rise = np.einsum("ni,ni->n", n, moved) / np.einsum("ni,ni->n", n, view)
    stride = np.linalg.norm(moved - rise[:, None] * view, axis=1)
    return float(np.median(np.sqrt(np.maximum(asked.width[f, i] ** 2 - found.beam.blur, 0.0)) * stride))


@compiled
def answer_to_skew(peak: float, gain: float, dark: float, speckle: float, answers: Array) -> float:
    """rho: displacement of a Gaussian fit, in sigma, by a unit of He3 in the profile.

    The weights are 1 / (dark + peak G / gain + (speckle peak G)^2); the answer depends on both ratios to ``dark``, and is
    looked up in ``answers``, those of `skews`.
    """
    last = answers.shape[0] - 1
    q = min(max(peak / (gain * dark), 1e-3), 1e3)
    r = min(max((speckle * peak) ** 2 / dark, 1e-3), 1e3)
    k = min((math.log10(q) + 3.0) / 6.0 * last, last - 1e-3)
    m = min((math.log10(r) + 3.0) / 6.0 * last, last - 1e-3)
    i, j = int(k), int(m)
    low = answers[i, j] + (k - i) * (answers[i + 1, j] - answers[i, j])
    high = answers[i, j + 1] + (k - i) * (answers[i + 1, j + 1] - answers[i, j + 1])
    return float(low + (m - j) * (high - low))


@cache
def skews() -> Array:
    """Answers (25, 25) to skew over the logarithms of both ratios, -3 to 3."""
    ratio = np.linspace(-3.0, 3.0, 25)
    u = np.linspace(-4.0, 4.0, 401)
    g = np.exp(-0.5 * u**2)
    weight = g**2 / (1.0 + 10.0 ** ratio[:, None, None] * g + 10.0 ** ratio[None, :, None] * g**2)
    return np.asarray((weight * u * (u**3 - 3.0 * u)).sum(axis=2) / (weight * u * u).sum(axis=2))


def _stride(lattice: Lattice) -> tuple[int, int]:
    """Frames and lines from one point of a patch to the next."""
    with np.errstate(invalid="ignore"):  # one line in eight says enough
        spread = lattice.width[:, ::8] * np.linalg.norm(lattice.moved[:, ::8], axis=2)
    known = np.isfinite(spread)
    wide = SPAN * float(np.median(spread[known])) if known.any() else 1.0
    frames, lines = (wide / max(lattice.step(axis), 1e-9) / surface.HALF for axis in (0, 1))
    return int(np.clip(np.rint(frames), 1, MOST[0])), int(np.clip(np.rint(lines), 1, MOST[1]))
