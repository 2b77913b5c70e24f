"""An arm, a camera and a board, drawn by an independent pinhole: images, a log of poses, and the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calibration.geometry import Pose
from calibration.rays import PinholeCamera
from calibration.rig import Rig, Verification
from calibration.volume import Volume

SIZE = (800, 600)
MATRIX = np.array([[1100.0, 0.0, 396.0], [0.0, 1100.0, 304.0], [0.0, 0.0, 1.0]])
ROWS, COLUMNS, PITCH = 6, 9, 5.0


def pose(vector, shift) -> Pose:
    """By SciPy's rotations."""
    return Pose(Rotation.from_rotvec(vector).as_matrix(), np.asarray(shift, dtype=float))


@dataclass(frozen=True)
class Arm:
    """Poses of a session."""

    sensor: Pose  # flange_from_camera, or base_from_camera
    target: Pose
    said: list[Pose]  # base_from_flange, with the robot's error
    seen: list[Pose]  # camera_from_target, true


def marks() -> np.ndarray:
    column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    return PITCH * np.column_stack([column.ravel(), row.ravel(), np.zeros(column.size)])


def arm(rng, n=15, *, mount="hand", sigma=(0.03, 0.01), axes=(0.35, 0.35, 0.8), away=190.0) -> Arm:
    """Views in which the board is whole; sigma of the robot in mm and degrees, turns (rad) of the camera about x, y, z."""
    sensor = pose([0.1, -0.2, 1.2], [40.0, -25.0, 90.0])
    target = pose([0.4, 0.1, -0.6], [520.0, 130.0, 60.0])
    middle = marks().mean(axis=0)
    said, seen = [], []
    for _ in range(n):
        turn = pose(np.clip(rng.normal(0, 1, 3), -1.6, 1.6) * axes, np.zeros(3))
        at = np.array([*rng.uniform(-12, 12, 2), away + rng.uniform(-25, 25)])
        view = Pose(turn.rotation, at - turn.rotation @ middle)
        error = pose(rng.normal(0, np.deg2rad(sigma[1]), 3), rng.normal(0, sigma[0], 3))
        flange = target @ view.inverse @ sensor.inverse if mount == "hand" else sensor @ view @ target.inverse
        said.append(flange @ error.inverse)
        seen.append(view)
    return Arm(sensor, target, said, seen)


def rig() -> Rig:
    """The pinhole that draws, as a rig without lasers."""
    volume = Volume(np.vstack([np.eye(3), -np.eye(3)]), np.full(6, 1e4))
    camera = PinholeCamera(MATRIX, np.zeros(5), Pose.identity(), SIZE, volume, np.zeros((9, 9)), 0.05)
    return Rig(camera, {}, (), Verification(True, "given"))


def project(view: Pose, points: np.ndarray) -> np.ndarray:
    p = view.apply(points) @ MATRIX.T
    return p[:, :2] / p[:, 2:]


def picture(view: Pose, rng) -> np.ndarray:
    """A chessboard with a white margin, twice as fine and then averaged, blurred and noisy."""
    fine, per = 2, 16
    board = np.kron(
        (np.indices((ROWS + 1, COLUMNS + 1)).sum(axis=0) % 2).astype(np.uint8) * 190 + 30, np.ones((per, per), np.uint8)
    )
    board = cv2.copyMakeBorder(board, per, per, per, per, cv2.BORDER_CONSTANT, value=220)
    scale = PITCH / per  # mm a texel; inner corner (0, 0) lies at texel (2 per, 2 per) - 0.5
    texel = np.array([[scale, 0, scale * (0.5 - 2 * per)], [0, scale, scale * (0.5 - 2 * per)], [0, 0, 1.0]])
    flat = MATRIX @ np.column_stack([view.rotation[:, :2], view.translation])
    up = np.array([[fine, 0, 0.5 * (fine - 1)], [0, fine, 0.5 * (fine - 1)], [0, 0, 1.0]])
    big = cv2.warpPerspective(
        board, up @ flat @ texel, (SIZE[0] * fine, SIZE[1] * fine), flags=cv2.INTER_LINEAR, borderValue=90
    )
    small = cv2.GaussianBlur(cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA).astype(float), (0, 0), 0.6)
    return np.clip(small + rng.normal(0, 1.5, small.shape), 0, 255).astype(np.uint8)


def numbers(notation: str, flange: Pose, mm: float) -> list[float]:
    """By SciPy, not by the code under test."""
    turn, place = Rotation.from_matrix(flange.rotation), list(flange.translation / mm)
    if notation == "quaternion-xyzw":
        return place + list(turn.as_quat())
    if notation in {"quaternion-wxyz", "abb"}:
        return place + list(np.roll(turn.as_quat(), 1))
    if notation == "ur":
        return place + list(turn.as_rotvec())
    if notation == "kuka":
        return place + list(turn.as_euler("ZYX", degrees=True))
    if notation in {"fanuc", "rpy-deg"}:
        return place + list(turn.as_euler("xyz", degrees=True))
    matrix = flange.matrix.copy()
    matrix[:3, 3] /= mm
    return list(matrix.ravel())


HEADERS = {
    "quaternion-xyzw": "x,y,z,qx,qy,qz,qw", "quaternion-wxyz": "x,y,z,qw,qx,qy,qz", "ur": "x,y,z,rx,ry,rz",
    "kuka": "x,y,z,a,b,c", "fanuc": "x,y,z,w,p,r", "rpy-deg": "x,y,z,roll,pitch,yaw", "abb": "x,y,z,q1,q2,q3,q4",
    "matrix": ",".join(f"m{i}{j}" for i in range(4) for j in range(4)),
}  # fmt: skip


def write_log(path: Path, poses, *, notation="quaternion-xyzw", mm=1000.0, header=None, inverse=False) -> None:
    lines = ["image," + HEADERS[header or notation]]
    for k, flange in enumerate(poses):
        values = numbers(notation, flange.inverse if inverse else flange, mm)
        lines.append(f"im{k:02}.png," + ",".join(f"{v:.9g}" for v in values))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_toml(
    folder: Path, *, mount="hand", units="m", notation="quaternion-xyzw", gives="base_from_flange", more=""
) -> Path:
    path = folder / "hand-eye.toml"
    path.write_text(
        f'format = 1\nunits = "mm"\nmount = "{mount}"\n[target]\nkind = "chessboard"\nrows = {ROWS}\ncolumns = {COLUMNS}\n'
        f'pitch = {PITCH}\n[robot]\nposes = "poses.csv"\nunits = "{units}"\nnotation = "{notation}"\ngives = "{gives}"\n'
        f'images = "views/*.png"\n{more}',
        encoding="utf-8",
    )
    return path


def write_session(folder: Path, made: Arm, rng, **log) -> Path:
    """A whole session on disk: images, log, toml and rig."""
    (folder / "views").mkdir(parents=True)
    for k, view in enumerate(made.seen):
        cv2.imwrite(str(folder / "views" / f"im{k:02}.png"), picture(view, rng))
    write_log(folder / "poses.csv", made.said, **log)
    rig().save(folder / "rig.json")
    return write_toml(folder)
