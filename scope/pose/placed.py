"""`scope pose` and `scope check` from files to results: what the commands print and write."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array, Pose
from calibration.notation import COLUMNS, NOTATIONS, pose_of
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.export import write_scalars
from scope.pose.estimate import PoseResult
from scope.session import MM


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A pose in the frames that were asked for; None where there is no pose or the cloud does not know the sensor."""

    result: PoseResult
    camera_from_model: Pose | None
    robot_from_model: Pose | None
    at: int | None  # frame
    warnings: tuple[str, ...] = ()  # of what was given, in one line each


def read_transform(path: Path) -> Pose:
    """Pose cloud_from_model of a JSON file: a 4x4 row-major list, or an object with it under ``matrix`` or ``cloud_from_model``.

    Lengths are mm, unless the object has ``units``.

    Raises
    ------
    FileError
        No such file, no JSON, or a matrix that is not rigid.
    """
    held = _json(path)
    rows = held.get("matrix", held.get("cloud_from_model")) if isinstance(held, dict) else held
    mm = _units(path, held["units"]) if isinstance(held, dict) and "units" in held else 1.0
    try:
        return pose_of("matrix", _rows(rows), mm=mm)
    except (ValueError, TypeError) as error:
        raise FileError(
            f"{path}: holds no rigid 4x4 matrix: {error}; give [[r, r, r, x], ..., [0, 0, 0, 1]], mm"
        ) from error


@dataclass(frozen=True, slots=True, eq=False)
class RobotEnd:
    """Where the camera is on the robot, as its file states it."""

    robot_from_camera: Pose  # mm
    warning: str = ""  # what looks wrong about it, in one line


_EXAMPLE = '{"robot_from_camera": [[r, r, r, x], ..., [0, 0, 0, 1]], "units": "mm", "convention": "matrix"}'
_NEAR = 10.0  # mm; a camera is hardly ever nearer than this to a robot's base or flange in all of x, y and z


def read_robot_from_camera(path: Path) -> RobotEnd:
    """Pose robot_from_camera of a JSON object with the keys ``robot_from_camera``, ``units`` and ``convention``.

    The convention is the name of a notation of `calibration.notation`, and the value its numbers. Nothing is guessed:
    a 4x4 of nested rows alone may go without a convention, since it can be no other.

    Raises
    ------
    FileError
        No such file, no JSON object, a key that is missing or unknown, numbers that are no rigid motion.
    """
    held = _json(path)
    if isinstance(held, dict) and "cloud_from_model" in held and "robot_from_camera" not in held:
        raise FileError(
            f"{path}: is the answer of scope pose, which says where a part is, not where the camera is; give {_EXAMPLE}"
        )
    if not isinstance(held, dict) or "robot_from_camera" not in held:
        raise FileError(
            f"{path}: has no key robot_from_camera, so that nothing says what its numbers are; give {_EXAMPLE}"
        )
    for key in held:
        if key not in {"robot_from_camera", "units", "convention"}:
            raise FileError(
                f"{path}: {key[:40]!r} is an unknown key; allowed are robot_from_camera, units and convention: remove it"
            )
    if "units" not in held:
        raise FileError(f'{path}: has no key units; add "units": "mm" (or "m", "cm", "inch"), that of the translation')
    mm = _units(path, held["units"])
    numbers = held["robot_from_camera"]
    rows = isinstance(numbers, list) and len(numbers) > 0 and isinstance(numbers[0], list)
    convention = held.get("convention", "matrix" if rows else None)
    if convention not in NOTATIONS:
        raise FileError(
            f"{path}: convention {str(convention)[:30]!r} says not what the numbers are; use one of {', '.join(NOTATIONS)}"
        )
    try:
        pose = pose_of(convention, _rows(numbers), mm=mm)
    except (ValueError, TypeError) as error:
        raise FileError(
            f"{path}: robot_from_camera is no {convention}: {error}; the order is {' '.join(COLUMNS[convention])}"
        ) from error
    size = float(np.abs(pose.translation).max())
    warning = ""
    if 0.0 < size < _NEAR:
        warning = (
            f"{path}: robot_from_camera shifts by {size:.3g} mm at most; are its translations in metres? "
            f'units says {held["units"]!r}: "m" would make them {size / mm * 1000.0:.4g} mm'
        )
    return RobotEnd(pose, warning)


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); give a JSON file with a 4x4 matrix") from error
    except (ValueError, RecursionError) as error:
        text = str(error)[:80]
        raise FileError(f"{path}: is no JSON ({text}); give a 4x4 matrix, row by row, mm") from error


def _units(path: Path, name: object) -> float:
    if not isinstance(name, str) or name not in MM:
        raise FileError(f"{path}: units is {str(name)[:20]!r}; use one of {', '.join(MM)}")
    return MM[name]


def _rows(numbers: object) -> Array:
    """Numbers of JSON; ``ValueError`` for text, truth values and ragged rows."""
    flat = (
        [x for row in numbers for x in (row if isinstance(row, list) else [row])] if isinstance(numbers, list) else []
    )
    if not flat or any(isinstance(x, bool) or not isinstance(x, int | float) for x in flat):
        raise ValueError("numbers are expected")
    try:
        return np.array(numbers, dtype=np.float64)
    except OverflowError as error:
        raise ValueError("a number is too large") from error


def frame_of(cloud: ScanCloud, at: str) -> int | None:
    """Frame number of ``last``, ``first`` or a number; None for the first two where the cloud knows no sensor.

    Raises
    ------
    ValueError
        Any other word.
    MeasurementError
        A frame that the cloud does not know.
    """
    known = None if cloud.sensors is None or len(cloud.sensors) == 0 else cloud.sensors.frame
    if at in ("last", "first"):
        if known is None:
            return None
        return int(known.max() if at == "last" else known.min())
    if not at.isdecimal():
        raise ValueError(f"--at {at!r} is neither last nor first nor the number of a frame")
    if known is None or int(at) not in known:
        told = "no frames at all" if known is None else f"frames {known.min()} to {known.max()}"
        raise MeasurementError(f"the cloud has no frame {at}: it knows {told}; choose one of them with --at")
    return int(at)


def place(cloud: ScanCloud, result: PoseResult, at: str, robot: RobotEnd | Pose | None = None) -> Placed:
    """The pose in the camera's frame when frame ``at`` was taken, and in the robot's."""
    frame = frame_of(cloud, at)
    camera = None
    if frame is not None and result.cloud_from_model is not None and np.isfinite(cloud.camera_centre).all():
        camera = cloud.cloud_from_camera(frame).inverse @ result.cloud_from_model
    end = RobotEnd(robot) if isinstance(robot, Pose) else robot
    placed = end.robot_from_camera @ camera if end is not None and camera is not None else None
    return Placed(result, camera, placed, frame, (end.warning,) if end is not None and end.warning else ())


def write_deviation(path: Path, cloud: ScanCloud, result: PoseResult) -> None:
    """Write the part's points with their signed distance (mm, outside positive) from the model at the best pose.

    It stands there under the names that programs take for a scalar, see `scope.export.write_scalars`.
    """
    if not result.candidates:
        raise MeasurementError(f"{path}: there is no pose to compare with ({result.why}); nothing was written")
    told = (f"deviation from {result.model.name}, mm, outside positive", *(f"origin {line}" for line in cloud.origin))
    scalars = {"deviation": np.asarray(result.deviation, dtype=np.float32)}
    if np.isfinite(cloud.sigma).any():
        scalars["sigma"] = cloud.sigma[result.points]
    write_scalars(path, cloud.points[result.points], scalars, told)
