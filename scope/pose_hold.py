"""Motions that the surface normals do not hold, but the borders of the surface do: a face slides only until points hang over."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, Pose
from scope.pose_surface import Surface

REACH = 0.9  # mm each way
STEP = 0.09  # mm
RISE = 20.0  # nats above the least at which a motion is ruled out
HELD = 0.45  # mm, half the width that may be left


def move(pose: Pose, motion: Array, amount: float, centre: Array, radius: float) -> Pose:
    """Pose after ``amount`` mm of a unit motion (6,): shift of ``centre``, and turns about it as mm at ``radius``."""
    turn = Pose.from_rotation_vector(amount * motion[3:] / radius, np.zeros(3)).rotation
    return Pose(turn @ pose.rotation, centre + turn @ (pose.translation - centre) + amount * motion[:3])


def hold(
    surface: Surface, pose: Pose, motions: Array, points: Array, sigma: Array, centre: Array, radius: float
) -> tuple[Pose, Array] | None:
    """Settle loose motions by the points that would hang over an edge or lie inside: a profile of their cost.

    Parameters
    ----------
    surface, pose : Surface, Pose
        The part, cloud_from_model.
    motions : (L, 6)
        Unit motions that point-to-plane alignment leaves loose.
    points, sigma : (N, 3), (N,)
        All points that the model explains at ``pose``, mm.
    centre, radius : (3,) mm, mm
        What the motions are measured about.

    Returns
    -------
    (Pose, (L,) mm) or None
        The pose in the middle of what is allowed, and one standard deviation for each motion: half the width at 20 nats, which
        is 6.3 of them where the cost is quadratic, over five. None where some motion, or a sum of
        two, is not stopped on both sides within 0.45 mm, and for three loose motions or more (a bare plane).
    """
    if len(motions) == 0 or len(motions) > 2:
        return None
    some = np.linspace(0, len(points) - 1, min(len(points), 20_000)).astype(np.int64)
    near, spread = points[some], sigma[some]
    offsets = np.arange(-REACH, REACH + STEP / 2, STEP)

    def allowed(at: Pose, motion: Array) -> tuple[float, float] | None:
        cost = np.array([_cost(surface, move(at, motion, s, centre, radius), near, spread) for s in offsets])
        inside = np.flatnonzero(cost < cost.min() + RISE)
        if inside[0] == 0 or inside[-1] == len(offsets) - 1:
            return None
        return float(offsets[inside[0]]), float(offsets[inside[-1]])

    widths = []
    for motion in motions:
        bounds = allowed(pose, motion)
        if bounds is None:
            return None
        pose = move(pose, motion, 0.5 * (bounds[0] + bounds[1]), centre, radius)
        widths.append(0.5 * (bounds[1] - bounds[0]) + STEP)
    if len(motions) == 2:
        for sign in (1.0, -1.0):
            bounds = allowed(pose, (motions[0] + sign * motions[1]) / np.sqrt(2.0))
            if bounds is None or max(-bounds[0], bounds[1]) > HELD:
                return None
    return (pose, np.array(widths) / 5.0) if max(widths) <= HELD else None


def _cost(surface: Surface, pose: Pose, points: Array, sigma: Array) -> float:
    local = pose.inverse.apply(points)
    closest, _ = surface.nearest(local)
    gap = ((local - closest) ** 2).sum(axis=1)
    return float(np.minimum(gap / (2 * sigma**2), 8.0).sum())
