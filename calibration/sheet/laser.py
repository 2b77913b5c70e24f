"""Fits a sheet of light to points on known planes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Bools, Plane, fit_plane
from calibration.sheet.curved import CurvedSheet, Sheet, SheetFrame, order_of

TUKEY = 4.685  # tuning constant, 95 % efficiency for Gaussian noise (Holland & Welsch 1977)
_MAD = 1.4826
_ORDERS = {2: 4, 3: 5, 4: 5}  # planes that the order of a curved sheet needs, so that one can be left out
_LAGS = range(2, 6)  # points along a stripe, over which noise is independent and shape is not


@dataclass(frozen=True, slots=True, eq=False)
class StripePoints:
    """Where the stripe was seen on one calibration plane."""

    plane: str  # name of the plane
    points: Array  # (n, 3) mm, in C
    sigma: Array  # (n,) mm, of each point across the stripe


@dataclass(frozen=True, slots=True, eq=False)
class PlaneOfLight:
    """How one calibration plane's stripe fits."""

    plane: str
    n: int
    rms_mm: float  # about the sheet
    loo_mm: float  # about the sheet fitted without this plane; NaN where the rest determines none


@dataclass(frozen=True, slots=True, eq=False)
class Laser:
    """A sheet of light with its covariance and how well it was found."""

    name: str
    sheet: Sheet
    frame: SheetFrame
    covariance: Array  # (3, 3), or larger for a curved sheet, mm^2, of the parameters in `frame`
    origin: Array  # (3,) mm in C, NaN where not told
    along: str  # "rows" or "columns", as found at calibration
    channel: str
    rms_mm: float
    loo_mm: float  # median over the planes
    flatness_mm: float  # peak to valley of the quadratic part over what was measured
    flatness_sigma: float  # mm, its standard error
    n: int
    planes: tuple[PlaneOfLight, ...] = ()
    coupling: Array = field(
        default_factory=lambda: np.zeros((0, 0))
    )  # (L, P) movement of the parameters, a unit of each
    # of the camera's, which ``covariance`` holds fixed; (0, 0): found as if the camera were known
    local_mm: float = float(
        "nan"
    )  # one sigma, what the sheet's shape leaves unexplained from place to place, in ``covariance``

    @property
    def plane(self) -> Plane:
        """The sheet's plane (the base plane of a curved one)."""
        return self.sheet.plane if isinstance(self.sheet, CurvedSheet) else _flat(self.sheet)

    def lift(self, points: Array) -> Array:
        """Movement (N, P) mm of the sheet along its normal at points (N, 3), a unit of each parameter of ``covariance``."""
        terms = self.frame.terms(points, order=order_of(len(self.covariance)))
        return np.asarray(terms * (self.sheet.normal_at(points) @ self.plane.normal)[:, None])

    def sigma_at(self, points: Array) -> Array:
        """Standard deviation (N,) mm of the sheet along its normal at points (N, 3), from the calibration."""
        terms = self.frame.terms(points, order=order_of(len(self.covariance)))
        return np.asarray(np.sqrt(np.maximum(((terms @ self.covariance) * terms).sum(axis=1), 0)))


def _flat(sheet: Sheet) -> Plane:
    if isinstance(sheet, Plane):
        return sheet
    raise ValueError(f"a sheet of type {type(sheet).__name__} has no plane")


