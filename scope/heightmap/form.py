"""Form removal (the F-operator of ISO 25178-2): plane, sphere, cylinder, polynomial, chosen or found."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array
from scope.errors import MeasurementError
from scope.heightmap.heights import HeightMap

HIGHEST_ORDER = 10
_FORMS = ("auto", "plane", "robust-plane", "sphere", "cylinder", "none")
_CAUTION = 3.0  # times Schwarz's penalty
_FIT_POINTS = 50_000  # a form has few parameters: more points than this only cost time


@dataclass(frozen=True, slots=True, eq=False)
class Form:
    """A form, fitted."""

    name: str  # plane, robust-plane, sphere, cylinder, poly2 ...
    terms: int  # parameters it has
    residual: Array  # (N,) mm, what is left, along the normal of the form
    radius: float = math.nan  # mm, of a sphere or cylinder; positive where the surface is convex


def remove_form(heights: HeightMap, name: str = "auto") -> HeightMap:
    """Take a form off a height map; what is left is along the normal of the form.

    Parameters
    ----------
    heights : HeightMap
    name : str
        ``plane`` (total least squares), ``robust-plane`` (Tukey's biweight: for surfaces with a few deep pits),
        ``sphere``, ``cylinder`` (least squares of the distance to it), ``polyN`` of order N from 2 to 10 (least
        squares over the levelled map), ``none``, or ``auto``: the simplest of plane, cylinder, sphere and poly2
        that explains the shape, by the Bayesian information criterion over independent areas (Schwarz 1978).

    Returns
    -------
    HeightMap
        Heights about zero, the form's name, and a note where a form of so many terms takes roughness with it.

    Raises
    ------
    MeasurementError
        Fewer heights than the form needs.
    ValueError
        A form that is not known.
    """
    known = heights.known
    down, along = heights.places()
    points = np.stack([along[known], down[known], heights.z[known]], axis=1)
    form = choose_form(points, heights) if name == "auto" else fit_form(points, name)
    z = np.full(heights.z.shape, np.nan)
    z[known] = form.residual
    label = form.name if math.isnan(form.radius) else f"{form.name} of radius {abs(form.radius):.4g} mm"
    notes = heights.notes
    if name != "auto" and form.terms > 3:
        notes = (*notes, *_taken_along(points, form, heights))
    return heights.with_heights(z, form=label, notes=notes)


def require_form(name: str) -> None:
    """``ValueError`` unless ``name`` is a form that `remove_form` knows."""
    order = name[4:] if name.startswith("poly") else ""
    if name not in _FORMS and not (order.isdigit() and 2 <= int(order) <= HIGHEST_ORDER):
        raise ValueError(f"form {name!r} is not known: {', '.join(_FORMS)}, poly2 to poly{HIGHEST_ORDER}")


def fit_form(points: Array, name: str) -> Form:
    """Fit a form, by its name (see `remove_form`), to points (N, 3) mm whose third coordinate is the height."""
    require_form(name)
    if name == "none":
        return Form("none", 0, points[:, 2] - points[:, 2].mean())
    if name in {"plane", "robust-plane"}:
        _enough(points, 3, name)
        return Form(name, 3, _levelled(points, robust=name == "robust-plane")[:, 2])
    if name == "sphere":
        _enough(points, 4, name)
        return _fit_sphere(points)
    if name == "cylinder":
        _enough(points, 5, name)
        return _fit_cylinder(points)
    order = int(name[4:])
    _enough(points, (order + 1) * (order + 2) // 2, name)
    return _fit_polynomial(points, order)


def choose_form(points: Array, heights: HeightMap) -> Form:
    """The simplest form that explains the shape of points (N, 3) mm on the lattice of ``heights``.

    Each candidate is judged by n ln(variance left) + 3 terms ln n (Schwarz's criterion, with thrice its caution: a form
    that is not there costs roughness), where n is the number of independent areas, found from
    the correlation that the best candidate leaves; so neighbouring heights of one bump do not count twice.
    """
    candidates = [fit_form(points, name) for name in ("plane", "cylinder", "sphere", "poly2")]
    best = min(candidates, key=lambda form: float(form.residual.var()))
    areas = independent_areas(best.residual, heights)
    floor = 1e-12 * max(float(np.ptp(points, axis=0).max()), 1e-9) ** 2

    def criterion(form: Form) -> float:
        return areas * math.log(float(form.residual.var()) + floor) + _CAUTION * form.terms * math.log(max(areas, 2.0))

    return min(candidates, key=criterion)


def independent_areas(residual: Array, heights: HeightMap) -> float:
    """How many unrelated areas a residual (one a known height) holds: area over the integral of its correlation.

    That integral is the share of the variance that one free parameter takes from a random surface; independent noise
    adds next to nothing to it. Correlations below a tenth of the greatest beside lag 0 are left out.
    """
    from scope.heightmap.spatial import autocorrelation

    z = np.full(heights.z.shape, np.nan)
    z[heights.known] = residual
    acf = autocorrelation(z, heights.pitch)
    if not acf.variance > 0.0:
        return 2.0
    beside = np.nan_to_num(acf.covariance)
    beside[acf.centre] = 0.0
    integral = acf.variance + float(beside[beside > 0.1 * max(float(beside.max()), 1e-300)].sum())
    return max(2.0, float(heights.known.sum()) * acf.variance / integral)


def _taken_along(points: Array, form: Form, heights: HeightMap) -> tuple[str, ...]:
    """Warn where a chosen form leaves less than a simpler one would without having explained any shape."""
    simple = choose_form(points, heights)
    if simple.terms >= form.terms:
        return ()
    areas = independent_areas(simple.residual, heights)
    share = min((form.terms - simple.terms) / areas, 1.0)
    if share < 0.01 and float(form.residual.std()) > 0.99 * float(simple.residual.std()):
        return ()
    told = (
        f"warning: the form {form.name} has {form.terms} terms where {simple.name} with {simple.terms} explains the "
        f"shape: it takes about {100.0 * (1.0 - math.sqrt(1.0 - share)):.1f} % of Sq with it; use --form {simple.name}"
    )
    return (told,)


def _enough(points: Array, terms: int, name: str) -> None:
    if len(points) < 3 * terms:
        raise MeasurementError(
            f"{len(points)} heights are too few for the form {name} of {terms} terms; choose a larger region"
        )


def _sample(points: Array) -> Array:
    """Spread over all points (N, 3), in steps of the golden section, which lock to no row or column."""
    if len(points) <= _FIT_POINTS:
        return points
    place = (np.arange(_FIT_POINTS) * 0.6180339887498949) % 1.0
    return points[(place * len(points)).astype(np.int64)]


def _levelled(points: Array, *, robust: bool = False) -> Array:
    """Points in a frame whose third axis is the normal of their total least squares plane, from their centroid."""
    weights = np.ones(len(points))
    for _ in range(20 if robust else 1):
        centre = weights @ points / weights.sum()
        offset = points - centre
        _, axes = np.linalg.eigh((offset * weights[:, None]).T @ offset)
        normal = axes[:, 0] if axes[2, 0] >= 0.0 else -axes[:, 0]
        distance = offset @ normal
        if robust:
            scale = 1.4826 * float(np.median(np.abs(distance - np.median(distance)))) + 1e-12
            weights = np.clip(1.0 - (distance / (4.685 * scale)) ** 2, 0.0, None) ** 2
    first = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    first /= np.linalg.norm(first)
    return np.asarray(offset @ np.stack([first, np.cross(normal, first), normal], axis=1))


def _fit_polynomial(points: Array, order: int) -> Form:
    """Least squares over Legendre products, which stay well conditioned over a patch."""
    level = _levelled(points)
    span = np.abs(level[:, :2]).max(axis=0)
    x, y = level[:, 0] / span[0], level[:, 1] / span[1]
    powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    normal, right = np.zeros((len(powers), len(powers))), np.zeros(len(powers))
    residual = level[:, 2].copy()
    blocks = [slice(start, start + 65536) for start in range(0, len(level), 65536)]

    def basis(block: slice) -> Array:
        first = np.polynomial.legendre.legvander(x[block], order)
        second = np.polynomial.legendre.legvander(y[block], order)
        return np.stack([first[:, i] * second[:, j] for i, j in powers], axis=1)

    for block in blocks:
        terms = basis(block)
        normal += terms.T @ terms
        right += terms.T @ residual[block]
    coefficients = np.linalg.lstsq(normal, right, rcond=1e-13)[0]
    for block in blocks:
        residual[block] -= basis(block) @ coefficients
    return Form(f"poly{order}", len(powers), residual)


def _fit_sphere(points: Array) -> Form:
    """Least squares of the distance to a sphere (Gauss-Newton on curvature and tangent plane; Pratt's parameters)."""
    level = _levelled(points)
    k = _curvature(level)
    solution = _gauss_newton(level, np.array([0.0, 0.0, 0.0, 0.5 * (k[0] + k[2])]), _sphere_distance)
    return Form("sphere", 4, _sphere_distance(level, solution), _radius(solution[3]))


def _fit_cylinder(points: Array) -> Form:
    """Least squares of the distance to a cylinder, whose axis lies nearly along the patch."""
    level = _levelled(points)
    a, b, c = _curvature(level)
    values, directions = np.linalg.eigh(np.array([[a, b], [b, c]]))
    curved = int(np.argmax(np.abs(values)))
    angle = math.atan2(directions[1, curved], directions[0, curved])
    solution = _gauss_newton(level, np.array([0.0, 0.0, 0.0, values[curved], angle]), _cylinder_distance)
    return Form("cylinder", 5, _cylinder_distance(level, solution), _radius(solution[3]))


def _curvature(level: Array) -> Array:
    """Second derivatives (xx, xy, yy), 1/mm, of the quadric through levelled points."""
    part = _sample(level)
    x, y = part[:, 0], part[:, 1]
    design = np.stack([np.ones(len(x)), x, y, 0.5 * x * x, x * y, 0.5 * y * y], axis=1)
    return np.asarray(np.linalg.lstsq(design, part[:, 2], rcond=None)[0][3:])


def _sphere_distance(points: Array, parameters: Array) -> Array:
    """Signed distance (N,) mm to the sphere with offset, two tilts and curvature; a plane at curvature 0."""
    offset, tilt_x, tilt_y, curvature = parameters
    axis = np.array([-tilt_x, -tilt_y, 1.0])
    axis /= np.linalg.norm(axis)
    q = points - np.array([0.0, 0.0, offset])
    # The root of k d^2 / 2 + (1 - k h) d = h - k |q|^2 / 2 in d, in the form that lives at k = 0.
    return _offset_distance(q @ axis, (q * q).sum(axis=1), curvature)


def _cylinder_distance(points: Array, parameters: Array) -> Array:
    """Signed distance (N,) mm to the cylinder: as the sphere's, with the part along the axis taken out."""
    offset, tilt_x, tilt_y, curvature, angle = parameters
    normal = np.array([-tilt_x, -tilt_y, 1.0])
    normal /= np.linalg.norm(normal)
    axis = np.array([-math.sin(angle), math.cos(angle), 0.0])
    axis -= (axis @ normal) * normal
    axis /= np.linalg.norm(axis)
    q = points - np.array([0.0, 0.0, offset])
    return _offset_distance(q @ normal, (q * q).sum(axis=1) - (q @ axis) ** 2, curvature)


def _offset_distance(height: Array, square: Array, curvature: float) -> Array:
    """Distance to a circle of signed curvature through the origin, from the height over its tangent and |q|^2.

    With centre at 1/k above the tangent: d = s (1/|k| - |q - centre|), written so that k -> 0 gives the height.
    """
    rest = height - 0.5 * curvature * square
    return np.asarray(2.0 * rest / (1.0 + np.sqrt(np.maximum(1.0 - 2.0 * curvature * rest, 0.0))))


def _gauss_newton(level: Array, start: Array, distance: Callable[[Array, Array], Array]) -> Array:
    from scipy.optimize import least_squares

    part = _sample(level)
    reach = float(np.abs(level[:, :2]).max())
    scale = np.array([reach, 1.0, 1.0, 1.0 / reach, 1.0])[: len(start)]
    solution = least_squares(lambda p: distance(part, p), start, x_scale=scale, method="trf")
    return np.asarray(solution.x)


def _radius(curvature: float) -> float:
    """Radius (mm) of a curvature; positive where the surface bends away from the sensor."""
    return -1.0 / curvature if abs(curvature) > 1e-12 else math.inf
