"""What is done already of a day, line by line on disk: nothing of it is lost when the machine stops."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from calibration.errors import FileError
from scope.batch.table import HEAD, Row


def journal_of(table: Path) -> Path:
    """The journal beside a table; it goes when the table is written."""
    return table.with_name(table.name + ".part")


def read_journal(table: Path) -> list[Row]:
    """Rows of sessions that were done before the run stopped; a last line that was cut is left out."""
    path = journal_of(table)
    if not path.is_file():
        return []
    rows: list[Row] = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row: Any = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(row, dict) and set(HEAD) <= set(row):
            rows.append(row)
    return rows


@contextmanager
def journal(table: Path, *, begin: bool) -> Iterator[TextIO]:
    """Open the journal to append to it, emptied where a run begins anew."""
    path = journal_of(table)
    try:
        stream = path.open("w" if begin else "a", encoding="utf-8")
    except OSError as error:
        raise FileError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
    with stream:
        note(stream, None)  # after a line that was cut
        yield stream


def note(stream: TextIO, row: Row | None) -> None:
    """Append one row, on disk when this returns; None ends a line."""
    try:
        stream.write("\n" if row is None else json.dumps(row) + "\n")
        stream.flush()
    except OSError as error:
        raise FileError(
            f"{stream.name}: could not be written ({error.strerror}); free space, then use --resume"
        ) from error
