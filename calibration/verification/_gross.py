"""Planes misplaced by so much that nothing is linear about them: where the search for faults starts.

The modes of `calibration.verification.misplacement` are first order. A target that slipped by centimetres or an offset typed with two
digits exchanged is found coarsely first: the plane, or the two, without which the others agree, put back by its pose
before their rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array
from calibration.rays import PlaneMarks, RayField, fit_ray_field, locate_target
from calibration.verification import misplacement as placement
from calibration.verification.misplacement import MODES, ROTATION, SLIP_X, SLIP_Y, STAND_OFF, TILT_X, TILT_Y
from calibration.verification.mix_ups import coarse_misfit

GROSS_PX = 1.0  # coarse misfit of all planes: less, and the modes are linear enough
AGREE_PX = 0.5  # coarse misfit of planes that agree: what a cubic leaves of a strong lens
BETTER = 0.1  # of the misfit of all planes: as little must be left without the culprits


def coarse_starts(planes: Sequence[PlaneMarks], basis: RayField) -> list[Array]:
    """Amounts (n, 7), as of `placement.modes`, from which the search for faults may start, one array a guess.

    Zero where nothing is gross, or where no one or two planes explain the misfit. With three planes any one could be the
    culprit: each gives a start.
    """
    nothing = np.zeros((len(planes), MODES))
    if len(planes) < 3:
        return [nothing]
    whole = coarse_misfit(planes, basis.c_from_d)
    if whole < GROSS_PX:
        return [nothing]
    starts = []
    for culprits in _culprits(planes, basis.c_from_d, whole):
        start = nothing.copy()
        for k in culprits:
            start[k] = _located(planes, culprits, k, basis)
        if np.isfinite(start).all():
            starts.append(start)
    return starts or [nothing]


def _culprits(planes: Sequence[PlaneMarks], c_from_d: Array, whole: float) -> list[tuple[int, ...]]:
    """Sets of planes without which the others agree, the likeliest first: single planes, then pairs of five or more."""
    n = len(planes)
    for size in (1, 2):
        if n - size < 3 and n > 3:
            break
        left = {
            out: coarse_misfit([p for k, p in enumerate(planes) if k not in out], c_from_d)
            for out in combinations(range(n), size)
        }
        good = sorted((m, out) for out, m in left.items() if m < max(AGREE_PX, BETTER * whole))
        if good:
            return [out for _, out in good[:3]]
    return []


def _located(planes: Sequence[PlaneMarks], culprits: tuple[int, ...], k: int, basis: RayField) -> Array:
    """Amounts (7,) that put a plane where the rays of the innocent ones see it; NaN where they see it nowhere."""
    innocent = [p for i, p in enumerate(planes) if i not in culprits]
    plane = planes[k]
    try:
        located = locate_target(fit_ray_field(innocent, orders=(3, 1)).field, plane)
    except (CalibrationError, ValueError, np.linalg.LinAlgError):
        return np.full(MODES, np.nan)
    return amounts_of(plane, located, basis)


def amounts_of(stated: PlaneMarks, located: PlaneMarks, basis: RayField) -> Array:
    """Amounts (7,) of `placement.put_right` that move a plane from where it is stated to where it is located."""
    moved = stated.c_from_plane.inverse @ located.c_from_plane
    centre = np.append(placement.middle(stated), 0.0)
    axis = stated.c_from_plane.rotation.T @ basis.c_from_d[:, 2]
    shift = moved.apply(centre[None])[0] - centre
    amounts = np.zeros(MODES)
    amounts[STAND_OFF] = shift[2] / axis[2]
    amounts[[SLIP_X, SLIP_Y]] = (shift - amounts[STAND_OFF] * axis)[:2]
    amounts[[TILT_X, TILT_Y, ROTATION]] = cv2.Rodrigues(moved.rotation)[0].ravel()
    return amounts
