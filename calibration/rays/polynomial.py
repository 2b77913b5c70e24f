"""Polynomials of the pixel in products of Chebyshev polynomials, and least squares with its leave-one-out.

Any set of exponents that holds, with a term, all terms below it spans the same space in powers and in Chebyshev
products, wherever the origin is. So the sets of DePiero & Kress (equations 3 and 5) are fitted here in a basis whose
columns are nearly orthogonal, and give the very same map as the paper's powers would in exact arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np

from calibration.geometry import Array, Ints

Terms: TypeAlias = Literal["linear", "paper"] | int

_PAPER = ((0, 0), (1, 0), (0, 1), (2, 0), (0, 2), (3, 0), (0, 3), (2, 1), (1, 2), (1, 1), (2, 2))


@lru_cache(maxsize=64)
def exponents(terms: Terms) -> tuple[tuple[int, int], ...]:
    """Exponents (of v, of u) of a set of terms: ``linear`` (eq. 5), ``paper`` (eq. 3), or all up to total degree N."""
    if terms == "linear":
        return exponents(1)
    if terms == "paper":
        return _PAPER
    if terms < 0:
        raise ValueError(f"the order of a polynomial cannot be {terms}")
    return tuple((i, degree - i) for degree in range(terms + 1) for i in range(degree, -1, -1))


@dataclass(frozen=True, slots=True, eq=False)
class Domain:
    """Maps pixels to the square [-1, 1] x [-1, 1], optionally through a homography first."""

    homography: Array  # (3, 3), of (u, v, 1); the identity where none is used
    centre: Array  # (2,) of the mapped coordinates
    half: Array  # (2,) half their extent

    @classmethod
    def around(cls, pixels: Array, homography: Array | None = None) -> Domain:
        """Smallest domain that holds pixels (N, 2) px."""
        h = np.eye(3) if homography is None else homography
        q = _project(h, pixels)[0]
        low, high = q.min(axis=0), q.max(axis=0)
        return cls(h, (low + high) / 2, np.maximum((high - low) / 2, 1e-12))

    def square(self, pixels: Array) -> Array:
        """Coordinates (N, 2) in the square."""
        return np.asarray((_project(self.homography, pixels)[0] - self.centre) / self.half)

    def square_and_jacobian(self, pixels: Array) -> tuple[Array, Array]:
        """Coordinates (N, 2) and their derivatives by (u, v), (N, 2, 2)."""
        q, w = _project(self.homography, pixels)
        h = self.homography
        if h[2, 0] == 0.0 and h[2, 1] == 0.0:  # the same everywhere
            constant = h[:2, :2] / h[2, 2] / self.half[:, None]
            return (q - self.centre) / self.half, np.broadcast_to(constant, (len(q), 2, 2))
        jacobian = (h[None, :2, :2] - q[:, :, None] * h[None, 2:, :2]) / w[:, None, None]
        return (q - self.centre) / self.half, jacobian / self.half[:, None]


def _project(h: Array, pixels: Array) -> tuple[Array, Array]:
    if h[2, 0] == 0.0 and h[2, 1] == 0.0:  # affine: nothing to divide by but one number
        return (pixels @ h[:2, :2].T + h[:2, 2]) / h[2, 2], np.full(len(pixels), h[2, 2])
    x = pixels @ h[:, :2].T + h[:, 2]
    return x[:, :2] / x[:, 2:], x[:, 2]


def design(square: Array, terms: Terms) -> Array:
    """Chebyshev products T_i(t) T_j(s) at (s, t) (N, 2), as (N, d)."""
    pairs = np.array(exponents(terms))
    s, t = _chebyshev(square[:, 0], pairs[:, 1].max()), _chebyshev(square[:, 1], pairs[:, 0].max())
    return np.asarray(t[:, pairs[:, 0]] * s[:, pairs[:, 1]])


def design_gradient(square: Array, terms: Terms) -> tuple[Array, Array]:
    """Derivatives of `design` by s and by t, each (N, d)."""
    pairs = np.array(exponents(terms))
    s, t = _chebyshev(square[:, 0], pairs[:, 1].max()), _chebyshev(square[:, 1], pairs[:, 0].max())
    ds, dt = _chebyshev_slope(square[:, 0], pairs[:, 1].max()), _chebyshev_slope(square[:, 1], pairs[:, 0].max())
    i, j = pairs[:, 0], pairs[:, 1]
    return t[:, i] * ds[:, j], dt[:, i] * s[:, j]


def _chebyshev(x: Array, degree: int) -> Array:
    """T_0 .. T_degree at x, (N, degree + 1): T_k+1 = 2 x T_k - T_k-1."""
    values = np.ones((len(x), degree + 1))
    if degree > 0:
        values[:, 1] = x
    for k in range(2, degree + 1):
        values[:, k] = 2 * x * values[:, k - 1] - values[:, k - 2]
    return values


def _chebyshev_slope(x: Array, degree: int) -> Array:
    """Derivatives of T_0 .. T_degree: T_k' = k U_k-1."""
    slopes = np.zeros((len(x), degree + 1))
    second = np.ones((len(x), max(degree, 1)))  # U_0 .. U_degree-1
    if degree > 1:
        second[:, 1] = 2 * x
    for k in range(2, degree):
        second[:, k] = 2 * x * second[:, k - 1] - second[:, k - 2]
    for k in range(1, degree + 1):
        slopes[:, k] = k * second[:, k - 1]
    return slopes


