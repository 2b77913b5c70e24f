"""Scans with poses to one cloud that keeps all their columns, and knows where each sensor was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.geometry import Pose, quaternion_from_rotation, rotation_from_quaternion
from scope.cloud import ScanCloud, Sensors
from scope.errors import MeasurementError

_LASERS = 255


def joined(clouds: Sequence[ScanCloud], poses: Sequence[Pose], names: Sequence[str]) -> ScanCloud:
    """One cloud, in the frame that the poses lead to.

    Frames are counted on from scan to scan; lasers keep their names where all scans are of one rig, and are called after
    their scan where not. Rig, centre of the camera and verification are those of all, or unknown.

    Raises
    ------
    MeasurementError
        More than 255 lasers in all.
    """
    same = len({(c.rig_sha256, c.laser_names) for c in clouds}) == 1
    lasers: list[str] = []
    parts: list[ScanCloud] = []
    sensors: list[Sensors] = []
    first = 0
    for cloud, pose, name in zip(clouds, poses, names, strict=True):
        own = [laser if same else f"{name}:{laser}" for laser in cloud.laser_names]
        lasers += [laser for laser in own if laser not in lasers]
        number = np.array([lasers.index(laser) for laser in own])
        if len(lasers) > _LASERS:
            raise MeasurementError(f"{len(lasers)} lasers in all; a cloud names {_LASERS} at most: merge fewer scans")
        low = int(cloud.frame.min(initial=0))
        if cloud.sensors is not None:
            low = min(low, int(cloud.sensors.frame.min(initial=low)))
            sensors.append(_moved(cloud.sensors, pose, number, first - low))
        parts.append(
            replace(
                cloud, points=pose.apply(cloud.points), frame=(cloud.frame - low + first).astype(np.int32),
                laser=number[cloud.laser].astype(np.uint8),
                normals=None if cloud.normals is None else cloud.normals @ pose.rotation.T,
            )
        )  # fmt: skip
        top = int(parts[-1].frame.max(initial=first))
        if cloud.sensors is not None:
            top = max(top, int(sensors[-1].frame.max(initial=top)))
        first = top + 1
    return _whole(parts, clouds, lasers, sensors, same)


def _whole(
    parts: Sequence[ScanCloud], clouds: Sequence[ScanCloud], lasers: list[str], sensors: list[Sensors], same: bool
) -> ScanCloud:
    pixels = all(np.isfinite(part.pixels).all() for part in parts)
    stripes = {name: k for part, cloud in zip(parts, clouds, strict=True) if len(cloud.stripe_width) == len(cloud.laser_names)
               for name, k in zip([lasers[n] for n in np.unique(part.laser)], range(len(cloud.laser_names)), strict=False)}  # fmt: skip
    known = same and set(stripes) == set(lasers)
    return replace(
        ScanCloud.from_points(np.concatenate([p.points for p in parts])),
        intensity=np.concatenate([p.intensity for p in parts]),
        sigma=np.concatenate([p.sigma for p in parts]),
        sigma_cal=np.concatenate([p.sigma_cal for p in parts]),
        pixels=np.concatenate([p.pixels if pixels else np.full_like(p.pixels, np.nan) for p in parts]),
        frame=np.concatenate([p.frame for p in parts]),
        laser=np.concatenate([p.laser for p in parts]),
        normals=None if any(p.normals is None for p in parts) else np.concatenate([p.normals for p in parts if p.normals is not None]),
        sensors=_all(sensors) if len(sensors) == len(parts) else None,
        laser_names=tuple(lasers),
        rig_sha256=clouds[0].rig_sha256 if same else "",
        verified=all(c.verified for c in clouds),
        complete=all(c.complete for c in clouds),
        stripe_width=clouds[0].stripe_width if known else (),
        stripe_corrected=clouds[0].stripe_corrected if known else (),
        camera_centre=clouds[0].camera_centre if same else np.full(3, np.nan),
    )  # fmt: skip


def _moved(sensors: Sensors, pose: Pose, number: np.typing.NDArray[np.int64], frames: int) -> Sensors:
    turned = [quaternion_from_rotation(pose.rotation @ rotation_from_quaternion(q)) for q in sensors.rotation]
    return Sensors(
        (sensors.frame + frames).astype(np.int32), number[sensors.laser].astype(np.uint8), pose.apply(sensors.centre),
        np.array(turned).reshape(-1, 4), pose.apply(sensors.laser_origin),
    )  # fmt: skip


def _all(sensors: Sequence[Sensors]) -> Sensors:
    return Sensors(*(np.concatenate([getattr(s, name) for s in sensors]) for name in ("frame", "laser", "centre", "rotation", "laser_origin")))  # fmt: skip
