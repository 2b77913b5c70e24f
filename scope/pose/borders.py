"""Motions that the surface normals do not settle, but the borders of the surface do: a face slides only until points hang over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Pose
from scope.model import Surface

REACH = 0.9  # mm each way
STEP = 0.09  # mm
RISE = 20.0  # nats above the least at which a motion is ruled out, where all points lie on the model
CAP = 8.0  # nats: a point that does not
HELD = 0.45  # mm, half the width that may be left


def move(pose: Pose, motion: Array, amount: float, centre: Array, radius: float) -> Pose:
    """Pose after ``amount`` mm of a unit motion (6,): shift of ``centre``, and turns about it as mm at ``radius``."""
    turn = Pose.from_rotation_vector(amount * motion[3:] / radius, np.zeros(3)).rotation
    return Pose(turn @ pose.rotation, centre + turn @ (pose.translation - centre) + amount * motion[:3])


@dataclass(frozen=True, slots=True, eq=False)
class Sliding:
    """A pose with motions that point-to-plane alignment leaves loose."""

    pose: Pose  # cloud_from_model
    motions: Array  # (L, 6) unit: shift of the centre, and turns about it as mm at the radius
    points: Array  # (N, 3) mm, all points that the model explains at this pose
    sigma: Array  # (N,) mm
    centre: Array  # (3,) mm, cloud frame
    radius: float  # mm


def settle_by_borders(surface: Surface, sliding: Sliding) -> tuple[Pose, Array] | None:
    """Settle loose motions by the points that would hang over an edge or lie inside: a profile of their cost.

    Returns
    -------
    (Pose, (L,) mm) or None
        The pose in the middle of what is allowed, and one standard deviation for each motion: half the width at 20 nats, which
        is 6.3 of them where the cost is quadratic, over five. Points that lie nowhere, as stripes smeared over an edge do,
        widen it. None where some motion, or a sum of them, is not
        stopped on both sides within 0.45 mm: a bare plane, or a face whose rim is in shadow. None for more than three.
    """
    pose, motions, points = sliding.pose, sliding.motions, sliding.points
    centre, radius = sliding.centre, sliding.radius
    if len(motions) == 0 or len(motions) > 3:
        return None
    rim = np.flatnonzero(np.isfinite(surface.crease_distance(pose.inverse.apply(points), 3.0 * REACH)))
    if len(rim) < 0.02 * len(points):  # no sharp edges: any point may tell
        rim = np.arange(len(points))
    some = rim[np.linspace(0, len(rim) - 1, min(len(rim), 20_000)).astype(np.int64)]
    near, spread = points[some], sliding.sigma[some]
    odd = int((_costs(surface, pose, near, spread) >= CAP).sum())
    rise = RISE + 0.5 * CAP * odd  # half of the points that lie nowhere may by chance lie well elsewhere
    offsets = np.arange(-REACH, REACH + STEP / 2, STEP)

    def allowed(at: Pose, motion: Array) -> tuple[float, float] | None:
        cost = np.array([_cost(surface, move(at, motion, s, centre, radius), near, spread) for s in offsets])
        inside = np.flatnonzero(cost < cost.min() + rise)
        if inside[0] == 0 or inside[-1] == len(offsets) - 1:
            return None
        return float(offsets[inside[0]]), float(offsets[inside[-1]])

    widths = np.zeros(len(motions))
    for _ in range(1 if len(motions) == 1 else 2):  # one motion shifts the middle of another
        for k, motion in enumerate(motions):
            bounds = allowed(pose, motion)
            if bounds is None:
                return None
            pose = move(pose, motion, 0.5 * (bounds[0] + bounds[1]), centre, radius)
            widths[k] = 0.5 * (bounds[1] - bounds[0]) + STEP
    for mixed in mixtures(len(motions)) @ motions:
        bounds = allowed(pose, mixed)
        if bounds is None or max(-bounds[0], bounds[1]) > HELD:
            return None
    return (pose, widths / 5.0) if widths.max() <= HELD else None


def mixtures(count: int) -> Array:
    """Unit sums and differences (K, count) of two or three motions."""
    signs = np.array(list(np.ndindex(*[3] * count)), dtype=np.float64) - 1.0
    leading = np.array([s[np.flatnonzero(s)[0]] > 0 if s.any() else False for s in signs])
    signs = signs[leading & (np.abs(signs).sum(axis=1) > 1)]
    return np.asarray(signs / np.linalg.norm(signs, axis=1, keepdims=True)).reshape(-1, count)


def _cost(surface: Surface, pose: Pose, points: Array, sigma: Array) -> float:
    return float(_costs(surface, pose, points, sigma).sum())


def _costs(surface: Surface, pose: Pose, points: Array, sigma: Array) -> Array:
    local = pose.inverse.apply(points)
    closest, _ = surface.nearest(local)
    return np.asarray(np.minimum(((local - closest) ** 2).sum(axis=1) / (2 * sigma**2), CAP))
