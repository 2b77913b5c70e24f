"""The growth of a bent lattice among points, compiled by numba. Importing this module loads numba."""

from __future__ import annotations

import math

import numpy as np

from calibration.compiled import cached
from calibration.geometry import Array, Ints

_SPAN = 3  # cells around one that predict it
_LEAST = 1.1  # weight of neighbours, once there are some: about two beside a cell
_HOLD = 0.02, 0.08  # how strongly slope and curvature are held back where few points tell them


def _predict(points: Array, where: Ints, i: int, j: int, basis: Array, skip: int, out: Array) -> float:
    """Where the point of cell (i, j) is expected, px, into ``out[:2]``; the local steps into ``out[2:]``.

    A quadratic in the indices is fitted to the points within three cells, nearer ones weighing more; its curvature is
    held back towards zero and its slope towards ``basis``. Returns the weight of the points that were used.
    """
    m, b = np.zeros((6, 6)), np.zeros((6, 2))
    t = np.empty(6)
    total = 0.0
    for di in range(-_SPAN, _SPAN + 1):
        for dj in range(-_SPAN, _SPAN + 1):
            x, y = i + di, j + dj
            if x < 0 or y < 0 or x >= where.shape[0] or y >= where.shape[1]:
                continue
            k = where[x, y]
            if k < 0 or k == skip:
                continue
            w = math.exp(-0.35 * (di * di + dj * dj))
            t[0], t[1], t[2], t[3], t[4], t[5] = 1.0, di, dj, di * di, di * dj, dj * dj
            e = points[k, 0] - basis[0, 0] * di - basis[0, 1] * dj
            f = points[k, 1] - basis[1, 0] * di - basis[1, 1] * dj
            total += w
            for p in range(6):
                b[p, 0] += w * t[p] * e
                b[p, 1] += w * t[p] * f
                for q in range(p + 1):
                    m[p, q] += w * t[p] * t[q]
    if total == 0.0:
        return 0.0
    for p in range(6):
        m[p, p] += total * (1e-9 if p == 0 else _HOLD[0] if p < 3 else _HOLD[1])
        for q in range(p):
            m[q, p] = m[p, q]
    # Gauss elimination: the matrix is positive definite
    for p in range(6):
        for r in range(p + 1, 6):
            c = m[r, p] / m[p, p]
            for q in range(p, 6):
                m[r, q] -= c * m[p, q]
            b[r, 0] -= c * b[p, 0]
            b[r, 1] -= c * b[p, 1]
    for p in range(5, -1, -1):
        for q in range(p + 1, 6):
            b[p, 0] -= m[p, q] * b[q, 0]
            b[p, 1] -= m[p, q] * b[q, 1]
        b[p, 0] /= m[p, p]
        b[p, 1] /= m[p, p]
    out[0], out[1] = b[0, 0], b[0, 1]
    out[2], out[3] = basis[0, 0] + b[1, 0], basis[1, 0] + b[1, 1]
    out[4], out[5] = basis[0, 1] + b[2, 0], basis[1, 1] + b[2, 1]
    return total


_predict = cached(error_model="numpy")(_predict)


def _grow(points: Array, start: Ints, basis: Array, reach: int, tolerance: float) -> Ints:
    n = len(points)
    side = 2 * reach + 1
    where = np.full((side, side), -1, np.int64)  # point of a cell
    tried = np.zeros((side, side), np.float64)  # weight of what predicted a cell when it was last looked at
    cell = start.copy()
    grown = 0
    for k in range(n):
        if cell[k, 0] >= 0:
            where[cell[k, 0], cell[k, 1]] = k
            grown += 1
    place = np.empty(6)
    list_i, list_j, weight = np.empty(side * side, np.int64), np.empty(side * side, np.int64), np.empty(side * side)
    step = 1
    while True:
        # the cells beside what is known, best supported first
        count = 0
        i0, i1, j0, j1 = side, 0, side, 0
        for k in range(n):
            if cell[k, 0] >= 0:
                i0, i1 = min(i0, cell[k, 0]), max(i1, cell[k, 0])
                j0, j1 = min(j0, cell[k, 1]), max(j1, cell[k, 1])
        for i in range(max(2, i0 - step), min(side - 2, i1 + step + 1)):
            for j in range(max(2, j0 - step), min(side - 2, j1 + step + 1)):
                if where[i, j] >= 0:
                    continue
                support = 0.0
                for di in range(-step, step + 1):
                    for dj in range(-step, step + 1):
                        if where[i + di, j + dj] >= 0:
                            support += math.exp(-0.35 * (di * di + dj * dj))
                if support > 1.02 * tried[i, j] and (support > _LEAST or grown < 6):
                    list_i[count], list_j[count], weight[count] = i, j, support
                    count += 1
        found = 0
        for c in np.argsort(-weight[:count]):
            i, j = list_i[c], list_j[c]
            if weight[c] < 0.5 * weight[:count].max() and found > 0:
                break
            tried[i, j] = weight[c]
            if _predict(points, where, i, j, basis, -1, place) == 0.0:
                continue
            best, pick, second = np.inf, -1, np.inf
            for k in range(n):
                g = (points[k, 0] - place[0]) ** 2 + (points[k, 1] - place[1]) ** 2
                if g < best:
                    second, best, pick = best, g, k
                elif g < second:
                    second = g
            short = min(place[2] ** 2 + place[3] ** 2, place[4] ** 2 + place[5] ** 2)
            if best > tolerance * tolerance * short or cell[pick, 0] >= 0:
                continue
            where[i, j] = pick
            cell[pick, 0], cell[pick, 1] = i, j
            found += 1
            grown += 1
        if found > 0:
            step = 1
        elif step == 1:
            step = 2
        else:
            break
    return cell


def _misfit(points: Array, cell: Ints, basis: Array, reach: int) -> Array:
    n = len(points)
    side = 2 * reach + 1
    where = np.full((side, side), -1, np.int64)
    out = np.zeros((n, 3))
    out[:, 0] = np.inf
    place = np.empty(6)
    for k in range(n):
        if cell[k, 0] >= 0:
            where[cell[k, 0], cell[k, 1]] = k
    for k in range(n):
        if cell[k, 0] < 0:
            continue
        out[k, 2] = _predict(points, where, cell[k, 0], cell[k, 1], basis, k, place)
        if out[k, 2] > 0.0:
            short = min(place[2] ** 2 + place[3] ** 2, place[4] ** 2 + place[5] ** 2)
            out[k, 1] = math.sqrt(abs(place[2] * place[5] - place[3] * place[4]))
            out[k, 0] = math.sqrt(((points[k, 0] - place[0]) ** 2 + (points[k, 1] - place[1]) ** 2) / short)
    return out


#: ``grow(points, start, basis, reach, tolerance) -> (N, 2)``: cells of the points from 0 to 2 reach, -1 where they are on
#: no lattice, grown from those that ``start`` (N, 2) has.
grow = cached(error_model="numpy")(_grow)
#: ``misfit(points, cell, basis, reach) -> (N, 3)``: distance of each point from where its neighbours predict it, in
#: steps; the side of a square of the area of its cell, px; and the weight of the neighbours.
misfit = cached(error_model="numpy")(_misfit)
