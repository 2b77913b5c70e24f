"""Surface normals from the scan lattice: neighbours along the stripe and from frame to frame."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array
from scope.cloud.lattice import lattice_index
from scope.cloud.scan_cloud import ScanCloud


def lattice_normals(cloud: ScanCloud, *, reach: int = 2) -> Array:
    """Unit normals (N, 3), towards the camera, NaN where the lattice gives none.

    Parameters
    ----------
    cloud : ScanCloud
        With pixels and sensors; without sensors normals point to negative z.
    reach : int
        Neighbours up to this many steps away in both directions of the lattice serve a plane fit (total least squares);
        those further than four median spacings are on another surface and do not. Fewer than six leave NaN.
    """
    normals = np.full((len(cloud), 3), np.nan)
    for laser in np.unique(cloud.laser):
        index = lattice_index(cloud, int(laser))
        if min(index.shape) < 2:
            continue
        _fill(cloud, index, normals, reach)
    towards = np.array([0.0, 0.0, -1.0])
    if cloud.sensors is not None:
        centre = {int(f): c for f, c in zip(cloud.sensors.frame, cloud.sensors.centre, strict=True)}
        towards = np.array([centre.get(int(f), np.full(3, np.nan)) for f in cloud.frame]).reshape(-1, 3) - cloud.points
    flip = np.einsum("ni,ni->n", normals, np.broadcast_to(towards, normals.shape)) < 0
    normals[flip] *= -1
    return normals


def _fill(cloud: ScanCloud, index: np.typing.NDArray[np.int64], normals: Array, reach: int) -> None:
    rows, columns = index.shape
    padded = np.full((rows + 2 * reach, columns + 2 * reach), -1, dtype=np.int64)
    padded[reach:-reach, reach:-reach] = index
    here = index.ravel()
    known = here >= 0
    offsets = [(i, j) for i in range(2 * reach + 1) for j in range(2 * reach + 1) if (i, j) != (reach, reach)]
    count = np.zeros(len(here))
    total, square = np.zeros((len(here), 3)), np.zeros((len(here), 3, 3))
    limit = 4.0 * reach * lattice_spacing(cloud, index)
    for i, j in offsets:
        other = padded[i : i + rows, j : j + columns].ravel()
        both = known & (other >= 0)
        step = cloud.points[other[both]] - cloud.points[here[both]]
        near = np.linalg.norm(step, axis=1) <= limit
        into = np.flatnonzero(both)[near]
        count[into] += 1
        total[into] += step[near]
        square[into] += step[near][:, :, None] * step[near][:, None, :]
    enough = np.flatnonzero(known & (count >= 6))
    n = count[enough, None] + 1  # the point itself is the origin
    mean = total[enough] / n
    spread = square[enough] - n[:, :, None] * mean[:, :, None] * mean[:, None, :]
    normals[here[enough]] = np.linalg.eigh(spread)[1][:, :, 0]


def lattice_spacing(cloud: ScanCloud, index: np.typing.NDArray[np.int64]) -> float:
    """Larger of the median distances (mm) between neighbours along the stripe and between frames; 0 where there are none."""
    steps = []
    for a, b in ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:])):
        both = (a >= 0) & (b >= 0)
        if both.any():
            steps.append(float(np.median(np.linalg.norm(cloud.points[a[both]] - cloud.points[b[both]], axis=1))))
    return max(steps, default=0.0)
