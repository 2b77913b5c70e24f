"""What planes say about one another once the field of rays is eliminated.

Generalised least squares of all marks, with three kinds of unknowns: the field of rays (any affine change of space that
keeps the planes is in it, and so is invisible), the placement modes of every plane, and a displacement of every mark of
the target, which repeats on all planes and is taken as random (a variance component). The field is eliminated; what is
left is a score and an information matrix of 7 modes a plane, from which every hypothesis on planes follows by a small
solve, and the shift of every single mark by itself (Baarda's data snooping).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints
from calibration.rays import MAX_ORDER, PlaneMarks, RayField
from calibration.verification import misplacement as placement
from calibration.verification.misplacement import MODES
from calibration.verification.observations import Observations, fit_field


@dataclass(frozen=True, slots=True, eq=False)
class Redundancy:
    """Score and information of the placement modes (7 a plane, plane by plane, as `placement.modes`)."""

    field: RayField  # to which the modes refer
    score: Array  # (7n,) M' P y / sigma^2
    information: Array  # (7n, 7n) M' P M / sigma^2: inverse covariance of the modes
    sigma_px: float  # of one coordinate of a centroid
    target_mm: float  # of one coordinate of a mark of the target; 0 where not seen
    freedom: int  # left by field and modes
    shift_px: Array  # (N, 2) by which each mark, taken by itself, is off
    shift_chi2: Array  # (N,) its square over its covariance; chi-square with 2 degrees of freedom for a good mark
    shift_sigma: Array  # (N,) px, standard error of the shift, a coordinate
    mark: Ints  # (m,) numbers of the marks of the target
    target_shift: (
        Array  # (m, 2) mm by which each stands off its stated place, in the target's coordinates; 0 where not seen
    )
    moved_px: Array  # (N, 2) what the placement of its plane adds to the residual of each mark about the field
    rank: int  # of the modes: how many of their combinations the planes determine

    @property
    def planes(self) -> int:
        """Number of planes."""
        return len(self.score) // MODES


def redundancy_of(planes: Sequence[PlaneMarks], basis: RayField, *, most: int = MAX_ORDER) -> Redundancy:
    """Eliminate the field of rays and judge the planes by what is left.

    Parameters
    ----------
    planes : sequence of PlaneMarks
        Two or more. With two, the field follows every mode of either and ``information`` vanishes.
    basis : RayField
        Gives depth frame, domain, pivot and reach; its orders and coefficients are not used.
    most : int
        Highest order of the field.

    Notes
    -----
    The orders of the field are those that predict best all sightings of a mark left out together (leaving out one
    sighting only would let the field learn the errors of the target), and then higher by `sightings.EXTRA_ORDER`.
    """
    rows = Observations.of(planes, basis.c_from_d)
    field = fit_field(rows, basis, most)
    here = placement.expected(field, rows.pixels, rows.world)
    to_px = np.linalg.inv(field.jacobian(here, rows.world[:, 2]))
    design = field.design(here, rows.world[:, 2])
    ends = np.cumsum([len(p) for p in planes])[:-1]
    slope = np.split(placement.slopes(field, here, rows.world)[rows.back], ends)
    unit = np.eye(3)[:, :2]
    target = rows.gather(
        [
            placement.across(field, p, s, np.broadcast_to(unit, (len(p), 3, 2)))
            for p, s in zip(planes, slope, strict=True)
        ]
    )
    terms = design.shape[1]
    x = np.zeros((len(here), 2, 2 * terms + MODES * len(planes) + 1))
    x[:, :, :terms] = to_px[:, :, :1] * design[:, None, :]
    x[:, :, terms : 2 * terms] = to_px[:, :, 1:] * design[:, None, :]
    seen = rows.gather([placement.modes(field, p, s) for p, s in zip(planes, slope, strict=True)])
    for k in range(len(planes)):
        own = rows.plane == k
        at = 2 * terms + MODES * k
        x[own, :, at : at + MODES] = to_px[own] @ seen[own]
    x[:, :, -1] = here - rows.pixels
    spread = to_px @ target  # px/mm: how an error of the target shows
    solution = _solve(rows, x, spread, terms, 0.0)
    ratio = _target_ratio(rows, x, solution, spread)
    if ratio > 0.0:
        ratio, solution = _refine(rows, x, spread, terms, ratio)
    noise = _noise_profile(rows, solution)
    if noise is not None:
        x, spread = x / noise[:, None, None], spread / noise[:, None, None]
        solution = _solve(rows, x, spread, terms, ratio)
    sigma2 = solution.rest / solution.freedom
    shift = -np.einsum("nij,nj->ni", solution.pull_inverse, solution.pull)
    error = np.sqrt(sigma2 * np.trace(solution.pull_inverse, axis1=1, axis2=2) / 2)
    moved = x[:, :, :-1] @ solution.moving
    common = np.add.reduceat(np.einsum("nij,ni->nj", spread, solution.pull), rows.first)
    if noise is not None:
        shift, error, moved = shift * noise[:, None], error * noise, moved * noise[:, None]
    return Redundancy(
        field,
        solution.score / sigma2,
        solution.information / sigma2,
        float(np.sqrt(sigma2)),
        float(np.sqrt(ratio * sigma2)),
        solution.freedom,
        shift[rows.back],
        solution.chi2[rows.back] / sigma2,
        error[rows.back],
        rows.mark,
        -ratio * common,
        -moved[rows.back],
        solution.inverse_half.shape[1] - 2 * terms,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    score: Array  # (7n,)
    information: Array  # (7n, 7n)
    rest: float  # px^2, weighted sum of squares that field and modes leave
    freedom: int
    beta: Array  # coefficients of all columns but the last
    moving: Array  # the same, of the modes alone, the field having followed them as far as it can
    excess: float  # squared pulls of the target's marks over what noise of this covariance gives them
    inverse_half: Array  # (columns, rank): inverse of the normal matrix is this times its transpose
    pull: Array  # (N, 2) P y
    pull_inverse: Array  # (N, 2, 2) inverse of the diagonal blocks of P

    @property
    def chi2(self) -> Array:
        """(N,) px^2: weighted square of the shift of each mark by itself."""
        return np.asarray(np.einsum("ni,nij,nj->n", self.pull, self.pull_inverse, self.pull))


def _solve(rows: Observations, x: Array, spread: Array, terms: int, ratio: float) -> _Solution:
    """Least squares of the last column by the others, under the covariance 1 + ratio * (target's part)."""
    whiten = _Whitener(rows, spread, ratio)
    w = whiten(x)
    columns = w.shape[2]
    flat = w.reshape(-1, columns)
    gram = flat.T @ flat
    f = 2 * terms
    lower = np.linalg.cholesky(gram[:f, :f] + 1e-13 * np.diag(np.diag(gram)[:f]))
    inverse_lower = np.linalg.inv(lower)
    half = inverse_lower @ gram[:f, f:]
    left = gram[f:, f:] - half.T @ half  # of modes and y, the field eliminated
    score, information = left[:-1, -1], left[:-1, :-1]
    scale = np.sqrt(np.maximum(np.diag(gram)[f:-1], 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    seen = values > 1e-9
    root = vectors[:, seen] / np.sqrt(values[seen]) / scale[:, None]  # (7n, rank)
    modes = root @ (root.T @ score)
    back = inverse_lower.T @ half[:, :-1]  # field coefficients that a mode takes with it
    beta = np.concatenate([inverse_lower.T @ half[:, -1] - back @ modes, modes])
    inverse_half = np.block([[inverse_lower.T, -back @ root], [np.zeros((len(root), f)), root]])
    residual = w[:, :, -1] - w[:, :, :-1] @ beta
    freedom = max(residual.size - f - int(seen.sum()), 1)
    rest = float((residual**2).sum())
    pull = whiten(residual[:, :, None])[:, :, 0]
    reach = whiten(w[:, :, :-1] @ inverse_half) if ratio > 0 else w[:, :, :-1] @ inverse_half
    diagonal = whiten.squared() - reach @ np.swapaxes(reach, 1, 2)
    diagonal += 1e-9 * np.eye(2)
    turned = np.swapaxes(spread, 1, 2)
    pulls = np.add.reduceat(turned @ pull[:, :, None], rows.first)
    own = np.add.reduceat(turned @ (whiten.squared_times(spread)), rows.first)
    taken = np.add.reduceat(turned @ reach, rows.first)
    expected = float(np.trace(own, axis1=1, axis2=2).sum() - (taken**2).sum())
    excess = float((pulls**2).sum()) / (rest / freedom * max(expected, 1e-300))
    moving = np.concatenate([-back @ modes, modes])
    return _Solution(
        score, information, rest, freedom, beta, moving, excess, inverse_half, pull, np.linalg.inv(diagonal)
    )


class _Whitener:
    """Multiplies rows by (1 + ratio K K')^(-1/2), K stacking the target's part over the sightings of each mark."""

    def __init__(self, rows: Observations, spread: Array, ratio: float) -> None:
        self.first, self.spread, self.ratio = rows.first, spread, ratio
        self.mark = np.repeat(np.arange(len(rows.first)), np.diff(np.append(rows.first, len(rows.plane))))
        inner = np.add.reduceat(np.swapaxes(spread, 1, 2) @ spread, rows.first)
        values, vectors = np.linalg.eigh(inner)
        change = (1.0 / np.sqrt(1.0 + ratio * values) - 1.0) / values
        self.core = (vectors * change[:, None, :]) @ np.swapaxes(vectors, 1, 2)
        square = -ratio / (1.0 + ratio * values)
        self.core_squared = (vectors * square[:, None, :]) @ np.swapaxes(vectors, 1, 2)

    def __call__(self, x: Array) -> Array:
        """Rows (N, 2, c), whitened."""
        if self.ratio <= 0.0:
            return x
        common = np.add.reduceat(np.swapaxes(self.spread, 1, 2) @ x, self.first)
        return np.asarray(x + self.spread @ (self.core @ common)[self.mark])

    def squared_times(self, x: Array) -> Array:
        """Rows (N, 2, c) times the inverse covariance."""
        common = np.add.reduceat(np.swapaxes(self.spread, 1, 2) @ x, self.first)
        return np.asarray(x + self.spread @ (self.core_squared @ common)[self.mark])

    def squared(self) -> Array:
        """Diagonal blocks (N, 2, 2) of the inverse covariance."""
        return np.asarray(np.eye(2) + self.spread @ self.core_squared[self.mark] @ np.swapaxes(self.spread, 1, 2))


def _refine(rows: Observations, x: Array, spread: Array, terms: int, ratio: float) -> tuple[float, _Solution]:
    """Ratio of variances by restricted maximum likelihood from a first estimate, and the solution under it.

    There the squared pulls of the target's marks are just what their covariance gives (Patterson & Thompson 1971); the
    secant method on logarithms finds it.
    """
    at, solution = np.log(ratio), _solve(rows, x, spread, terms, ratio)
    off = np.log(solution.excess)
    slope = -0.5
    for _ in range(5):
        if abs(off) < 0.02:
            break
        step = float(np.clip(-off / slope, -3.0, 3.0))
        solution = _solve(rows, x, spread, terms, float(np.exp(at + step)))
        new = np.log(solution.excess)
        slope = min((new - off) / step, -0.05)
        at, off = at + step, new
    return float(np.exp(at)), solution


def _target_ratio(rows: Observations, x: Array, solution: _Solution, spread: Array) -> float:
    """Variance of a mark of the target over that of a centroid, mm^2/px^2; 0 where it does not show.

    Moments: the mean square of the residuals' means over the sightings of a mark, against that of their scatter about
    them, each over its own degrees of freedom. Significant at 0.1 %.
    """
    from scipy.stats import f as f_distribution

    count = np.diff(np.append(rows.first, len(rows.plane)))
    residual = x[:, :, -1] - x[:, :, :-1] @ solution.beta
    total = np.add.reduceat(residual, rows.first)
    between = float((total**2 / count[:, None]).sum())
    within = solution.rest - between
    sums = np.add.reduceat(x[:, :, :-1], rows.first) / np.sqrt(count)[:, None, None]
    taken = float(((sums @ solution.inverse_half) ** 2).sum())
    freedom_between = 2 * len(count) - taken
    freedom_within = solution.freedom - freedom_between
    if freedom_between < 4 or freedom_within < 4:
        return 0.0
    f = (between / freedom_between) / (within / freedom_within)
    if f < f_distribution.isf(1e-3, freedom_between, freedom_within):
        return 0.0
    scale = float(np.add.reduceat((spread**2).sum(axis=(1, 2)) / 2, rows.first).mean())
    return (f - 1.0) / scale


def _noise_profile(rows: Observations, solution: _Solution) -> Array | None:
    """Noise (N,) of each centroid relative to the typical one, or None where it is the same everywhere.

    Planes out of focus are noisier as a whole, and spots far from the middle of the image as a rule. The logarithm of
    the variance is a constant a plane and a term in the square of the distance from the middle, fitted to the squared
    shifts (exponentially distributed for normal noise) by Fisher scoring. Significant at 0.1 %.
    """
    from scipy.stats import chi2

    away = ((rows.pixels - rows.pixels.mean(axis=0)) ** 2).sum(axis=1)
    planes = (rows.plane[:, None] == np.arange(len(rows.planes))).astype(np.float64)
    a = np.column_stack([planes, away / away.max() - 0.5])
    square = solution.chi2 / 2.0
    square = np.minimum(square, 8.0 * np.median(square) / np.log(2.0))  # a bad mark is no noise
    inverse = np.linalg.inv(a.T @ a)
    theta = np.append(np.full(planes.shape[1], np.log(square.mean())), 0.0)
    for _ in range(6):
        theta = theta + inverse @ (a.T @ (square / np.exp(a @ theta) - 1.0))
    level = a @ theta
    gain = 2.0 * float((np.log(square.mean()) - level).sum())
    if not np.isfinite(gain) or chi2.sf(gain, planes.shape[1]) > 1e-3:
        return None
    return np.asarray(np.exp((level - level.mean()) / 2.0))
