"""Marks that stand beside where their neighbours on the same plane say: dirt, a reflection, a damaged spot.

The map of one plane is smooth whatever the planes do to each other, so that a bad mark shows on its own plane before any
rays are fitted. A fit that bad marks have drawn to themselves hides them; here the weights fall with the residual and
vanish (Beaton & Tukey 1974), from a start that no single residual governs, and what is left is tested mark by mark.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Bools
from calibration.rays import polynomial
from calibration.rays.plane_map import MAX_ORDER, PlaneMarks
from calibration.rays.polynomial import Domain

FALSE_ALARM = 5e-4  # probability that a plane without bad marks is said to have one
MOST_BAD = 0.05  # of a plane's marks that may be left out, one in any case; more, and the plane is no good

_FEWEST = 8  # marks of which one can be judged
_TAIL = 2.5  # times the 95 % quantile of the others: real centroids have longer tails than a normal distribution
_LEAST_PX = 0.02  # less does no harm, and no camera is known so well
_TRUNCATION = 3.0  # times what a higher order moves a mark: as much may be the lens and not the mark
_REDESCEND = 6.0  # standard deviations at which the weight of a mark vanishes
_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))  # of the length of a normal vector (2,) of unit sigma
_A_TERM = 2.0  # marks a term: a map that could follow single marks tells little of them
_MANY = 60  # marks of which enough stay when the suspicious ones are set aside first
_L1 = 8  # rounds of least absolute residuals before weights redescend
_ROUNDS = 30
_SURELY = 0.4  # weight above which a mark is good enough to start from: three and a half standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class BadMarks:
    """Which of a plane's n marks are off, and by how much."""

    rows: Bools  # (n,)
    size: Array  # (n,) px from where the other marks say, predicted without the mark itself
    sigma: Array  # (n,) px, standard error of that in one coordinate


def find_bad_marks(marks: PlaneMarks) -> BadMarks:
    """Marks of one plane that a smooth map of the others does not explain.

    Parameters
    ----------
    marks : PlaneMarks
        Marks of one plane as they were seen. Their covariance, where known, says how far each may stand off.

    Returns
    -------
    BadMarks
        None of fewer than eight marks. Where more than half of the marks are off, the answer is meaningless.

    Notes
    -----
    Plane points are polynomials of the pixel after a homography, of the order whose left-out residuals are smallest, each
    counted up to six standard deviations. A mark is bad where its residual, predicted without it,
    is larger than chance gives the worst of so many (F distribution), than two and a half times what one in
    twenty of the others shows, and than three times what a higher order changes in the prediction: at the corner of a very
    wide lens, where the series has not converged, the misfit is the polynomial's and no mark is blamed.
    Weak where bad marks stand side by side and lean the same way, which are taken for the lens, and on planes of fewer than
    some fifty marks, which the rays of all planes judge better (`calibration.verification.find_faults`).

    Source: redescending M-estimates, Beaton & Tukey, Technometrics 16 (1974) 147; externally studentised residuals, Cook &
    Weisberg, Residuals and Influence in Regression (1982) 2.2.
    """
    n = len(marks)
    nothing = BadMarks(np.zeros(n, dtype=bool), np.zeros(n), np.full(n, np.nan))
    if n < _FEWEST:
        return nothing
    try:
        problem = _Problem.of(marks)
        return _one_by_one(problem) if n < _MANY else _judged(problem, _robust_weights(problem))
    except np.linalg.LinAlgError:
        return nothing  # marks on one line: the fit of the map says so


