"""Points of an image to the indices of a lattice that is bent by perspective and by the lens.

Nothing is known here of a target: the lattice has two directions and an origin of its own, and is only required to be
locally affine. `calibration.grid` finds out how it lies on the target.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Ints

_TOLERANCE = 0.25  # steps: how far a point may lie from where its neighbours predict it
_STRAY = 0.15  # steps: the same once the lattice is complete
_LEAST_STRAY = 0.04  # steps: the same where the neighbours lie all around
_INTERIOR, _FEW = 4.8, 1.2  # weight of neighbours that lie all around, and of too few to tell the cell's size
_NEIGHBOURS = 12
_SEEDS = 40


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Where N points lie on a lattice with directions and an origin of its own."""

    index: Ints  # (N, 2), (i, j); meaningless where not on the lattice
    on: Bools  # (N,) which points are on it
    side: Array  # (N,) px, of a square of the area of the cell about the point; NaN where too few neighbours tell


def index_lattice(points: Array, aspect: float = 1.0) -> Lattice:
    """Find the largest lattice that can be grown among points, and the indices of the points on it.

    Parameters
    ----------
    points : (N, 2) array, px
        Centroids (u, v); some may belong to no lattice.
    aspect : float
        Pitch along one side of the lattice over that along the other, as far as it is known: it tells the sides of a
        tilted cell from its diagonals.

    Returns
    -------
    Lattice
        Nothing is on it where there is none.
    """
    from calibration import grid_kernel as kernel

    n = len(points)
    best = Lattice(np.zeros((n, 2), np.int64), np.zeros(n, np.bool_), np.full(n, np.nan))
    if n < 4:
        return best
    points = np.ascontiguousarray(points, dtype=np.float64)
    reach = min(n, 3 * int(np.ceil(np.sqrt(n))) + 30) + 4
    for seed, basis in _seeds(points, aspect):
        cell = kernel.grow(points, seed, basis, reach, _TOLERANCE)
        miss, side, weight = kernel.misfit(points, cell, basis, reach).T
        known = np.isfinite(miss)
        if known.sum() <= best.on.sum():
            continue
        # a stray point near a lattice place is told by how well the others fit
        limit = np.clip(8.0 * float(np.median(miss[known])), _LEAST_STRAY, _STRAY)
        keep = miss < np.where(weight > _INTERIOR, limit, _STRAY)
        if keep.sum() < max(4, best.on.sum()):
            continue
        cell, keep = _straighten(points, _primitive(cell, keep), keep)
        if keep.sum() > best.on.sum():
            miss, side, weight = kernel.misfit(points, cell, basis, reach).T
            best = Lattice(cell, keep, np.where(weight > _FEW, side, np.nan))
        if best.on.sum() > 0.6 * n:
            break
    return best


def _straighten(points: Array, index: Ints, on: Bools) -> tuple[Ints, Bools]:
    """Drop points that no smooth map of the whole lattice explains, and take in those that it does.

    The map is a homography followed by a polynomial, which takes what the lens bends, fitted with weights that fall
    with the residual (Cauchy). What grew wrong at one place is seen from all the others.
    """
    centre, scale = points[on].mean(axis=0), float(np.abs(points[on] - points[on].mean(axis=0)).max())
    p = (points - centre) / scale
    kept = on
    for _ in range(3):
        order = 4 if kept.sum() >= 60 else 3 if kept.sum() >= 30 else 2 if kept.sum() >= 14 else 1
        if kept.sum() < 8:
            return index, kept
        low, high = index[kept].min(axis=0), index[kept].max(axis=0)
        middle, span = (low + high) / 2.0, max(float((high - low).max()) / 2.0, 1.0)
        # pixels to indices: that way the polynomial needs no inverse to be asked where a point lies
        where = (index - middle) / span
        weight = np.ones(int(kept.sum()))
        for _ in range(4):
            guess = _to_index(p, p[kept], where[kept], weight, order)
            residual = np.linalg.norm(guess[kept] - where[kept], axis=1) * span
            weight = 1.0 / (1.0 + (residual / max(0.03, 1.5 * float(np.median(residual)))) ** 2)
        guess = guess * span + middle
        nearest = np.round(guess).astype(np.int64)
        off = np.abs(guess - nearest).max(axis=1)
        spread = float(np.median(off[kept]))
        near = ((nearest >= low - 2) & (nearest <= high + 2)).all(axis=1)
        candidates = np.flatnonzero((off < np.clip(8.0 * spread, _LEAST_STRAY, _STRAY)) & near)
        # of two points that claim one place the nearer one has it
        candidates = candidates[np.argsort(off[candidates])]
        _, first = np.unique(nearest[candidates], axis=0, return_index=True)
        new = np.zeros(len(points), np.bool_)
        new[candidates[first]] = True
        settled = bool((new == kept).all() and (nearest[kept] == index[kept]).all())
        index, kept = np.where(new[:, None], nearest, -1), new
        if settled:
            break
    return index - index[kept].min(axis=0) + 4 if kept.any() else index, kept


