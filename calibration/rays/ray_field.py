"""One smooth field of rays fitted to every mark of every plane at once.

In coordinates whose third axis is the stand-off, the ray of pixel p crosses depth z at

    X(p, z) = A(p) + (z - z0) B(p),

with A and B polynomials of the pixel (optionally after a homography, which makes an oblique pinhole exact). z0 is the
depth where the rays come closest together: there a lens has A nearly constant, so that A needs a lower order than B,
and what a window in front of the lens does to the rays is smooth in both. For given z0 and domain the field is linear
in its coefficients, and the marks of every plane, tilted or not, are fitted in one least squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Rays
from calibration.rays import polynomial
from calibration.rays.plane_map import PlaneMarks, rms
from calibration.rays.polynomial import Domain

if TYPE_CHECKING:
    from calibration.rays.chebyshev import Series

MAX_ORDER = 9
WIDEST_ORDER = 13  # of B, where that of a very wide lens is not settled at `MAX_ORDER`


@dataclass(frozen=True, slots=True, eq=False)
class RayField:
    """X(p, z) = A(p) + (z - z0) B(p) in the depth frame D, whose third axis is the mean normal of the planes."""

    c_from_d: Array  # (3, 3) rotation; the identity where the planes face z
    domain: Domain
    slope_order: int  # of B
    origin_order: int  # of A
    pivot: float  # z0, mm
    reach: float  # mm, by which (z - z0) is divided in the design
    coefficients: Array  # (dB + dA, 2)
    inverse: Array  # (dB + dA, dB + dA): covariance of the coefficients is inverse * sigma**2
    sigma: float  # px, of one coordinate of a mark about the field
    depths: Array  # (n,) mean depth of each plane, ascending, mm
    forward: float  # +1 where depth grows away from the camera, else -1

    def design(self, pixels: Array, depth: Array) -> Array:
        """Rows (N, dB + dA) of the least squares at pixels (N, 2) and depths (N,)."""
        return _design(
            self.domain.square(pixels), (depth - self.pivot) / self.reach, self.slope_order, self.origin_order
        )

    def depth(self, points: Array) -> Array:
        """Depths (N,) mm of points (N, 3) in C."""
        return np.asarray(points @ self.c_from_d[:, 2])

    def crossing(self, pixels: Array, depth: Array) -> Array:
        """Coordinates (N, 2) mm in D where the rays of pixels cross depths (N,)."""
        return np.asarray(self.design(pixels, depth) @ self.coefficients)

    def rays(self, pixels: Array) -> Rays:
        """Rays in C; their origins are at the depth of the plane nearest to the camera."""
        near = self.depths[0] if self.forward > 0 else self.depths[-1]
        found = _series(self).values(self.domain.square(pixels)).T
        b, a = found[:, :2] / self.reach, found[:, 2:]
        origin = np.column_stack([a + (near - self.pivot) * b, np.full(len(pixels), near)])
        direction = self.forward * np.column_stack([b, np.ones(len(pixels))])
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return Rays(origin @ self.c_from_d.T, direction @ self.c_from_d.T)

    def jacobian(self, pixels: Array, depth: Array) -> Array:
        """Derivatives (N, 2, 2) mm/px of `crossing` by (u, v)."""
        square, by_pixel = self.domain.square_and_jacobian(pixels)
        _, by_s, by_t = _series(self).values_and_slopes(square)
        lever = (depth - self.pivot) / self.reach
        found = np.empty((len(pixels), 2, 2))
        for k in range(2):  # x and y; B's functions come first, then A's
            in_s, in_t = by_s[k] * lever + by_s[2 + k], by_t[k] * lever + by_t[2 + k]
            for j in range(2):
                found[:, k, j] = in_s * by_pixel[:, 0, j] + in_t * by_pixel[:, 1, j]
        return found

    def sigma_at(self, pixels: Array, depth: Array) -> Array:
        """Standard deviation (N,) mm of one coordinate of `crossing`, from the noise of the marks alone."""
        lever = (depth - self.pivot) / self.reach
        square, mixed, plain = _variance_series(self).values(self.domain.square(pixels))
        return np.asarray(self.sigma * np.sqrt(np.maximum((square * lever + mixed) * lever + plain, 0.0)))


@dataclass(frozen=True, slots=True, eq=False)
class RayFieldFit:
    """A field and how well it fits all marks, plane by plane in the order given."""

    field: RayField
    residuals: Array  # (n, 2) px, mark minus field
    left_out: Array  # (n, 2) px, each mark predicted from a fit without it on any plane
    plane: np.typing.NDArray[np.int64]  # (n,) index of the plane of each row

    @property
    def loo_px(self) -> float:
        """Root mean square of the left-out residual, px."""
        return rms(self.left_out)


def fit_ray_field(planes: list[PlaneMarks], *, orders: tuple[int, int] | None = None) -> RayFieldFit:
    """Fit the field to the marks of two planes or more.

    Parameters
    ----------
    planes : list of PlaneMarks
        At two different stand-offs at least.
    orders : (slope, origin), optional
        Orders of B and A. Without it leave-one-out chooses both, and whether a homography goes first.

    Raises
    ------
    CalibrationError
        With fewer than two stand-offs, or too few marks for order 1.
    """
    if len(planes) < 2:
        raise CalibrationError(
            f"{len(planes)} plane with marks; sighting rays need two or more at different stand-offs: add a plane"
        )
    problem = _Problem.of(planes)
    domain = Domain.around(problem.pixels)
    projective = _projective_domain(problem, domain)
    if projective is not None and problem.fit(projective, 3, 1).loo_px < 0.9 * problem.fit(domain, 3, 1).loo_px:
        domain = projective
    return problem.search(domain) if orders is None else problem.fit(domain, *orders)


def depth_frame(planes: list[PlaneMarks]) -> Array:
    """Rotation (3, 3) c_from_d whose third column is the mean normal of the planes; exact identity where that is z."""
    normals = np.array([p.c_from_plane.rotation[:, 2] for p in planes])
    mean = (normals * np.sign(normals @ normals[0])[:, None]).mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    mean = mean / np.linalg.norm(mean) * np.sign(mean[axis])
    if axis == 2 and mean[2] > np.cos(np.deg2rad(45.0)):
        return np.eye(3)  # depth is z: what users call stand-off, and the field does not mind the tilt
    other = np.eye(3)[(axis + 1) % 3]
    x = other - (other @ mean) * mean
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(mean, x), mean])


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    pixels: Array  # (n, 2)
    across: Array  # (n, 2) mm in D
    depth: Array  # (n,) mm in D
    plane: np.typing.NDArray[np.int64]  # (n,)
    group: np.typing.NDArray[np.int64]  # (n,) the same number for one spot of the target on all planes
    depths: Array  # (planes,)
    c_from_d: Array

    @classmethod
    def of(cls, planes: list[PlaneMarks]) -> _Problem:
        c_from_d = depth_frame(planes)
        world = np.concatenate([p.world for p in planes]) @ c_from_d
        plane = np.repeat(np.arange(len(planes)), [len(p) for p in planes])
        depths = np.array([world[plane == k, 2].mean() for k in range(len(planes))])
        pixels = np.concatenate([p.pixels for p in planes])
        return cls(pixels, world[:, :2], world[:, 2], plane, _same_spot(planes), np.sort(depths), c_from_d)

    def fit(self, domain: Domain, slope_order: int, origin_order: int) -> RayFieldFit:
        """Fit with given orders, weighted in px, about the depth where the rays come closest together."""
        start = self.start(domain, slope_order)
        lens = _Lens.of(self, domain, start, slope_order)
        return self._solve(domain, slope_order, origin_order, lens.pivot, lens.reach, lens.weights)

    def start(self, domain: Domain, order: int) -> RayField:
        """Field of order 3 at most, about the middle plane, unweighted: gives scale and pivot to start from."""
        span = float(np.ptp(self.depths)) or 1.0
        order = max(1, min(order, 3))
        return self._solve(domain, order, order, float(self.depths.mean()), span, np.ones(len(self.depth))).field

    def search(self, domain: Domain, most: int = MAX_ORDER) -> RayFieldFit:
        """Orders with the least leave-one-out error: B upwards with A of order 3 at most, then A both ways.

        Candidates are compared on one Gram matrix; the winner is solved by QR. Where the highest is the best, higher ones
        up to `WIDEST_ORDER` are tried, too.
        """
        highest = max(n for n in range(1, most + 1) if n == 1 or len(self.depth) >= 3 * len(polynomial.exponents(n)))
        lens = _Lens.of(self, domain, self.start(domain, highest), min(5, highest), most)
        scores: dict[tuple[int, int], float] = {}

        def score(slope: int, origin: int) -> float:
            if (slope, origin) not in scores:
                scores[slope, origin] = lens.left_out(slope, origin)
            return scores[slope, origin]

        origin = min(3, highest)
        slope = min(range(1, highest + 1), key=lambda n: score(n, min(n, origin)))
        origin = min(range(slope + 1), key=lambda n: score(slope, n))
        slope = min(range(max(1, origin), highest + 1), key=lambda n: score(n, origin))
        if not np.isfinite(score(slope, origin)):
            slope, origin = 1, 1
        if slope == most < WIDEST_ORDER:
            return self.search(domain, WIDEST_ORDER)
        return self._solve(domain, slope, origin, lens.pivot, lens.reach, lens.weights)

    def pivot_of(self, field: RayField) -> tuple[float, float]:
        """Depth where the rays come closest together, and the reach from there to the planes.

        Minimises the spread of A + (z - z0) B over the marks' pixels; nearly parallel rays give a far pivot, which is
        held within 20 depth ranges so that the design stays well conditioned.
        """
        sample = self.pixels[:: max(1, len(self.pixels) // 500)]
        here = field.crossing(sample, np.full(len(sample), self.depths[0]))
        there = field.crossing(sample, np.full(len(sample), self.depths[-1]))
        span = float(self.depths[-1] - self.depths[0])
        a, b = here - here.mean(axis=0), (there - here - (there - here).mean(axis=0)) / span
        offset = -float((a * b).sum() / max((b * b).sum(), 1e-300))
        offset = float(np.clip(offset, -20 * span, 20 * span))
        pivot = float(self.depths[0]) + offset
        return pivot, float(np.abs(self.depths - pivot).max())

    def weights_of(self, field: RayField) -> Array:
        """px^2/mm^2 at each mark: the inverse square of the local scale."""
        jacobian = field.jacobian(self.pixels, self.depth)
        return np.asarray(1.0 / np.maximum(np.abs(np.linalg.det(jacobian)), 1e-30))

    def _solve(
        self, domain: Domain, slope_order: int, origin_order: int, pivot: float, reach: float, weights: Array
    ) -> RayFieldFit:
        rows = _design(domain.square(self.pixels), (self.depth - pivot) / reach, slope_order, origin_order)
        try:
            fit = polynomial.solve(rows, self.across, weights)
        except np.linalg.LinAlgError as error:
            raise CalibrationError(
                f"{len(self.pixels)} marks on {len(self.depths)} planes do not determine a ray field of order "
                f"{slope_order}: the planes must stand at two or more different stand-offs and show marks over the whole "
                "view"
            ) from error
        freedom = max(len(rows) - rows.shape[1], 1)
        sigma = float(np.sqrt((weights[:, None] * fit.residuals**2).sum() / (2 * freedom)))
        sigma *= _repetition(fit.residuals * np.sqrt(weights)[:, None], self.group)
        field = RayField(
            self.c_from_d, domain, slope_order, origin_order, pivot, reach, fit.solution, fit.inverse, sigma, self.depths,
            1.0 if pivot <= self.depths.mean() else -1.0,
        )  # fmt: skip
        to_px = np.linalg.inv(field.jacobian(self.pixels, self.depth))
        residuals = np.einsum("nij,nj->ni", to_px, fit.residuals)
        left_out = np.einsum("nij,nj->ni", to_px, fit.left_out(self.group))
        return RayFieldFit(field, residuals, left_out, self.plane)


@dataclass(frozen=True, slots=True, eq=False)
class _Lens:
    """Pivot and weights of one domain, and the Gram matrix of the largest design about them."""

    pivot: float  # mm
    reach: float  # mm
    weights: Array  # (n,) px^2/mm^2
    rows: Array  # (n, 2 dmax), weighted
    across: Array  # (n, 2), weighted
    gram: Array  # (2 dmax, 2 dmax)
    group: np.typing.NDArray[np.int64]  # (n,)

    @classmethod
    def of(cls, problem: _Problem, domain: Domain, start: RayField, order: int, most: int = MAX_ORDER) -> _Lens:
        weights = problem.weights_of(start)
        pivot, reach = problem.pivot_of(start)
        root = np.sqrt(weights)[:, None]
        terms = polynomial.design(domain.square(problem.pixels), max(most, order)) * root
        across = problem.across * root
        for _ in range(2):  # Gauss-Newton in the pivot alone, A held constant: exact for a lens with one centre
            b = terms[:, : len(polynomial.exponents(order))]
            rows = np.hstack([b * ((problem.depth - pivot) / reach)[:, None], root])
            q = np.linalg.qr(rows)[0]
            slopes = b @ np.linalg.lstsq(rows, across, rcond=None)[0][:-1] / reach
            free, rest = slopes - q @ (q.T @ slopes), across - q @ (q.T @ across)
            if (free**2).sum() < 1e-8 * (slopes**2).sum():
                break  # rays nearly parallel: the pivot changes nothing
            step = -float((free * rest).sum() / (free**2).sum())
            limit = 20 * float(np.ptp(problem.depths))
            pivot = float(np.clip(pivot + step, problem.depths[0] - limit, problem.depths[0] + limit))
            reach = float(np.abs(problem.depths - pivot).max())
        rows = np.hstack([terms * ((problem.depth - pivot) / reach)[:, None], terms])
        return cls(pivot, reach, weights, rows, across, rows.T @ rows, problem.group)

    def left_out(self, slope_order: int, origin_order: int) -> float:
        """Mean squared left-out residual, px^2; infinite where the marks do not determine these orders."""
        full = self.rows.shape[1] // 2
        slope, origin = len(polynomial.exponents(slope_order)), len(polynomial.exponents(origin_order))
        use = np.concatenate([np.arange(slope), full + np.arange(origin)])
        if len(self.rows) < 1.2 * len(use):
            return float("inf")
        a = self.rows[:, use]
        try:
            lower = np.linalg.cholesky(self.gram[np.ix_(use, use)])
        except np.linalg.LinAlgError:
            return float("inf")
        if np.diag(lower).min() <= 1e-8 * np.diag(lower).max():
            return float("inf")
        half = np.asarray(np.linalg.solve(lower, a.T))
        residual = self.across - half.T @ (half @ self.across)
        alone = polynomial.left_out(half.T, residual, self.group)
        return float((alone**2).sum(axis=1).mean())


def _same_spot(planes: list[PlaneMarks]) -> np.typing.NDArray[np.int64]:
    """Number (n,) that is the same for one spot of the target on all planes.

    A misplaced spot is misplaced on every plane, so that the other planes would predict its error: what is left out
    together must be all that shares it.
    """
    points = np.concatenate([p.points for p in planes])
    step = max(1e-6 * float(np.abs(points).max()), 1e-9)
    return np.asarray(np.unique(np.round(points / step), axis=0, return_inverse=True)[1].ravel(), dtype=np.int64)


def _repetition(residuals: Array, group: np.typing.NDArray[np.int64]) -> float:
    """Factor >= 1 on standard errors for residuals (n, 2) that repeat within groups (Moulton 1986).

    With intra-group correlation rho and m members, n observations count as n / (1 + (m - 1) rho).
    """
    count = np.bincount(group)
    members = float((count**2).sum() / count.sum())
    if members < 1.5:
        return 1.0
    total = np.stack([np.bincount(group, residuals[:, k]) for k in range(2)], axis=1)
    own = float((residuals**2).sum())
    pairs = float((total**2).sum()) - own  # sum over ordered pairs within groups
    rho = (pairs / max(float((count * (count - 1)).sum()), 1.0)) / (own / len(residuals))
    return float(np.sqrt(1.0 + (members - 1.0) * np.clip(rho, 0.0, 1.0)))


@lru_cache(maxsize=32)
def _series(field: RayField) -> Series:
    """Coordinates x and y of B, then of A, as functions of the pixel's square coordinates."""
    from calibration.rays.chebyshev import Series

    slope, start = polynomial.exponents(field.slope_order), polynomial.exponents(field.origin_order)
    b, a = field.coefficients[: len(slope)], field.coefficients[len(slope) :]
    return Series.joined([Series.of_terms(slope, b), Series.of_terms(start, a)])


