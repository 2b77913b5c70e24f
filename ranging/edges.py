"""Finds the points that an edge has displaced, and refines the others by the slope of their surface.

Where a surface ends, or its neighbour hides or shades it, the camera sees part of the stripe's width, and the point is off
by up to half of it. On a lattice such points betray themselves: they belong to none of the smooth patches around them.
A rough surface is no reason to reject anything: there no patch is smooth, and the points stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Codes
from calibration.reason import Reason
from ranging import surface
from ranging.kernels import compiled
from ranging.lattice import Lattice
from ranging.slope import correct, footprint

AWAY = 4.0  # standard deviations from the nearest smooth patch, beyond which a point belongs to none
FRAMES, LINES = 3, 2  # distances from the end of the surface at which a point that belongs to no patch is kept
STEEPEST = 4.0  # rise over run, along the ray, beyond which neighbours are not on one surface
FAR = 9


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Frames of a lattice after correction, (n, L, ...) each; rows without a point are NaN, and ``reason`` says why."""

    points: Array  # (n, L, 3) mm, in the cloud frame
    position: Array  # (n, L) px
    sigma: Array  # (n, L) mm along the ray
    reason: Codes  # (n, L)
    footprint: Array  # (n, L) mm, one sigma of the stripe on the surface; NaN where unknown
    corrected: Array  # (n, L) share (0 to 1) of what slope and curvature displaced that was taken off


def refine(lattice: Lattice, first: int, last: int) -> Refined:
    """Correct and judge frames ``first`` to ``last`` - 1 of a lattice.

    Parameters
    ----------
    lattice : Lattice
        With `lattice.CONTEXT` frames before and after those asked for, where there are as many: each frame's answer
        depends on no more.
    first, last : int
        Rows of the lattice.

    Returns
    -------
    Refined
        A point has the reason EDGE where there are smooth patches around it and it belongs to none of them, and where
        there is none and the surface ends within ``FRAMES`` frames or ``LINES`` lines. In a capture without motion, and of a
        single frame, nothing is corrected and nothing rejected.
    """
    rows = slice(first, last)
    found = correct(lattice, first, last)
    reason = lattice.reason[rows].copy()
    points, position, sigma = lattice.points[rows].copy(), lattice.position[rows].copy(), lattice.sigma[rows].copy()
    if lattice.moves:
        ends = np.full((2, *sigma.shape), FAR, dtype=np.int64)
        nearest_end(lattice.points, lattice.view, lattice.sigma, first, last, ends)
        fit = found.table[rows]
        belongs = fit[..., surface.MISFIT] < surface.SMOOTH
        cut = np.where(belongs, np.abs(fit[..., surface.AWAY]) > AWAY, (ends[0] < FRAMES) | (ends[1] < LINES))
        cut |= (ends[0] < 1) | (ends[1] < 1)
        reason[cut & (reason == Reason.RANGED)] = Reason.EDGE
    ranged = reason == Reason.RANGED
    shift = np.where(ranged, found.shift[rows], 0.0)
    view, sheet = lattice.view[rows], lattice.sheet[rows]
    moved = lattice.moved[rows]
    with np.errstate(invalid="ignore", divide="ignore"):
        along = np.einsum("fli,fli->fl", sheet, moved) / np.einsum("fli,fli->fl", sheet, view)
        points -= shift[..., None] * (moved - along[..., None] * view)
        sigma = np.hypot(sigma, np.where(ranged, found.sigma[rows], 0.0) * np.abs(along))
    position -= shift
    across, corrected = footprint(found, lattice)[rows], found.share[rows].copy()
    for values in (points, position, sigma, across, corrected):
        values[~ranged] = np.nan
    return Refined(points, position, sigma, reason, across, corrected)


@compiled
def nearest_end(points: Array, view: Array, sigma: Array, first: int, last: int, ends: NDArray[np.int64]) -> None:
    """Steps from each point to the end of its surface, over frames ``ends[0]`` and over lines ``ends[1]``; FAR at most.

    A surface ends where the next point is missing or lies behind or before; the border of the lattice is no end, nor is a
    frame without any point: it was lost, or the laser was off.
    """
    frames, lines = sigma.shape
    lost = np.zeros(frames, dtype=np.bool_)
    for f in range(frames):
        lost[f] = not np.any(sigma[f] > 0.0)
    for f in range(first, last):
        for i in range(lines):
            if not sigma[f, i] > 0.0:
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
