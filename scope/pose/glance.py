"""A glance at a piece of a scan, before it is searched in earnest: how much of it a few hundred starts explain."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Ints
from scope.cloud import ScanCloud
from scope.model import Model
from scope.pose.search import View, normals_of, search, thin
from scope.pose.visibility import viewpoints

STARTS, KEPT = 200, 10  # orientations tried; poses that are refined
POINTS = 600


def glance(cloud: ScanCloud, rows: Ints, model: Model) -> float:
    """Share (0 to 1) of the points of a piece that the best of a few poses leaves unexplained.

    A fortieth of the work of the search that decides, and no decision: it puts the pieces of a scan in the order in which they are
    worth a search. Weak for parts that look alike from everywhere, where a few starts may miss the one that fits.

    Parameters
    ----------
    cloud, rows : ScanCloud, (N,)
        The scan, and the points of one piece of it.
    model : Model
        The part.
    """
    points = cloud.points[rows]
    spacing = model.diameter / 60
    chosen = thin(points, spacing)
    chosen = np.random.default_rng(0).permutation(chosen)[:POINTS]
    camera, _ = viewpoints(cloud, rows)
    at = None if camera is None else camera[chosen]
    normals = normals_of(points, points[chosen], at, radius=2.5 * spacing)
    _, cost = search(model, View(points[chosen], normals, at, None), starts=STARTS, keep=KEPT)
    return float(cost.min(initial=1.0))