class _Prediction(NamedTuple):
    """Every mark predicted from the others, at every order."""

    error: Array  # (orders, n, 2) px
    spread: Array  # (orders, n) standard deviation of a coordinate of the error over that of one mark of weight 1
    terms: NDArray[np.int64]  # (orders,)
    inside: Array  # (orders,) weighted sum of squares of the residuals, px^2


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    design: Array  # (n, d) of the highest order; lower orders are its leading columns
    points: Array  # (n, 2) mm
    scale: Array  # (n,) px/mm
    to_px: Array  # (n, 2, 2) px/mm, with direction
    noise: Array  # (n,) px^2, variance of a coordinate by the mark's own covariance; 0 where unknown
    terms: NDArray[np.int64]  # (orders,) columns of each order

    @classmethod
    def of(cls, marks: PlaneMarks) -> _Problem:
        h = cv2.findHomography(marks.pixels, marks.points, cv2.LMEDS)[0] if np.ptp(marks.points) > 0 else None
        domain = Domain.around(marks.pixels, h)
        n = len(marks)
        highest = max(k for k in range(1, MAX_ORDER + 1) if k == 1 or n >= 1.5 * len(polynomial.exponents(k)))
        square, by_pixel = domain.square_and_jacobian(marks.pixels)
        design = polynomial.design(square, highest)
        variance = np.nan_to_num(np.trace(marks.covariance, axis1=1, axis2=2) / 2.0, nan=0.0, posinf=0.0)
        terms = np.array([len(polynomial.exponents(k)) for k in range(1, highest + 1)])
        start = cls(design, marks.points, np.ones(n), np.zeros((n, 2, 2)), variance, terms)
        order = min(highest, 5)
        low = terms[order - 1]
        weight = np.ones(n)
        for _ in range(6):  # least absolute residuals: what a mark pulls does not grow with how far it is off
            root = np.sqrt(weight)[:, None]
            solution = np.linalg.lstsq(design[:, :low] * root, start.points * root, rcond=None)[0]
            off = np.linalg.norm(start.points - design[:, :low] @ solution, axis=1)
            weight = 1.0 / np.maximum(off, 0.1 * float(np.median(off)) + 1e-300)
            weight /= weight.max()
        along, down = polynomial.design_gradient(square, order)
        jacobian = np.stack([along @ solution, down @ solution], axis=2) @ by_pixel
        area = np.abs(np.linalg.det(jacobian))
        if not (np.isfinite(area).all() and area.any()):
            raise np.linalg.LinAlgError("points on one line")
        scale = 1.0 / np.sqrt(np.maximum(area, 0.01 * float(np.median(area))))
        to_px = np.asarray(np.linalg.pinv(jacobian), dtype=np.float64)
        return cls(design, marks.points, scale, to_px, variance, terms)

    def predict(self, weight: Array) -> _Prediction:
        """Predict every mark without itself, with weights (n,) of the others, at every order from one QR."""
        root = np.sqrt(weight)[:, None]
        full = self.design * self.scale[:, None]
        y = self.points * self.scale[:, None]
        kept = weight > 0.0
        q, r = np.linalg.qr((full * root)[kept])
        size = np.abs(np.diag(r))
        known = int(np.argmax(np.append(size <= 1e-10 * size.max(), True)))  # columns before the first dependent one
        terms = self.terms[self.terms <= min(known, int(kept.sum()) / 1.5)]
        if not len(terms):
            raise np.linalg.LinAlgError("too few marks")
        d = int(terms[-1])
        basis = full[:, :d] @ np.linalg.inv(r[:d, :d])  # of which the weighted rows are orthonormal
        part = q[:, :d].T @ (y * root)[kept]
        fitted = np.stack([basis[:, :t] @ part[:t] for t in terms])
        reach = np.stack([np.einsum("nd,nd->n", basis[:, :t], basis[:, :t]) for t in terms])
        residual = y - fitted
        left = np.maximum(1.0 - weight * reach, 1e-3)
        inside = np.einsum("n,onk->o", weight, residual**2)
        # without the mark, reach grows to reach / (1 - weight reach); the mark's own noise is 1
        spread = np.sqrt(1.0 + reach / left)
        return _Prediction(residual / left[:, :, None], spread, terms, inside)


def _robust_weights(problem: _Problem) -> Array:
    """Weights (n,) between 0 and 1: least absolute residuals first, then redescending, until they no longer change."""
    weight = np.ones(len(problem.points))
    for turn in range(_ROUNDS):
        found = problem.predict(weight)
        distance = _best(found)[1]
        typical = max(float(np.median(distance)) / _MEDIAN, 1e-300)
        sigma = typical * np.sqrt(1.0 + problem.noise / max(float(np.median(problem.noise)), typical**2))
        sigma /= np.sqrt(2.0) if problem.noise.any() else 1.0
        d = distance / np.maximum(sigma, 1e-300)
        new = 1.0 / np.maximum(d, 1.0) if turn < _L1 else np.maximum(1.0 - (d / _REDESCEND) ** 2, 0.0) ** 2
        if turn > _L1 and np.abs(new - weight).max() < 0.01:
            break
        weight = new
    return weight


