"""Rigid motions as robots and people write them: numbers in the order of a named notation, to a `Pose` and back.

================  ==============================  =====================================================================
notation          columns                         rotation
================  ==============================  =====================================================================
matrix            m00 m01 ... m33                 4x4, row by row
quaternion-xyzw   x y z qx qy qz qw               unit quaternion, real part last (ROS, scipy)
quaternion-wxyz   x y z qw qx qy qz               unit quaternion, real part first (Eigen's constructor, SCOPE)
ur                x y z rx ry rz                  rotation vector, axis times angle, rad (Universal Robots, ``p[...]``)
kuka              x y z a b c                     degrees, R = Rz(a) Ry(b) Rx(c) (KUKA KRL, ``FRAME``)
fanuc             x y z w p r                     degrees about the fixed axes x, y, z: R = Rz(r) Ry(p) Rx(w)
abb               x y z q1 q2 q3 q4               unit quaternion, real part first (ABB RAPID, ``orient``)
rpy-deg           x y z roll pitch yaw            degrees about the fixed axes x, y, z: R = Rz(yaw) Ry(pitch) Rx(roll)
================  ==============================  =====================================================================

Sources: the makers' manuals (UR Script: Pose; KUKA System Software: FRAME, A B C; FANUC Operator's Manual: W P R; ABB
RAPID: orient). Angles are read in any range; those that are given lie in -180 to 180 degrees (the middle one in -90 to 90).
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from calibration.geometry import Array, Pose, quaternion_from_rotation, rotation_from_quaternion

Notation = Literal["matrix", "quaternion-xyzw", "quaternion-wxyz", "ur", "kuka", "fanuc", "abb", "rpy-deg"]
NOTATIONS: tuple[Notation, ...] = get_args(Notation)
_PLACE = ("x", "y", "z")
COLUMNS: dict[Notation, tuple[str, ...]] = {
    "matrix": tuple(f"m{i}{j}" for i in range(4) for j in range(4)),
    "quaternion-xyzw": (*_PLACE, "qx", "qy", "qz", "qw"),
    "quaternion-wxyz": (*_PLACE, "qw", "qx", "qy", "qz"),
    "ur": (*_PLACE, "rx", "ry", "rz"),
    "kuka": (*_PLACE, "a", "b", "c"),
    "fanuc": (*_PLACE, "w", "p", "r"),
    "abb": (*_PLACE, "q1", "q2", "q3", "q4"),
    "rpy-deg": (*_PLACE, "roll", "pitch", "yaw"),
}
_LOOSE = 0.01  # a quaternion of four digits is off its length by less


def pose_of(notation: Notation, values: ArrayLike, *, mm: float = 1.0) -> Pose:
    """Pose of the numbers of a notation.

    Parameters
    ----------
    notation : Notation
        What the numbers are.
    values : (n,) or (4, 4)
        One for each of ``COLUMNS[notation]``; a matrix may keep its rows.
    mm : float
        Length of the unit of the translation, mm.

    Raises
    ------
    ValueError
        Another count of numbers, one that is not finite, a matrix that is not rigid, a quaternion that is no unit quaternion.
    """
    given = np.asarray(values, dtype=np.float64)
    if notation == "matrix":
        pose = Pose.from_matrix(given.reshape(4, 4) if given.shape == (16,) else given, tolerance=1e-3)
        return Pose(pose.rotation, pose.translation * mm)
    columns = COLUMNS[notation]
    if given.shape != (len(columns),) or not np.isfinite(given).all():
        raise ValueError(
            f"{notation} is {len(columns)} finite numbers: {', '.join(columns)}; found shape {given.shape}"
        )
    place, turn = given[:3] * mm, given[3:]
    if notation == "ur":
        return Pose.from_rotation_vector(turn, place)
    if notation in {"kuka", "fanuc", "rpy-deg"}:
        about_xyz = turn[::-1] if notation == "kuka" else turn
        return Pose(_from_roll_pitch_yaw(np.radians(about_xyz)), place)
    length = float(np.linalg.norm(turn))
    if abs(length - 1.0) > _LOOSE:
        raise ValueError(f"a quaternion has length 1; found {length:.4g}")
    real_first = np.roll(turn, 1) if notation == "quaternion-xyzw" else turn
    return Pose(rotation_from_quaternion(real_first / length), place)


def numbers_of(notation: Notation, pose: Pose, *, mm: float = 1.0) -> Array:
    """Numbers of a pose in the order of ``COLUMNS[notation]``; the translation in units of ``mm`` mm.

    Where an angle is not determined (pitch of +-90 degrees), the one about x is 0.
    """
    place = pose.translation / mm
    if notation == "matrix":
        return np.asarray(Pose(pose.rotation, place).matrix.ravel())
    if notation == "ur":
        turn = rotation_vector(pose.rotation)
    elif notation in {"kuka", "fanuc", "rpy-deg"}:
        angles = np.degrees(roll_pitch_yaw(pose.rotation))
        turn = angles[::-1] if notation == "kuka" else angles
    else:
        quaternion = quaternion_from_rotation(pose.rotation)
        turn = np.roll(quaternion, -1) if notation == "quaternion-xyzw" else quaternion
    return np.concatenate([place, turn])


def rotation_vector(rotation: Array) -> Array:
    """Axis times angle (3,) rad, of length 0 to pi; at pi either sense of the axis is right and one is given."""
    q = quaternion_from_rotation(rotation)
    sine = float(np.linalg.norm(q[1:]))
    return np.asarray(q[1:] * (2.0 if sine < 1e-12 else 2.0 * np.arctan2(sine, q[0]) / sine))


def roll_pitch_yaw(rotation: Array) -> Array:
    """Angles (3,) rad about the fixed axes x, then y, then z: R = Rz(yaw) Ry(pitch) Rx(roll).

    At pitch = +-90 degrees only the sum or difference of the others is known: roll is then 0.
    """
    pitch = float(np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0])))
    if np.hypot(rotation[0, 0], rotation[1, 0]) < 1e-9:
        return np.array([0.0, pitch, float(np.arctan2(-rotation[0, 1], rotation[1, 1]))])
    roll = float(np.arctan2(rotation[2, 1], rotation[2, 2]))
    return np.array([roll, pitch, float(np.arctan2(rotation[1, 0], rotation[0, 0]))])


def _from_roll_pitch_yaw(angles: Array) -> Array:
    """Rotation Rz(yaw) Ry(pitch) Rx(roll) of angles (3,) rad about x, y, z."""
    x, y, z = (
        Pose.from_rotation_vector(angle * axis, np.zeros(3)) for angle, axis in zip(angles, np.eye(3), strict=True)
    )
    return (z @ y @ x).rotation