@lru_cache(maxsize=32)
def _variance_series(field: RayField) -> Series:
    """Factors of lever^2, lever and 1 in the variance of `RayField.crossing` over sigma^2."""
    from calibration.rays.chebyshev import Series

    slope, start = polynomial.exponents(field.slope_order), polynomial.exponents(field.origin_order)
    split, size = len(slope), 2 * max(field.slope_order, field.origin_order) + 1
    bb, ba, aa = field.inverse[:split, :split], field.inverse[:split, split:], field.inverse[split:, split:]
    return Series.joined(
        [
            Series.of_form(slope, slope, bb, size),
            Series.of_form(slope, start, 2.0 * ba, size),
            Series.of_form(start, start, aa, size),
        ]
    )


def _design(square: Array, lever: Array, slope_order: int, origin_order: int) -> Array:
    return np.hstack([polynomial.design(square, slope_order) * lever[:, None], polynomial.design(square, origin_order)])


def _projective_domain(problem: _Problem, domain: Domain) -> Domain | None:
    """Domain after the homography from pixel to ray slope, exact for an oblique pinhole."""
    terms = len(polynomial.exponents(2))
    if len(problem.depth) < 4 * terms:
        return None
    field = problem.fit(domain, 2, 2).field
    sample = problem.pixels
    near, far = np.full(len(sample), problem.depths[0]), np.full(len(sample), problem.depths[-1])
    slopes = field.crossing(sample, far) - field.crossing(sample, near)
    return Domain.around(sample, polynomial.homography(sample, slopes))