def _to_index(p: Array, known: Array, where: Array, weight: Array, order: int) -> Array:
    """Places (N, 2) in the lattice of points (N, 2), by a map fitted to known ones: homography, then polynomial."""
    one = np.ones(len(known))
    a = np.zeros((2 * len(known), 8))
    a[::2, :3] = a[1::2, 3:6] = np.column_stack([known, one])
    a[::2, 6:], a[1::2, 6:] = -where[:, :1] * known, -where[:, 1:] * known
    w = np.sqrt(np.repeat(weight, 2))
    h = np.append(np.linalg.lstsq(a * w[:, None], where.ravel() * w, rcond=None)[0], 1.0).reshape(3, 3)

    def flat(q: Array) -> Array:
        image = np.column_stack([q, np.ones(len(q))]) @ h.T
        return np.asarray(image[:, :2] / np.where(np.abs(image[:, 2:]) < 1e-9, 1e-9, image[:, 2:]))

    def terms(q: Array) -> Array:
        x, y = np.clip(q, -3.0, 3.0).T
        return np.stack([x**m * y**n for m in range(order + 1) for n in range(order + 1 - m)], axis=1)

    basis, w = terms(flat(known)), np.sqrt(weight)
    return np.asarray(terms(flat(p)) @ np.linalg.lstsq(basis * w[:, None], where * w[:, None], rcond=None)[0])


def _primitive(index: Ints, on: Bools) -> Ints:
    """Indices on the lattice that the points fill, where ``index`` counts one of which only every second place is used.

    That happens where the first step was taken to dirt that lies half way between two points.
    """
    for _ in range(2):
        i, j = index[on].T
        for test, halved in (
            (i, lambda x: np.stack([x[:, 0] // 2, x[:, 1]], axis=1)),
            (j, lambda x: np.stack([x[:, 0], x[:, 1] // 2], axis=1)),
            (i + j, lambda x: np.stack([(x[:, 0] + x[:, 1]) // 2, (x[:, 0] - x[:, 1]) // 2], axis=1)),
        ):
            odd = float(np.mean(test % 2))
            if min(odd, 1.0 - odd) < 0.03:
                index = halved(
                    index - np.array([1, 0]) if odd > 0.5 and test is not j else index - np.array([0, int(odd > 0.5)])
                )
                break
        else:
            break
    return index


def _seeds(points: Array, aspect: float) -> Iterator[tuple[int, Array]]:
    """Points with two steps (2, 2) px that explain their neighbourhood, the middle of the view first.

    Of all pairs of steps to neighbours that give most of the neighbours whole indices, the one is taken whose cell is
    nearest to a rectangle of the known aspect: a tilt by up to 50 degrees cannot make a diagonal look squarer.
    """
    count = min(_NEIGHBOURS, len(points) - 1)
    order = np.argsort(np.linalg.norm(points - np.median(points, axis=0), axis=1))[:_SEEDS]
    for s in order:
        gap = points - points[s]
        near = np.argsort(np.einsum("nx,nx->n", gap, gap))[1 : count + 1]
        steps = gap[near]
        a, b = np.triu_indices(len(steps), 1)
        basis = np.stack([steps[a], steps[b]], axis=2)  # columns are steps
        det = basis[:, 0, 0] * basis[:, 1, 1] - basis[:, 0, 1] * basis[:, 1, 0]
        lengths = np.linalg.norm(basis, axis=1)
        sound = np.abs(det) > 0.3 * lengths[:, 0] * lengths[:, 1]
        if not sound.any():
            continue
        basis, det = basis[sound], det[sound]
        # Cramer's rule: coordinates (P, 2, K) of the neighbours in every basis
        x = (basis[:, 1, 1, None] * steps[:, 0] - basis[:, 0, 1, None] * steps[:, 1]) / det[:, None]
        y = (basis[:, 0, 0, None] * steps[:, 1] - basis[:, 1, 0, None] * steps[:, 0]) / det[:, None]
        miss = np.maximum(np.abs(x - np.round(x)), np.abs(y - np.round(y)))
        explained = (miss < 0.25).sum(axis=1)
        best = explained.max()
        if best < 0.6 * len(steps):
            continue
        worst = np.minimum(*(_condition(basis / np.array([ratio, 1.0])) for ratio in (aspect, 1.0 / aspect)))
        worst[explained < 0.8 * best] = np.inf
        k = int(worst.argmin())
        yield int(s), np.ascontiguousarray(basis[k])


def _condition(matrices: Array) -> Array:
    """Ratio (P,) of the singular values of 2x2 matrices, in closed form."""
    square = np.einsum("pij,pij->p", matrices, matrices)
    det = np.abs(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])
    root = np.sqrt(np.maximum(square**2 - 4.0 * det**2, 0.0))
    return np.asarray(np.sqrt((square + root) / np.maximum(square - root, 1e-12 * square)))
