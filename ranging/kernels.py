"""Compiled passes over whole frames: where on each line the light is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[Any]  # (rows, columns) uint8 or uint16
Kernel = TypeVar("Kernel", bound=Callable[..., Any])

BLOCK = 16  # px; a line across the rows is folded into maxima of this many rows
FAST = {"contract", "reassoc", "nsz", "arcp"}  # never nnan: NaN is an answer


def compiled(function: Kernel) -> Kernel:
    """Compile without the interpreter lock, keeping the machine code on disk where a folder for it can be written."""
    try:
        return numba.njit(function, nogil=True, cache=True, fastmath=FAST)  # type: ignore[no-any-return]
    except RuntimeError:  # numba found no folder that it may write to
        return numba.njit(function, nogil=True, fastmath=FAST)  # type: ignore[no-any-return]


@compiled
def _highest(line: Pixels) -> int:
    top = line.dtype.type(0)
    for j in range(line.size):
        top = max(top, line[j])
    return top


@compiled
def peaks_of_rows(image: Pixels, dark: Pixels, has_dark: bool, half: int, order: Pixels, out: Pixels) -> None:
    """Where each row is brightest, and how bright it is farther than ``half`` from there.

    ``order`` is 0, 1, 2, ... as uint16, longer than a row; ``out`` (rows, 3) int32 receives place, value, second value.
    """
    rows, columns = image.shape
    lit = np.zeros(columns, image.dtype)
    for i in range(rows):
        line = image[i]
        if has_dark:
            off = dark[i]
            for j in range(columns):
                lit[j] = max(line[j], off[j]) - off[j]
            line = lit
        top = _highest(line)
        at = order[columns]
        for j in range(columns):
            hit = order[j] if line[j] == top else at
            at = min(at, hit)
        out[i, 0] = at
        out[i, 1] = top
        second = line.dtype.type(0)
        left = np.int64(at) - half
        right = np.int64(at) + half + 1
        if left > 0:
            second = _highest(line[:left])
        if right < columns:
            second = max(second, _highest(line[right:]))
        out[i, 2] = second


@compiled
def peaks_of_columns(image: Pixels, dark: Pixels, has_dark: bool, half: int, out: Pixels) -> None:
    """Where each column is brightest, and how bright it is farther than ``half`` from there; as `peaks_of_rows`."""
    rows, columns = image.shape
    count = (rows + BLOCK - 1) // BLOCK
    tops = np.zeros((count, columns), image.dtype)
    lit = np.empty(columns, image.dtype)
    for b in range(count):
        top = tops[b]
        for i in range(b * BLOCK, min((b + 1) * BLOCK, rows)):
            line = image[i]
            if has_dark:
                off = dark[i]
                for j in range(columns):
                    lit[j] = max(line[j], off[j]) - off[j]
                line = lit
            for j in range(columns):
                top[j] = max(top[j], line[j])
    best = np.zeros(columns, image.dtype)
    for b in range(count):
        top = tops[b]
        for j in range(columns):
            best[j] = max(best[j], top[j])
    for j in range(columns):
        value = np.int64(best[j])
        b = 0
        while tops[b, j] != best[j]:
            b += 1
        i = b * BLOCK
        while lit_at(image, dark, has_dark, i, j) != value:
            i += 1
        second = np.int64(0)
        for c in range(count):
            first, last = c * BLOCK, min((c + 1) * BLOCK, rows) - 1
            if np.int64(tops[c, j]) <= second or (first >= i - half and last <= i + half):
                continue
            if last < i - half or first > i + half:
                second = np.int64(tops[c, j])
                continue
            for k in range(first, last + 1):
                if k < i - half or k > i + half:
                    second = max(second, lit_at(image, dark, has_dark, k, j))
        out[j, 0] = i
        out[j, 1] = value
        out[j, 2] = second


@compiled
def lit_at(image: Pixels, dark: Pixels, has_dark: bool, i: int, j: int) -> int:
    """The laser's light at one pixel, clamped at 0."""
    value = np.int64(image[i, j])
    if has_dark:
        value = max(0, value - np.int64(dark[i, j]))
    return value
