"""How far two lasers disagree about a surface that both have seen."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calibration.geometry import Array, Ints
from scope.cloud import ScanCloud
from scope.mesh import lattice_index
from scope.normals import lattice_spacing

_LEAST = 8  # points of each laser in a cell
_FLAT = 0.01  # of the cell: rms about its plane, beyond three sigma, above which its curvature would not cancel
_ROUND = 0.2  # least ratio of the two extents within the plane


@dataclass(frozen=True, slots=True)
class Agreement:
    """Distance from one laser's surface to another's, along its normal towards the camera, over cells of space."""

    first: str
    second: str
    cells: int  # in which both lasers have seen the surface
    mean_mm: float  # NaN without a cell
    rms_mm: float
    sigma_mm: float  # rms that independent noise and both calibrations let expect
    beyond: float  # share of the cells whose surfaces lie more than three of their own sigma apart: a second sheet


def agreements(cloud: ScanCloud, *, cell: float | None = None) -> tuple[Agreement, ...]:
    """Compare every two lasers of a cloud, cell by cell.

    Parameters
    ----------
    cloud : ScanCloud
        Of several lasers; of one, there is nothing to compare.
    cell : float, optional
        Edge of the cells, mm; by default five times the larger spacing of the points.

    Returns
    -------
    tuple of Agreement
        In a cell, both lasers' points are given one common orientation (total least squares about their own means); the
        distance between the means along its normal is the disagreement. Curvature cancels as far as both lasers sample
        the cell alike; cells that are not flat, or that one laser only grazes in a line, do not count.
    """
    present = [int(k) for k in np.unique(cloud.laser)]
    if len(present) < 2:
        return ()
    size = cell or 5.0 * max(_spacing(cloud.select(cloud.laser == k)) for k in present)
    if size <= 0.0:
        return ()
    return tuple(_compare(cloud, a, b, size) for a, b in combinations(present, 2))


def _compare(cloud: ScanCloud, first: int, second: int, size: float) -> Agreement:
    chosen = cloud.select(np.isin(cloud.laser, (first, second)))
    owner = (chosen.laser == second).astype(np.int64)
    label = _cells(chosen.points, size)
    cells = int(label.max(initial=-1)) + 1
    slot = 2 * label + owner  # both lasers of a cell lie side by side
    count = np.bincount(slot, minlength=2 * cells).astype(np.float64)
    origin = chosen.points.mean(axis=0)
    local = chosen.points - origin
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.stack([np.bincount(slot, local[:, k], 2 * cells) for k in range(3)], axis=1) / count[:, None]
    left = local - mean[slot]
    scatter = np.empty((cells, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            scatter[:, i, j] = scatter[:, j, i] = np.bincount(label, left[:, i] * left[:, j], cells)
    both = np.flatnonzero(count.reshape(-1, 2).min(axis=1, initial=np.inf) >= _LEAST)
    spread, axes = np.linalg.eigh(scatter[both])
    total = count.reshape(-1, 2)[both].sum(axis=1)
    spread = np.sqrt(np.maximum(spread, 0) / total[:, None])
    gap = mean.reshape(-1, 2, 3)[both]
    gap = gap[:, 1] - gap[:, 0]
    normal = axes[:, :, 0] * np.where(axes[:, 2:, 0] > 0, -1.0, 1.0)  # the camera looks along +z
    off = np.einsum("ni,ni->n", gap, normal)
    beside = np.linalg.norm(gap - off[:, None] * normal, axis=1)
    noise = np.bincount(label, chosen.sigma.astype(np.float64) ** 2, cells)[both] / total
    use = (
        (spread[:, 0] < 3.0 * np.sqrt(noise) + _FLAT * size)
        & (spread[:, 1] > _ROUND * spread[:, 2])
        & (beside < 0.25 * size)
    )
    names = cloud.laser_names
    if not use.any():
        return Agreement(names[first], names[second], 0, *[float("nan")] * 4)
    own = np.bincount(slot, chosen.sigma.astype(np.float64) ** 2, 2 * cells) / count.clip(1) ** 2
    shared = np.bincount(slot, chosen.sigma_cal.astype(np.float64) ** 2, 2 * cells) / count.clip(1)
    expected = (own + shared).reshape(-1, 2)[both].sum(axis=1)[use]
    off = off[use]
    return Agreement(
        names[first], names[second], len(off), float(off.mean()), float(np.sqrt((off**2).mean())),
        float(np.sqrt(expected.mean())), float((off**2 > 9.0 * expected).mean()),
    )  # fmt: skip


def _cells(points: Array, size: float) -> Ints:
    """Number (N,) from 0 of the cube of space that each point lies in."""
    place = np.floor((points - points.min(axis=0, initial=np.inf)) / size).astype(np.int64)
    extent = place.max(axis=0, initial=0) + 1
    key = (place[:, 0] * extent[1] + place[:, 1]) * extent[2] + place[:, 2]
    return np.unique(key, return_inverse=True)[1].astype(np.int64)


def _spacing(cloud: ScanCloud) -> float:
    """Spacing, mm, of the lattice of the cloud's one laser."""
    return lattice_spacing(cloud, lattice_index(cloud, int(cloud.laser[0])))
