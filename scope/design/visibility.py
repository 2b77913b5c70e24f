"""Whether camera and laser reach a point past the objects of the design."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, Pose, Rays
from scope.simulation import VirtualRig, exact_rays, project

_MARGIN = 0.5  # mm before the point, within which a surface is the point's own


def unobstructed(rig: VirtualRig, point: Array, travel: float) -> tuple[bool, bool]:
    """Whether nothing stands between camera and point, and between laser and point (3,) mm in C.

    ``travel`` is the position of the motion at which the point is on the sheet.
    """
    if not rig.scene.parts:
        return True, True
    motion = rig.design.motion
    pose = Pose.identity()
    if motion is not None and motion.kind == "linear" and np.isfinite(travel):
        direction = np.array(motion.direction) / np.linalg.norm(np.array(motion.direction))
        pose = Pose(np.eye(3), travel * (1.0 if motion.moves == "object" else -1.0) * direction)
    scene = rig.scene.moved(pose)
    pixel = project(rig.camera, point[None])
    if not np.isfinite(pixel).all():
        return False, False
    light, _ = rig.laser.reach(point[None])
    reached = []
    for rays in (exact_rays(rig.camera, pixel), Rays(np.array(light.origin), light.direction)):
        away = float((point - rays.origin[0]) @ rays.direction[0])
        reached.append(bool(scene.cast(rays).distance[0] >= away - _MARGIN))
    return reached[0], reached[1]
