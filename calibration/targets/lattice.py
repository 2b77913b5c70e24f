"""Points of an image to the indices of a lattice that is bent by perspective and by the lens.

Nothing is known here of a target: the lattice has two directions and an origin of its own, and is only required to be
locally affine. `calibration.targets.grid` finds out how it lies on the target.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Ints

_TOLERANCE = 0.25  # steps: how far a point may lie from where its neighbours predict it
_STRAY = 0.15  # steps: the same once the lattice is complete
_LEAST_STRAY = 0.04  # steps: the same where the neighbours lie all around
_INTERIOR = 4.8  # weight of neighbours that lie all around
_NEIGHBOURS = 12
_SEEDS = 40  # places to start from, at most
_TRIALS = 3  # of them, before a lattice of most points is taken for good


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Where N points lie on a lattice with directions and an origin of its own."""

    index: Ints  # (N, 2), (i, j); meaningless where not on the lattice
    on: Bools  # (N,) which points are on it
    side: Array  # (N,) px, of a square of the area of the cell about the point
    strays: int  # points among the cells that are not on it: dirt, or a part that could not be followed


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
    from calibration.targets import _lattice_kernels as kernel

    n = len(points)
    best = Lattice(np.zeros((n, 2), np.int64), np.zeros(n, np.bool_), np.full(n, np.nan), n)
    if n < 4:
        return best
    points = np.ascontiguousarray(points, dtype=np.float64)
    reach = min(n, 3 * int(np.ceil(np.sqrt(n))) + 30) + 4
    for trial, (seed, basis) in enumerate(_seeds(points, aspect)):
        if best.on.sum() > (0.9 if trial < _TRIALS else 0.6) * n:
            break
        start = np.full((n, 2), -1, np.int64)
        start[seed] = reach
        for _ in range(4):
            before = int(best.on.sum())
            cell = kernel.grow(points, start, basis, reach, _TOLERANCE)
            miss, side, weight = kernel.misfit(points, cell, basis, reach).T
            known = np.isfinite(miss)
            if known.sum() < 4:
                break
            # a stray point near a lattice place is told by how well the others fit
            limit = np.clip(8.0 * float(np.median(miss[known])), _LEAST_STRAY, _STRAY)
            keep = miss < np.where(weight > _INTERIOR, limit, _STRAY)
            if keep.sum() < 4:
                break
            found = _straighten(points, Lattice(_primitive(cell, keep), keep, side, 0))
            if found.on.sum() > best.on.sum():
                best = found
            if found.on.sum() > 0.97 * n or found.on.sum() <= before:
                break
            # the map of the whole has thrown out what grew wrong and taken in what was missed: grow again from there
            middle = np.round(found.index[found.on].mean(axis=0)).astype(np.int64)
            start = np.where(found.on[:, None], found.index - middle + reach, -1)
            if (start[found.on] < 4).any() or (start[found.on] > 2 * reach - 4).any():
                break
    return best


def _straighten(points: Array, grown: Lattice) -> Lattice:
    """Drop points that no smooth map of the whole lattice explains, and take in those that it does.

    The map is a homography followed by a polynomial, which takes what the lens bends, fitted with weights that fall
    with the residual (Cauchy). What grew wrong at one place is seen from all the others.
    """
    index, kept, side = grown.index, grown.on, grown.side
    centre = points[kept].mean(axis=0)
    scale = float(np.abs(points[kept] - centre).max())
    p = (points - centre) / scale
    strays = 0
    step = 0.1 * float(np.median(side[kept])) / scale
    for _ in range(3):
        order = 4 if kept.sum() >= 60 else 3 if kept.sum() >= 30 else 2 if kept.sum() >= 14 else 1
        if kept.sum() < 8:
            return Lattice(index, kept, side, int((~kept).sum()))
        low, high = index[kept].min(axis=0), index[kept].max(axis=0)
        middle, span = (low + high) / 2.0, max(float((high - low).max()) / 2.0, 1.0)
        # pixels to indices: that way the polynomial needs no inverse to be asked where a point lies
        where = (index - middle) / span
        weight = np.ones(int(kept.sum()))
        for _ in range(4):
            to_index = _index_map(p[kept], where[kept], weight, order)
            residual = np.linalg.norm(to_index(p[kept]) - where[kept], axis=1) * span
            weight = 1.0 / (1.0 + (residual / max(0.03, 1.5 * float(np.median(residual)))) ** 2)
        guess = to_index(p) * span + middle
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
        east, south = ((to_index(p + d) * span + middle - guess) / (step * scale) for d in np.eye(2) * step)
        side = 1.0 / np.sqrt(np.abs(east[:, 0] * south[:, 1] - east[:, 1] * south[:, 0]) + 1e-12)
        strays = int((((nearest >= low) & (nearest <= high)).all(axis=1) & ~new).sum())
        index, kept = np.where(new[:, None], nearest, -1), new
        if settled:
            break
    return Lattice(index, kept, side, strays)


