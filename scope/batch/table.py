"""Rows to CSV or Parquet, whole or not at all, and back."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calibration.atomic import written_whole
from calibration.errors import FileError
from scope.batch.session import Outcome
from scope.errors import MissingLibraryError

HEAD = ("session", "status", "reason", "seconds", "digest")
_LARGEST = 1 << 28  # bytes of a table that is read back
Row = dict[str, Any]


def require_table(path: Path) -> None:
    """Refuse a name that is neither CSV nor Parquet, or Parquet without its library."""
    ending = path.suffix.lower()
    if ending not in {".csv", ".parquet"}:
        raise ValueError(f"{path.name}: the table of a day is .csv or .parquet")
    if ending == ".parquet":
        _parquet(path)


def row_of(outcome: Outcome) -> Row:
    """Row of a session: its head, then the figures that it has."""
    head = (outcome.source, outcome.status, outcome.reason, round(outcome.seconds, 3), outcome.digest)
    known = {name: value for name, value in outcome.figures.items() if _plain(value) not in {None, ""}}
    return dict(zip(HEAD, head, strict=True)) | known


def columns_of(rows: Sequence[Row]) -> list[str]:
    """Columns in the order in which the rows bring them."""
    return list(dict.fromkeys([*HEAD, *(name for row in rows for name in row)]))


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a table; what a row does not tell is empty (CSV) or null (Parquet)."""
    columns = columns_of(rows)
    if path.suffix.lower() == ".parquet":
        arrow, parquet = _parquet(path)
        held = {name: [_plain(row.get(name)) for row in rows] for name in columns}
        table = arrow.table({name: _typed(arrow, values) for name, values in held.items()})
        with written_whole(path) as stream:
            parquet.write_table(table, stream)
        return
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_text(row.get(name)) for name in columns])
    with written_whole(path) as stream:
        stream.write(text.getvalue().encode("utf-8"))


def read_rows(path: Path) -> list[Row]:
    """Rows of a table that `write_rows` wrote, cells as they stand (CSV: text); ``FileError`` for anything else."""
    try:
        if path.stat().st_size > _LARGEST:
            raise FileError(f"{path}: is larger than any table of a day ({_LARGEST >> 20} MB); choose another name")
        if path.suffix.lower() == ".parquet":
            rows: list[Row] = _parquet(path)[1].read_table(path).to_pylist()
        else:
            lines = csv.reader(io.StringIO(path.read_text(encoding="utf-8"), newline=""), strict=True)
            title, *body = list(lines) or [[]]
            rows = [dict(zip(title, line, strict=True)) for line in body]
    except (OSError, ValueError, csv.Error) as error:
        raise FileError(
            f"{path}: is no table that scope batch wrote ({str(error)[:80]}); choose another name"
        ) from error
    if any(not set(HEAD) <= set(row) for row in rows):
        raise FileError(f"{path}: has no columns {', '.join(HEAD)}: not written by scope batch; choose another name")
    return [{name: value for name, value in row.items() if name in HEAD or value not in {"", None}} for row in rows]


def _text(value: Any) -> str:
    plain = _plain(value)
    if isinstance(plain, bool):
        return "true" if plain else "false"
    return "" if plain is None else repr(plain) if isinstance(plain, float) else str(plain)


def _plain(value: Any) -> Any:
    """Value as a cell: NaN and infinities are nothing."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _typed(arrow: Any, values: list[Any]) -> Any:
    """Column of one type: numbers where all are, else text."""
    known = [value for value in values if value is not None]
    if known and all(isinstance(value, int | float) and not isinstance(value, bool) for value in known):
        if not all(isinstance(value, int) for value in known):
            return arrow.array([None if value is None else float(value) for value in values])
        return arrow.array(values, type=arrow.int64())
    if known and all(isinstance(value, bool) for value in known):
        return arrow.array(values)
    return arrow.array([None if value is None else _text(value) for value in values], type=arrow.string())


def _parquet(path: Path) -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingLibraryError(
            f"{path}: Parquet needs the package pyarrow; install it: pip install 'scope-scanner[cluster]', or write .csv"
        ) from error
    return pyarrow, pyarrow.parquet
