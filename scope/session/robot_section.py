"""[robot]: the log of a robot's poses, in the robot's own notation."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array, Pose, quaternion_from_rotation, rotation_from_quaternion
from calibration.notation import COLUMNS, NOTATIONS, Notation, pose_of
from scope.session.toml_file import MM, Number, Positive, Section, Units, numbers, read_csv

Gives = Literal["base_from_flange", "flange_from_base"]
_LEAST_HEADER = ("image", "frame")
GAP_S = 0.5  # between rows of a log over time, beyond which nothing is interpolated


class RobotSection(Section):
    """[robot]: where the poses stand and what their numbers mean; nothing of it is guessed."""

    poses: str
    units: Units
    notation: Notation
    gives: Gives
    images: str
    repeatability_mm: Positive | None = None
    repeatability_deg: Positive | None = None
    times: str | None = None
    delay: Number | Literal["find"] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PoseLog:
    """What a robot said, row by row."""

    path: Path
    names: tuple[str, ...]  # file names of the images (or numbers of the frames) of the rows
    values: Array  # (n, k) in the order of the notation's columns
    notation: Notation
    units: Units
    gives: Gives
    key: str = "image"  # or "frame"

    def base_from_flange(self, row: int) -> Pose:
        """Pose of a row, mm; ``FileError`` where its numbers are none."""
        try:
            pose = pose_of(self.notation, self.values[row], mm=MM[self.units])
        except ValueError as error:
            raise FileError(f"{self.path}: row {row + 2} ({self.names[row]}): {error}; correct the row") from error
        return pose if self.gives == "base_from_flange" else pose.inverse

    def row_of(self, image: Path) -> int | None:
        """Row of an image, by its name or the end of its path; None where there is none."""
        for row, name in enumerate(self.names):
            if name == image.name:
                return row
        return None


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """What a robot said over time: poses between its rows are interpolated."""

    path: Path
    seconds: Array  # (n,) ascending
    turn: Array  # (n, 4) quaternions w x y z, each near the one before
    place: Array  # (n, 3) mm

    def at(self, seconds: Array) -> list[Pose]:
        """base_from_flange at moments (m,) s within the log: places linearly, turns along the shortest arc."""
        k = np.clip(np.searchsorted(self.seconds, seconds, side="right") - 1, 0, len(self.seconds) - 2)
        part = (seconds - self.seconds[k]) / (self.seconds[k + 1] - self.seconds[k])
        place = self.place[k] + part[:, None] * (self.place[k + 1] - self.place[k])
        cosine = np.clip((self.turn[k] * self.turn[k + 1]).sum(axis=1), -1.0, 1.0)
        arc = np.arccos(cosine)
        small = arc < 1e-6
        sine = np.where(small, 1.0, np.sin(arc))
        a = np.where(small, 1.0 - part, np.sin((1.0 - part) * arc) / sine)
        b = np.where(small, part, np.sin(part * arc) / sine)
        turn = a[:, None] * self.turn[k] + b[:, None] * self.turn[k + 1]
        return [Pose(rotation_from_quaternion(q / np.linalg.norm(q)), p) for q, p in zip(turn, place, strict=True)]

    def twists(self, seconds: Array, *, span: float = 0.02) -> Array:
        """Velocities (m, 6) of the flange in its own frame: turns rad/s, shift mm/s; differences over ``span`` s."""
        low = np.clip(seconds - span / 2, self.seconds[0], self.seconds[-1])
        high = np.clip(seconds + span / 2, self.seconds[0], self.seconds[-1])
        found = np.zeros((len(seconds), 6))
        for i, (a, b, time) in enumerate(zip(self.at(low), self.at(high), high - low, strict=True)):
            moved = a.inverse @ b
            q = quaternion_from_rotation(moved.rotation)
            axis = q[1:] * (np.sign(q[0]) or 1.0)
            length = float(np.linalg.norm(axis))
            angle = 2.0 * np.arctan2(length, abs(q[0]))
            found[i, :3] = axis / max(length, 1e-300) * angle / max(time, 1e-9)
            found[i, 3:] = moved.translation / max(time, 1e-9)
        return found


def read_pose_track(path: Path, notation: Notation, units: Units, gives: Gives, *, gap: float = GAP_S) -> PoseTrack:
    """Read a CSV whose header is ``seconds`` and the columns of the notation, in its order.

    Raises
    ------
    FileError
        Columns of another notation, times that do not ascend, or rows further apart than ``gap`` s.
    """
    columns = COLUMNS[notation]
    _require_columns(path, notation, columns)
    table = read_csv(path, ("seconds", *columns))
    seconds = numbers(path, "seconds", table["seconds"])
    if len(seconds) < 2 or (np.diff(seconds) <= 0).any():
        raise FileError(
            f"{path}: seconds must ascend from row to row, over two rows or more: sort it, and drop rows that repeat a time"
        )
    widest = int(np.argmax(np.diff(seconds)))
    if np.diff(seconds)[widest] > gap:
        raise FileError(
            f"{path}: row {widest + 2} and the next are {np.diff(seconds)[widest]:.3g} s apart, {gap:g} at most are interpolated: log the arm more often"
        )
    names = tuple(str(k) for k in range(len(seconds)))
    values = np.stack([numbers(path, name, table[name]) for name in columns], axis=1)
    log = PoseLog(path, names, values, notation, units, gives)
    poses = [log.base_from_flange(k) for k in range(len(seconds))]
    turn = np.stack([quaternion_from_rotation(p.rotation) for p in poses])
    for k in range(1, len(turn)):
        if turn[k] @ turn[k - 1] < 0:
            turn[k] = -turn[k]
    return PoseTrack(path, seconds, turn, np.stack([p.translation for p in poses]))


def read_times(path: Path) -> dict[str, float]:
    """Seconds at which each image was taken: a CSV with header ``image,seconds``."""
    table = read_csv(path, ("image", "seconds"))
    names = [Path(name.replace("\\", "/")).name for name in table["image"]]
    if len(set(names)) < len(names):
        raise FileError(f"{path}: {max(names, key=names.count)!r} has several rows; keep one for each image")
    return dict(zip(names, numbers(path, "seconds", table["seconds"]).tolist(), strict=True))


def read_pose_log(path: Path, notation: Notation, units: Units, gives: Gives) -> PoseLog:
    """Read a CSV whose header is ``image`` (or ``frame``) and the columns of the notation, in its order.

    Raises
    ------
    FileError
        Columns of another notation than was stated, or in its order; rows that are short, named twice or no numbers.
    """
    columns = COLUMNS[notation]
    _require_columns(path, notation, columns)
    table = read_csv(path, columns, optional=_LEAST_HEADER)
    key = next((name for name in _LEAST_HEADER if name in table), None)
    if key is None:
        raise FileError(f"{path}: the header names neither image nor frame; one of them must say which row is whose")
    names = tuple(Path(name.replace("\\", "/")).name for name in table[key])
    if not names:
        raise FileError(f"{path}: has no row below its header; write one for each image")
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise FileError(f"{path}: {twice[:60]!r} has {names.count(twice)} rows; keep one row for each {key}")
    values = np.stack([numbers(path, name, table[name]) for name in columns], axis=1)
    return PoseLog(path, names, values, notation, units, gives, key)


def _require_columns(path: Path, notation: Notation, columns: Sequence[str]) -> None:
    """``FileError`` where the header has the columns of another notation, or these in another order."""
    header = _header(path)
    told = [name for name in header if name in columns]
    if tuple(told) == tuple(columns):
        return
    same = [n for n in NOTATIONS if tuple(name for name in header if name in COLUMNS[n]) == COLUMNS[n]]
    found = (
        f"{', '.join(header)[:80]}, which are those of notation {same[0]!r}" if same else f"{', '.join(header)[:80]}"
    )
    raise FileError(
        f"{path}: the header has {found}; notation = {notation!r} has {', '.join(columns)}, in this order: correct the one "
        "that is wrong"
    )


def _header(path: Path) -> list[str]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            row = next(csv.reader([stream.readline(1 << 16)]), [])
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{path}: is no CSV in UTF-8 ({error}); write it again") from error
    return [name.strip() for name in row]
