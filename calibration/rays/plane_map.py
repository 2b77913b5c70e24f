"""Pixel to point on one plane: the camera model W = P L of DePiero & Kress (equations 2 to 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Bools, Plane, Pose
from calibration.rays import polynomial
from calibration.rays.polynomial import Domain, Terms

Order: TypeAlias = Literal["auto", "linear", "paper"] | int
MAX_ORDER = 9
WIDEST_ORDER = 13  # tried where `MAX_ORDER` is the best so far: a very wide lens


@dataclass(frozen=True, slots=True, eq=False)
class PlaneMarks:
    """What was seen of the target at one stand-off; row i of every array is one mark."""

    name: str
    pixels: Array  # (n, 2) px (u, v), centroids
    points: Array  # (n, 2) mm, in the plane
    c_from_plane: Pose  # the plane is z = 0 of its own frame
    mark: np.typing.NDArray[np.int64]  # (n,) number of the mark on the target
    covariance: Array  # (n, 2, 2) px^2 of the centroids; NaN where unknown

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def world(self) -> Array:
        """(n, 3) mm, in C."""
        return self.c_from_plane.apply(np.column_stack([self.points, np.zeros(len(self.points))]))

    def select(self, keep: Bools) -> PlaneMarks:
        """The marks of a mask (n,)."""
        return PlaneMarks(
            self.name, self.pixels[keep], self.points[keep], self.c_from_plane, self.mark[keep], self.covariance[keep]
        )


@dataclass(frozen=True, slots=True, eq=False)
class PlaneMap:
    """The map of one calibration plane."""

    name: str
    terms: Terms
    domain: Domain
    coefficients: Array  # (d, 2): plane coordinates, mm, from Chebyshev products
    c_from_plane: Pose
    inverse: Array  # (d, d): covariance of the coefficients is inverse * sigma**2
    sigma: float  # mm, of one coordinate of a mark about the map

    @property
    def plane(self) -> Plane:
        """The plane in C."""
        return Plane.through(self.c_from_plane.translation, self.c_from_plane.rotation[:, 2])

    def plane_points(self, pixels: Array) -> Array:
        """Points (N, 2) mm in the plane's own coordinates, of pixels (N, 2)."""
        return np.asarray(polynomial.design(self.domain.square(pixels), self.terms) @ self.coefficients)

    def points(self, pixels: Array) -> Array:
        """Points (N, 3) mm in C, of pixels (N, 2): W = P L."""
        flat = self.plane_points(pixels)
        return self.c_from_plane.apply(np.column_stack([flat, np.zeros(len(flat))]))

    def jacobian(self, pixels: Array) -> Array:
        """Derivatives (N, 2, 2) mm/px of the plane coordinates by (u, v)."""
        square, by_pixel = self.domain.square_and_jacobian(pixels)
        along, down = polynomial.design_gradient(square, self.terms)
        by_square = np.stack([along @ self.coefficients, down @ self.coefficients], axis=2)
        return np.asarray(by_square @ by_pixel)

    def sigma_at(self, pixels: Array) -> Array:
        """Standard deviation (N,) mm of one plane coordinate of the map itself, from the noise of its marks."""
        p = polynomial.design(self.domain.square(pixels), self.terms)
        return np.asarray(self.sigma * np.sqrt(np.einsum("nd,de,ne->n", p, self.inverse, p)))


@dataclass(frozen=True, slots=True, eq=False)
class PlaneFit:
    """A map and how well it fits its own marks: the intra-plane analysis."""

    map: PlaneMap
    residuals: Array  # (n, 2) px: mark minus map, turned to the image by the inverse Jacobian
    left_out: Array  # (n, 2) px: the same, each mark predicted from a fit without it
    residuals_mm: Array  # (n, 2) mm, in the plane
    left_out_mm: Array  # (n, 2) mm

    @property
    def fit_px(self) -> float:
        """Root mean square of the two-dimensional residual, px."""
        return rms(self.residuals)

    @property
    def fit_px_mean(self) -> float:
        """Mean length of the residual, px: the figure that the paper quotes."""
        return float(np.linalg.norm(self.residuals, axis=1).mean())

    @property
    def loo_px(self) -> float:
        """Root mean square of the left-out residual, px."""
        return rms(self.left_out)

    @property
    def loo_mm(self) -> float:
        """Root mean square of the left-out residual, mm."""
        return rms(self.left_out_mm)


