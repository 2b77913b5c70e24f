"""Compiled passes over whole frames: where on each line the light is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import compiled

Pixels = NDArray[Any]  # (rows, columns) uint8 or uint16

COMB = 256  # px; a row is folded onto so many
BLOCK = 16  # px; a line across the rows is folded into maxima of this many rows


@compiled
def peaks_of_rows(image: Pixels, dark: Pixels, has_dark: bool, half: int, out: NDArray[np.int32]) -> None:
    """Where each row is brightest, and how bright it is farther than ``half`` from there.

    ``out`` (3, rows) receives place, value and second value. A row is folded onto COMB pixels, at the width of the vector
    unit; the place is then looked for among the few pixels that share the highest tooth.
    """
    rows, columns = image.shape
    lit = np.zeros(columns, image.dtype)
    comb = np.zeros(COMB, image.dtype)
    order = np.arange(COMB).astype(np.uint16)
    last = np.uint16(COMB)
    for i in range(rows):
        line = image[i]
        if has_dark:
            off = dark[i]
            for j in range(columns):
                lit[j] = max(line[j], off[j]) - off[j]
            line = lit
        top = _fold(line, comb)
        tooth = last
        for k in range(COMB):
            tooth = min(tooth, order[k] if comb[k] == top else last)
        at = int(tooth)
        while line[at] != top:
            at += COMB
        left, right = max(0, at - half), min(columns, at + half + 1)
        second = line.dtype.type(0)
        if left > 0:
            second = max(second, _fold(line[:left], comb))
        if right < columns:
            second = max(second, _fold(line[right:], comb))
        out[0, i] = at
        out[1, i] = top
        out[2, i] = second


@compiled
def _fold(line: Pixels, comb: Pixels) -> Any:
    """Maxima of all pixels j, j + COMB, j + 2 COMB ... in ``comb``; returns the highest."""
    columns = line.size
    for k in range(COMB):
        comb[k] = 0
    for start in range(0, columns, COMB):
        part = line[start : start + COMB]
        for k in range(part.size):
            comb[k] = max(comb[k], part[k])
    top = line.dtype.type(0)
    for k in range(COMB):
        top = max(top, comb[k])
    return top


@compiled
def peaks_of_columns(image: Pixels, dark: Pixels, has_dark: bool, half: int, out: NDArray[np.int32]) -> None:
    """Where each column is brightest, and how bright it is farther than ``half`` from there; as `peaks_of_rows`.

    Rows are folded into maxima of BLOCK rows, all columns side by side; only blocks that matter are looked into again.
    """
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
    where = np.zeros(columns, np.uint16)
    for b in range(count):
        top = tops[b]
        here = np.uint16(b)
        for j in range(columns):
            where[j] = here if top[j] > best[j] else where[j]
            best[j] = max(best[j], top[j])
    # The second value: first from blocks clear of the excluded stretch, then from the parts of those that touch it.
    clear = np.uint16(half // BLOCK + 2)
    second = np.zeros(columns, image.dtype)
    zero = image.dtype.type(0)
    for b in range(count):
        top = tops[b]
        here = np.uint16(b)
        for j in range(columns):
            far = max(here, where[j]) - min(here, where[j]) >= clear
            second[j] = max(second[j], top[j] if far else zero)
    for j in range(columns):
        value = np.float32(best[j])
        block = int(where[j])
        i = block * BLOCK
        while light(image, dark, has_dark, i, j) < value:
            i += 1
        other = np.float32(second[j])
        for c in range(max(0, block - half // BLOCK - 1), min(count, block + half // BLOCK + 2)):
            if np.float32(tops[c, j]) <= max(other, np.float32(0.25) * value):
                continue
            for k in range(c * BLOCK, min((c + 1) * BLOCK, rows)):
                if abs(k - i) > half:
                    other = max(other, light(image, dark, has_dark, k, j))
        out[0, j] = i
        out[1, j] = np.int32(value)
        out[2, j] = np.int32(other)


@compiled
def light(lines: Pixels, dark: Pixels, has_dark: bool, i: int, j: int) -> Any:
    """Laser light at pixel j of line i: float32, negative where noise has it so."""
    value = np.float32(lines[i, j])
    if has_dark:
        value -= np.float32(dark[i, j])
    return value
