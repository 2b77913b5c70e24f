"""[robot]: the log of a robot's poses, in the robot's own notation."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array, Pose
from calibration.notation import COLUMNS, NOTATIONS, Notation, pose_of
from scope.session.toml_file import MM, Positive, Section, Units, numbers, read_csv

Gives = Literal["base_from_flange", "flange_from_base"]
_LEAST_HEADER = ("image", "frame")


class RobotSection(Section):
    """[robot]: where the poses stand and what their numbers mean; nothing of it is guessed."""

    poses: str
    units: Units
    notation: Notation
    gives: Gives
    images: str
    repeatability_mm: Positive | None = None
    repeatability_deg: Positive | None = None


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
