"""Gaussian filters of surface texture over maps with gaps (ISO 16610-21 and -61), and roughness from place to place."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from calibration.geometry import Array
from scope.errors import MeasurementError
from scope.heightmap.heights import HeightMap

ALPHA = math.sqrt(math.log(2.0) / math.pi)  # half the amplitude passes at the nesting index (ISO 16610-21, 4.2)
# Nesting indices, mm (ISO 25178-3): the series 1, 2, 2.5, 5, 8.
NESTING = tuple(round(factor * 10.0**power, 6) for power in range(-4, 3) for factor in (1.0, 2.0, 2.5, 5.0, 8.0))
SAMPLES_PER_INDEX = 3.0  # an S-filter spans three samples or more (ISO 25178-3)


class Smoothed(NamedTuple):
    """What a Gaussian filter passed, and how much of its window it had."""

    z: Array  # (rows, columns) mm, NaN where the window holds next to nothing
    support: Array  # (rows, columns) share (0 to 1) of the filter's weight that fell on known heights


def gaussian(z: Array, pitch: tuple[float, float], nesting: tuple[float, float]) -> Smoothed:
    """Gaussian-weighted mean of heights (rows, columns) mm with the nesting index (down, along) mm; 0 leaves it be.

    A normalised convolution: the weights that fall into gaps and over the border are left out and the others scaled
    up to one. Where less than a quarter of the weight is left the result is NaN.
    """
    from scipy.ndimage import gaussian_filter

    spread = [ALPHA * index / p / math.sqrt(2.0 * math.pi) for index, p in zip(nesting, pitch, strict=True)]
    known = np.isfinite(z)
    options = {"sigma": spread, "mode": "constant", "truncate": 4.0}
    weight = gaussian_filter(known.astype(np.float64), **options)
    total = gaussian_filter(np.where(known, z, 0.0), **options)
    return Smoothed(np.divide(total, weight, out=np.full(z.shape, np.nan), where=weight >= 0.25), weight)


def s_filter(heights: HeightMap, index: float) -> HeightMap:
    """Take away what is shorter than the nesting index (mm): ISO 25178-2's S-filter. Gaps stay gaps.

    ``MeasurementError`` where the index is not sampled by at least two pitches, or is longer than the patch.
    """
    coarse = max(heights.pitch)
    if index < 2.0 * coarse:
        raise MeasurementError(
            f"the S-filter of {index:g} mm is finer than the pitch of {coarse:.3g} mm can carry; "
            f"give --s-filter {least_s_index(heights.pitch):g} or more, or scan with smaller steps"
        )
    _fits(heights, index, "S-filter")
    smooth = gaussian(heights.z, heights.pitch, (index, index))
    z = np.where(heights.known, smooth.z, np.nan)
    return heights.with_heights(z, filters=(*heights.filters, _told("S", index, heights, smooth.support)))


def l_filter(heights: HeightMap, index: float) -> HeightMap:
    """Take away what is longer than the nesting index (mm): ISO 25178-2's L-filter. Gaps stay gaps.

    ``MeasurementError`` where the index is longer than the patch.
    """
    _fits(heights, index, "L-filter")
    smooth = gaussian(heights.z, heights.pitch, (index, index))
    return heights.with_heights(
        heights.z - smooth.z, filters=(*heights.filters, _told("L", index, heights, smooth.support))
    )


def least_s_index(pitch: tuple[float, float]) -> float:
    """Least nesting index (mm) of the standard's series that a pitch (down, along) mm supports."""
    need = SAMPLES_PER_INDEX * max(pitch)
    return next((index for index in NESTING if index >= need * (1.0 - 1e-9)), need)


def local_roughness(z: Array, pitch: tuple[float, float], window: float) -> Array:
    """Sq from place to place (rows, columns) mm: rms height in a Gaussian window of ``window`` mm nesting index.

    Heights are taken about the local mean, so that a step between two finishes does not count as roughness.
    """
    index = (window, window)
    mean = gaussian(z, pitch, index).z
    square = gaussian(z * z, pitch, index).z
    return np.sqrt(np.maximum(square - mean**2, 0.0))


def _fits(heights: HeightMap, index: float, name: str) -> None:
    side = min(heights.size)
    if not 0.0 < index <= side:
        raise MeasurementError(
            f"the {name} of {index:g} mm is longer than the patch ({side:.3g} mm on its shorter side); "
            "choose a larger region or a shorter nesting index"
        )


def _told(name: str, index: float, heights: HeightMap, support: Array) -> str:
    """Say what was done and how much of the map lies near a border or a gap."""
    short = float((support[heights.known] < 0.95).mean()) if heights.known.any() else 0.0
    return f"{name}-filter Gaussian {index:g} mm (ISO 16610-61); end effects on {100.0 * short:.1f} % of the heights"
