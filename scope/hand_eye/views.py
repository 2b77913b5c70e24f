"""Images of the target to what the adjustment of hand and eye takes: marks, rays, and what a pixel is worth."""

from __future__ import annotations

import numpy as np

from calibration.camera import Camera
from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array, Pose
from calibration.rays import PlaneMarks, locate_target
from calibration.stages import SeenTarget
from calibration.targets import Charuco, MarkerBoard, SpotGrid, Target


def seen_target(camera: Camera, marks: PlaneMarks, base_from_flange: Pose, target: Target | None) -> SeenTarget:
    """One view for the adjustment.

    Parameters
    ----------
    camera : Camera
        The rig's.
    marks : PlaneMarks
        Of the view; its pose is found here.
    base_from_flange : Pose
        As the robot says.
    target : Target or None
        A grid that looks the same after a turn gives a pose for each of them.

    Raises
    ------
    CalibrationError
        Marks from which no pose follows.
    """
    known = np.asarray(np.isfinite(camera.rays(marks.pixels).direction).all(axis=1))
    placed = locate_target(camera, marks.select(known) if not known.all() else marks)
    world, pixels = placed.world, placed.pixels
    near = world[:, 2] if camera.model == "two-plane" else None
    rays = camera.rays(pixels, near=near)
    to_pixels = _to_pixels(rays.direction, camera.shift(pixels, world))
    points = np.column_stack([placed.points, np.zeros(len(placed))])
    by_camera = None
    if np.isfinite(camera.covariance).all():
        by_camera = np.einsum("nij,njp->nip", to_pixels, camera.jacobian(pixels, world))
    turns = alike(target)
    return SeenTarget(
        marks.name, base_from_flange, tuple(placed.c_from_plane @ turn.inverse for turn in turns),
        tuple(turn.apply(points) for turn in turns), rays.origin, to_pixels, placed.covariance, by_camera,
    )  # fmt: skip


def alike(target: Target | None) -> tuple[Pose, ...]:
    """Turns of the target's frame after which its marks stand where others stood, the identity first.

    Boards whose marks have names, and grids with fiducials, have none.
    """
    still = (Pose.identity(),)
    if (
        target is None
        or isinstance(target, Charuco | MarkerBoard)
        or (isinstance(target, SpotGrid) and target.fiducials)
    ):
        return still
    marks = target.marks
    middle = (marks.min(axis=0) + marks.max(axis=0)) / 2
    found = list(still)
    for quarter in (2, 1, 3):
        turn = Pose.from_rotation_vector([0.0, 0.0, quarter * np.pi / 2], np.zeros(3))
        turn = Pose(np.rint(turn.rotation), middle - np.rint(turn.rotation) @ middle)
        away = np.linalg.norm(turn.apply(marks)[:, None] - marks[None], axis=2).min(axis=1)
        if away.max() < 1e-6 * max(float(np.ptp(marks[:, :2])), 1e-9):
            found.append(turn)
    return tuple(found)


def require_size(found: tuple[int, int], camera: Camera, image: str) -> None:
    """``FileError`` for an image of another size than the rig's."""
    if found != camera.size:
        raise FileError(
            f"{image}: {found[0]} x {found[1]} px; the rig was calibrated at {camera.size[0]} x {camera.size[1]} px: take "
            "the views with the settings of the calibration"
        )


def _to_pixels(direction: Array, shift: Array) -> Array:
    """Movement (n, 2, 3) px/mm of a point's image, from the rays' directions (n, 3) and mm/px (n, 3, 2) across them."""
    across = np.eye(3) - np.einsum("ni,nj->nij", direction, direction)
    moved = across @ shift
    normal = moved.transpose(0, 2, 1) @ moved
    if not np.isfinite(normal).all() or (np.linalg.det(normal) <= 0).any():
        raise CalibrationError("marks outside the calibrated part of the image; bring the target nearer to its middle")
    return np.asarray(np.linalg.inv(normal) @ moved.transpose(0, 2, 1))
