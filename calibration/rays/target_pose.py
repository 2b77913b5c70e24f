"""Where a target stands, from the rays of a calibrated camera: freehand views of a rig that has a jig."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from calibration.camera import centre_of
from calibration.errors import CalibrationError
from calibration.geometry import Array, Pose, Rays
from calibration.rays.plane_map import PlaneMarks


class RaySource(Protocol):
    """A camera, or a bare field of rays."""

    def rays(self, pixels: Array) -> Rays:
        """RaySource rays in C of pixels (N, 2) px."""
        ...


def locate_target(camera: RaySource, marks: PlaneMarks) -> PlaneMarks:
    """Marks of a freehand view with the pose that brings them nearest to their sighting rays.

    Starts from OpenCV's plane pose with the rays' nearest point as centre, and then minimises the distances between
    marks and rays (Gauss-Newton on the rigid motion), which needs no common centre. ``CalibrationError`` where fewer
    than six marks have a ray or the result does not explain the marks.
    """
    rays = camera.rays(marks.pixels)
    known = np.isfinite(rays.direction).all(axis=1)
    if known.sum() < 6:
        raise CalibrationError(
            f"view {marks.name}: {int(known.sum())} marks with a sighting ray; six or more are needed"
        )
    origin, direction = rays.origin[known], rays.direction[known]
    points = np.column_stack([marks.points[known], np.zeros(int(known.sum()))])
    centre = centre_of(rays)
    axis = direction.mean(axis=0)
    turn = _facing(axis / np.linalg.norm(axis))
    seen = direction @ turn.T
    flat = seen[:, :2] / seen[:, 2:]
    done, r, t = cv2.solvePnP(points, flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    if not done:
        raise CalibrationError(f"view {marks.name}: its {int(known.sum())} marks give no pose; take the view again")
    start = Pose.from_rotation_vector(np.ravel(r), np.ravel(t))
    pose = Pose(turn.T, centre) @ start
    kept = Rays(origin, direction)
    for _ in range(20):
        world = pose.apply(points)
        gap = world - origin
        across = gap - np.einsum("ni,ni->n", gap, direction)[:, None] * direction
        project = np.eye(3) - np.einsum("ni,nj->nij", direction, direction)
        arm = world - pose.translation
        cross = np.zeros((len(arm), 3, 3))  # d(world)/d(rotation) = -[arm]x
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = arm[:, 2], -arm[:, 1], arm[:, 0]
        cross -= cross.transpose(0, 2, 1)
        jacobian = np.concatenate([project @ cross, project], axis=2).reshape(-1, 6)
        step = -np.linalg.lstsq(jacobian, across.reshape(-1), rcond=None)[0]
        turned = Pose.from_rotation_vector(step[:3], np.zeros(3)).rotation
        pose = Pose(turned @ pose.rotation, pose.translation + step[3:])
        if np.abs(step).max() < 1e-10:
            break
    distance = kept.distance_to(pose.apply(points))
    if not np.median(distance) < 0.05 * float(np.ptp(points, axis=0).max()):
        raise CalibrationError(
            f"view {marks.name}: no pose brings its marks to their rays (median distance {np.median(distance):.2f} mm); is it "
            "the target of this file?"
        )
    return PlaneMarks(marks.name, marks.pixels, marks.points, pose, marks.mark, marks.covariance)


def centre_covariance(camera: RaySource, placed: PlaneMarks) -> Array:
    """Covariance (3, 3) mm^2 of the middle of a located target, from how far its marks lie from their rays.

    The marks of a rigid target share the error of its pose: along the sighting direction it is far larger than across.
    """
    rays, world = camera.rays(placed.pixels), placed.world
    known = np.isfinite(rays.direction).all(axis=1)
    direction, world = rays.direction[known], world[known]
    gap = world - rays.origin[known]
    project = np.eye(3) - np.einsum("ni,nj->nij", direction, direction)
    arm = world - world.mean(axis=0)
    cross = np.zeros((len(arm), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = arm[:, 2], -arm[:, 1], arm[:, 0]
    cross -= cross.transpose(0, 2, 1)
    jacobian = np.concatenate([project @ cross, project], axis=2).reshape(-1, 6)
    across = np.einsum("nij,nj->ni", project, gap)
    variance = float((across**2).sum()) / max(2 * len(arm) - 6, 1)
    return np.asarray(variance * np.linalg.pinv(jacobian.T @ jacobian)[3:, 3:])


def _facing(axis: np.typing.NDArray[np.float64]) -> np.typing.NDArray[np.float64]:
    """Rotation (3, 3) whose third row is the axis."""
    other = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(other, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis])