def fit_laser(
    name: str,
    stripes: list[StripePoints],
    *,
    along: str,
    channel: str,
    origin: Array | None = None,
    curved: bool | None = None,
) -> Laser:
    """Fit the sheet of light, robustly, to all stripes.

    Parameters
    ----------
    name : str
        Of the laser.
    stripes : list of StripePoints
        On two planes or more, at different places.
    along, channel : str
        Kept for ranging.
    origin : (3,) array, optional
        About where the light comes from, mm in C.
    curved : bool, optional
        Whether the sheet is curved. Without it, it is where four planes or more show a quadratic part of more than
        five standard errors that also takes 30 % off the leave-one-plane-out variance. With five planes, a third and
        a fourth order may follow, where each takes another 30 % off: thick tilted glass bends a sheet so. False also says
        that the planes' places were estimated, so that the points of one are off together: see below.

    Returns
    -------
    Laser
        What the shape of the sheet leaves unexplained along the stripes, beyond the noise of the points, is part of the
        covariance: it enters as an uncertainty of the offset. With ``curved`` False the jackknife over three planes or more
        (Efron and Stein, Ann. Statist. 9, 1981) takes its place in directions in which it says more than noise of the points can.

    Raises
    ------
    CalibrationError
        Stripes on fewer than two planes, or all on one line, which leave the sheet free to turn.
    """
    seen = [s for s in stripes if len(s.points) >= 2]
    if len(seen) < 2:
        raise CalibrationError(
            f"laser {name}: a stripe was found on {len(seen)} plane(s); two or more are needed: check the laser images, "
            "their background and `channel`"
        )
    best = _Fit.of(name, seen, order=1)
    quadratic = _Fit.of(name, seen, order=2) if len(seen) >= 3 else None
    if quadratic is not None and (curved or (curved is None and _is_curved(seen, quadratic))):
        best = quadratic
        for order in (3, 4):
            if len(seen) >= _ORDERS[order] and _predicts_better(name, seen, order, than=best.order):
                best = _Fit.of(name, seen, order=order)
    left_out = [_left_out(name, seen, k, order=best.order) for k in range(len(seen))]
    planes = tuple(
        PlaneOfLight(s.plane, len(s.points), _robust_rms(best.sheet.distance(s.points), best.scale), loo)
        for s, loo in zip(seen, left_out, strict=True)
    )
    known = [loo for loo in left_out if np.isfinite(loo)]
    covariance = _with_views(best, seen) if curved is False else best.covariance
    valley, error = (0.0, np.inf) if quadratic is None else quadratic.flatness()
    return Laser(
        name, best.sheet, best.frame, covariance, np.full(3, np.nan) if origin is None else origin, along, channel,
        best.rms, float(np.median(known)) if known else float("nan"), valley, error, int(best.used.sum()), planes,
        local_mm=best.local,
    )  # fmt: skip


def _is_curved(stripes: list[StripePoints], quadratic: _Fit) -> bool:
    if len(stripes) < _ORDERS[2]:
        return False
    valley, error = quadratic.flatness()
    return valley >= 5 * error and _predicts_better(quadratic.name, stripes, 2, than=1)


def _predicts_better(name: str, stripes: list[StripePoints], order: int, *, than: int) -> bool:
    """Whether a higher order takes 30 % off the variance of planes left out."""
    high, low = ([_left_out(name, stripes, k, order=n) for k in range(len(stripes))] for n in (order, than))
    return bool(np.nanmean(np.square(high)) < 0.7 * np.nanmean(np.square(low)))


def _left_out(name: str, stripes: list[StripePoints], k: int, *, order: int) -> float:
    rest = [s for i, s in enumerate(stripes) if i != k]
    try:
        fit = _Fit.of(name, rest, order=order)
    except CalibrationError:
        return float("nan")
    return _robust_rms(fit.sheet.distance(stripes[k].points), 0.0)


