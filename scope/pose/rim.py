"""Faces that slide in themselves, settled by their rims: the scan ends where the part ends, on every side alike."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, Pose
from scope.model import Model, Surface
from scope.pose.borders import REACH, Sliding, mixtures, move
from scope.pose.visibility import Visibility

WIDTH = 1.5  # mm from a sharp edge: the rim of a face
FAR = 1.0  # mm: a place further than this from all points tells nothing
COVERED = 0.8  # share of the rim that must have points within that
RISE = 0.012  # mm2 by which the mean square gap must grow 0.9 mm to either side
LEAST = 100  # samples of the rim
SHARE = 0.3  # of the gap between rim and points, rms: what one side may keep back more than the other, one sigma
FLOOR = 0.05  # mm, one sigma


def settle_by_rim(
    surface: Surface, model: Model, sliding: Sliding, visibility: Visibility
) -> tuple[Pose, Array] | None:
    """Settle loose motions by the gaps between the rims of the part's visible faces and the points of the scan.

    A stripe is lost or cut on the last tenths of a millimetre before an edge, on all sides about alike: in the right place the
    gaps are least. Less sure than `scope.pose.borders`, which asks that no point hangs over, but not deceived by the
    loss itself.

    Parameters
    ----------
    surface, model : Surface, Model
        The part.
    sliding : Sliding
        Three motions at most.
    visibility : Visibility
        Tells which rims camera and laser should have seen.

    Returns
    -------
    (Pose, (L,) mm) or None
        The pose of least gaps and one standard deviation of each motion. None where some motion or a sum of them is not
        stopped on both sides, or where much of the rim has no points.
    """
    from scipy.spatial import cKDTree

    pose, motions, centre, radius = sliding.pose, sliding.motions, sliding.centre, sliding.radius
    if not 0 < len(motions) <= 3:
        return None
    tree = cKDTree(sliding.points)
    close = np.flatnonzero(surface.crease_distance(model.samples, WIDTH) < WIDTH)
    offsets = np.linspace(-REACH, REACH, 13)
    spread = np.zeros(len(motions))
    gap = np.zeros(0)
    for _ in range(2):
        wanted = visibility.expected(surface, pose, model.samples[close], model.normals[close], np.zeros((0, 3)))
        rim = model.samples[close[wanted]]
        if len(rim) < LEAST:
            return None

        def gaps(at: Pose, motion: Array, amount: float, rim: Array = rim) -> float:
            there = move(at, motion, amount, centre, radius).apply(rim)
            return float(np.mean(np.minimum(tree.query(there, distance_upper_bound=FAR)[0], FAR) ** 2))

        for motion in motions:
            cost = np.array([gaps(pose, motion, s) for s in offsets])
            least = int(np.argmin(cost))
            if not 1 < least < len(offsets) - 2:
                return None
            bend = np.polyfit(offsets[least - 2 : least + 3], cost[least - 2 : least + 3], 2)
            step = -bend[1] / (2 * bend[0]) if bend[0] > 0 else 0.0
            pose = move(pose, motion, float(np.clip(step, offsets[least - 1], offsets[least + 1])), centre, radius)
        gap = np.minimum(tree.query(pose.apply(rim), distance_upper_bound=FAR)[0], FAR)
    if (gap < FAR).mean() < COVERED:
        return None
    still = float(np.mean(gap**2))
    for motion in np.concatenate([motions, mixtures(len(motions)) @ motions]):
        if min(gaps(pose, motion, -REACH), gaps(pose, motion, REACH)) < still + RISE:
            return None
    spread[:] = max(SHARE * float(np.sqrt(still)), FLOOR)
    return pose, spread
