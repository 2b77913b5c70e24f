"""Several clouds against one model: prepared once, one answer a cloud, one table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import ScopeError
from calibration.geometry import Pose
from calibration.notation import roll_pitch_yaw
from scope.cloud import Region, ScanCloud, unknown
from scope.model import load_model
from scope.pose.answer import PoseOptions
from scope.pose.estimate import estimate_pose
from scope.pose.placed import Placed, RobotEnd, frame_of, place
from scope.pose.wording import pose_result

FOUND, BAD_DATA, NOT_SURE = 0, 1, 3  # exit status of a cloud


@dataclass(frozen=True, slots=True, eq=False)
class Sighted:
    """What became of one cloud of several."""

    path: Path
    cloud: ScanCloud | None  # None where it could not be read
    placed: Placed | None  # None where there was no answer at all
    error: str = ""  # why not, in one line
    unread: str = ""  # what the cloud does not tell

    @property
    def status(self) -> int:
        """0 found, 1 bad data, 3 refused or ambiguous."""
        if self.placed is None:
            return BAD_DATA
        return FOUND if self.placed.result.found else NOT_SURE


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """Of which position, and in which robot's base, poses are told."""

    at: str = "last"
    robot: RobotEnd | None = None


def poses_of(
    clouds: Sequence[Path],
    model: Path,
    *,
    region: Region | None = None,
    initial: Pose | None = None,
    told_in: Told = Told(),
    options: PoseOptions | None = None,
    on_cloud: Callable[[int, int], None] = lambda _done, _total: None,
) -> Iterator[Sighted]:
    """The pose of the part in each cloud; a cloud without an answer says why and does not stop the others.

    Parameters
    ----------
    clouds : sequence of path
        Cloud files, one open at a time.
    model : path
        Mesh of the part, read and prepared once.
    region, initial, options
        As for a single cloud: `estimate_pose`.
    told_in : Told
        Of which position, and in which robot's base, the poses are told: `place`.
    on_cloud : callable
        Told (done, total) after each.

    Raises
    ------
    FileError, MeasurementError
        The model cannot be used.
    """
    prepared = load_model(model)
    for number, path in enumerate(clouds, 1):
        cloud = None
        try:
            cloud = ScanCloud.load(path)
            frame_of(cloud, told_in.at)
            result = estimate_pose(cloud, prepared, region=region, initial=initial, options=options)
            yield Sighted(
                path, cloud, place(cloud, result, told_in.at, told_in.robot), unread=unknown(cloud, path.name)
            )
        except ScopeError as error:
            told = " ".join(str(error).split())
            yield Sighted(path, cloud, None, told if str(path) in told else f"{path}: {told}")
        on_cloud(number, len(clouds))


def sighted_result(sighted: Sighted) -> dict[str, Any]:
    """What --json gives of one cloud of several: as of a single one, with ``cloud``, ``status`` and ``error``."""
    head = {"cloud": str(sighted.path), "status": sighted.status, "error": sighted.error or None}
    return head | ({"found": False} if sighted.placed is None else pose_result(sighted.placed))


def poses_table(sighted: Sequence[Sighted]) -> str:
    """One row a cloud, in the frame of the robot where all know it, else of the camera, else of the cloud; mm and degrees."""
    known = [s.placed for s in sighted if s.placed is not None and s.placed.result.found]
    frame = "cloud"
    if known and all(p.robot_from_model is not None for p in known):
        frame = "robot"
    elif known and all(p.camera_from_model is not None for p in known):
        frame = "camera"
    titles = ("cloud", "x", "y", "z", "roll", "pitch", "yaw", "sigma mm", "deg", "rms mm", "answer")
    rows: list[tuple[str, ...]] = [titles]
    for each in sighted:
        blank = ("-",) * 9
        if each.placed is None:
            rows.append((each.path.name, *blank, f"error: {each.error}"))
        elif not each.placed.result.found:
            result = each.placed.result
            rows.append((each.path.name, *blank, f"{'ambiguous' if result.ambiguous else 'refused'}: {result.why}"))
        else:
            rows.append((each.path.name, *_numbers(each.placed, frame), f"found: {each.placed.result.why}"))
    wide = [max(len(row[k]) for row in rows) for k in range(10)]
    lines = [
        "  ".join([row[0].ljust(wide[0]), *(row[k].rjust(wide[k]) for k in range(1, 10)), row[10]]) for row in rows
    ]
    return "\n".join([f"the part in the frame of the {frame}, mm and degrees", *lines])


def _numbers(placed: Placed, frame: str) -> tuple[str, ...]:
    result = placed.result
    poses = {"robot": placed.robot_from_model, "camera": placed.camera_from_model, "cloud": result.cloud_from_model}
    pose = poses[frame]
    if pose is None:
        return ("-",) * 9
    turns = np.degrees(roll_pitch_yaw(pose.rotation))
    sigma = ("-", "-")
    if result.covariance is not None:
        sd = np.sqrt(np.diag(result.covariance))
        sigma = (f"{sd[:3].max():.4f}", f"{np.degrees(sd[3:].max()):.4f}")
    return (*(f"{x:.3f}" for x in (*pose.translation, *turns)), *sigma, f"{result.rmse_mm:.4f}")
