"""Frame number to the motion that puts the object back to position 0: cloud_from_C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calibration.geometry import Array, Pose
from ranging.errors import RangingError


class Motion(Protocol):
    """A pose for every frame."""

    def cloud_from_c(self, frame: int) -> Pose:
        """Motion from C when ``frame`` was taken to the cloud frame."""
        ...


@dataclass(frozen=True, slots=True)
class Fixed:
    """Nothing moves."""

    def cloud_from_c(self, frame: int) -> Pose:  # noqa: ARG002  (every frame alike)
        """Return the identity."""
        return Pose.identity()


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """Position of every frame: start + frame * step, or listed."""

    start: float
    step: float
    listed: Array | None = None  # (frames,), instead of start and step

    def at(self, frame: int) -> float:
        """Position, mm or rad; ``RangingError`` for a frame that is not listed."""
        if self.listed is None:
            return self.start + frame * self.step
        if frame >= len(self.listed):
            raise RangingError(
                f"{len(self.listed)} positions for frame {frame}; one a frame is needed: complete the list"
            )
        return float(self.listed[frame])


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """A linear stage: x_cloud = x_C - s direction."""

    direction: Array  # (3,) unit, in C
    positions: Positions  # mm
    sign: float = 1.0  # -1 where the sensor moves

    def cloud_from_c(self, frame: int) -> Pose:
        """Shift by -s along the direction."""
        return Pose(np.eye(3), -self.sign * self.positions.at(frame) * self.direction)


@dataclass(frozen=True, slots=True, eq=False)
class Turntable:
    """A turntable: x_cloud = p + Rot(axis, -s) (x_C - p), right-hand rule."""

    point: Array  # (3,) mm, on the axis, in C
    axis: Array  # (3,) unit, in C
    positions: Positions  # rad
    sign: float = 1.0

    def cloud_from_c(self, frame: int) -> Pose:
        """Turn by -s about the axis."""
        turn = Pose.from_rotation_vector(-self.sign * self.positions.at(frame) * self.axis, np.zeros(3))
        return Pose(turn.rotation, self.point - turn.rotation @ self.point)


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """A measured pose for every frame."""

    cloud_from_camera: tuple[Pose, ...]

    def cloud_from_c(self, frame: int) -> Pose:
        """Pose of the frame; ``RangingError`` where there is none."""
        if frame >= len(self.cloud_from_camera):
            raise RangingError(f"{len(self.cloud_from_camera)} poses and a frame {frame}; one pose a frame is needed")
        return self.cloud_from_camera[frame]
