"""One scan of an artefact to the errors that it shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.geometry import Array, Bools, Ints
from scope.acceptance.acceptance_file import Known
from scope.acceptance.form import expected_spread, facing, representative, spread
from scope.acceptance.standards import Key, Standard
from scope.check import Artefact, Shape, fit_artefact, rays_of, shared_of
from scope.cloud import ScanCloud
from scope.errors import MeasurementError

_BAND = 0.06  # of a radius: points further from the sphere are none of it
_LEAST = 50  # points
_FEW = 0.01  # share of points up to which what is left out are outliers
_FLAT = 0.5  # mm, the same for a plane
_ALIKE = 0.05  # of a calibrated distance, beyond which it is another bar


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """An error of indication at one position."""

    key: Key
    scan: str
    value: float  # mm
    claimed: (
        float | None
    )  # mm, k = 2 that the scanner states for it; of a form, what its sigma explains at most (97.5 %)
    points: int
    left_out: int  # points beyond what the standard lets count
    everything: float  # mm: of a form, the spread of all points; else the value
    representative: float | None = None  # mm: of 25 points, where the standard asks for them


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What a scan of an artefact gave, and where it stood."""

    scan: str
    readings: tuple[Reading, ...]
    place: Array  # (3,) mm
    direction: Array  # (3,) unit, of a bar or a plane; zero of a sphere
    length: float  # mm, greatest extent of the plane's points; else 0
    where: Array  # (n, 3) mm: points on the artefact
    residual: Array  # (n,) mm, of each


def seen_artefact(scan: str, cloud: ScanCloud, known: Known, standard: Standard) -> Seen:
    """Errors of a scan.

    Raises
    ------
    MeasurementError
        The artefact is not in it.
    """
    part = cloud if known.region is None else cloud.select(known.region.contains(cloud.points))
    _require_points(part)
    if known.kind == "sphere":
        return _sphere(scan, part, known, standard)
    return _plane(scan, part, standard) if known.kind == "plane" else _bar(scan, part, known)


def _require_points(cloud: ScanCloud) -> None:
    if len(cloud) < _LEAST:
        raise MeasurementError(
            f"{len(cloud)} points are left to look in, {_LEAST} are the least; correct its region or scan it"
        )


def _sphere(scan: str, cloud: ScanCloud, known: Known, standard: Standard) -> Seen:
    shape = fit_artefact(cloud, Artefact("sphere", diameter=known.size))
    camera, ray = rays_of(cloud)
    offset = cloud.points - shape.point
    distance = np.linalg.norm(offset, axis=1)
    on = (np.abs(distance - shape.radius) < _BAND * shape.radius) & facing(cloud.points, shape.point, camera)
    out = offset[on] / distance[on, None]
    sphere, residual = _least_squares_sphere(cloud.points[on], shape, standard.left_out)
    value = spread(residual, standard.left_out)
    design = np.column_stack([out, np.ones(len(out))])
    form = _form("probing_form", scan, value, residual, standard, _explained(cloud, on, ray, out, design, standard))
    if standard.patches:
        pole = out.sum(axis=0) if camera is None else camera[on].mean(axis=0) - shape.point
        few = float(np.ptp(representative(out, residual, pole)))
        form = replace(form, representative=few)
    k2 = 2.0 * float(np.sqrt(shape.radius_se**2 + shape.radius_shared**2 + shape.radius_slope**2))
    size = 2.0 * sphere[3] - known.size
    readings = (form, Reading("probing_size", scan, size, 2.0 * k2, int(on.sum()), 0, size))
    return Seen(scan, readings, sphere[:3], np.zeros(3), 0.0, cloud.points[on], residual)


def _least_squares_sphere(points: Array, shape: Shape, left_out: float) -> tuple[Array, Array]:
    """Centre and radius (4,) mm of the sphere through all points but outliers, and the residuals (N,) of all.

    Outliers are the few that the standard lets be left out; where it takes the spread of 95 %, all points are fitted.
    """
    value = np.r_[shape.point, shape.radius]
    few = left_out if left_out < _FEW else 0.0
    for _ in range(20):
        offset = points - value[:3]
        length = np.linalg.norm(offset, axis=1)
        residual = length - value[3]
        kept = np.argsort(np.abs(residual))[: len(points) - int(few * len(points) + 1e-9)]
        design = np.column_stack([offset / length[:, None], np.ones(len(points))])
        step = np.linalg.lstsq(design[kept], residual[kept], rcond=1e-12)[0]
        value = value + step
        if np.linalg.norm(step) < 1e-10:
            break
    return value, np.asarray(np.linalg.norm(points - value[:3], axis=1) - value[3])


