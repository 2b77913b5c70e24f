"""The covariance of a cloud's points, from the rig that they were ranged with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array
from calibration.rig import Rig
from calibration.sheet import Laser
from calibration.stages import Stage
from ranging.covariance import PointCovariance, joined, propagate
from ranging.motion import Linear, Motion, Turntable
from scope.cloud import MOST_ERRORS, ScanCloud, Systematic
from scope.errors import MeasurementError

_NODES = 9  # of the lattice along u, and along v
_LEFT = 1e-6  # of the variance, that errors left out may carry


def point_covariance(cloud: ScanCloud, rig: Rig, *, jacobian: bool = False) -> PointCovariance:
    """Covariance of every point as 3x3, and the Jacobian of the points to the calibration where asked for.

    Parameters
    ----------
    cloud : ScanCloud
        From `scope.scan`, or a part of one (`ScanCloud.select`): of few points, where the Jacobian is wanted.
    rig : Rig
        The one that the cloud was ranged with.
    jacobian : bool
        Whether to hand over the derivatives by all P parameters (about a hundred): 24 N P bytes.

    Returns
    -------
    PointCovariance
        In the cloud frame, row i for point i. The parameters are the camera's, then those of each laser of
        ``cloud.laser_names``. Along the sighting ray, ``noise`` is what `ScanCloud.sigma` says and ``calibration`` what
        `ScanCloud.sigma_cal` says. The motion counts as exact; lasers of a jig as found independently of the camera.

    Raises
    ------
    MeasurementError
        A cloud of another rig, or one that does not say where its sensor was.
    """
    if cloud.rig_sha256 != rig.sha256 or not set(cloud.laser_names) <= set(rig.lasers):
        raise MeasurementError(
            f"the cloud was ranged with the rig {cloud.rig_sha256[:12] or 'unknown'}, this rig is {rig.sha256[:12]}; give the "
            "rig of the scan"
        )
    if cloud.sensors is None or not np.isfinite(cloud.camera_centre).all():
        raise MeasurementError("the cloud does not say where its sensor was; give one that scope scan wrote")
    lasers = [rig.lasers[name] for name in cloud.laser_names]
    sizes = np.cumsum([len(rig.camera.covariance), *(len(laser.covariance) for laser in lasers)])
    noise, calibration = np.full((len(cloud), 3, 3), np.nan), np.full((len(cloud), 3, 3), np.nan)
    kept = np.zeros((len(cloud), 3, sizes[-1])) if jacobian else None
    turn, points = _in_camera_frame(cloud)
    for k, laser in enumerate(lasers):
        rows = np.flatnonzero(cloud.laser == k)
        found = propagate(
            rig.camera, laser, cloud.pixels[rows].astype(np.float64), points[rows], cloud.sigma[rows].astype(np.float64),
            1 if laser.along == "rows" else 0, jacobian=jacobian,
        )  # fmt: skip
        back = turn[rows]
        noise[rows] = back @ found.noise @ back.transpose(0, 2, 1)
        calibration[rows] = back @ found.calibration @ back.transpose(0, 2, 1)
        if kept is not None and found.jacobian is not None:
            columns = np.r_[: sizes[0], sizes[k] : sizes[k + 1]]
            kept[rows[:, None], :, columns] = (back @ found.jacobian).transpose(0, 2, 1)
    parameters = joined(rig.camera.covariance, *(laser.covariance for laser in lasers))
    return PointCovariance(noise, calibration, parameters, kept)


def systematic_of(
    rig: Rig, lasers: Sequence[Laser], boxes: Mapping[int, Array], motion: Motion | None = None
) -> Systematic | None:
    """What errors of the calibration do to points of each laser's sheet, but for motions of the whole cloud.

    Parameters
    ----------
    rig : Rig
    lasers : sequence of Laser
        In the order of the cloud's ``laser_names``.
    boxes : mapping of number to (2, 2) array
        Least and greatest pixel (u, v) of the points of each laser that has some.
    motion : Motion, optional
        Where it is that of the rig's stage, which was found with the camera, the stage's own movement is taken off: beyond it a
        cloud moves only as a whole.

    Returns
    -------
    Systematic, or None
        The parameters' covariance in its own axes (K of them, those that matter); None where a ray meets no sheet.
    """
    nodes, moved, local = [], [], []
    sizes = np.cumsum([len(rig.camera.covariance), *(len(laser.covariance) for laser in lasers)])
    for k, (low, high) in boxes.items():
        laser, high = lasers[k], np.maximum(high, low + 1.0)
        sides = (np.linspace(a, b, _NODES).astype(np.float32) for a, b in zip(low, high, strict=True))
        pixels = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2).astype(np.float64)
        points = laser.sheet.intersect(rig.camera.rays(pixels)).points
        if not np.isfinite(points).all():
            return None
        across = 1 if laser.along == "rows" else 0
        found = propagate(rig.camera, laser, pixels, points, np.zeros(len(pixels)), across, jacobian=True)
        by_all = np.zeros((len(pixels), 3, sizes[-1]))
        if found.jacobian is not None:
            by_all[:, :, np.r_[: sizes[0], sizes[k] : sizes[k + 1]]] = found.jacobian
        if (stage := _stage_of(rig, motion)) is not None:
            by_all[:, :, : sizes[0]] -= _carried(stage, points)
        steep = np.abs(np.einsum("ni,ni->n", laser.sheet.normal_at(points), rig.camera.rays(pixels).direction))
        nodes.append((np.full(len(pixels), k, dtype=np.uint8), pixels))
        moved.append(by_all)
        local.append((laser.local_mm if np.isfinite(laser.local_mm) else 0.0) / steep)
    if not nodes:
        return None
    value, vector = np.linalg.eigh(joined(rig.camera.covariance, *(laser.covariance for laser in lasers)))
    by_error = np.concatenate(moved) @ (vector * np.sqrt(np.maximum(value, 0.0)))  # (G, 3, P)
    _, size, turn = np.linalg.svd(by_error.reshape(-1, by_error.shape[2]), full_matrices=False)
    count = int(np.clip((np.cumsum(size[::-1] ** 2)[::-1] > _LEFT * (size**2).sum()).sum(), 1, MOST_ERRORS))
    moves = np.einsum("gip,kp->gki", by_error, turn[:count])
    laser_of, pixels = (np.concatenate(part) for part in zip(*nodes, strict=True))
    return Systematic(laser_of, pixels, moves, np.concatenate(local))


def _stage_of(rig: Rig, motion: Motion | None) -> Stage | None:
    """The rig's stage by which a motion goes, where it follows the camera."""
    for stage in rig.stages:
        if not stage.coupling.size:
            continue
        if isinstance(motion, Linear) and stage.kind == "linear" and (motion.direction == stage.direction).all():
            return stage
        if isinstance(motion, Turntable) and stage.kind == "turntable" and (motion.point == stage.point).all():
            return stage
    return None