def _with_views(fit: _Fit, stripes: list[StripePoints]) -> Array:
    """Covariance (3, 3) of a flat sheet: of its fit, or as the fits that leave one plane out differ, where that is more than by chance."""
    others = []
    for k in range(len(stripes)):
        try:
            plane = _Fit.of(fit.name, [s for i, s in enumerate(stripes) if i != k], order=1).sheet
        except CalibrationError:
            continue
        plane, normal = _flat(plane), _flat(fit.sheet).normal
        slope = -fit.frame.reach * (fit.frame.axes @ plane.normal)
        others.append(np.append(slope, plane.offset - fit.frame.centre @ plane.normal) / (normal @ plane.normal))
    if len(others) < 3:
        return fit.covariance
    off = np.array(others) - np.mean(others, axis=0)
    jackknife = (len(others) - 1) / len(others) * off.T @ off
    values, vectors = np.linalg.eigh(fit.covariance)
    if not values.max() > 0.0:  # points without error: nothing to grow
        return fit.covariance
    root = vectors * np.sqrt(np.maximum(values, 1e-12 * values.max()))
    whitened = np.linalg.solve(root, np.linalg.solve(root, jackknife).T)
    times, directions = np.linalg.eigh(whitened)
    grown = root @ directions
    chance = 1.0 + 6.0 * np.sqrt(2.0 / (len(others) - 1))  # what independent noise alone may give
    return np.asarray((grown * np.where(times > chance, times, 1.0)) @ grown.T)


def _robust_rms(distances: Array, scale: float) -> float:
    """Rms of the distances without the gross outliers (further than six robust deviations from their median)."""
    spread = max(_MAD * float(np.median(np.abs(distances - np.median(distances)))), scale, 1e-12)
    kept = np.abs(distances - np.median(distances)) <= 6 * spread
    return float(np.sqrt((distances[kept] ** 2).mean()))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    name: str
    sheet: Sheet
    frame: SheetFrame
    covariance: Array
    points: Array
    used: Bools
    scale: float  # mm, robust deviation of the residuals
    rms: float  # mm, of the used points
    order: int
    local: float  # mm, what the shape leaves unexplained along the stripes

    @classmethod
    def of(cls, name: str, stripes: list[StripePoints], *, order: int) -> _Fit:
        points = np.concatenate([s.points for s in stripes])
        weights = _balance(stripes)
        try:
            plane = fit_plane(points, weights=weights)
        except ValueError as error:
            raise CalibrationError(_one_line(name, len(stripes))) from error
        for _ in range(30):
            distance = plane.distance(points)
            spread = _scale(distance)
            robust = weights * _tukey(distance / spread)
            previous, plane = plane, fit_plane(points, weights=np.maximum(robust, 1e-12))
            if abs(float(previous.normal @ plane.normal)) > 1 - 1e-15:
                break
        frame = _frame(points, plane)
        if np.ptp(frame.coordinates(points)[:, 1]) * frame.reach < 1e-3 * frame.reach:
            raise CalibrationError(_one_line(name, len(stripes)))
        parameters, robust, inverse = _refine(points, weights, plane, frame, order=order)
        residual = plane.distance(points) - frame.terms(points, order=order) @ parameters
        used = np.asarray(robust > 0)
        freedom = max(int(used.sum()) - len(parameters), 1)
        variance = float((robust * residual**2).sum() / freedom)
        covariance = inverse * variance
        local = _unexplained(np.split(np.where(used, residual, np.nan), _ends(stripes)))
        covariance[2, 2] += local
        flat, frame = _moved(plane, frame, parameters)
        sheet: Sheet = CurvedSheet(flat, frame, parameters[3:]) if order > 1 else flat
        rms = float(np.sqrt((residual[used] ** 2).mean()))
        return cls(name, sheet, frame, covariance, points, used, _scale(residual), rms, order, float(np.sqrt(local)))

    def flatness(self) -> tuple[float, float]:
        """Peak to valley of the quadratic part over the points, mm, and its standard error."""
        if not isinstance(self.sheet, CurvedSheet):
            return 0.0, float("inf")
        shape = self.frame.terms(self.points[self.used], order=self.order)[:, 3:]
        height = shape @ self.sheet.curvature
        high, low = int(np.argmax(height)), int(np.argmin(height))
        difference = shape[high] - shape[low]
        return float(height[high] - height[low]), float(np.sqrt(difference @ self.covariance[3:, 3:] @ difference))