def _bar(scan: str, cloud: ScanCloud, known: Known) -> Seen:
    shapes: list[Shape] = []
    rest, row = cloud, np.arange(len(cloud))
    rows: list[Ints] = []
    for diameter in known.diameters:
        try:
            _require_points(rest)
            shape = fit_artefact(rest, Artefact("sphere", diameter=diameter))
        except MeasurementError as error:
            which = "first" if not shapes else "second"
            raise MeasurementError(f"{scan}: the {which} sphere of the ball bar is not found ({error})") from error
        shapes.append(shape)
        rows.append(row[shape.used])
        away = np.linalg.norm(rest.points - shape.point, axis=1) > 1.2 * shape.radius
        rest, row = rest.select(away), row[away]
    a, b = shapes
    apart = b.point - a.point
    length = float(np.linalg.norm(apart))
    if abs(length - known.size) > _ALIKE * known.size:
        raise MeasurementError(
            f"{scan}: the two spheres found are {length:.4g} mm apart, the ball bar's {known.size:.4g}: give its region, or correct distance"
        )
    e = apart / length
    claimed = 0.0
    if a.place is not None and b.place is not None:
        scatter = float(e @ (a.place.scatter + b.place.scatter) @ e)
        shared, _ = shared_of(cloud, *rays_of(cloud))  # one basis for both: what moves them alike does not count
        moved = [_moved(cloud, r, s, shared) for r, s in zip(rows, shapes, strict=True)]
        calibration = float(np.linalg.norm(e @ (moved[1] - moved[0])))
        slope = float(e @ (b.place.slope - a.place.slope))
        claimed = 2.0 * float(np.sqrt(scatter + calibration**2 + slope**2))
    value = length - known.size
    residual = np.concatenate([s.residual[s.used] for s in shapes])
    where = cloud.points[np.concatenate(rows)]
    reading = Reading("spacing", scan, value, claimed, len(residual), 0, value)
    return Seen(scan, (reading,), 0.5 * (a.point + b.point), e, 0.0, where, residual)


def _moved(cloud: ScanCloud, rows: Ints, shape: Shape, shared: Array) -> Array:
    """Movement (3, K) mm of a sphere's centre by each error of the calibration, which move the points by ``shared`` (N, 3, K)."""
    points = cloud.points[rows]
    out = points - shape.point
    out = out / np.linalg.norm(out, axis=1, keepdims=True)
    solve = np.linalg.pinv(np.column_stack([out, np.ones(len(rows))]), rcond=1e-10)[:3]
    return np.asarray(solve @ np.einsum("ni,nik->nk", out, np.nan_to_num(shared[rows])))


def _plane(scan: str, cloud: ScanCloud, standard: Standard) -> Seen:
    shape = fit_artefact(cloud, Artefact("plane"))
    _, ray = rays_of(cloud)
    axes = np.linalg.svd(shape.direction[None])[2][1:]
    flat = (cloud.points - shape.point) @ axes.T
    near = np.abs((cloud.points - shape.point) @ shape.direction) < _FLAT
    low, high = np.percentile(flat[shape.used], [0.05, 99.95], axis=0)
    on = near & ((flat >= low) & (flat <= high)).all(axis=1)
    design = np.column_stack([np.ones(int(on.sum())), flat[on]])
    height = (cloud.points[on] - shape.point) @ shape.direction
    slope = np.linalg.lstsq(design, height, rcond=None)[0]
    normal = shape.direction - slope[1] * axes[0] - slope[2] * axes[1]
    residual = (height - design @ slope) / np.linalg.norm(normal)
    value = spread(residual, standard.left_out)
    out = np.broadcast_to(normal / np.linalg.norm(normal), (int(on.sum()), 3))
    reading = _form("flatness", scan, value, residual, standard, _explained(cloud, on, ray, out, design, standard))
    middle = cloud.points[on].mean(axis=0)
    sides = np.linalg.svd(cloud.points[on] - middle, full_matrices=False)[2]
    length = float(np.ptp((cloud.points[on] - middle) @ sides[0]))
    return Seen(scan, (reading,), middle, out[0], length, cloud.points[on], residual)


def _form(
    key: Key, scan: str, value: float, residual: Array, standard: Standard, explained: tuple[float, float] | None
) -> Reading:
    claimed = None if explained is None else explained[0] + 2.0 * explained[1]
    out = int(standard.left_out * len(residual) + 1e-9)
    return Reading(key, scan, value, claimed, len(residual), out, spread(residual, 0.0))


def _explained(
    cloud: ScanCloud, on: Bools, ray: Array | None, out: Array, design: Array, standard: Standard
) -> tuple[float, float] | None:
    shared = np.einsum("ni,nik->nk", out, shared_of(cloud, *rays_of(cloud))[0][on])
    across = np.ones(len(out)) if ray is None else (out * ray[on]).sum(axis=1)
    return expected_spread(design, across, cloud.sigma[on].astype(np.float64), shared, standard.left_out)
