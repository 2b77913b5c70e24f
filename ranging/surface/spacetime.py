"""When the sheet of light passes a point of the object: a second measurement of it, from the frames about its own.

A line's profile is a picture of the sheet on a stretch of surface, and what the surface does there displaces it. A point
that is followed through the frames sees the sheet pass over it with one reflectance, one slope and one view of the laser
(B. Curless & M. Levoy, "Better optical triangulation through spacetime analysis", ICCV 1995): its light is a Gaussian in
the distance between point and sheet, whatever lies beside it. Only the lens still mixes it with its neighbours.

The errors of the two are opposite. Let x be the pixel across the stripe, a x the distance of the surface from the sheet, g
the relative growth of its light with x, s0 the sheet's width and c the blur of lens and pixel, all in px: the profile is
displaced by s0^2 g, the passage by -c^2 g; a surface that ends displaces both in the same two ways. With the weights c^2 and
s0^2 what they have in common remains, and their difference tells how far a point can be trusted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calibration.compiled import compiled
from calibration.geometry import Array, Bools, Ints, Pose
from ranging.background import Image
from ranging.stripe import Lines
from ranging.surface.lattice import Lattice

REACH = 5  # frames before and after that a point is followed through
TAPS = 0.25  # px^2, variance of the quadratic B-spline with which images are read between pixels
WINDOW = 2.5  # widths of the passage, either side of its middle, that are fitted
FAR = 80.0  # px; a point that moves farther between frames is not followed
GIVE = 0.2  # of its logarithm: how far the width may be from what the sheet and the blur let expect
STEPS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Timeframe:
    """A frame as it was taken, and what is needed to follow points through it."""

    image: Image  # (rows, columns) the stripe's channel
    dark: Image | None  # the same with the laser off
    along: str  # "rows" or "columns": the axis of the image along which the stripe runs
    saturation: float  # grey level at which the camera clips
    cloud_from_c: Pose
    slide: Array  # (L, 3) mm/px, of the ray at the frame's points when the pixel moves along the stripe; cloud frame
    floor: Array  # (L,) grey levels under the stripe


@dataclass(frozen=True, slots=True, eq=False)
class Passages:
    """When the sheet passed points of n frames, as distances; NaN where that is not known."""

    offset: Array  # (n, L) mm of the sheet along its normal, beyond the place it had in the point's own frame
    sigma: Array  # (n, L) mm, one standard deviation from the noise of the camera
    misfit: Array  # (n, L) chi squared a degree of freedom


def follow_points(
    lattice: Lattice, timeframes: Sequence[Timeframe | None], wanted: Bools, width: Array, first: int, last: int
) -> Passages:
    """Follow points of frames ``first`` to ``last`` - 1 of a lattice through the frames about them.

    Parameters
    ----------
    lattice : Lattice
    timeframes : sequence of Timeframe
        One a frame of the lattice; None where it is not held: it is not looked at then.
    wanted : (n, L) array
        Points to follow, of the frames asked for.
    width : (n, L) array, mm
        One sigma that the passage should have: of the sheet and, times the surface's slope to it, of the blur.
    first, last : int
        Rows of the lattice.

    Returns
    -------
    Passages
        NaN where fewer than three frames show the passage or all of them one side of it: the sheet moves too far from
        frame to frame, or along itself.
    """
    shape = wanted.shape
    offset, sigma, misfit = (np.full(shape, np.nan) for _ in range(3))
    slots = 2 * REACH + 1
    for f in range(first, last):
        row = f - first
        own = timeframes[f]
        lines = np.flatnonzero(wanted[row] & np.isfinite(lattice.sigma[f]) & np.isfinite(width[row]))
        if own is None or len(lines) == 0:
            continue
        seen = np.full((3, len(lines), slots), np.nan)  # distance of the sheet, light, variance a unit of noise
        for slot in range(slots):
            g = f + slot - REACH
            other = timeframes[g] if 0 <= g < len(timeframes) else None
            if other is not None and other.image.shape == own.image.shape:
                _watch(lattice, f, own, other, lines, seen[:, :, slot])
        noise = lattice.noise[f]
        answers = np.full((3, len(lines)), np.nan)
        samples = (seen[0], seen[1] - own.floor[lines, None], seen[2])
        camera = (float(noise[0]), float(noise[1]), float(noise[2]))
        fit_passages(samples, lattice.peak[f, lines], width[row, lines], camera, answers)
        offset[row, lines], sigma[row, lines], misfit[row, lines] = answers
    return Passages(offset, sigma, misfit)


def _watch(lattice: Lattice, f: int, own: Timeframe, other: Timeframe, lines: Ints, seen: Array) -> None:
    turn = own.cloud_from_c.rotation @ other.cloud_from_c.rotation.T
    image = other.image
    rows, columns = image.shape
    layout = (columns, rows, 1, columns) if own.along == "rows" else (rows, columns, columns, 1)
    dark = image.ravel()[:0] if other.dark is None else other.dark.ravel()
    watch(
        Lines(image.ravel(), dark, layout, float(other.saturation)),
        lines,
        _Points(lattice.points[f], lattice.view[f], lattice.moved[f], own.slide, lattice.sheet[f], lattice.position[f]),
        (turn, own.cloud_from_c.translation, other.cloud_from_c.translation),
        seen,
    )


class _Points(NamedTuple):
    """The points of one frame, in the cloud frame."""

    points: Array  # (L, 3) mm
    rays: Array  # (L, 3) unit
    moved: Array  # (L, 3) mm/px, of the ray when its pixel moves across the stripe
    slide: Array  # (L, 3) mm/px, likewise along it
    sheet: Array  # (L, 3) unit normals of the sheet
    position: Array  # (L,) px


@compiled
def watch(other: Lines, lines: Ints, own: _Points, motion: tuple[Array, Array, Array], seen: Array) -> None:
    """What another frame shows of the points on some lines of a frame.

    ``motion``, turn (3, 3), here and there (3,), puts a point where the object was in the other frame, in axes of this
    one: turn (x - there) - (x - here). The point's pixel moves along ``moved`` and ``slide``, and what is left along its
    ray does not show. ``seen`` (3, n) receives the distance that the point has moved off the sheet, its light, and the
    variance of the light over that of a pixel.
    """
    pixels, dark, (count, length, line_step, pixel_step), saturation, _ = other
    points, rays, moved, slide, sheet, position = own
    turn, here, there = motion
    taps = np.zeros(3)
    for k in range(len(lines)):
        i = lines[k]
        d = np.zeros(3)
        for r in range(3):
            d[r] = here[r] - points[i, r]
            for c in range(3):
                d[r] += turn[r, c] * (points[i, c] - there[c])
        off = d[0] * sheet[i, 0] + d[1] * sheet[i, 1] + d[2] * sheet[i, 2]
        m, s, v = moved[i], slide[i], rays[i]
        sv0, sv1, sv2 = s[1] * v[2] - s[2] * v[1], s[2] * v[0] - s[0] * v[2], s[0] * v[1] - s[1] * v[0]
        vm0, vm1, vm2 = v[1] * m[2] - v[2] * m[1], v[2] * m[0] - v[0] * m[2], v[0] * m[1] - v[1] * m[0]
        volume = m[0] * sv0 + m[1] * sv1 + m[2] * sv2
        across = (d[0] * sv0 + d[1] * sv1 + d[2] * sv2) / volume
        beside = (d[0] * vm0 + d[1] * vm1 + d[2] * vm2) / volume
        if not (abs(across) < FAR and abs(beside) < FAR):
            continue
        x, line = position[i] + across, i + beside
        j, n = int(np.floor(x + 0.5)), int(np.floor(line + 1e-6))
        part = max(line - n, 0.0)
        if j < 1 or j > length - 2 or n < 0 or n > count - 1 or (part > 1e-5 and n > count - 2):
            continue
        u = x - j
        taps[0], taps[1], taps[2] = 0.5 * (0.5 - u) ** 2, 0.75 - u * u, 0.5 * (0.5 + u) ** 2
        light, square = 0.0, 0.0
        whole = True
        for b in range(2 if part > 1e-5 else 1):
            share = part if b == 1 else 1.0 - part
            for a in range(3):
                at = (n + b) * line_step + (j + a - 1) * pixel_step
                whole = whole and pixels[at] < saturation
                value = np.float64(pixels[at])
                if dark.size > 0:
                    value -= np.float64(dark[at])
                weight = share * taps[a]
                light += weight * value
                square += weight * weight
        if whole:
            seen[0, k], seen[1, k], seen[2, k] = off, light, square


@compiled
def fit_passages(
    samples: tuple[Array, Array, Array],
    peak: Array,
    width: Array,
    camera: tuple[float, float, float],
    answers: Array,
) -> None:
    """Gaussians of the light (n, slots) over the distance that n points have moved off the sheet; NaN is no sample.

    ``samples`` are distance, light, and its variance over that of a pixel; ``camera`` is gain, variance of a dark pixel
    and contrast of the speckle. Weighted least squares for height, place and logarithm of the width, the last held near ``width`` (n,) by `GIVE`.
    ``answers`` (3, n) receives place, its standard deviation, and chi squared a degree of freedom.
    """
    (distance, light, factor), (gain, dark, speckle) = samples, camera
    n, slots = distance.shape
    for i in range(n):
        a, o, w = peak[i], 0.0, width[i]
        good = True
        f = np.zeros((3, 3))
        used, chi = 0, 0.0
        for step in range(STEPS):
            f[:] = 0.0
            f[2, 2] = 1.0 / (GIVE * GIVE)
            t0 = t1 = 0.0
            t2 = -math.log(w / width[i]) / (GIVE * GIVE)
            used, chi = 0, 0.0
            before = behind = False
            for k in range(slots):
                u = (distance[i, k] - o) / w
                if not abs(u) < WINDOW:
                    continue
                used += 1
                before = before or u < 0.0
                behind = behind or u > 0.0
                g = math.exp(-0.5 * u * u)
                m = max(a, 1.0) * g
                weight = 1.0 / (factor[i, k] * (dark + m / gain) + (speckle * m) ** 2)
                r = light[i, k] - a * g
                d0, d1, d2 = g, a * g * u / w, a * g * u * u
                f[0, 0] += weight * d0 * d0
                f[0, 1] += weight * d0 * d1
                f[0, 2] += weight * d0 * d2
                f[1, 1] += weight * d1 * d1
                f[1, 2] += weight * d1 * d2
                f[2, 2] += weight * d2 * d2
                t0 += weight * d0 * r
                t1 += weight * d1 * r
                t2 += weight * d2 * r
                chi += weight * r * r
            good = used >= 3 and before and behind
            if not good:
                break
            c00 = f[1, 1] * f[2, 2] - f[1, 2] * f[1, 2]
            c01 = f[0, 2] * f[1, 2] - f[0, 1] * f[2, 2]
            c02 = f[0, 1] * f[1, 2] - f[0, 2] * f[1, 1]
            c11 = f[0, 0] * f[2, 2] - f[0, 2] * f[0, 2]
            c12 = f[0, 1] * f[0, 2] - f[0, 0] * f[1, 2]
            c22 = f[0, 0] * f[1, 1] - f[0, 1] * f[0, 1]
            determinant = f[0, 0] * c00 + f[0, 1] * c01 + f[0, 2] * c02
            good = determinant > 0.0
            if not good:
                break
            da = (c00 * t0 + c01 * t1 + c02 * t2) / determinant
            do = (c01 * t0 + c11 * t1 + c12 * t2) / determinant
            dw = (c02 * t0 + c12 * t1 + c22 * t2) / determinant
            if step == STEPS - 1 or abs(do) < 0.003 * w:
                answers[0, i] = o + do
                answers[1, i] = math.sqrt(c11 / determinant)
                answers[2, i] = chi / max(used - 2, 1)
                break
            a = max(a + da, 0.3 * a)
            o += min(max(do, -0.5 * w), 0.5 * w)
            w *= math.exp(min(max(dw, -0.3), 0.3))
