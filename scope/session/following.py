"""Positions that come while the frames do: a CSV that grows by a row a frame, or a stage's log to be interpolated."""

from __future__ import annotations

import bisect
import csv
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array

Clock = Literal["first-frame", "system", "camera"]
GAP_S = 1.0  # between rows of a log, beyond which nothing is interpolated
_MOST = 5_000_000  # rows
_LONGEST = 10_000  # characters of a row
_WAIT = 0.01  # s between looks at a file that grows


@dataclass(frozen=True, slots=True, eq=False)
class Follow:
    """Where the position of each frame is told while the camera runs."""

    path: Path
    by: Literal["frame", "seconds"]  # a row a frame, or a log over time
    scale: float  # to mm or rad
    known: dict[int, float]  # position of each frame so far, mm or rad, as the motion reads it
    clock: Clock = "first-frame"  # whose seconds the log has
    delay: float = 0.0  # s to be added to a frame's time
    gap: float = GAP_S  # s
    wait: float = 0.0  # s for a row that is not there yet


def interpolated(path: Path, seconds: Array, positions: Array, at: Array, gap: float = GAP_S) -> Array:
    """Positions (N,) at the times (N,) between rows of a log; ``FileError`` for a time that no two rows enclose closely."""
    _require_rising(path, seconds)
    for k, moment in enumerate(at):
        if why := _not_enclosed(seconds, float(moment), gap):
            raise FileError(f"{path}: {why} (frame {k}); let the log run from before the first frame to after the last")
    return np.asarray(np.interp(at, seconds, positions))


def _require_rising(path: Path, seconds: Array) -> None:
    back = np.flatnonzero(np.diff(seconds) <= 0.0)
    if len(back):
        raise FileError(f"{path}: row {back[0] + 3}: its seconds do not come after those before; log in order of time")


def _not_enclosed(seconds: Array | list[float], moment: float, gap: float) -> str:
    if not len(seconds) or moment < seconds[0]:
        begin = f"begins at {seconds[0]:.6g} s" if len(seconds) else "is empty"
        return f"a frame was taken at {moment:.6g} s and the log {begin}"
    if moment > seconds[-1]:
        return f"a frame was taken at {moment:.6g} s and the log ends at {seconds[-1]:.6g} s"
    k = min(max(bisect.bisect_left(seconds, moment), 1), len(seconds) - 1)
    if moment not in (seconds[k - 1], seconds[k]) and seconds[k] - seconds[k - 1] > gap:
        return (
            f"the log has no row for {seconds[k] - seconds[k - 1]:.3g} s about {moment:.6g} s, more than gap = {gap:g}"
        )
    return ""


@dataclass(slots=True, eq=False)
class Follower:
    """Reads a file that grows, and gives each frame its place; rows that are not ended by a line break yet are not read."""

    follow: Follow
    give_up: Callable[[], bool] = lambda: False
    _begin: int = 0  # bytes read
    _columns: tuple[int, int, int] | None = None  # of the key, of the position, and how many there are
    _row: int = 1
    _keys: list[float] = field(default_factory=list)
    _values: list[float] = field(default_factory=list)
    _of: dict[int, float] = field(default_factory=dict)  # by frame

    def place(self, number: int, at: float | None) -> str:
        """Note where a frame stands, waiting for its row; why there is none, or empty."""
        follow, until = self.follow, time.monotonic() + self.follow.wait
        while True:
            try:
                self._read()
            except FileError as error:
                return str(error)
            why = self._placed(number, at)
            if not why or time.monotonic() > until or self.give_up() or (at is None and follow.by == "seconds"):
                return f"{follow.path}: {why}" if why else ""
            time.sleep(_WAIT)

    def _placed(self, number: int, at: float | None) -> str:
        follow = self.follow
        if follow.by == "frame":
            if number not in self._of:
                return f"no row for frame {number}"
            follow.known[number] = self._of[number] * follow.scale
            return ""
        if at is None:
            return f"frame {number} has no time stamp; a log needs a [camera] that gives them"
        moment = at + follow.delay
        if why := _not_enclosed(self._keys, moment, follow.gap):
            return why
        k = min(max(bisect.bisect_left(self._keys, moment), 1), len(self._keys) - 1)
        span = slice(max(k - 1, 0), k + 1)
        follow.known[number] = float(np.interp(moment, self._keys[span], self._values[span])) * follow.scale
        return ""

    def _read(self) -> None:
        """Take in whole rows that were added."""
        path = self.follow.path
        try:
            with path.open("rb") as stream:
                stream.seek(self._begin)
                added = stream.read(1 << 20)
        except FileNotFoundError:
            return  # it may come yet
        except OSError as error:
            raise FileError(f"{path}: cannot be read ({error.strerror}); check it") from error
        end = added.rfind(b"\n") + 1
        if end == 0 and len(added) > _LONGEST:
            raise FileError(f"{path}: row {self._row} is longer than {_LONGEST} characters; write one row a line")
        self._begin += end
        try:
            rows = list(csv.reader(added[:end].decode("utf-8-sig").splitlines()))
        except (UnicodeDecodeError, csv.Error) as error:
            raise FileError(f"{path}: is no CSV in UTF-8 ({error}); write it again") from error
        for row in rows:
            self._take(row)
            self._row += 1

    def _take(self, row: list[str]) -> None:
        path, by = self.follow.path, self.follow.by
        if self._columns is None:
            names = [name.strip() for name in row]
            if by not in names or "position" not in names:
                raise FileError(f"{path}: the header has {', '.join(names)[:80]}; needed: {by},position")
            self._columns = (names.index(by), names.index("position"), len(names))
            return
        if not row:
            return
        key, value, count = self._columns
        if len(row) != count:
            raise FileError(f"{path}: row {self._row} has {len(row)} values; the header names {count}: complete it")
        told, position = (_number(row[k]) for k in (key, value))
        if not (math.isfinite(told) and math.isfinite(position)):
            raise FileError(f"{path}: row {self._row}: found {','.join(row)[:60]!r}; needed: finite numbers")
        if by == "frame":
            if int(told) in self._of or told != int(told):
                raise FileError(f"{path}: row {self._row}: frame {told:g} is listed twice or is no whole number")
            self._of[int(told)] = position
        elif self._keys and told <= self._keys[-1]:
            raise FileError(
                f"{path}: row {self._row}: its seconds do not come after those before; log in order of time"
            )
        else:
            self._keys.append(told)
            self._values.append(position)
        if self._row > _MOST:
            raise FileError(f"{path}: more than {_MOST} rows; begin a new file for each scan")


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
