"""How accurate is it? A scan of something known, against what is known of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from calibration.geometry import Array, Bools, rotation_from_quaternion
from calibration.notebook import Shown, Summary, number
from scope.check.shapes import CUT, LEAST, Shape, find_cylinder, find_sphere, fit_levels, fit_shape
from scope.cloud import Region, ScanCloud, refuse_sheet
from scope.errors import MeasurementError
from scope.export import write_scalars
from scope.pose import largest_plane, normals_of, shared_errors, sheet_and_window, thin, viewpoints

Kind = Literal["sphere", "plane", "cylinder", "steps", "mesh"]
Each: TypeAlias = "Callable[[Callable[[ScanCloud], ArtefactCheck], Sequence[ScanCloud]], Iterable[ArtefactCheck]]"


@dataclass(frozen=True, slots=True)
class Artefact:
    """Something of known size: a sphere or cylinder by diameter, a plane, steps by their heights above the base, a mesh."""

    kind: Kind
    diameter: float = 0.0  # mm
    heights: tuple[float, ...] = ()  # mm
    mesh: str = ""  # file

    @classmethod
    def parse(cls, text: str) -> Artefact:
        """Artefact of ``sphere:d=40``, ``plane``, ``cylinder:d=20``, ``steps:5,10,20`` or ``mesh:file``; else ``ValueError``."""
        kind, _, rest = text.partition(":")
        try:
            if kind in ("sphere", "cylinder") and rest.startswith("d="):
                diameter = float(rest[2:])
                if np.isfinite(diameter) and diameter > 0:
                    return cls("sphere" if kind == "sphere" else "cylinder", diameter=diameter)
            elif kind == "plane" and not rest:
                return cls("plane")
            elif kind == "steps" and rest:
                heights = tuple(float(x) for x in rest.split(","))
                if all(np.isfinite(heights)) and all(h != 0 for h in heights) and len(set(heights)) == len(heights):
                    return cls("steps", heights=heights)
            elif kind == "mesh" and rest:
                return cls("mesh", mesh=rest)
        except ValueError:
            pass  # the message below says what is allowed
        raise ValueError(
            f"artefact {text!r} is not known; use sphere:d=40, cylinder:d=20, plane, steps:5,10,20 (different heights above "
            "the base, mm) or mesh:file"
        )


@dataclass(frozen=True, slots=True)
class Size:
    """One dimension, as known and as measured."""

    name: str
    nominal: float  # mm
    measured: float  # mm
    scatter: float  # mm, one sigma, of the points, neighbours' errors taken to be alike
    calibration: float  # mm, one sigma, through the calibration
    slope: float  # mm, one sigma, through what slopes do to a stripe

    @property
    def uncertainty(self) -> float:
        """Mm, k = 2: of the scanner; the artefact's own is not in it."""
        return 2.0 * float(np.sqrt(self.scatter**2 + self.calibration**2 + self.slope**2))

    @property
    def error(self) -> float:
        """Measured less nominal, mm."""
        return self.measured - self.nominal


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ArtefactCheck(Shown):
    """What a scan of an artefact says of the scanner."""

    artefact: Artefact
    sizes: tuple[Size, ...]
    error_mm: float  # the error of size that is largest in magnitude; plane and mesh: largest mean deviation of a patch
    form_mm: float  # width that holds 95 % of the deviations from the fitted artefact (ISO 10360-8, Form.Sph.D95%)
    rms_mm: float  # of the deviations
    linearity_percent: (
        float  # largest residual about the best line, % of the covered z span; NaN where nothing spans it
    )
    points: int  # that took part
    span_mm: float  # z span of the cloud, to which linearity refers
    within: bool | None  # |error_mm| <= tolerance; None without a tolerance
    claimed: bool | None  # every error of size lies within its claimed uncertainty; None where there is no size
    where: Array  # (points, 3) mm, those that took part
    deviation: Array  # (points,) mm, of each from the fitted artefact, signed

    def summary(self) -> Summary:
        """Errors of size and form, and whether they are within tolerance."""
        verdict = {None: "", True: ", within tolerance", False: ", out of tolerance"}[self.within]
        figures = (("error", number(self.error_mm, "mm")), ("form", number(self.form_mm, "mm")))
        return Summary(
            f"ArtefactCheck of a {self.artefact.kind}{verdict}",
            (*figures, ("rms", number(self.rms_mm, "mm")), ("points", f"{self.points:,}")),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Repeatability:
    """Several scans of one artefact."""

    checks: tuple[ArtefactCheck, ...]
    deviation_mm: tuple[float, ...]  # standard deviation of each size; of the error for plane and mesh

    @property
    def worst_mm(self) -> float:
        """The largest of them."""
        return max(self.deviation_mm)


def check_artefact(
    cloud: ScanCloud, artefact: Artefact | str, *, tolerance: float | None = None, region: Region | None = None
) -> ArtefactCheck:
    """Compare a scan with an artefact.

    Parameters
    ----------
    cloud : ScanCloud
        mm. Other things may be in it; a region makes sure that the right one is taken.
    artefact : Artefact or str
        See `Artefact.parse`.
    tolerance : float, optional
        Largest error allowed, mm.
    region : Region, optional
        Where the artefact (with its base, for steps) is.

    Raises
    ------
    MeasurementError
        The artefact is not found, or a mesh has no sure pose.
    """
    known = Artefact.parse(artefact) if isinstance(artefact, str) else artefact
    if tolerance is not None and not tolerance > 0:
        raise ValueError("the tolerance must be positive")
    part = cloud if region is None else cloud.select(region.contains(cloud.points))
    if len(part) < LEAST:
        where = "the cloud" if region is None else "the region"
        raise MeasurementError(
            f"{where} has {len(part)} points, {LEAST} needed; scan the artefact or choose another region"
        )
    refuse_sheet(cloud)
    span = float(np.ptp(cloud.points[:, 2]))
    if known.kind == "steps":
        return _steps(part, known, tolerance, span)
    if known.kind == "mesh":
        return _mesh(cloud, known, tolerance, region, span)
    shape = fit_artefact(part, known)
    sizes: tuple[Size, ...] = ()
    if known.kind != "plane":
        parts = (2 * shape.radius_se, 2 * shape.radius_shared, 2 * shape.radius_slope)
        sizes = (Size("diameter", known.diameter, 2 * shape.radius, *parts),)
    found = _Deviations(part.points, shape.nearest(part.points), shape.residual, shape.used)
    return _judged(known, sizes, found, tolerance, span)


def check_repeats(
    clouds: Sequence[ScanCloud],
    artefact: Artefact | str,
    *,
    tolerance: float | None = None,
    region: Region | None = None,
    each: Each = map,
) -> Repeatability:
    """Compare several scans of one artefact and say how well they repeat; two scans or more, else ``ValueError``.

    ``each`` checks the scans, one after the other unless it is told otherwise (`scope.batch.each`: on several processes).
    """
    if len(clouds) < 2:
        raise ValueError("repeatability needs two scans or more")
    checks = tuple(each(partial(check_artefact, artefact=artefact, tolerance=tolerance, region=region), clouds))
    values = np.array([[s.measured for s in c.sizes] or [c.error_mm] for c in checks])
    return Repeatability(checks, tuple(float(x) for x in values.std(axis=0, ddof=1)))


def write_residuals(path: Path, check: ArtefactCheck, cloud: ScanCloud) -> None:
    """Write the points that took part with their deviation from the fitted artefact, mm (see `scope.export.write_scalars`)."""
    told = (f"deviation from the fitted {check.artefact.kind}, mm", *(f"origin {line}" for line in cloud.origin))
    write_scalars(path, check.where, {"deviation": check.deviation}, told)


def rays_of(cloud: ScanCloud) -> tuple[Array | None, Array | None]:
    """Camera (N, 3) mm and unit sighting ray (N, 3) of each point; None where the cloud does not tell."""
    camera, _ = viewpoints(cloud, np.arange(len(cloud)))
    if camera is None:
        return None, None
    ray = cloud.points - camera
    return camera, ray / np.linalg.norm(ray, axis=1, keepdims=True)


def shared_of(cloud: ScanCloud, camera: Array | None, ray: Array | None) -> tuple[Array, Array]:
    """How K errors of the calibration move the points together (N, 3, K) mm, and what is local (N,) mm along the ray.

    As the cloud tells (`ScanCloud.shared_moves`). Where it does not, along the rays as errors of the sheet would make up its
    ``sigma_cal``, which is then local, too; where even the sheet is not known, all points alike.
    """
    told = cloud.shared_moves()
    if told is not None:
        return told
    sigma_cal = np.nan_to_num(cloud.sigma_cal).astype(np.float64)
    along = np.broadcast_to([0.0, 0.0, 1.0], cloud.points.shape) if ray is None else ray
    basis: Array | None = None
    if camera is not None and cloud.sensors is not None:
        first = np.flatnonzero(cloud.sensors.laser == cloud.sensors.laser[0])
        sheet, _ = sheet_and_window(cloud, first)
        if sheet is not None:
            normal = rotation_from_quaternion(cloud.sensors.rotation[first[0]]) @ sheet.normal
            basis = shared_errors(cloud.points, camera, normal, sigma_cal)
    basis = sigma_cal[:, None] if basis is None else basis
    return along[:, :, None] * basis[:, None, :], sigma_cal


def fit_artefact(cloud: ScanCloud, known: Artefact) -> Shape:
    """Sphere, cylinder or plane of a cloud; ``MeasurementError`` where there is none of this size."""
    points = cloud.points
    camera, ray = rays_of(cloud)
    (shared, _), sigma = shared_of(cloud, camera, ray), np.nan_to_num(cloud.sigma).astype(np.float64)
    if known.kind == "plane":
        plane = largest_plane(points, 0.5, np.random.default_rng(0))
        if plane is None:
            raise MeasurementError("no plane is in the cloud; scan it, or give its region")
        start = (plane.normal * plane.offset, plane.normal, 0.0)
        on = points[np.abs(plane.distance(points)) < 0.5]
        return fit_shape("plane", points, (on.mean(axis=0), *start[1:]), ray, shared, sigma, reach=0.5)
    radius = known.diameter / 2
    at = thin(points, radius / 25)
    facing = camera[at] if camera is not None else np.broadcast_to(points.mean(axis=0) - [0.0, 0.0, 1e4], (len(at), 3))
    normals = normals_of(points, points[at], facing, radius=max(radius / 6, 4 * _spacing(points)))
    found: list[Shape] = []
    for side in (1.0, -1.0) if camera is None else (1.0,):
        if known.kind == "sphere":
            start = (find_sphere(points[at], side * normals, radius), np.zeros(3), radius)
        else:
            start = (*find_cylinder(points[at], side * normals, radius, np.random.default_rng(0)), radius)
        try:
            found.append(fit_shape(known.kind, points, start, ray, shared, sigma, reach=0.06 * radius))
        except MeasurementError:
            if camera is not None:
                raise
    good = [s for s in found if abs(s.radius - radius) < 0.2 * radius]
    if not good:
        raise MeasurementError(
            f"no {known.kind} of diameter {known.diameter:g} mm is in the cloud; give its region, or check its size"
        )
    return max(good, key=lambda s: int(s.used.sum()))


def _spacing(points: Array) -> float:
    """Median distance of a point (N, 3) mm to its nearest neighbour."""
    from scipy.spatial import cKDTree

    some = points[:: max(1, len(points) // 1000)]
    return float(np.median(cKDTree(points).query(some, k=2)[0][:, 1]))


@dataclass(frozen=True, slots=True)
class _Deviations:
    """Points of a scan beside the fitted artefact."""

    points: Array  # (N, 3) mm
    nearest: Array  # (N, 3) mm, on the artefact
    residual: Array  # (N,) mm, signed
    used: Bools  # (N,)


def _judged(
    known: Artefact, sizes: tuple[Size, ...], found: _Deviations, tolerance: float | None, span: float
) -> ArtefactCheck:
    points, nearest, kept = found.points[found.used], found.nearest[found.used], found.residual[found.used]
    error = max((s.error for s in sizes), key=abs) if sizes else _worst_patch(points, kept)
    low, high = np.percentile(kept, [2.5, 97.5])
    return ArtefactCheck(
        artefact=known,
        sizes=sizes,
        error_mm=error,
        form_mm=float(high - low),
        rms_mm=float(np.sqrt(np.mean(kept**2))),
        linearity_percent=_linearity_by_depth(nearest[:, 2], points[:, 2], span),
        points=len(kept),
        span_mm=span,
        within=None if tolerance is None else bool(abs(error) <= tolerance),
        claimed=all(abs(s.error) <= s.uncertainty for s in sizes) if sizes else None,
        where=points,
        deviation=kept,
    )


def _worst_patch(points: Array, residual: Array) -> float:
    """The mean deviation, mm, that is largest in magnitude among the patches (a tenth of the extent) with 30 points or more."""
    side = max(float(np.ptp(points, axis=0).max()) / 10, 1e-9)
    _, patch, count = np.unique(
        np.floor((points - points.min(axis=0)) / side).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    mean = np.bincount(patch.ravel(), weights=residual) / count
    known = mean[count >= min(30, int(count.max()))]
    return float(known[np.argmax(np.abs(known))])


def _linearity_by_depth(nominal: Array, measured: Array, span: float) -> float:
    """Linearity of measured against nominal z in ten classes of depth; NaN where they cover less than 2 % of the span."""
    covered = float(np.ptp(nominal))
    if covered < 0.02 * span or covered <= 0:
        return float("nan")
    place = np.minimum(((nominal - nominal.min()) / covered * 10).astype(np.int64), 9)
    count = np.bincount(place, minlength=10)
    good = count >= 30
    if good.sum() < 3:
        return float("nan")
    x = np.bincount(place, weights=nominal, minlength=10)[good] / count[good]
    y = np.bincount(place, weights=measured, minlength=10)[good] / count[good]
    return _linearity(x, y, span)


def _linearity(nominal: Array, measured: Array, span: float) -> float:
    """Largest residual about the best line, % of ``span``; NaN for fewer than three values."""
    if len(nominal) < 3 or span <= 0:
        return float("nan")
    centre = nominal.mean()
    slope, offset = np.polyfit(nominal - centre, measured, 1)
    return float(100 * np.abs(measured - offset - slope * (nominal - centre)).max() / span)


def _steps(cloud: ScanCloud, known: Artefact, tolerance: float | None, span: float) -> ArtefactCheck:
    """Heights above the base, between parallel planes."""
    points = cloud.points
    camera, ray = rays_of(cloud)
    towards = np.array([0.0, 0.0, -1.0]) if camera is None else camera.mean(axis=0) - points.mean(axis=0)
    spacing = _spacing(points)
    at = thin(points, 2 * spacing)
    facing = camera[at] if camera is not None else points[at] + 1e4 * towards
    normals = normals_of(points, points[at], facing, radius=5 * spacing)
    found = fit_levels(
        points,
        points[at],
        normals,
        towards,
        np.array(known.heights),
        np.random.default_rng(0),
        sigma=cloud.sigma.astype(np.float64),
    )
    shared, unexplained = shared_of(cloud, camera, ray)
    along = np.ones(len(points)) if ray is None else ray @ found.normal
    bent = along * np.nan_to_num(cloud.sigma) * (1.0 - np.abs(along))
    levels = range(len(known.heights) + 1)
    pushed = np.einsum("i,nik->nk", found.normal, shared)
    moved = np.stack([pushed[found.level == k].mean(axis=0) for k in levels])
    # what the sheet's shape leaves unexplained differs from place to place along the stripe
    local = np.array([float(np.median((along * unexplained)[found.level == k])) for k in levels])
    tilted = np.array([float(bent[found.level == k].mean()) for k in levels])
    sizes = []
    for k, nominal in enumerate(known.heights, start=1):
        scatter = found.covariance[k, k] + found.covariance[0, 0] - 2 * found.covariance[0, k]
        parts = (
            float(np.sqrt(max(scatter, 0.0))),
            float(np.sqrt(np.sum((moved[k] - moved[0]) ** 2) + local[k] ** 2 + local[0] ** 2)),
            float(abs(tilted[k] - tilted[0])),
        )
        sizes.append(Size(f"step {nominal:g}", nominal, float(found.offset[k] - found.offset[0]), *parts))
    used = found.level >= 0
    flat = points - found.residual[:, None] * found.normal
    check = _judged(known, tuple(sizes), _Deviations(points, flat, found.residual, used), tolerance, span)
    nominal_levels = np.array([0.0, *(s.nominal for s in sizes)])
    measured = np.array([0.0, *(s.measured for s in sizes)])
    return replace(check, linearity_percent=_linearity(nominal_levels, measured, span))


def _mesh(
    cloud: ScanCloud, known: Artefact, tolerance: float | None, region: Region | None, span: float
) -> ArtefactCheck:
    from scope.model import Surface
    from scope.pose import estimate_pose

    result = estimate_pose(cloud, Path(known.mesh), region=region, part_tolerance=np.inf)
    if result.cloud_from_model is None:
        raise MeasurementError(f"the mesh cannot be compared, its pose is not sure: {result.why}")
    points = cloud.points[result.points]
    local = result.cloud_from_model.inverse.apply(points)
    closest, _ = Surface(result.model.vertices, result.model.faces).nearest(local)
    spread = 1.4826 * float(np.median(np.abs(result.deviation)))
    used = (np.abs(result.deviation) < max(2 * CUT * spread, 0.05)) & (
        np.linalg.norm(local - closest, axis=1) < max(2 * CUT * spread, 0.05)
    )
    nearest = result.cloud_from_model.apply(closest)
    return _judged(known, (), _Deviations(points, nearest, result.deviation, used), tolerance, span)
