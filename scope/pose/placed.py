"""`scope pose` and `scope check` from files to results: what the commands print and write."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.atomic import written_whole
from calibration.errors import FileError
from calibration.geometry import Pose
from scope.cloud import ScanCloud, ply
from scope.errors import MeasurementError
from scope.pose.estimate import PoseResult


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A pose in the frames that were asked for; None where there is no pose or the cloud does not know the sensor."""

    result: PoseResult
    camera_from_model: Pose | None
    robot_from_model: Pose | None
    at: int | None  # frame


def read_transform(path: Path) -> Pose:
    """Pose of a JSON file: a 4x4 row-major list (mm), or an object with it under ``matrix`` or ``cloud_from_model``.

    Raises
    ------
    FileError
        No such file, no JSON, or a matrix that is not rigid.
    """
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); give a JSON file with a 4x4 matrix") from error
    except ValueError as error:
        raise FileError(f"{path}: is no JSON ({error}); give a 4x4 matrix, row by row, mm") from error
    rows = held.get("matrix", held.get("cloud_from_model")) if isinstance(held, dict) else held
    try:
        return Pose.from_matrix(np.array(rows, dtype=np.float64))
    except (ValueError, TypeError) as error:
        raise FileError(
            f"{path}: holds no rigid 4x4 matrix: {error}; give [[r, r, r, x], ..., [0, 0, 0, 1]], mm"
        ) from error


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


def place(cloud: ScanCloud, result: PoseResult, at: str, robot_from_camera: Pose | None) -> Placed:
    """The pose in the camera's frame when frame ``at`` was taken, and in the robot's."""
    frame = frame_of(cloud, at)
    camera = None
    if frame is not None and result.cloud_from_model is not None and np.isfinite(cloud.camera_centre).all():
        camera = cloud.cloud_from_camera(frame).inverse @ result.cloud_from_model
    robot = robot_from_camera @ camera if robot_from_camera is not None and camera is not None else None
    return Placed(result, camera, robot, frame)


def write_deviation(path: Path, cloud: ScanCloud, result: PoseResult) -> None:
    """A PLY of the part's points with their signed distance (mm, outside positive) from the model at the best pose."""
    if not result.candidates:
        raise MeasurementError(f"{path}: there is no pose to compare with ({result.why}); nothing was written")
    points = cloud.points[result.points]
    rows = np.zeros(len(points), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("deviation", "<f4")])
    rows["x"], rows["y"], rows["z"] = points.T
    rows["deviation"] = result.deviation
    with written_whole(path) as stream:
        ply.write(
            stream, ply.Ply({"vertex": rows}, ("units mm", f"deviation from {result.model.name}, mm, outside positive"))
        )
