"""Clouds whose points never left the sheet of light: profiles on top of each other, which show no surface."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, rotation_from_quaternion
from scope.cloud.columns import Columns
from scope.errors import MeasurementError

_STILL = 1e-3  # mm, and as much in a rotation matrix times 1000: what single precision leaves of no motion
_THIN = 0.02  # of its length that a sheet, bent by glass, may be thick
_UNEXPLAINED = 0.1  # share of the points' spread that their pixels may leave open
_LEAST = 10  # points
_ENOUGH = 20_000  # points of a laser that are looked at


def refuse_sheet(cloud: Columns) -> None:
    """``MeasurementError`` where all points lie in one sheet of light.

    A cloud that knows where its sensor was shows whether the sheet ever moved across itself: it did not where camera and laser
    stood still in the frame of the cloud, or moved along the sheet only. Two lasers are two sheets, and no surface either. A
    cloud that knows neither sensor nor pixels is of another kind of scanner or cannot tell, and is taken as it is.
    """
    if cloud.sensors is None or len(cloud) < _LEAST or not np.isfinite(cloud.pixels).all():
        return
    sheets = [_still(cloud, int(laser)) for laser in np.unique(cloud.laser)]
    if all(sheets):
        frames = len(np.unique(cloud.frame))
        raise MeasurementError(
            f"all {len(cloud)} points of {frames} frame{'s' if frames > 1 else ''} lie in the sheet of light, on top of each other: "
            "nothing moved across it, so that they show no surface; give the capture its [motion] and scan again"
        )


def _still(cloud: Columns, laser: int) -> bool:
    """Whether the points of a laser lie in one sheet for want of motion."""
    sensors = cloud.sensors
    mine = np.flatnonzero(cloud.laser == laser)
    mine = mine[:: max(1, len(mine) // _ENOUGH)]
    if sensors is None or len(mine) < _LEAST:
        return True
    rows = np.flatnonzero((sensors.laser == laser) & np.isin(sensors.frame, cloud.frame[mine]))
    if len(rows) == 0 or not np.isfinite(sensors.centre[rows]).all():
        return False
    points = cloud.points[mine]
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[2] > _THIN * spread[0]:
        return False
    turned = sensors.rotation[rows] * np.sign(sensors.rotation[rows] @ sensors.rotation[rows[0]])[:, None]
    if np.abs(turned - turned[0]).max() * 1e3 > 10.0 * _STILL:
        return False
    turn = rotation_from_quaternion(sensors.rotation[rows[0]])
    order = np.argsort(sensors.frame[rows])
    at = order[np.searchsorted(sensors.frame[rows][order], cloud.frame[mine]).clip(0, len(rows) - 1)]
    local = (points - sensors.centre[rows][at]) @ turn
    if not _seen_there(local, cloud.pixels[mine].astype(np.float64)):
        return False
    shift = (sensors.centre[rows] - sensors.centre[rows[0]]) @ turn
    if np.abs(shift).max() <= _STILL:
        return True
    _, spread, axes = np.linalg.svd(local - local.mean(axis=0), full_matrices=False)
    if spread[1] < _THIN * spread[0] or spread[2] > 0.1 * spread[1]:
        return False  # a straight line in every frame shows no sheet
    return bool(np.abs(shift @ axes[2]).max() <= _STILL + 1e-3 * np.linalg.norm(shift, axis=1).max())


def _seen_there(local: Array, pixels: Array) -> bool:
    """Whether places in the camera's frame follow from the pixels, as in a fixed sheet they must."""
    u, v = (pixels - pixels.mean(axis=0)).T
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    terms /= np.maximum(np.linalg.norm(terms, axis=0), 1e-12)
    centred = local - local.mean(axis=0)
    left = centred - terms @ np.linalg.lstsq(terms, centred, rcond=None)[0]
    return bool(np.linalg.norm(left) <= _UNEXPLAINED * np.linalg.norm(centred))
