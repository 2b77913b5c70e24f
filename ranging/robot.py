"""A scanner on a robot's arm, or a part on it: motion from the robot's poses and the place of the camera, with its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibration.geometry import Array, Pose
from ranging.errors import RangingError


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """A pose of the robot for every frame.

    The cloud's frame is the robot's base where the camera is on the arm, and the flange, which carries the object, where the
    camera stands beside it.
    """

    mount: Literal["hand", "fixed"]
    sensor: Pose  # flange_from_camera, or base_from_camera
    base_from_flange: Sequence[Pose]  # one a frame, mm
    covariance: Array  # (6, 6) of ``sensor``: x, y, z mm, turns about x, y, z of the frame it leads to, rad
    repeatability: tuple[float, float]  # mm and rad, one standard deviation of a pose of the robot
    rig_sha256: str = ""  # of the rig whose frame C the sensor's is

    def cloud_from_c(self, frame: int) -> Pose:
        """Pose of the frame; ``RangingError`` where there is none."""
        if frame >= len(self.base_from_flange):
            raise RangingError(f"{len(self.base_from_flange)} poses and a frame {frame}; one pose a frame is needed")
        flange = self.base_from_flange[frame]
        return (flange if self.mount == "hand" else flange.inverse) @ self.sensor

    def sigma_along(self, frame: int, points: Array, view: Array) -> Array:
        """Standard deviation (N,) mm along the sighting rays (N, 3) at points (N, 3) of C: hand-eye and robot's pose.

        A turn w and a shift d of the sensor's pose move a point by d + w x p along the axes of the frame it leads to. The
        part of the hand-eye is shared by all frames, that of the robot's pose by the points of one; where a point moves
        across its ray, this figure does not show it.
        """
        at, ray = self.sensor.apply(points) - self.sensor.translation, view @ self.sensor.rotation.T
        by_sensor = np.concatenate([ray, np.cross(at, ray)], axis=1)
        variance = np.einsum("ni,ij,nj->n", by_sensor, self.covariance, by_sensor)
        flange = at + self.sensor.translation  # the robot's own error turns about the flange
        if self.mount == "fixed":
            back = self.base_from_flange[frame].inverse
            flange, ray = back.apply(flange), ray @ back.rotation.T
        lever = np.cross(flange, ray)
        mm, rad = self.repeatability
        return np.asarray(np.sqrt(np.maximum(variance, 0.0) + mm**2 + rad**2 * (lever**2).sum(axis=1)))
