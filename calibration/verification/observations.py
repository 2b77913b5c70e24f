"""All sightings of all marks, and the field of rays of generous order from which the planes are judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.geometry import Array, Ints
from calibration.rays import MAX_ORDER, PlaneMarks, RayField, polynomial

EXTRA_ORDER = 2  # above the best order, so that what a lens does beyond it is not taken for a misplaced plane
LEAST_ORDER = 3  # follows every placement mode, so that common ones stay invisible


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """All marks, ordered by their number so that the sightings of one mark are neighbours."""

    planes: tuple[PlaneMarks, ...]
    order: Ints  # (N,) from the planes' order to this one
    back: Ints  # (N,) and back
    plane: Ints  # (N,)
    first: Ints  # (m,) first row of each mark
    mark: Ints  # (m,) its number
    pixels: Array  # (N, 2)
    world: Array  # (N, 3) mm in D

    @classmethod
    def of(cls, planes: Sequence[PlaneMarks], c_from_d: Array) -> Observations:
        """All marks of the planes, in the depth frame D."""
        mark = np.concatenate([p.mark for p in planes])
        order = np.argsort(mark, kind="stable")
        first = np.flatnonzero(np.diff(mark[order], prepend=mark.min() - 1))
        plane = np.repeat(np.arange(len(planes)), [len(p) for p in planes])[order]
        pixels = np.concatenate([p.pixels for p in planes])[order]
        world = (np.concatenate([p.world for p in planes]) @ c_from_d)[order]
        return cls(tuple(planes), order, np.argsort(order), plane, first, mark[order][first], pixels, world)

    def gather(self, blocks: list[Array]) -> Array:
        """Arrays a plane, as one in this order."""
        return np.asarray(np.concatenate(blocks)[self.order])


def fit_field(rows: Observations, basis: RayField, most: int = MAX_ORDER) -> RayField:
    """Field whose orders predict best the sightings of a mark left out, raised by `EXTRA_ORDER`, to ``most`` at most."""
    depth, across = rows.world[:, 2], rows.world[:, :2]
    fewest = min(len(p) for p in rows.planes)
    highest = max(n for n in range(1, most + 1) if n == 1 or fewest >= 1.5 * len(polynomial.exponents(n)))
    if len(depth) >= 1.5 * 2 * len(polynomial.exponents(LEAST_ORDER)):  # a few marks, but on several planes
        highest = max(highest, min(LEAST_ORDER, most))
    start = _solve_field(rows, basis, min(3, highest), min(1, highest), np.ones(len(depth)))
    weight = 1.0 / np.sqrt(np.maximum(np.abs(np.linalg.det(start.jacobian(rows.pixels, depth))), 1e-30))
    square = basis.domain.square(rows.pixels)
    lever = ((depth - basis.pivot) / basis.reach)[:, None]
    terms = polynomial.design(square, highest)
    error: dict[tuple[int, int], float] = {}
    # one triangular basis holds, as its leading columns, every order of B with A of order 3 at most
    columns, steps = [], []
    for n in range(highest + 1):
        degree = np.array([sum(pair) for pair in polynomial.exponents(highest)])
        columns.append(terms[:, degree == n] * lever)
        if n <= LEAST_ORDER:
            columns.append(terms[:, degree == n])
        steps.append(sum(c.shape[1] for c in columns))
    a = np.hstack(columns) * weight[:, None]
    y = across * weight[:, None]
    gram = a.T @ a
    lower = np.linalg.cholesky(gram + 1e-12 * np.diag(np.diag(gram)))
    q = a @ np.linalg.inv(lower).T
    count = np.diff(np.append(rows.first, len(depth)))
    slots = np.repeat(np.arange(len(count)), count), np.arange(len(depth)) - np.repeat(rows.first, count)
    padded = np.zeros((len(count), int(count.max()), q.shape[1]))
    padded[slots] = q
    residual = np.zeros((len(count), int(count.max()), 2))
    residual[slots] = y
    hat = np.zeros((len(count), padded.shape[1], padded.shape[1]))
    before = 0
    for n, step in enumerate(steps):
        block = padded[:, :, before:step]
        residual -= block @ (q[:, before:step].T @ y)
        hat += block @ np.swapaxes(block, 1, 2)
        before = step
        if n and len(depth) >= 1.2 * step:
            out = np.linalg.solve(np.eye(hat.shape[1]) * (1 + 1e-9) - hat, residual)
            error[n, min(n, LEAST_ORDER)] = float((out**2).mean())
    best = min(error, key=lambda pair: error[pair])[0]
    slope_order = min(max(best + EXTRA_ORDER, LEAST_ORDER), highest)
    origin_order = min(slope_order, LEAST_ORDER)
    return _solve_field(rows, basis, slope_order, origin_order, weight)


def _solve_field(rows: Observations, basis: RayField, slope_order: int, origin_order: int, weight: Array) -> RayField:
    field = replace(basis, slope_order=slope_order, origin_order=origin_order)
    a = field.design(rows.pixels, rows.world[:, 2]) * weight[:, None]
    y = rows.world[:, :2] * weight[:, None]
    gram = a.T @ a
    lower = np.linalg.cholesky(gram + 1e-13 * np.diag(np.diag(gram)))
    inverse_lower = np.linalg.inv(lower)
    inverse = inverse_lower.T @ inverse_lower
    coefficients = inverse @ (a.T @ y)
    coefficients += inverse @ (a.T @ (y - a @ coefficients))  # one step of refinement
    return replace(field, coefficients=coefficients, inverse=inverse)
