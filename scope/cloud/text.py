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

    ``FileError`` for a file that holds anything else.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: is no text (byte {error.start}); give lines of x y z") from error
    lines = [line.split() for line in text.translate(str.maketrans(",;\t", "   ")).splitlines()]
    rows = [(k, words) for k, words in enumerate(lines, 1) if words and not words[0].startswith(("#", "//"))]
    first = next((i for i, (_, words) in enumerate(rows[: _TITLES + 1]) if len(words) >= 3 and _numeric(words)), None)
    if first is None:
        raise FileError(f"{path}: no line of x y z among its first; give a point cloud")
    points = np.empty((len(rows) - first, 3))
    for i, (k, words) in enumerate(rows[first:]):
        try:
            points[i] = [float(word) for word in words[:3]]
        except ValueError as error:
            raise FileError(f"{path}: line {k} holds {' '.join(words)[:40]!r}; needed: x y z") from error
    notes: tuple[str, ...] = ()
    if len(rows[first][1]) > 3:
        notes = (f"of {len(rows[first][1])} columns only x, y and z were taken",)
    return Stored(dict(zip("xyz", points.T, strict=True)), notes=notes)


def _numeric(words: list[str]) -> bool:
    try:
        for word in words[:3]:
            float(word)
    except ValueError:
        return False
    return True
