"""Points of an image to the indices of a lattice that is bent by perspective and by the lens.

Nothing is known here of a target: the lattice has two directions and an origin of its own, and is only required to be
locally affine. `calibration.grid` finds out how it lies on the target.
"""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, Bools, Ints

_TOLERANCE = 0.22  # of the distance between neighbours: how far a point may lie from where its neighbours predict it
_NEIGHBOURS = 12


def index_lattice(points: Array, aspect: float = 1.0) -> tuple[Ints, Bools]:
    """Indices of the points on the largest lattice that can be grown among them.

    Parameters
    ----------
    points : (N, 2) array, px
        Centroids (u, v); some may belong to no lattice.
    aspect : float
        Pitch along one side of the lattice over that along the other, as far as it is known: it tells the sides of a
        tilted cell from its diagonals.

    Returns
    -------
    (N, 2) array of integers
        Indices (i, j), from an arbitrary origin; those of points that are not on the lattice are meaningless.
    (N,) array, bool
        Which points are on it.
    """
    n = len(points)
    none = np.zeros((n, 2), np.int64), np.zeros(n, np.bool_)
    if n < 4:
        return none
    near = _nearest(points, min(_NEIGHBOURS, n - 1))
    best = none
    for seed, basis in _seeds(points, near, aspect):
        grown = _grow(points, near, seed, basis)
        if grown[1].sum() > best[1].sum():
            best = grown
        if best[1].sum() > 0.7 * n:
            break
    return best


def _nearest(points: Array, k: int) -> Ints:
    """Indices (N, k) of the nearest other points, nearest first."""
    square = np.sum(points**2, axis=1)
    distance = square[:, None] + square[None] - 2.0 * (points @ points.T)
    np.fill_diagonal(distance, np.inf)
    some = np.argpartition(distance, k - 1, axis=1)[:, :k]
    order = np.argsort(np.take_along_axis(distance, some, axis=1), axis=1)
    return np.take_along_axis(some, order, axis=1).astype(np.int64)


def _seeds(points: Array, near: Ints, aspect: float, most: int = 12) -> list[tuple[int, Array]]:
    """Points with a pair of steps (2, 2) px that explain their neighbourhood, the most convincing first."""
    centre = np.median(points, axis=0)
    order = np.argsort(np.linalg.norm(points - centre, axis=1))[: 3 * most]
    found: list[tuple[float, int, Array]] = []
    for s in order:
        steps = points[near[s]] - points[s]
        a, b = np.triu_indices(len(steps), 1)
        basis = np.stack([steps[a], steps[b]], axis=2)  # (P, 2, 2), columns are steps
        det = basis[:, 0, 0] * basis[:, 1, 1] - basis[:, 0, 1] * basis[:, 1, 0]
        lengths = np.linalg.norm(basis, axis=1)
        sound = np.abs(det) > 0.5 * lengths[:, 0] * lengths[:, 1]
        if not sound.any():
            continue
        basis, det = basis[sound], det[sound]
        coordinates = np.linalg.solve(basis, np.broadcast_to(steps.T, (len(basis), *steps.T.shape)))
        miss = np.abs(coordinates - np.round(coordinates)).max(axis=1)
        close = np.abs(coordinates).max(axis=1) < 1.6
        explained = (miss < 0.25).sum(axis=1) / len(steps)
        opposite = ((miss < 0.2) & close).sum(axis=1)
        worst = np.full(len(basis), np.inf)
        for ratio in {aspect, 1.0 / aspect}:
            worst = np.minimum(worst, _condition(basis * np.array([1.0, ratio])))
        score = 4.0 * explained + 0.25 * opposite - 0.5 * worst
        k = int(score.argmax())
        if explained[k] > 0.6:
            found.append((float(score[k]), int(s), basis[k]))
        if len(found) >= most:
            break
    found.sort(key=lambda item: -item[0])
    return [(s, basis) for _, s, basis in found]


