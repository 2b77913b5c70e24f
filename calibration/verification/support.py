"""Where planes have marks around a pixel, so that a figure may join them there."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from calibration.geometry import Array, Bools
from calibration.rays import PlaneMarks

AROUND = 1.3  # by which the hull of a plane's marks is enlarged about its middle for planes that are left out


def surrounded(pixels: Array, marks: Array, *, enlarged: float = 1.0) -> Bools:
    """Mask (N,) of pixels (N, 2) px within the convex hull of marks (n, 2) px, enlarged about its middle.

    Marks on one line, or fewer than three, surround nothing.
    """
    hull = cv2.convexHull(marks.astype(np.float32))[:, 0].astype(np.float64)
    middle = hull.mean(axis=0)
    hull = middle + enlarged * (hull - middle)
    along = np.roll(hull, -1, axis=0) - hull
    turn = float((hull[:, 0] * np.roll(hull[:, 1], -1) - hull[:, 1] * np.roll(hull[:, 0], -1)).sum())
    if len(hull) < 3 or abs(turn) < 1e-6:
        return np.zeros(len(pixels), dtype=bool)
    inside = np.asarray(np.isfinite(pixels).all(axis=1))
    for start, edge in zip(hull, along, strict=True):
        away = pixels - start
        inside &= (edge[0] * away[:, 1] - edge[1] * away[:, 0]) * np.sign(turn) >= 0.0
    return np.asarray(inside)


def support_of(pixels: Array, planes: Sequence[PlaneMarks], *, enlarged: float = 1.0) -> Bools:
    """Masks (n, N): which of n planes have marks around each of N pixels."""
    return np.array([surrounded(pixels, plane.pixels, enlarged=enlarged) for plane in planes]).reshape(
        len(planes), len(pixels)
    )
