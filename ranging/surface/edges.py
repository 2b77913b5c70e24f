"""Finds the points that an edge has displaced, and refines the others by the slope of their surface.

Where a surface ends, or its neighbour hides or shades it, the camera sees part of the stripe's width, and the point is off
by up to half of it. On a lattice such points are suspects: they have no smooth patch of their own. Suspects are measured a
second time, by the passage of the sheet through the frames, which errs to the other side; how far the answers differ tells
whether a suspect can be kept. A rough surface is no reason to reject anything: there no patch is smooth, and the points
stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import compiled
from calibration.geometry import Array, Bools, Codes
from calibration.reason import Reason
from ranging.surface import patches as surface
from ranging.surface.lattice import Lattice
from ranging.surface.slope import Slopes, footprint, slopes
from ranging.surface.spacetime import TAPS, Timeframe, follow_points

AWAY = 4.0  # standard deviations from the nearest smooth patch, beyond which a point belongs to none
FRAMES, LINES = 3, 2  # distances from the end of the surface at which a point that belongs to no patch is kept
STEEPEST = 4.0  # rise over run, along the ray, beyond which neighbours are not on one surface
FAR = 9
HALF = 0.8  # mean of half a Gaussian, in its standard deviations
HIDDEN = 0.3  # of the difference that half a stripe would cause: beyond, a point is no part of a result
LEFT = 0.3  # of the difference of two answers: what their mean still errs by


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Frames of a lattice after correction, (n, L, ...) each; rows without a point are NaN, and ``reason`` says why."""

    points: Array  # (n, L, 3) mm, in the cloud frame
    position: Array  # (n, L) px
    sigma: Array  # (n, L) mm along the ray
    reason: Codes  # (n, L)
    footprint: float  # mm, one sigma of the stripe on the surface; NaN where unknown
    corrected: (
        float  # mean share (0 to 1) of what slope and curvature displaced that was taken off; NaN without a point
    )