def _condition(matrices: Array) -> Array:
    """Ratio (P,) of the singular values of 2x2 matrices, in closed form."""
    square = np.sum(matrices**2, axis=(1, 2))
    det = np.abs(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])
    root = np.sqrt(np.maximum(square**2 - 4.0 * det**2, 0.0))
    return np.asarray(np.sqrt((square + root) / np.maximum(square - root, 1e-12)))


def _grow(points: Array, near: Ints, seed: int, basis: Array) -> tuple[Ints, Bools]:
    """Grow a lattice from one point, ring by ring; every cell is predicted by the points around it."""
    n = len(points)
    reach = int(np.ceil(np.sqrt(n))) * 4 + 8
    side = 2 * reach + 1
    where = np.full((side, side), -1, np.int64)  # point of a cell
    index = np.zeros((n, 2), np.int64)
    on = np.zeros(n, np.bool_)
    where[reach, reach] = seed
    on[seed] = True
    ring = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
    tried: dict[tuple[int, int], int] = {}
    for _ in range(4 * reach):
        known = index[on]
        cells = np.unique((known[:, None] + ring[None]).reshape(-1, 2), axis=0)
        cells = cells[(np.abs(cells) < reach - 3).all(axis=1)]
        cells = cells[where[cells[:, 0] + reach, cells[:, 1] + reach] < 0]
        fresh = [tried.get((int(i), int(j)), 0) < 3 for i, j in cells]
        cells = cells[fresh]
        if not len(cells):
            break
        place, step = _predict(points, where, reach, cells, basis)
        for i, j in cells:
            tried[int(i), int(j)] = tried.get((int(i), int(j)), 0) + 1
        distance = np.linalg.norm(points[None] - place[:, None], axis=2)
        distance[:, on] = np.inf
        pick = distance.argmin(axis=1)
        gap = distance[np.arange(len(cells)), pick]
        fits = gap < _TOLERANCE * step
        taken = False
        for c in np.argsort(gap):
            if fits[c] and not on[pick[c]]:
                on[pick[c]] = True
                index[pick[c]] = cells[c]
                where[cells[c, 0] + reach, cells[c, 1] + reach] = pick[c]
                taken = True
        if not taken:
            break
    return index, on


def _predict(points: Array, where: Ints, reach: int, cells: Ints, basis: Array) -> tuple[Array, Array]:
    """Where the points of cells (C, 2) are expected, px, and the shorter of the local steps, px.

    A quadratic in the indices is fitted to the points within three cells, nearer ones weighing more; its curvature and
    then its slope are held back towards zero and towards ``basis`` where there are too few points to tell.
    """
    span = np.arange(-3, 4)
    di, dj = (m.ravel() for m in np.meshgrid(span, span, indexing="ij"))
    owner = where[cells[:, 0, None] + di + reach, cells[:, 1, None] + dj + reach]  # (C, 49)
    there = owner >= 0
    weight = np.where(there, np.exp(-0.35 * (di**2 + dj**2)), 0.0)
    place = points[np.maximum(owner, 0)]
    plain = place - np.stack([di, dj], axis=1) @ basis.T  # (C, 49, 2): what is left of a plain lattice
    terms = np.stack([np.ones_like(di), di, dj, di * di, di * dj, dj * dj], axis=1).astype(np.float64)
    normal = np.einsum("ck,kp,kq->cpq", weight, terms, terms)
    hold = np.array([0.0, 0.01, 0.01, 0.05, 0.05, 0.05])
    normal += np.diag(hold) * weight.sum(axis=1)[:, None, None]
    right = np.einsum("ck,kp,ckx->cpx", weight, terms, plain)
    solution = np.linalg.solve(normal, right)
    slopes = solution[:, 1:3] + basis.T
    return solution[:, 0], np.linalg.norm(slopes, axis=2).min(axis=1)