def _carried(stage: Stage, points: Array) -> Array:
    """Movement (N, 3, P) mm of points (N, 3) as if they were fixed to a stage that follows the camera's parameters.

    An axis that moves by dp and turns by w carries what is about it along: x - p turns about a, so that the turned cloud moves
    by dp + w x (x - p) as a whole, whatever the angle. A direction of travel likewise, about C.
    """
    shift, turn = stage.coupling[:3], np.cross(stage.direction, stage.coupling[3:].T).T  # w = a x da
    arm = points
    if stage.kind == "turntable":
        arm = points - stage.point
    else:
        shift = np.zeros_like(shift)
    return np.asarray(np.stack([np.cross(w, arm) + d for w, d in zip(turn.T, shift.T, strict=True)], axis=-1))


def boxes_of(laser: NDArray[np.uint8], pixels: NDArray[np.floating[Any]]) -> dict[int, Array]:
    """Least and greatest pixel (2, 2) of the points of each laser."""
    mine = {int(k): pixels[laser == k] for k in np.unique(laser)}
    return {k: np.stack([some.min(axis=0), some.max(axis=0)]).astype(np.float64) for k, some in mine.items()}


def _in_camera_frame(cloud: ScanCloud) -> tuple[Array, Array]:
    """Rotations (N, 3, 3) from C to the cloud frame, and the points (N, 3) mm in C."""
    turn, points = np.empty((len(cloud), 3, 3)), np.empty((len(cloud), 3))
    order = np.argsort(cloud.frame, kind="stable")
    frames, begins = np.unique(cloud.frame[order], return_index=True)
    for frame, rows in zip(frames, np.split(order, begins[1:]), strict=True):
        pose = cloud.cloud_from_camera(int(frame))
        turn[rows] = pose.rotation
        points[rows] = pose.inverse.apply(cloud.points[rows])
    return turn, points