def _best(found: _Prediction) -> tuple[int, Array]:
    """Order whose left-out residuals are least, each counted up to a limit: index and lengths (n,) over their spread."""
    length = np.linalg.norm(found.error, axis=2) / found.spread
    typical = max(float(np.median(length, axis=1).min()) / _MEDIAN, 1e-300)
    raw = np.linalg.norm(found.error, axis=2)
    loss = np.minimum((raw / typical) ** 2, _REDESCEND**2).mean(axis=1)
    few = max(1, int((found.terms * _A_TERM <= found.error.shape[1]).sum()))
    k = int(np.argmax(loss <= 1.02 * loss[:few].min()))
    return k, length[k]


def _one_by_one(problem: _Problem) -> BadMarks:
    """Leave the worst mark out while there is a bad one: where few are, none is to be lost at the start."""
    good = np.ones(len(problem.points), dtype=bool)
    while True:
        bad, pull, found = _tested(problem, good)
        if not (bad & good).any():
            return replace(found, rows=~good & bad)
        good[np.argmax(np.where(bad & good, pull, 0.0))] = False


def _judged(problem: _Problem, weight: Array) -> BadMarks:
    """Test every mark against a plain fit of the good ones, until the good ones no longer change."""
    good = weight > _SURELY
    seen: set[bytes] = set()
    while True:
        bad, _, found = _tested(problem, good)
        seen.add(good.tobytes())
        good = ~bad
        if good.tobytes() in seen:
            return found


def _tested(problem: _Problem, good: Bools) -> tuple[Bools, Array, BadMarks]:
    """Which marks are off, given which are good, by how many standard errors, each (n,), and how that is told."""
    found = problem.predict(good.astype(np.float64))
    k, _ = _best(_only(found, good))
    error, sigma = _size(problem, found, k, good)
    bad = error > _limit(problem, found, k, good, error / sigma) * sigma
    bad &= (error > _TRUNCATION * _unsettled(found, k)) & (error > _LEAST_PX)
    # the test is on lengths in px of the local scale, which noise cannot turn; told is the way in the image
    shown = np.linalg.norm(problem.to_px @ (found.error[k] / problem.scale[:, None])[:, :, None], axis=1)[:, 0]
    return bad, error / sigma, BadMarks(bad, shown, sigma)


def _only(found: _Prediction, good: Bools) -> _Prediction:
    return found._replace(error=found.error[:, good], spread=found.spread[:, good])


def _size(problem: _Problem, found: _Prediction, k: int, good: Bools) -> tuple[Array, Array]:
    """How far every mark is off, (n,) px, and the standard error of a coordinate of it, (n,) px."""
    freedom = max(2 * int(good.sum() - found.terms[k]), 1)
    total = float(found.inside[k]) / freedom
    own = problem.noise * min(1.0, total / max(float(problem.noise[good].mean()), 1e-300))
    common = max(total - float(own[good].mean()), 0.0)  # of the target and of what else the centroids do not know
    error = np.linalg.norm(found.error[k], axis=1)
    sigma = np.sqrt(np.maximum(common + own + total * (found.spread[k] ** 2 - 1.0), 1e-300))
    return error, sigma


def _limit(problem: _Problem, found: _Prediction, k: int, good: Bools, distance: Array) -> float:
    """Length of an error over its sigma that chance does not exceed."""
    from scipy.stats import f

    freedom = max(2 * int(good.sum() - 1 - found.terms[k]), 1)
    chance = float(np.sqrt(2.0 * f.isf(FALSE_ALARM / len(problem.points), 2, freedom)))
    return max(chance, _TAIL * float(np.quantile(distance[good], 0.95)))


def _unsettled(found: _Prediction, k: int) -> Array:
    """(n,) px by which the predictions are not yet settled: what the next two orders change in them.

    Where there is no higher order, what the last one changed, less by the root of how the errors fell with it: they fall
    more slowly at a corner than in the middle.
    """
    change = [np.linalg.norm(found.error[j] - found.error[k], axis=1) for j in range(len(found.terms))]
    if k + 1 < len(change):
        return np.asarray(np.max(change[k + 1 : k + 3], axis=0))
    if k == 0:
        return np.zeros(found.error.shape[1])
    typical = np.median(np.linalg.norm(found.error[[k - 1, k]], axis=2), axis=1)
    return np.asarray(change[k - 1] * min(1.0, float(typical[1]) / max(float(typical[0]), 1e-300)) ** 0.5)
