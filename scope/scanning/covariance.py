"""The covariance of a cloud's points, from the rig that they were ranged with."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array
from calibration.rig import Rig
from ranging.covariance import PointCovariance, joined, propagate
from scope.cloud import ScanCloud
from scope.errors import MeasurementError


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
        `ScanCloud.sigma_cal` says. The motion counts as exact; camera and lasers as found independently.

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
