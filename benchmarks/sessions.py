"""Simulated calibration sessions: marks on planes, seen by a pinhole with a lens (OpenCV's projection)."""

from __future__ import annotations

import cv2
import numpy as np

from calibration.geometry import Array, Pose
from calibration.rays import PlaneMarks

SIZE = (1280, 960)
FOUR = (320.0, 373.0, 427.0, 480.0)
FIVE = (320.0, 360.0, 400.0, 440.0, 480.0)
SEVEN = (320.0, 347.0, 373.0, 400.0, 427.0, 453.0, 480.0)


def session(
    rng: np.random.Generator,
    *,
    stand_offs: tuple[float, ...] = FIVE,
    rows: int = 19,
    columns: int = 25,
    pitch: float = 12.0,
    noise_px: float = 0.02,
    target_mm: float = 0.0,
    focal_px: float = 1400.0,
    lens: tuple[float, ...] = (-0.18, 0.05, 4e-4, -3e-4, 0.0),
    oblique: float = 0.0,
    azimuth: float = 0.0,
    true_pose: dict[int, Pose] | None = None,
    true_scale: dict[int, float] | None = None,
) -> list[PlaneMarks]:
    """Marks of a session, stated where the jig says, and seen where they are.

    Lengths mm, angles rad. The camera looks at the middle of the volume from ``oblique`` off the normal. ``true_pose``
    moves the target of a plane in its own frame from where it is stated to be; ``true_scale`` stretches its spacing.
    """
    flat = np.stack(np.meshgrid(np.arange(columns) * pitch, np.arange(rows) * pitch), axis=-1).reshape(-1, 2)
    real = flat + target_mm * rng.standard_normal(flat.shape)
    middle = flat.mean(axis=0)
    turn = Pose.from_rotation_vector(oblique * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]), np.zeros(3)).rotation
    aim = np.array([0.0, 0.0, float(np.mean(stand_offs))])
    matrix = np.array([[focal_px, 0, SIZE[0] / 2 + 15], [0, focal_px, SIZE[1] / 2 - 10], [0, 0, 1.0]])
    planes = []
    for k, z in enumerate(stand_offs):
        stated = Pose(np.eye(3), np.array([-middle[0], -middle[1], z]))
        true = stated @ true_pose[k] if true_pose and k in true_pose else stated
        scale = true_scale.get(k, 1.0) if true_scale else 1.0
        world = true.apply(np.column_stack([real * scale, np.zeros(len(real))]))
        seen = (world - aim) @ turn.T + aim
        pixels = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, np.array(lens))[0][:, 0]
        pixels = pixels + noise_px * rng.standard_normal(pixels.shape)
        inside = ((pixels > 5) & (pixels < np.array(SIZE) - 6)).all(axis=1)
        unknown = np.full((int(inside.sum()), 2, 2), np.nan)
        planes.append(PlaneMarks(f"w{z:.0f}", pixels[inside], flat[inside], stated, np.flatnonzero(inside), unknown))
    return planes


def misplacement(kind: str, size: float, angle: float, about: Array) -> Pose:
    """Motion of a target in its own frame.

    ``slip`` by size mm towards angle, ``rotation`` by size rad about a point (2,) of it, ``stand_off`` by size mm,
    ``tilt`` by size rad about the line through the point along angle.
    """
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    centre = np.append(about, 0.0)
    if kind == "slip":
        return Pose(np.eye(3), size * along)
    if kind == "stand_off":
        return Pose(np.eye(3), np.array([0.0, 0.0, size]))
    axis = {"rotation": np.array([0.0, 0.0, 1.0]), "tilt": along}[kind]
    rotation = Pose.from_rotation_vector(size * axis, np.zeros(3)).rotation
    return Pose(rotation, centre - rotation @ centre)
