"""Frame number to the motion that puts the object back to position 0: cloud_from_C."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
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
class ToldPositions(Positions):
    """Positions that are told while the frames come: ``known`` grows, and holds a frame's before it is ranged."""

    known: dict[int, float] = field(default_factory=dict)  # mm or rad, by frame

    def at(self, frame: int) -> float:
        """Position, mm or rad; ``RangingError`` for a frame of which none was told."""
        if frame not in self.known:
            raise RangingError(f"no position was told of frame {frame}; one a frame is needed")
        return self.known[frame]


@dataclass(frozen=True, slots=True, eq=False, init=False)
class Linear:
    """A linear stage that carries the object: x_cloud = x_C - s direction; sign -1 where it carries the sensor.

    Parameters
    ----------
    direction : (3,)
        Of the motion, in C; its length does not matter.
    step : float
        mm from frame to frame.
    positions : (frames,) or Positions
        mm, instead of a step.
    start : float
        mm, position of frame 0.
    sign : float
        1 where the object moves, -1 where the sensor does.

    Raises
    ------
    ValueError
        Neither or both of step and positions, a direction of another shape or of no length.
    """

    direction: Array  # (3,) unit, in C
    positions: Positions  # mm
    sign: float  # -1 where the sensor moves

    def __init__(
        self,
        direction: Sequence[float] | Array,
        step: float | None = None,
        *,
        positions: Positions | Sequence[float] | Array | None = None,
        start: float = 0.0,
        sign: float = 1.0,
    ) -> None:
        object.__setattr__(self, "direction", _unit(direction, "direction"))
        object.__setattr__(self, "positions", _positions(step, positions, start, "mm"))
        object.__setattr__(self, "sign", _sign(sign))

    def cloud_from_c(self, frame: int) -> Pose:
        """Shift by -s along the direction."""
        return Pose(np.eye(3), -self.sign * self.positions.at(frame) * self.direction)


@dataclass(frozen=True, slots=True, eq=False, init=False)
class Turntable:
    """A turntable that carries the object: x_cloud = p + Rot(axis, -s) (x_C - p), right-hand rule.

    Parameters
    ----------
    point : (3,)
        mm, on the axis, in C.
    axis : (3,)
        Direction of the axis, in C; its length does not matter.
    step : float
        rad from frame to frame.
    positions : (frames,) or Positions
        rad, instead of a step.
    start : float
        rad, position of frame 0.
    sign : float
        1 where the object turns, -1 where the sensor goes around it.

    Raises
    ------
    ValueError
        Neither or both of step and positions, a point or axis of another shape, an axis of no length.
    """

    point: Array  # (3,) mm, on the axis, in C
    axis: Array  # (3,) unit, in C
    positions: Positions  # rad
    sign: float

    def __init__(
        self,
        point: Sequence[float] | Array,
        axis: Sequence[float] | Array,
        step: float | None = None,
        *,
        positions: Positions | Sequence[float] | Array | None = None,
        start: float = 0.0,
        sign: float = 1.0,
    ) -> None:
        object.__setattr__(self, "point", _vector(point, "point", "mm"))
        object.__setattr__(self, "axis", _unit(axis, "axis"))
        object.__setattr__(self, "positions", _positions(step, positions, start, "rad"))
        object.__setattr__(self, "sign", _sign(sign))

    def cloud_from_c(self, frame: int) -> Pose:
        """Turn by -s about the axis."""
        turn = Pose.from_rotation_vector(-self.sign * self.positions.at(frame) * self.axis, np.zeros(3))
        return Pose(turn.rotation, self.point - turn.rotation @ self.point)


@dataclass(frozen=True, slots=True, eq=False, init=False)
class Poses:
    """A measured pose for every frame.

    Parameters
    ----------
    cloud_from_camera : Poses or (frames, 4, 4)
        Of the camera frame C in the cloud frame, lengths in mm, one a frame.

    Raises
    ------
    ValueError
        Arrays of another shape, or whose rotation is none.
    """

    cloud_from_camera: tuple[Pose, ...]

    def __init__(self, cloud_from_camera: Sequence[Pose] | Sequence[Array] | Array) -> None:
        object.__setattr__(self, "cloud_from_camera", tuple(_pose(pose) for pose in cloud_from_camera))

    def cloud_from_c(self, frame: int) -> Pose:
        """Pose of the frame; ``RangingError`` where there is none."""
        if frame >= len(self.cloud_from_camera):
            raise RangingError(f"{len(self.cloud_from_camera)} poses and a frame {frame}; one pose a frame is needed")
        return self.cloud_from_camera[frame]


def _vector(value: Sequence[float] | Array, name: str, unit: str) -> Array:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} must be three finite numbers, {unit}, in C; it has the shape {vector.shape}")
    return vector


def _unit(value: Sequence[float] | Array, name: str) -> Array:
    vector = _vector(value, name, "of any length")
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise ValueError(f"{name} is (0, 0, 0): a direction (3,) in C is needed")
    return vector if abs(length - 1.0) < 1e-15 else np.asarray(vector / length)


def _positions(
    step: float | None, positions: Positions | Sequence[float] | Array | None, start: float, unit: str
) -> Positions:
    if isinstance(positions, Positions) and step is None:
        return positions
    if (step is None) == (positions is None):
        raise ValueError(f"give either step ({unit} a frame) or positions (frames,) in {unit}")
    if positions is None:
        if step == 0.0:
            raise ValueError(f"step is 0 {unit}: every frame would lie on the first; give the distance between frames")
        return Positions(float(start), float(step or 0.0))
    listed = np.asarray(positions, dtype=np.float64)
    if listed.ndim != 1 or not np.isfinite(listed).all():
        raise ValueError(f"positions must be finite, of shape (frames,), in {unit}; they have the shape {listed.shape}")
    return Positions(0.0, 0.0, listed)


def _sign(sign: float) -> float:
    if sign not in {1.0, -1.0}:
        raise ValueError(f"sign must be 1 (the object moves) or -1 (the sensor moves), not {sign!r}")
    return float(sign)


def _pose(value: Pose | Array) -> Pose:
    if isinstance(value, Pose):
        return value
    return Pose.from_matrix(value)