def refine(
    lattice: Lattice,
    first: int,
    last: int,
    timeframes: Sequence[Timeframe | None] = (),
    *,
    blur_px: float = math.nan,
) -> Refined:
    """Correct and judge frames ``first`` to ``last`` - 1 of a lattice.

    Parameters
    ----------
    lattice : Lattice
        With `lattice.CONTEXT` frames before and after those asked for, where there are as many: each frame's answer
        depends on no more.
    first, last : int
        Rows of the lattice.
    timeframes : sequence of Timeframe, optional
        Of each frame of the lattice, as for `follow_points`; without them points are judged by their neighbours alone.
    blur_px : float
        One sigma of lens and pixel; NaN where the calibration does not tell.

    Returns
    -------
    Refined
        A point of a smooth patch is corrected for its slope. Other points are measured a second time, by the passage of the
        sheet. Where the two answers are too far apart, or the surface ends within ``LINES`` lines, the reason is EDGE; else
        they are joined, but for points of a rough surface on which they agree. Without a second answer it is EDGE where the
        point lies off the patch beside it, and, if there is no patch, where the surface ends within ``FRAMES``
        frames or ``LINES`` lines. In a capture without motion, and of a single frame, nothing is corrected or rejected.
    """
    rows = slice(first, last)
    found = slopes(lattice, first, last, blur_px=blur_px)
    reason = lattice.reason[rows].copy()
    points, position, sigma = lattice.points[rows].copy(), lattice.position[rows].copy(), lattice.sigma[rows].copy()
    view, sheet, moved = lattice.view[rows], lattice.sheet[rows], lattice.moved[rows]
    steep = np.einsum("fli,fli->fl", sheet, view)
    weight = np.zeros(reason.shape)
    if found.moves:
        fit = found.table
        belongs = fit[..., surface.MISFIT] < surface.SMOOTH
        suspect = ~(belongs & (fit[..., surface.OWN] == 1.0))  # a wide patch of its own has no end near by
        ends = np.full((2, *sigma.shape), FAR, dtype=np.int64)
        nearest_end(lattice.points, lattice.view, lattice.sigma, first, last, suspect, ends)
        at_end = (ends[0] < FRAMES) | (ends[1] < LINES)
        cut = np.where(belongs, np.abs(fit[..., surface.AWAY]) > AWAY, at_end) | (ends[0] < 1) | (ends[1] < 1)
        if len(timeframes) and found.beam.width > 0.0:
            second = measure_again(lattice, found, timeframes, suspect & (reason == Reason.RANGED), first, last)
            known = np.isfinite(second.offset)
            joined = known & (belongs | at_end | second.unlike)
            weight = np.where(joined, second.weight, 0.0)
            points -= np.where(joined, weight * second.offset / steep, 0.0)[..., None] * view
            sigma = np.where(joined, second.sigma / np.abs(steep), sigma)
            cut = np.where(known, second.apart | (ends[1] < LINES), cut)
        reason[cut & (reason == Reason.RANGED)] = Reason.EDGE
    ranged = reason == Reason.RANGED
    shift, left, share = (np.where(ranged, values, 0.0) for values in found.correction(weight))
    with np.errstate(invalid="ignore", divide="ignore"):
        along = np.einsum("fli,fli->fl", sheet, moved) / steep
        points -= shift[..., None] * (moved - along[..., None] * view)
        sigma = np.hypot(sigma, left * np.abs(along))
    position -= shift
    for values in (points, position, sigma):
        values[~ranged] = np.nan
    across = footprint(found, lattice.rows(first, last), ranged)
    return Refined(points, position, sigma, reason, across, float(share[ranged].mean()) if ranged.any() else np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Second:
    """Points measured a second time: (n, L) arrays, NaN or zero where that was not asked for or not possible."""

    offset: Array  # mm along the sheet's normal: the surface lies so far before the sheet at the point's pixel
    weight: Array  # of this answer, beside the first
    sigma: Array  # mm along the sheet's normal, of both answers joined
    unlike: Bools  # the answers differ by more than their noise
    apart: Bools  # the answers differ by more than an edge may explain that hides a small part of the stripe


def measure_again(
    lattice: Lattice, found: Slopes, timeframes: Sequence[Timeframe | None], doubtful: Bools, first: int, last: int
) -> Second:
    """Measure ``doubtful`` (n, L) points by the passage of the sheet, and see what both answers say of each other.

    The weights are those with which the errors of both cancel (see `ranging.surface.spacetime`). Where the stripe is cut in half,
    each answer errs by the mean of half a Gaussian, 0.8 of the sheet's width and of the blur, to opposite sides; what they
    differ beyond their noise and beyond what the slope explains measures how much is hidden.
    """
    rows = slice(first, last)
    slope = np.abs(found.table[..., surface.LEAVING])
    known = np.isfinite(slope)
    slope = np.where(known, slope, np.median(slope[known]) if known.any() else np.nan)
    sheet, blur = found.sheet, slope * np.sqrt(found.beam.blur + TAPS)
    width = np.hypot(sheet, blur)
    passed = follow_points(lattice, timeframes, doubtful, width, first, last)
    weight = np.where(np.isfinite(passed.offset), (sheet / width) ** 2, 0.0)
    own = lattice.sigma[rows] * np.abs(np.einsum("fli,fli->fl", lattice.sheet[rows], lattice.view[rows]))
    with np.errstate(invalid="ignore"):
        explained = found.table[..., surface.LEAVING] * (found.passage - found.profile)
        gap = np.abs(passed.offset - np.where(np.isfinite(explained), explained, 0.0))
        spread = np.hypot(own, passed.sigma)
        apart = gap > HIDDEN * HALF * (sheet + blur) + 2.0 * spread
        noise = np.hypot((1.0 - weight) * own, weight * passed.sigma)
        sigma = np.hypot(noise, LEFT * np.maximum(gap - spread, 0.0))
    return Second(passed.offset, weight, sigma, gap > 3.0 * spread, apart)


@compiled
def nearest_end(
    points: Array, view: Array, sigma: Array, first: int, last: int, wanted: Bools, ends: NDArray[np.int64]
) -> None:  # fmt: skip
    """Steps from each ``wanted`` (n, L) point to the end of its surface, over frames ``ends[0]`` and over lines ``ends[1]``; FAR at most.

    A surface ends where the next point is missing or lies behind or before; the border of the lattice is no end, nor is a
    frame without any point: it was lost, or the laser was off.
    """
    frames, lines = sigma.shape
    lost = np.zeros(frames, dtype=np.bool_)
    for f in range(frames):
        lost[f] = not np.any(sigma[f] > 0.0)
    for f in range(first, last):
        for i in range(lines):
            if not (wanted[f - first, i] and sigma[f, i] > 0.0):
                continue
            for axis in range(2):
                for way in (-1, 1):
                    g, j = f, i
                    for n in range(FAR):
                        h, k = (g + way, j) if axis == 0 else (g, j + way)
                        if h < 0 or h >= frames or k < 0 or k >= lines or lost[h]:
                            break
                        if not _joined(points[g, j], points[h, k], view[g, j], sigma[g, j] + sigma[h, k]):
                            ends[axis, f - first, i] = min(n, ends[axis, f - first, i])
                            break
                        g, j = h, k


@compiled
def _joined(here: Array, there: Array, ray: Array, sigma: float) -> bool:
    x, y, z = there[0] - here[0], there[1] - here[1], there[2] - here[2]
    rise = x * ray[0] + y * ray[1] + z * ray[2]
    run = np.sqrt(max(x * x + y * y + z * z - rise * rise, 0.0))
    return bool(abs(rise) <= STEEPEST * run + 4.0 * sigma)
