"""Records in an SQLite file: one row a calibration, verification, scan or check."""

from __future__ import annotations

import csv
import getpass
import io
import json
import math
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calibration.errors import FileError
from scope.version import __version__

NAME = "history.db"
SWITCH = "SCOPE_HISTORY"  # environment: "off", or the file to write instead of the one beside the result
_LONGEST = 1 << 16  # characters of a row's figures
_MOST = 100_000  # records that are read
_COLUMNS = ("moment", "kind", "rig", "passed", "figures", "camera", "version", "who", "file")
_TABLE = (
    "CREATE TABLE IF NOT EXISTS records (id INTEGER PRIMARY KEY, moment TEXT NOT NULL, kind TEXT NOT NULL, rig TEXT NOT NULL, "
    "passed INTEGER NOT NULL, figures TEXT NOT NULL, camera TEXT NOT NULL, version TEXT NOT NULL, who TEXT NOT NULL, "
    "file TEXT NOT NULL)"
)


@dataclass(frozen=True, slots=True)
class Record:
    """One result."""

    kind: str  # "calibrate", "verify", "scan", "check", "roughness" or "pose"
    passed: bool
    figures: Mapping[str, float]
    rig: str = ""  # SHA-256 of the rig, where there is one
    camera: str = ""
    file: str = ""  # name of what was made or judged
    when: str = ""  # ISO 8601, UTC; now where it is left out
    version: str = __version__
    who: str = ""  # the user where it is left out

    @property
    def content(self) -> dict[str, Any]:
        """What --json gives."""
        return {
            "when": self.when, "kind": self.kind, "rig": self.rig, "passed": self.passed, "figures": dict(self.figures),
            "camera": self.camera, "version": self.version, "who": self.who, "file": self.file,
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class Journal:
    """The records of one file, which is made with the first of them."""

    path: Path

    def add(self, record: Record) -> None:
        """Keep a record; ``FileError`` where the file cannot be written, or is none of these."""
        when = record.when or datetime.now(UTC).isoformat(timespec="seconds")
        figures = {name: float(value) for name, value in record.figures.items() if math.isfinite(value)}
        row = (when, record.kind, record.rig, int(record.passed), json.dumps(figures), record.camera, record.version, record.who or _user(),
               record.file)  # fmt: skip
        with self._opened() as database, database:
            database.execute(_TABLE)
            database.execute(f"INSERT INTO records ({', '.join(_COLUMNS)}) VALUES (?,?,?,?,?,?,?,?,?)", row)  # noqa: S608 (names of ours)

    def records(self, *, kind: str | None = None) -> list[Record]:
        """All records, the oldest first; none where there is no file yet. ``FileError`` for a file that is no journal."""
        if not self.path.exists():
            return []
        query = (
            f"SELECT {', '.join(_COLUMNS)} FROM records WHERE ? IS NULL OR kind = ? ORDER BY moment, id LIMIT {_MOST}"  # noqa: S608
        )
        with self._opened() as database:
            rows = database.execute(query, (kind, kind)).fetchall()
        return [self._record(row) for row in rows]

    def _record(self, row: tuple[Any, ...]) -> Record:
        when, kind, rig, passed, figures, camera, version, who, file = row
        texts = [str(each)[:500] for each in (kind, rig, camera, version, who, file, when)]
        try:
            told = json.loads(str(figures)[:_LONGEST])
            numbers = {str(name)[:60]: float(value) for name, value in told.items()}
        except (ValueError, TypeError, AttributeError) as error:
            raise FileError(
                f"{self.path}: the figures of {texts[6]} cannot be read; restore the file or move it away"
            ) from error
        kind, rig, camera, version, who, file, when = texts
        return Record(kind, bool(passed), numbers, rig, camera, file, when, version, who)

    @contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        try:
            with closing(sqlite3.connect(self.path, timeout=5.0)) as database:
                yield database
        except sqlite3.Error as error:
            raise FileError(
                f"{self.path}: is no history that can be read or written ({error}); move it away, or name another with --db or "
                f"{SWITCH}"
            ) from error


def journal_beside(result: Path) -> Journal | None:
    """Journal in the folder of a result, or the one that the environment names; None where that says "off"."""
    said = os.environ.get(SWITCH, "")
    if said.lower() in {"off", "0", "no"}:
        return None
    return Journal(Path(said) if said else result.parent / NAME)


def records_csv(records: list[Record]) -> str:
    """CSV of records: a column for every figure that any of them has."""
    names = sorted({name for record in records for name in record.figures})
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(("when", "kind", "passed", "rig", "camera", "version", "who", "file", *names))
    for r in records:
        known = [_safe(each) for each in (r.when, r.kind, int(r.passed), r.rig, r.camera, r.version, r.who, r.file)]
        writer.writerow([*known, *(r.figures.get(name, "") for name in names)])
    return stream.getvalue()


def _safe(value: object) -> object:
    """Text that a spreadsheet does not take for a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in {"=", "+", "-", "@"} else value


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return ""
