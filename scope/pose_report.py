"""A pose in words, in JSON that robots read, and on a page."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Pose
from scope.pose_model import Model


def what_differs(model: Model, best: Pose, rival: Pose) -> str:
    """Where on the model two poses differ most, and from where that is seen, in words.

    The model's samples are moved by the motion between the two poses; those far from the surface then are the features
    that tell them apart.
    """
    motion = rival.inverse @ best
    away = np.abs(model.fine.look_up(motion.apply(model.samples))[0])
    worst = away > max(0.5 * float(away.max()), 1e-9)
    if float(away.max()) < 1e-3 * model.diameter:
        return "the mesh itself looks the same in both poses"
    feature = model.samples[worst]
    middle, out = np.median(feature, axis=0), model.normals[worst].mean(axis=0)
    seen = best.rotation @ (out / max(float(np.linalg.norm(out)), 1e-9))
    return (
        f"the poses differ most about ({middle[0]:.0f}, {middle[1]:.0f}, {middle[2]:.0f}) mm of the model (by {away.max():.1f} mm); "
        f"scan it from ({seen[0]:.2f}, {seen[1]:.2f}, {seen[2]:.2f}) of the cloud"
    )
