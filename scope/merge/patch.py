"""A scan prepared to be put against others: normals, spacing, noise, and a thinned copy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.geometry import Array, Bools, Ints
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.merge.sight import Splats, unknown_cameras

LEAST = 200  # points of a scan
_FULL = 60_000  # points that take part in the search of neighbours
_FEW = 3_000  # points by which a scan is judged
_NEIGHBOURS = 16
_USUAL = 1.5  # times the median of it: scatter about the plane of the neighbours that noise and curvature explain


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """One scan: N points with normals, and a few of them spread evenly, by which it is judged against others."""

    name: str
    points: Array  # (N, 3) mm, cloud frame; thinned where they are very many
    normals: Array  # (N, 3) unit, towards the sensor
    sigma: Array  # (N,) mm, independent from point to point
    shared: Array  # (N,) mm, through the calibration; 0 where unknown
    spacing: float  # mm, median distance to the nearest neighbour
    few: Ints  # (M,) indices
    inner: Bools  # (N,) not at the rim of the scan
    rough: Array  # (N,) mm, scatter about the plane of the neighbours beyond the usual: large on an edge of the part
    tree: Any  # cKDTree of the points
    splats: Splats
    cameras: Array  # (N, 3) mm, of each point; far away in the likeliest direction where the cloud does not tell
    told: bool  # whether it told

    @property
    def size(self) -> float:
        """Length of the box's diagonal, mm."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))


def prepared(cloud: ScanCloud, name: str, *, most: int = _FULL) -> Patch:
    """Normals from the nearest neighbours (total least squares), towards the sensor where the cloud knows it.

    Without sensors the normals are made to agree along the surface and turned outwards from the middle.

    Raises
    ------
    MeasurementError
        Too few points.
    """
    from scipy.spatial import cKDTree

    if len(cloud) < LEAST:
        raise MeasurementError(
            f"{name}: {len(cloud)} points; a scan of {LEAST} or more is needed to be put against others"
        )
    rows = np.arange(len(cloud)) if len(cloud) <= most else np.linspace(0, len(cloud) - 1, most).astype(np.int64)
    points = cloud.points[rows]
    tree = cKDTree(points)
    away, index = tree.query(points, k=_NEIGHBOURS, workers=1)
    # points along a stripe are often much closer than from stripe to stripe: the ring of neighbours tells the spacing
    spacing = float(np.median(away[:, 6])) / 1.5
    around = points[index] - points[index].mean(axis=1, keepdims=True)
    values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normals = axes[:, :, 0]
    rough = np.sqrt(values[:, 0] / (_NEIGHBOURS - 3))
    centre = points[index].mean(axis=1)
    off = np.linalg.norm(points - centre, axis=1)
    inner = off < 0.45 * away[:, -1]
    cameras = _cameras(cloud, rows)
    if cameras is None:
        normals = _agreeing(points, normals, tree)
    else:
        normals *= np.where((normals * (cameras - points)).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    sigma = cloud.sigma[rows].astype(np.float64)
    usual = max(float(np.median(rough)), 1e-6)
    sigma = np.where(np.isfinite(sigma), sigma, usual)
    shared = np.nan_to_num(cloud.sigma_cal[rows].astype(np.float64), nan=0.0)
    excess = np.sqrt(np.maximum(rough**2 - (_USUAL * usual) ** 2, 0.0))
    few = _even(points, _FEW)
    splats = Splats(points, normals, spacing)
    told = cameras is not None
    if cameras is None:
        cameras = unknown_cameras(points, normals, splats, few[:: max(1, len(few) // 300)], 2.0 * spacing)
    return Patch(name, points, normals, sigma, shared, spacing, few, inner, excess, tree, splats, cameras, told)


def _cameras(cloud: ScanCloud, rows: Ints) -> Array | None:
    """Where the camera was (N, 3) for each point; None where the cloud does not tell."""
    sensors = cloud.sensors
    if sensors is None or len(sensors) == 0 or not np.isfinite(sensors.centre).all():
        return None
    frames, first = np.unique(sensors.frame, return_index=True)
    place = np.minimum(np.searchsorted(frames, cloud.frame[rows]), len(frames) - 1)
    return sensors.centre[first[place]] if (frames[place] == cloud.frame[rows]).all() else None


def _agreeing(points: Array, normals: Array, tree: Any) -> Array:
    """Normals with one sense along the surface: a tree of neighbours whose normals are most alike (Hoppe et al. 1992), outwards."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

    n = len(points)
    index = tree.query(points, k=min(10, n), workers=1)[1]
    a, b = np.repeat(np.arange(n), index.shape[1] - 1), index[:, 1:].ravel()
    cost = 1.0 - np.abs((normals[a] * normals[b]).sum(axis=1)) + 1e-6
    graph = minimum_spanning_tree(coo_matrix((cost, (a, b)), shape=(n, n)))
    count, piece = connected_components(graph, directed=False)
    found = normals.copy()
    for k in range(count):
        members = np.flatnonzero(piece == k)
        order, before = breadth_first_order(graph, members[0], directed=False)
        sign = np.ones(n)
        for i in order[1:]:
            sign[i] = sign[before[i]] * (1.0 if normals[i] @ normals[before[i]] >= 0 else -1.0)
        outwards = ((points[order] - points.mean(axis=0)) * (normals[order] * sign[order, None])).sum()
        found[order] = normals[order] * (sign[order] * (1.0 if outwards >= 0 else -1.0))[:, None]
    return found


def _even(points: Array, count: int) -> Ints:
    """About ``count`` indices spread evenly in space: one in each cube."""
    if len(points) <= count:
        return np.arange(len(points))
    edge = float(np.linalg.norm(np.ptp(points, axis=0))) / 40
    best = np.arange(len(points))
    for _ in range(12):
        key = np.floor(points / edge).astype(np.int64)
        best = np.sort(np.unique(key, axis=0, return_index=True)[1])
        if 0.6 * count <= len(best) <= 1.2 * count:
            break
        edge *= float(np.sqrt(len(best) / count))
    return best
