"""How far two lasers disagree about a surface that both have seen."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calibration.geometry import Array, Ints
from scope.cloud import ScanCloud, lattice_index, lattice_spacing

_LEAST = 8  # points of each laser in a cell
_SMOOTH = 4.0  # chi squared a degree of freedom of a cell's surface: beyond, an edge or roughness runs through it
_SHAKY = 0.02  # of the cell: standard deviation of a step, beyond which the cell's points do not determine it


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
        Edge of the cells, mm; by default four times the larger spacing of the points.

    Returns
    -------
    tuple of Agreement
        In a cell, one quadratic surface is fitted to the points of both lasers, with a step between them: the step is the
        disagreement. Cells on which the points lie on no such surface, or that do not determine the step, do not
        count.
    """
    present = [int(k) for k in np.unique(cloud.laser)]
    if len(present) < 2:
        return ()
    size = cell or 4.0 * max(_spacing(cloud.select(cloud.laser == k)) for k in present)
    if size <= 0.0:
        return ()
    return tuple(_compare(cloud, a, b, size) for a, b in combinations(present, 2))


def _compare(cloud: ScanCloud, first: int, second: int, size: float) -> Agreement:
    chosen = cloud.select(np.isin(cloud.laser, (first, second)))
    owner = (chosen.laser == second).astype(np.int64)
    label = _cells(chosen.points, size)
    cells = int(label.max(initial=-1)) + 1
    each = np.bincount(2 * label + owner, minlength=2 * cells).reshape(-1, 2)
    keep = (each.min(axis=1, initial=np.iinfo(np.int64).max) >= _LEAST)[label]
    names = cloud.laser_names[first], cloud.laser_names[second]
    if not keep.any():
        return Agreement(*names, 0, *[float("nan")] * 4)
    chosen, owner = chosen.select(keep), owner[keep]
    label = np.unique(label[keep], return_inverse=True)[1].astype(np.int64)
    step, own, misfit = _steps(chosen, owner, label, size)
    shared = sum(
        np.bincount(label[owner == k], chosen.sigma_cal[owner == k].astype(np.float64) ** 2)
        / np.bincount(label[owner == k])
        for k in (0, 1)
    )
    with np.errstate(invalid="ignore"):
        use = (misfit < _SMOOTH) & (own < (_SHAKY * size) ** 2)
    if not use.any():
        return Agreement(*names, 0, *[float("nan")] * 4)
    step, expected = step[use], (own + shared)[use]
    return Agreement(
        *names, len(step), float(step.mean()), float(np.sqrt((step**2).mean())), float(np.sqrt(expected.mean())),
        float((step**2 > 9.0 * expected).mean()),
    )  # fmt: skip


def _steps(cloud: ScanCloud, owner: Ints, label: Ints, size: float) -> tuple[Array, Array, Array]:
    """Step (M,) mm from the first laser's surface to the second's in M cells, its variance from noise, and the misfit.

    The surface is h = q(a, b) + step, in axes of the cell's own least squares plane, h towards the camera; q is quadratic.
    Points weigh by their noise, which lies along the sighting ray: on a steep surface it counts by its part along the normal.
    """
    cells = int(label.max()) + 1
    count = np.bincount(label, minlength=cells)

    def sums(values: Array) -> Array:
        return np.stack([np.bincount(label, column, cells) for column in values.T], axis=1)

    local = cloud.points - (sums(cloud.points - cloud.points[0]) / count[:, None] + cloud.points[0])[label]
    spread = sums((local[:, :, None] * local[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
    axes = np.linalg.eigh(spread)[1].transpose(0, 2, 1)  # rows; the first is the normal
    axes[:, 0] *= np.where(axes[:, 0, 2:] > 0, -1.0, 1.0)  # the camera looks along +z
    h, a, b = np.einsum("nij,nj->in", axes[label], local) / size
    terms = np.stack([np.ones_like(a), a, b, a * a, a * b, b * b, owner.astype(np.float64)], axis=1)
    noise = np.maximum(cloud.sigma.astype(np.float64) * np.abs(axes[label, 0, 2]), 1e-9) / size
    weighted = terms / noise[:, None] ** 2
    n = terms.shape[1]
    normal = sums((weighted[:, :, None] * terms[:, None, :]).reshape(-1, n * n)).reshape(-1, n, n)
    scale = np.sqrt(np.einsum("cii->ci", normal))
    normal = normal / (scale[:, :, None] * scale[:, None, :]) + 1e-10 * np.eye(n)
    inverse = np.linalg.inv(normal) / (scale[:, :, None] * scale[:, None, :])
    found = np.einsum("cij,cj->ci", inverse, sums(weighted * h[:, None]))
    left = (h - np.einsum("ni,ni->n", terms, found[label])) / noise
    misfit = np.bincount(label, left**2, cells) / np.maximum(count - n, 1)
    return found[:, -1] * size, inverse[:, -1, -1] * size**2 * np.maximum(misfit, 1.0), misfit


def _cells(points: Array, size: float) -> Ints:
    """Number (N,) from 0 of the cube of space that each point lies in."""
    place = np.floor((points - points.min(axis=0, initial=np.inf)) / size).astype(np.int64)
    extent = place.max(axis=0, initial=0) + 1
    key = (place[:, 0] * extent[1] + place[:, 1]) * extent[2] + place[:, 2]
    return np.unique(key, return_inverse=True)[1].astype(np.int64)


def _spacing(cloud: ScanCloud) -> float:
    """Spacing, mm, of the lattice of the cloud's one laser."""
    return lattice_spacing(cloud, lattice_index(cloud, int(cloud.laser[0])))
