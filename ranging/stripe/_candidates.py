"""Several peaks on a line: which of them is the stripe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import compiled
from calibration.geometry import Array
from ranging.stripe._peak_kernels import Pixels
from ranging.stripe._table import Layout

MOST = 6  # peaks that are remembered on a line
APART = 10  # px, least distance between two peaks
SHARE = 0.3  # of the strongest peak above the mean of the line; lower peaks are not looked at
LEAP = 40.0  # px; a longer step between lines costs no more than this one
STEP = 3.0  # px; a step of this length costs as much as a peak e times fainter


@compiled
def find_peaks(
    pixels: Pixels,
    dark: Pixels,
    layout: Layout,
    threshold: float,
    places: NDArray[np.int32],
    values: Array,
) -> None:
    """Find the strongest peaks of every line, in the order of their place.

    ``places`` and ``values`` (N, MOST) receive px and grey levels above the mean of the line; -1 and 0 where there are
    fewer.
    """
    count, length, line_step, pixel_step = layout
    line = np.empty(length)
    for i in range(count):
        mean = 0.0
        for j in range(length):
            at = i * line_step + j * pixel_step
            line[j] = pixels[at]
            if dark.size > 0:
                line[j] -= dark[at]
            mean += line[j]
        mean /= length
        strongest = 0.0
        for k in range(MOST):
            places[i, k] = -1
            values[i, k] = 0.0
        for k in range(MOST):
            best = 0
            for j in range(length):
                if line[j] > line[best]:
                    best = j
            value = line[best] - mean
            if k == 0:
                strongest = value
            if value < threshold or value < SHARE * strongest:
                break
            slot = k
            while slot > 0 and places[i, slot - 1] > best:
                places[i, slot] = places[i, slot - 1]
                values[i, slot] = values[i, slot - 1]
                slot -= 1
            places[i, slot] = best
            values[i, slot] = value
            for j in range(max(0, best - APART), min(length, best + APART + 1)):
                line[j] = -1e9


@compiled
def follow(places: NDArray[np.int32], values: Array, chosen: NDArray[np.int32]) -> None:
    """Choose the peaks (N,) that form the strongest and smoothest run from line to line (Viterbi); -1 where a line has none."""
    count = places.shape[0]
    cost = np.full((count, MOST), np.inf)
    origin = np.full((count, MOST), -1, np.int32)
    last = -1
    end = np.full(count, -1, np.int64)
    for i in range(count):
        chosen[i] = -1
        if places[i, 0] < 0:
            continue
        end[i] = last
        for k in range(MOST):
            if places[i, k] < 0:
                break
            faint = -np.log(values[i, k])
            if last < 0:
                cost[i, k] = faint
                continue
            for q in range(MOST):
                if places[last, q] < 0:
                    break
                step = abs(places[i, k] - places[last, q]) / (i - last)
                total = cost[last, q] + faint + min(step, LEAP) / STEP
                if total < cost[i, k]:
                    cost[i, k] = total
                    origin[i, k] = q
        last = i
    if last < 0:
        return
    k = 0
    for q in range(MOST):
        if cost[last, q] < cost[last, k]:
            k = q
    while last >= 0:
        chosen[last] = places[last, k]
        k = origin[last, k]
        last = end[last]