def rms(vectors: Array) -> float:
    """Root mean square length of vectors (n, k); NaN for none."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean())) if len(vectors) else float("nan")


def fit_plane_map(marks: PlaneMarks, *, order: Order = "auto", tilted: bool = False) -> PlaneFit:
    """Fit the map of one plane.

    Parameters
    ----------
    marks : PlaneMarks
        Centroids and where they are on the plane.
    order : "auto", "linear", "paper" or int
        Terms of equation 5, of equation 3, all terms up to a degree, or the degree that leave-one-out chooses: the
        lowest whose error is within 2 % of the best.
    tilted : bool
        Fit the polynomial after the best homography, which is exact for a tilted plane under a pinhole.

    Raises
    ------
    CalibrationError
        With fewer marks than terms, or marks that leave a term undetermined (on one line, say).
    """
    h = None
    if tilted and len(marks) >= 4:
        h = polynomial.homography(marks.pixels, marks.points)
    domain = Domain.around(marks.pixels, h)
    if order != "auto":
        return _fit(marks, domain, order)
    best: PlaneFit | None = None
    for degree in range(1, WIDEST_ORDER + 1):
        if degree > MAX_ORDER and best is not None and best.map.terms != degree - 1:
            break  # settled
        if len(marks) < 1.5 * len(polynomial.exponents(degree)) and best is not None:
            break
        try:
            fit = _fit(marks, domain, degree)
        except CalibrationError:
            if best is None:
                raise
            break
        if best is None or fit.loo_px < 0.98 * best.loo_px:
            best = fit
    if best is None:  # range(1, ...) always runs once
        raise ValueError("no order was tried")
    return best


def _fit(marks: PlaneMarks, domain: Domain, terms: Terms) -> PlaneFit:
    need = len(polynomial.exponents(terms))
    if len(marks) < need:
        raise CalibrationError(
            f"plane {marks.name}: {len(marks)} marks found; order {terms} has {need} terms and needs at least that many "
            "marks: show more of the target or lower --order"
        )
    p = polynomial.design(domain.square(marks.pixels), terms)
    freedom = len(marks) - need
    try:
        _check_spread(marks.points)
        fit = polynomial.solve(p, marks.points)
        sigma = float(np.sqrt((fit.residuals**2).sum() / (2 * freedom))) if freedom else float("nan")
        plane_map = PlaneMap(marks.name, terms, domain, fit.solution, marks.c_from_plane, fit.inverse, sigma)
        to_px = np.linalg.inv(plane_map.jacobian(marks.pixels))  # singular where the points lie on one line
    except np.linalg.LinAlgError as error:
        raise CalibrationError(
            f"plane {marks.name}: the {len(marks)} marks do not determine order {terms} (they lie on one line, or on too "
            "few rows or columns): show more of the target or lower --order"
        ) from error
    alone = (
        fit.left_out() if freedom else np.full_like(fit.residuals, np.nan)
    )  # as many terms as marks foretell nothing
    return PlaneFit(
        plane_map,
        np.einsum("nij,nj->ni", to_px, fit.residuals),
        np.einsum("nij,nj->ni", to_px, alone),
        fit.residuals,
        alone,
    )


def _check_spread(points: Array) -> None:
    """``LinAlgError`` for points on one line, whose image a lens may bend so that it looks like more than a line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[-1] <= 1e-9 * spread[0]:
        raise np.linalg.LinAlgError("points on one line")


@dataclass(frozen=True, slots=True, eq=False)
class Conditioning:
    """What the choice of coordinates does to the paper's pseudoinverse L = (P'P)^-1 P'W (equation 4)."""

    span: float  # orders of magnitude between the largest and the smallest element of P'P
    condition: float  # of P'P
    dependence: float  # largest |cosine| between two columns of P; 1 is dependent
    error: float  # mm, rms difference of the map from the orthogonal solution, at the marks
    error_single: float  # mm, the same in single precision, which the paper's day had; NaN where it is singular there


def normal_equations(
    marks: PlaneMarks,
    *,
    terms: Terms = "paper",
    coordinates: Literal["pixels", "unit", "centred", "chebyshev"] = "unit",
) -> tuple[Array, Conditioning]:
    """Solve the paper's normal equations by LU with powers of the pixel, for comparison with the orthogonal solver.

    On a symmetric grid the sums of odd powers cancel about the centre, so that elements of P'P span more orders there; but
    its columns are less alike and its condition is better than with the origin in a corner. In double precision LU loses
    nothing that matters in any of them (scaling columns does not change its pivots), in single precision it does.

    Parameters
    ----------
    marks : PlaneMarks
        Marks of one plane.
    terms : Terms
        As in `fit_plane_map`.
    coordinates : "pixels", "unit", "centred" or "chebyshev"
        Raw pixels; normalised to (0, 1) with the origin in a corner, as the paper recommends; to (-1, 1) about the
        centre, which it warns of; or products of Chebyshev polynomials of the latter, which SCOPE fits with (by QR).

    Returns
    -------
    coefficients : (d, 2) array
        NaN where the matrix is exactly singular.
    conditioning : Conditioning
    """
    low, high = marks.pixels.min(axis=0), marks.pixels.max(axis=0)
    scaled = {
        "pixels": marks.pixels,
        "unit": (marks.pixels - low) / (high - low),
        "centred": (2 * marks.pixels - low - high) / (high - low),
        "chebyshev": (2 * marks.pixels - low - high) / (high - low),
    }[coordinates]
    pairs = np.array(polynomial.exponents(terms))
    if coordinates == "chebyshev":
        p = polynomial.design(scaled, terms)
    else:
        p = scaled[:, 1:] ** pairs[:, 0] * scaled[:, :1] ** pairs[:, 1]
    gram = p.T @ p
    sizes = np.abs(gram[gram != 0])
    try:
        coefficients = np.asarray(np.linalg.solve(gram, p.T @ marks.points), dtype=np.float64)
    except np.linalg.LinAlgError:
        coefficients = np.full((len(pairs), 2), np.nan)
    reference = fit_plane_map(marks, order=terms).map.plane_points(marks.pixels)
    span = float(np.log10(sizes.max() / sizes.min()))
    unit = p / np.linalg.norm(p, axis=0)
    dependence = float(np.abs(unit.T @ unit - np.eye(len(pairs))).max())
    single = rms(p @ _in_single(p, marks.points) - reference)
    return coefficients, Conditioning(
        span, float(np.linalg.cond(gram)), dependence, rms(p @ coefficients - reference), single
    )


def _in_single(p: Array, points: Array) -> Array:
    """Coefficients (d, 2) of the normal equations formed and solved in single precision; NaN where singular."""
    p32, w32 = p.astype(np.float32), points.astype(np.float32)
    try:
        return np.asarray(np.linalg.solve(p32.T @ p32, p32.T @ w32), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.full((p.shape[1], 2), np.nan)
