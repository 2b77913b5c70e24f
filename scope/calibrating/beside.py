"""Marks of a grid that stand so far beside their places that they got no label."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array
from calibration.rays import BadMarks, PlaneMarks, fit_plane_map
from calibration.verification import Fault, of_marks

_NEAR = 0.4  # of the pitch: a spot as near to the place of a mark that is missing is that mark
_ENOUGH = 20  # marks whose map tells where a missing one should be


def beside_the_grid(strays: Array | None, marks: PlaneMarks, points: Array) -> tuple[Fault, ...]:
    """Spots beside the place of a mark that was not found: that mark, off by more than the labels allow.

    Parameters
    ----------
    strays : (s, 2) array, px
        Spots that look like marks and got no label.
    marks : PlaneMarks
        Those that did.
    points : (m, 3) array, mm
        All marks of the target, in its frame.

    Returns
    -------
    tuple of Fault
        One a mark, where the map of the labelled marks puts a spot less than `_NEAR` of the way to the next mark from one that is
        missing. None from fewer than twenty labelled marks.
    """
    if strays is None or not len(strays) or len(marks) < _ENOUGH:
        return ()
    fit = fit_plane_map(marks, tilted=True)
    missing = np.setdiff1d(np.arange(len(points)), marks.mark)
    away = np.linalg.norm(fit.map.plane_points(strays)[:, None] - points[None, :, :2], axis=2)
    nearest = away.argmin(axis=1)
    pitch = np.sort(np.linalg.norm(points[:, :2] - points[0, :2], axis=1))[1]
    mine = np.isin(nearest, missing) & (away.min(axis=1) < _NEAR * pitch)
    nearest, once = np.unique(nearest[mine], return_index=True)
    seen = strays[mine][once]
    stray = PlaneMarks(
        marks.name, seen, points[nearest, :2], marks.c_from_plane, nearest, np.full((len(seen), 2, 2), np.nan)
    )
    offset = (fit.map.plane_points(seen) - stray.points)[:, :, None]
    size = np.linalg.norm(np.linalg.inv(fit.map.jacobian(seen)) @ offset, axis=1)[:, 0]
    sigma = np.full(len(seen), fit.loo_px / np.sqrt(2.0))
    return of_marks(stray, BadMarks(np.ones(len(seen), dtype=bool), size, sigma))