@dataclass(frozen=True, slots=True, eq=False)
class LinearFit:
    """Weighted least squares A x = b, with what follows from it in closed form."""

    solution: Array  # (d, k)
    residuals: Array  # (n, k) b - A x, unweighted
    basis: Array  # (n, d) orthonormal columns that span the weighted A
    root: Array  # (n,) square roots of the weights
    inverse: Array  # (d, d) inverse of A' W A

    def left_out(self, groups: Ints | None = None) -> Array:
        """Residuals (n, k) of each row predicted from a fit without its group (n,); without groups, without itself."""
        weighted = self.root[:, None] * self.residuals
        return np.asarray(left_out(self.basis, weighted, groups) / self.root[:, None])


def solve(a: Array, b: Array, weights: Array | None = None) -> LinearFit:
    """Least squares by QR (never by normal equations); ``weights`` (n,) multiply squared residuals.

    ``np.linalg.LinAlgError`` where the columns are dependent, so that the caller can say in its own words what is
    missing.
    """
    root = np.ones(len(a)) if weights is None else np.sqrt(weights)
    q, r = np.linalg.qr(a * root[:, None])
    diagonal = np.abs(np.diag(r))
    if len(a) < a.shape[1] or diagonal.min() <= 1e-10 * diagonal.max():
        raise np.linalg.LinAlgError("dependent columns")
    inverse_r = np.linalg.inv(r)
    solution = inverse_r @ (q.T @ (b * root[:, None]))
    return LinearFit(solution, b - a @ solution, q, root, inverse_r @ inverse_r.T)


def left_out(basis: Array, residuals: Array, groups: Ints | None = None) -> Array:
    """Residuals (n, k) predicted from a fit without the row's group: (I - H_gg)^-1 r_g (Cook & Weisberg 1982, 2.2).

    Without groups every row is its own, and this is r / (1 - h), the residual of PRESS (Allen 1974).
    """
    if groups is None:
        leverage = np.einsum("nd,nd->n", basis, basis)
        return np.asarray(residuals / np.maximum(1.0 - leverage, 1e-9)[:, None])
    rank = np.argsort(groups, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(groups[rank]) != 0])
    sizes = np.diff(np.r_[starts, len(groups)])
    result = np.empty_like(residuals)
    for size in np.unique(sizes):
        rows = rank[starts[sizes == size][:, None] + np.arange(size)]  # (groups of this size, size)
        q = basis[rows]
        kept = np.eye(size) - q @ q.transpose(0, 2, 1) + 1e-9 * np.eye(size)
        result[rows] = np.linalg.solve(kept, residuals[rows])
    return result


def homography(source: Array, image: Array) -> Array:
    """Homography (3, 3) that maps points (N, 2) to points (N, 2), by the normalised direct linear transform.

    Source: Hartley & Zisserman, Multiple View Geometry, algorithm 4.2. ``ValueError`` for fewer than four points.
    """
    if len(source) < 4:
        raise ValueError("a homography needs four points")
    ts, ti = _normaliser(source), _normaliser(image)
    x, y = _project(ts, source)[0], _project(ti, image)[0]
    one, zero = np.ones(len(x)), np.zeros((len(x), 3))
    p = np.column_stack([x, one])
    rows = np.concatenate([np.hstack([p, zero, -y[:, :1] * p]), np.hstack([zero, p, -y[:, 1:] * p])])
    h = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3)
    h = np.linalg.inv(ti) @ h @ ts
    return np.asarray(h / h[2, 2])


def _normaliser(points: Array) -> Array:
    centre = points.mean(axis=0)
    scale = np.sqrt(2.0) / max(float(np.sqrt(((points - centre) ** 2).sum(axis=1)).mean()), 1e-300)
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1.0]])
