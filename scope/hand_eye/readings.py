"""A log of poses read in other ways than it was stated: the usual ways of getting a convention wrong, tried one by one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from calibration.geometry import Array, Pose
from calibration.notation import COLUMNS, Notation, numbers_of, pose_of
from calibration.stages import Mount, SeenTarget, Start, consensus
from scope.session import MM, PoseLog

# Numbers that a file may hold under the name of a notation, by how many there are. The second word says what is done to
# them before they are read: angles in the other unit, a matrix by columns.
_ALIKE: dict[int, tuple[tuple[Notation, str], ...]] = {
    16: (("matrix", ""), ("matrix", "by columns")),
    7: (("quaternion-xyzw", ""), ("quaternion-wxyz", "")),
    6: (
        ("ur", ""), ("kuka", ""), ("fanuc", ""), ("ur", "in degrees"), ("kuka", "in radians"), ("fanuc", "in radians"),
        ("rpy-deg", "about moving axes x, y, z"),
    ),
}  # fmt: skip
_SAME: dict[Notation, Notation] = {"abb": "quaternion-wxyz", "rpy-deg": "fanuc"}
_TRIALS = 40


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One way to read the log."""

    told: str  # what to write instead of what was stated, in words
    mount: Mount
    changes: int  # keys that differ from the statement
    start: Start  # what the views agree on, if the log is read so


def readings_of(log: PoseLog, rows: Sequence[int], views: Sequence[SeenTarget], mount: Mount) -> list[Reading]:
    """Every other reading of the log that gives rigid poses, best agreement of the views first.

    Other notations of as many numbers, the inverse, the other units of length, the camera mounted the other way, and rows
    that are one late or early.
    """
    found = []
    for told, other, changes, poses in _poses(log, rows, mount):
        turned = [view.saying(pose) for view, pose in zip(views, poses, strict=True)]
        found.append(Reading(told, other, changes, consensus(turned, other, trials=_TRIALS)))
    found += _shifted(views, mount)
    return sorted(found, key=lambda reading: _cost(reading, mount))


def _cost(reading: Reading, mount: Mount) -> float:
    """Disagreement, mm, and a little for every key that would have been wrong; the inverse is a commoner error than the mount."""
    return reading.start.typical_mm * (1.0 + 0.2 * reading.changes + 0.1 * (reading.mount != mount))


def _poses(log: PoseLog, rows: Sequence[int], mount: Mount) -> Iterator[tuple[str, Mount, int, list[Pose]]]:
    stated = _SAME.get(log.notation, log.notation)
    mounts: tuple[Mount, ...] = (mount, "fixed" if mount == "hand" else "hand")
    for (notation, how), units, inverse, other in product(
        _ALIKE[len(COLUMNS[log.notation])], MM, (False, True), mounts
    ):
        same = notation == stated and not how
        changes = (not same) + (units != log.units) + inverse + (other != mount)
        if changes == 0 or changes > 2 or (inverse and other != mount):
            continue
        try:
            poses = [pose_of(notation, _numbers(log.values[row], how), mm=MM[units]) for row in rows]
        except ValueError:
            continue
        gives = log.gives
        if inverse:
            gives = "flange_from_base" if gives == "base_from_flange" else "base_from_flange"
        words = [] if same else [f'notation = "{notation}"' + (f" {how}" if how else "")]
        words += [] if units == log.units else [f'units = "{units}"']
        words += [f'gives = "{gives}"'] if inverse else []
        words += [f'mount = "{other}"'] if other != mount else []
        yield " and ".join(words), other, changes, poses if gives == "base_from_flange" else [p.inverse for p in poses]


def _numbers(values: Array, how: str) -> Array:
    """Numbers of a row, made what the notation has."""
    if how == "by columns":
        return np.asarray(values.reshape(4, 4).T.ravel())
    if how == "in degrees":
        return np.concatenate([values[:3], np.radians(values[3:])])
    if how == "in radians":
        return np.concatenate([values[:3], np.degrees(values[3:])])
    if how == "about moving axes x, y, z":  # R = Rx Ry Rz: the inverse of the fixed axes' with the signs turned
        turn = pose_of("rpy-deg", np.concatenate([np.zeros(3), -values[3:]])).inverse.rotation
        return np.concatenate([values[:3], numbers_of("rpy-deg", Pose(turn, np.zeros(3)))[3:]])
    return values


def _shifted(views: Sequence[SeenTarget], mount: Mount) -> list[Reading]:
    """The log with its poses moved by one row against the images."""
    found: list[Reading] = []
    if len(views) < 5:
        return found
    poses = [view.base_from_flange for view in views]
    for shift, told in (
        (1, "each image with the pose of the row before"),
        (-1, "each image with the pose of the row after"),
    ):
        kept = list(views)[1:] if shift == 1 else list(views)[:-1]
        said = poses[:-1] if shift == 1 else poses[1:]
        start = consensus([v.saying(p) for v, p in zip(kept, said, strict=True)], mount, trials=_TRIALS)
        found.append(Reading(told, mount, 2, start))
    return found