def _index_map(known: Array, where: Array, weight: Array, order: int) -> Callable[[Array], Array]:
    """Map of points (N, 2) to places in the lattice, fitted to known ones: a homography, then a polynomial."""
    a = np.zeros((2 * len(known), 8))
    a[::2, :2] = a[1::2, 3:5] = known
    a[::2, 2] = a[1::2, 5] = 1.0
    a[::2, 6:], a[1::2, 6:] = -where[:, :1] * known, -where[:, 1:] * known
    w = np.repeat(weight, 2)[:, None]
    normal = a.T @ (w * a)
    h = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(8), (w * a).T @ where.ravel())

    def terms(q: Array) -> Array:
        below = q @ h[6:] + 1.0
        below = np.where(np.abs(below) < 1e-9, 1e-9, below)
        x, y = np.clip((q @ h[:2] + h[2]) / below, -3.0, 3.0), np.clip((q @ h[3:5] + h[5]) / below, -3.0, 3.0)
        one = np.ones_like(x)
        xs, ys = [one], [one]
        for _ in range(order):
            xs.append(xs[-1] * x)
            ys.append(ys[-1] * y)
        return np.stack([xs[m] * ys[n] for m in range(order + 1) for n in range(order + 1 - m)], axis=1)

    basis, root = terms(known), np.sqrt(weight)[:, None]
    left, right = np.linalg.qr(basis * root)
    # a diagonal that is nothing belongs to a term that the points do not tell apart from the others
    sure = np.abs(np.diag(right)) > 1e-9 * np.abs(np.diag(right)).max()
    if sure.all():
        factor = np.linalg.solve(right, left.T @ (where * root))
    else:
        factor = np.linalg.lstsq(basis * root, where * root, rcond=1e-9)[0]
    return lambda q: np.asarray(terms(q) @ factor)


def _primitive(index: Ints, on: Bools) -> Ints:
    """Indices on the lattice that the points fill, where ``index`` counts one of which only every second place is used.

    That happens where the first step was taken to dirt that lies half way between two points.
    """
    for _ in range(2):
        for parity, halved in (((1, 0), ((1, 0), (0, 2))), ((0, 1), ((2, 0), (0, 1))), ((1, 1), ((1, 1), (1, -1)))):
            odd = float(np.mean(index[on] @ np.array(parity) % 2))
            if min(odd, 1.0 - odd) < 0.03:
                first = np.array([1, 0]) if parity[0] else np.array([0, 1])
                index = ((index - first * round(odd)) @ np.array(halved).T) // 2
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
        yield int(s), _shortest(basis[k])


def _shortest(basis: Array) -> Array:
    """Shortest pair of steps, as columns, of the lattice of a pair (Lagrange and Gauss)."""
    a, b = basis[:, 0], basis[:, 1]
    for _ in range(8):
        if a @ a > b @ b:
            a, b = b, a
        whole = np.round((a @ b) / (a @ a))
        if whole == 0.0:
            break
        b = b - whole * a
    return np.ascontiguousarray(np.stack([a, b], axis=1))


def _condition(matrices: Array) -> Array:
    """Ratio (P,) of the singular values of 2x2 matrices, in closed form."""
    square = np.einsum("pij,pij->p", matrices, matrices)
    det = np.abs(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])
    root = np.sqrt(np.maximum(square**2 - 4.0 * det**2, 0.0))
    return np.asarray(np.sqrt((square + root) / np.maximum(square - root, 1e-12 * square)))
