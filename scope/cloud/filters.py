"""Filters that take points out of a cloud; off by default, and each says how many it took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools
from scope.cloud.lattice import lattice_index
from scope.cloud.normals import lattice_normals, lattice_spacing
from scope.cloud.scan_cloud import ScanCloud

_REACH = 4.0  # median spacings within which a neighbour on the lattice is on the same surface


@dataclass(frozen=True, slots=True)
class FilterOptions:
    """Which filters run, in this order; a sigma limit is part of ranging (``ScanOptions.max_sigma``)."""

    isolated: int | None = None  # least neighbours on the scan lattice, 1 to 8
    max_incidence: float | None = None  # degrees between sighting ray and surface normal
    voxel: float | None = None  # mm; one point is kept in each cube of this edge

    def __post_init__(self) -> None:
        if self.isolated is not None and not 1 <= self.isolated <= 8:
            raise ValueError("isolated counts neighbours: 1 to 8")
        if self.max_incidence is not None and not 0.0 < self.max_incidence <= 90.0:
            raise ValueError("max_incidence is an angle above 0 and up to 90 degrees")
        if self.voxel is not None and not 0.0 < self.voxel < np.inf:
            raise ValueError("voxel is a length above 0 mm")

    @property
    def any(self) -> bool:
        """Whether a filter is asked for."""
        return self != FilterOptions()


def filtered(cloud: ScanCloud, options: FilterOptions) -> tuple[ScanCloud, Mapping[str, int]]:
    """Points that every filter asked for has left, and how many each has removed.

    Points stay as they were measured and in scan order: nothing is moved or averaged.
    """
    removed: dict[str, int] = {}
    if options.isolated is not None:
        cloud, removed["isolated"] = _kept(cloud, neighbours(cloud) >= options.isolated)
    if options.max_incidence is not None:
        cloud, removed["incidence"] = _kept(cloud, ~(incidence(cloud) > options.max_incidence))
    if options.voxel is not None:
        cloud, removed["voxel"] = _kept(cloud, most_certain(cloud, options.voxel))
    return cloud, removed


def _kept(cloud: ScanCloud, keep: Bools) -> tuple[ScanCloud, int]:
    return cloud.select(keep), int((~keep).sum())


def neighbours(cloud: ScanCloud) -> Array:
    """Neighbours (N,), 0 to 8, that each point has on the scan lattice (line and frame next to its own), near it in space.

    Near is within four times the median spacing of the lattice, so that a point behind an edge does not count.
    """
    count = np.zeros(len(cloud))
    for laser in np.unique(cloud.laser):
        index = lattice_index(cloud, int(laser))
        if index.size == 0:
            continue
        limit = _REACH * lattice_spacing(cloud, index)
        padded = np.pad(index, 1, constant_values=-1)
        rows, columns = index.shape
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
            other = padded[i : i + rows, j : j + columns]
            both = (index >= 0) & (other >= 0)
            here = index[both]
            near = np.linalg.norm(cloud.points[other[both]] - cloud.points[here], axis=1) <= limit
            count[here[near]] += 1
    return count


def incidence(cloud: ScanCloud) -> Array:
    """Angle (N,) degrees between each point's sighting ray and its surface normal; NaN where the lattice gives no normal.

    ``ValueError`` for a cloud that does not say where its camera was.
    """
    if cloud.sensors is None:
        raise ValueError("the cloud does not say where its sensor was")
    normals = cloud.normals if cloud.normals is not None else lattice_normals(cloud)
    order = np.argsort(cloud.sensors.frame, kind="stable")
    at = order[np.searchsorted(cloud.sensors.frame[order], cloud.frame).clip(0, len(order) - 1)]
    sight = cloud.points - cloud.sensors.centre[at]
    cosine = np.abs(np.einsum("ni,ni->n", sight, normals)) / np.linalg.norm(sight, axis=1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0))))


def most_certain(cloud: ScanCloud, edge: float) -> Bools:
    """Mask (N,) with one point in each occupied cube of ``edge`` mm: the one with the least sigma."""
    keep = np.zeros(len(cloud), dtype=bool)
    if len(cloud) == 0:
        return keep
    cube = np.floor(cloud.points / edge).astype(np.int64)
    cube -= cube.min(axis=0)
    order = np.lexsort((np.nan_to_num(cloud.sigma, nan=np.inf), *cube.T))
    first = np.r_[True, (np.diff(cube[order], axis=0) != 0).any(axis=1)]
    keep[order[first]] = True
    return keep
