"""Clouds as text: a line a point, x y z first, whatever stands behind them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.errors import FileError
from scope.cloud.fields import Stored

ENDINGS = (".xyz", ".txt", ".csv", ".pts", ".asc")
_TITLES = 20  # lines before the first point, at most


def read(path: Path) -> Stored:
    """Read lines of x y z, separated by blanks, commas or semicolons; titles, comments (#, //) and a leading count are skipped.

    Where a title names every column, x y z first, as exports for CloudCompare have it, all columns are taken.

    ``FileError`` for a file that holds anything else.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: is no text (byte {error.start}); give lines of x y z") from error
    plain = text.translate(str.maketrans(",;\t", "   "))
    lines = [line.split() for line in plain.splitlines()]
    rows = [(k, words) for k, words in enumerate(lines, 1) if words and not words[0].startswith(("#", "//"))]
    first = next((i for i, (_, words) in enumerate(rows[: _TITLES + 1]) if len(words) >= 3 and _numeric(words)), None)
    if first is None:
        raise FileError(f"{path}: no line of x y z among its first; give a point cloud")
    wide = len(rows[first][1])
    names = _names(lines[: rows[first][0] - 1], wide)
    values = np.empty((len(rows) - first, len(names)))
    for i, (k, words) in enumerate(rows[first:]):
        try:
            values[i] = [float(word) for word in words[: len(names)]]
        except ValueError as error:
            wanted = " ".join(names)
            raise FileError(f"{path}: line {k} holds {' '.join(words)[:40]!r}; needed: {wanted}") from error
    notes: tuple[str, ...] = ()
    if wide > len(names):
        notes = (f"of {wide} columns only x, y and z were taken",)
    return Stored(dict(zip(names, values.T, strict=True)), notes=notes)


def _names(titles: list[list[str]], wide: int) -> list[str]:
    """Names of the columns: those of a title that names each of ``wide`` columns once, x y z first; else x y z."""
    for words in reversed(titles):
        named = [word.strip('"').lower() for word in " ".join(words).lstrip("#/ ").split()]
        if len(named) == wide == len(set(named)) and named[:3] == ["x", "y", "z"]:
            return named
    return ["x", "y", "z"]


def _numeric(words: list[str]) -> bool:
    try:
        for word in words[:3]:
            float(word)
    except ValueError:
        return False
    return True