def _ends(stripes: list[StripePoints]) -> Array:
    return np.cumsum([len(s.points) for s in stripes])[:-1]


def _unexplained(residuals: list[Array]) -> float:
    """Variance, mm^2, that residuals (n,) of stripes, in the order of their lines, share with those a few lines away.

    The mean product of residuals at `_LAGS` is free of independent noise. Zero where it is within three standard errors
    of none.
    """
    products = np.concatenate([r[:-lag] * r[lag:] for r in residuals for lag in _LAGS if len(r) > lag] or [np.zeros(0)])
    known = np.isfinite(products)
    count = int(known.sum())
    if count < 100:
        return 0.0
    total = float(np.nanmean(np.concatenate(residuals) ** 2))
    shared = float(products[known].mean())
    return shared if shared > 3 * total / np.sqrt(count) else 0.0


def _one_line(name: str, planes: int) -> str:
    return (
        f"laser {name}: its stripes on {planes} planes all lie on one line, so the sheet of light is free to turn about "
        "it: use planes at different stand-offs, or tilt the target"
    )


def _balance(stripes: list[StripePoints]) -> Array:
    """Weights by the points' sigma, where it is known, relative to the median so that they stay near one."""
    sigma = np.concatenate([s.sigma for s in stripes])
    known = np.isfinite(sigma) & (sigma > 0)
    if not known.any():
        return np.ones(len(sigma))
    middle = float(np.median(sigma[known]))
    return np.asarray(1.0 / np.clip(np.where(known, sigma, middle) / middle, 0.5, 3.0) ** 2)


def _scale(residual: Array) -> float:
    return max(_MAD * float(np.median(np.abs(residual))), 1e-9)


def _tukey(x: Array) -> Array:
    return np.where(np.abs(x) < TUKEY, (1 - (x / TUKEY) ** 2) ** 2, 0.0)


def _frame(points: Array, plane: Plane) -> SheetFrame:
    centre = points.mean(axis=0)
    centre = centre - plane.distance(centre[None])[0] * plane.normal
    flat = points - centre
    flat = flat - (flat @ plane.normal)[:, None] * plane.normal
    axes = np.linalg.svd(flat, full_matrices=False)[2][:2]
    return SheetFrame(centre, axes, max(float(np.abs(flat @ axes.T).max()), 1e-9))


def _refine(
    points: Array, weights: Array, plane: Plane, frame: SheetFrame, *, order: int
) -> tuple[Array, Array, Array]:
    """Parameters about the plane, the robust weights, and the inverse normal matrix of the weighted fit."""
    terms, distance = frame.terms(points, order=order), plane.distance(points)
    parameters, robust = np.zeros(terms.shape[1]), weights
    for _ in range(20):
        residual = distance - terms @ parameters
        robust = weights * _tukey(residual / _scale(residual))
        root = np.sqrt(robust)[:, None]
        step = np.linalg.lstsq(terms * root, residual * root[:, 0], rcond=None)[0]
        parameters = parameters + step
        if np.abs(step).max() < 1e-12 * frame.reach:
            break
    normal = (terms * robust[:, None]).T @ terms
    return parameters, robust, np.asarray(np.linalg.pinv(normal, rcond=1e-14))


def _moved(plane: Plane, frame: SheetFrame, parameters: Array) -> tuple[Plane, SheetFrame]:
    """Plane and frame after tilt and offset; the parameters' covariance carries over to first order."""
    normal = plane.normal - (parameters[:2] / frame.reach) @ frame.axes
    centre = frame.centre + parameters[2] * plane.normal
    moved = Plane.through(centre, normal)
    first = frame.axes[0] - (frame.axes[0] @ moved.normal) * moved.normal
    first = first / np.linalg.norm(first)
    second = np.cross(moved.normal, first)
    second = second if second @ frame.axes[1] > 0 else -second
    return moved, SheetFrame(centre, np.stack([first, second]), frame.reach)
