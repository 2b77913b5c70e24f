"""Covariances of poses in the order of files: the place first."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array


def by_place_first(covariance: Array) -> Array:
    """Covariance (6, 6) of (shift, turn) from that of (turn, shift)."""
    order = [3, 4, 5, 0, 1, 2]
    return np.asarray(covariance[np.ix_(order, order)])
