"""The calibration that the jig will give, before it is made: what its spots and stripes leave uncertain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Plane, Pose, fit_plane
from calibration.rays import PlaneMarks, RayField, fit_ray_field
from calibration.sheet import CurvedSheet, SheetFrame, StripePoints, fit_laser, order_of
from calibration.volume import Volume
from scope.design.spots import PlannedPlane
from scope.design.stripe import look
from scope.simulation import VirtualRig, exact_rays, project

TUKEY = 4.685  # as the sheet is fitted
_DRAWS = 48  # calibrations that are drawn
_LINES, _LINES_BENT = 80, 300  # points that stand for all lines of a stripe; of one whose bend must be told from noise


@dataclass(frozen=True, slots=True, eq=False)
class PlannedCalibration:
    """Errors of many calibrations of one design, by linear theory about the exact rays and sheet.

    Draw 0 is what noise-free marks would leave: the part of lens and window that the models cannot follow.
    """

    rig: VirtualRig
    field: RayField
    wrong: Array  # (terms, 2, draws) mm, of the coefficients of the field
    volume: Volume
    plane: Plane  # about which the sheet is described
    frame: SheetFrame
    sheet: Array  # (P, draws) mm, parameters of the fitted sheets
    order: int

    def errors(self, points: Array) -> Array:
        """Errors (N, draws) mm along the ray of points (N, 3) of the sheet; column 0 without noise.

        A ray that is off by d and a sheet that is off by h along its normal n move the point by (h - n . d) / (n . v)
        along its ray v.
        """
        pixels = project(self.rig.camera, points)
        view = exact_rays(self.rig.camera, pixels).direction
        normal = self.rig.laser.sheet_normal(points)
        off = _ray_errors(self.field, self.wrong, pixels, points)
        lifted = self.frame.terms(points, order=self.order) @ self.sheet - self.plane.distance(points)[:, None]
        lifted = lifted * (normal @ self.plane.normal)[:, None]
        across = np.einsum("ni,nik->nk", normal, off)
        return np.asarray((lifted - across) / np.einsum("ni,ni->n", normal, view)[:, None])

    def sigma_at(self, points: Array) -> Array:
        """Expected rms error (N,) mm along the ray, noise and what the models cannot follow together."""
        errors = self.errors(points)
        return rms_of(errors)


def rms_of(errors: Array) -> Array:
    """Rms (N,) over the draws of errors (N, draws) whose column 0 is without noise."""
    noise = errors[:, 1:] - errors[:, :1]
    return np.asarray(np.sqrt(errors[:, 0] ** 2 + (noise**2).mean(axis=1)))


def plan_calibration(rig: VirtualRig, planes: list[PlannedPlane], rng: np.random.Generator) -> PlannedCalibration:
    """Plan the calibration of rays and sheet on the jig's planes.

    Raises
    ------
    CalibrationError
        Too few spots or stand-offs, or a sheet that misses the planes.
    """
    shown = [plane for plane in planes if len(plane.pixels) >= 4]
    if len(shown) < 2:
        raise CalibrationError(
            f"the camera sees four spots or more at {len(shown)} of {len(planes)} stand-offs; two are needed: move the jig "
            "into view"
        )
    marks = [_marks(rig, plane, planes.index(plane), rng) for plane in shown]
    chosen = fit_ray_field(marks).field  # with noise, which has a say in its orders
    exact = [_marks(rig, plane, planes.index(plane), None) for plane in shown]
    field = fit_ray_field(exact, orders=(chosen.slope_order, chosen.origin_order)).field
    wrong = _coefficient_errors(field, exact, np.concatenate([plane.sigma for plane in shown]), rng)
    volume = Volume.around(np.concatenate([m.world for m in exact]), np.array([0.0, 0.0, 1.0]))
    return _with_sheet(rig, field, wrong, volume, planes, shown, rng)


def _marks(rig: VirtualRig, plane: PlannedPlane, k: int, rng: np.random.Generator | None) -> PlaneMarks:
    pixels = plane.pixels
    if rng is not None:
        pixels = pixels + plane.sigma[:, None] * rng.standard_normal(pixels.shape)
    covariance = plane.sigma[:, None, None] ** 2 * np.eye(2)
    return PlaneMarks(plane.name, pixels, plane.points, rig.stated[k], plane.mark, covariance)


def _coefficient_errors(field: RayField, marks: list[PlaneMarks], sigma: Array, rng: np.random.Generator) -> Array:
    """Drawn errors (terms, 2, draws) of the coefficients; draw 0 is zero."""
    pixels = np.concatenate([m.pixels for m in marks])
    depth = field.depth(np.concatenate([m.world for m in marks]))
    rows = field.design(pixels, depth)
    scale = np.abs(np.linalg.det(field.jacobian(pixels, depth)))  # mm^2/px^2
    weighted = rows / np.maximum(scale, 1e-30)[:, None]
    normal = weighted.T @ rows
    spread = (weighted * (sigma**2)[:, None]).T @ rows
    solved = np.linalg.solve(normal, np.linalg.solve(normal, spread).T)
    values, vectors = np.linalg.eigh((solved + solved.T) / 2)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = np.einsum("tp,pck->tck", root, rng.standard_normal((len(root), 2, _DRAWS)))
    return np.concatenate([np.zeros((len(root), 2, 1)), drawn], axis=2)


def _ray_errors(field: RayField, wrong: Array, pixels: Array, points: Array) -> Array:
    """Displacements (N, 3, draws) mm, across depth, of the field's rays of pixels at points against the exact rays."""
    depth = field.depth(points)
    exact = (points @ field.c_from_d)[:, :2]
    bias = field.crossing(pixels, depth) - exact
    drawn = np.einsum("nt,tck->nck", field.design(pixels, depth), wrong) + bias[:, :, None]
    return np.asarray(np.einsum("ic,nck->nik", field.c_from_d[:, :2], drawn))


def _with_sheet(
    rig: VirtualRig, field: RayField, wrong: Array, volume: Volume, planes: list[PlannedPlane],
    shown: list[PlannedPlane], rng: np.random.Generator,
) -> PlannedCalibration:  # fmt: skip
    """Fit the sheet of every draw to the stripes on the planes."""
    points, names, noise, weight, off, sides = [], [], [], [], [], []
    for plane in shown:
        k = planes.index(plane)
        pose, stated = rig.actual[k], rig.stated[k]  # where the light falls, and where it is believed to
        lit = stripe_on_plane(rig, plane, pose)
        if len(lit) < 2:
            continue
        seen = look(rig, lit, -np.sign(pose.rotation[2, 2]) * pose.rotation[:, 2], albedo=1.0, dark_images=rig.design.jig.laser_images * (rig.design.camera.ambient > 0))  # fmt: skip
        lines = max(float(np.ptp(seen.pixels[:, 0 if rig.along == "rows" else 1])), 1.0)
        moved = _ray_errors(field, wrong, seen.pixels, lit)
        face = stated.rotation[:, 2]  # onto the stated plane, along the ray
        steep = np.einsum("ni,i->n", seen.view, face)
        beyond = np.einsum("i,nik->nk", face, moved) + ((lit - stated.translation) @ face)[:, None]
        moved = moved - seen.view[:, :, None] * (beyond / steep[:, None])[:, None, :]
        each = seen.sigma_px * np.abs(np.einsum("ni,ni->n", seen.normal, seen.view)) * seen.along_ray
        points.append(lit)
        names.append(plane.name)
        off.append(np.einsum("ni,nik->nk", seen.normal, moved) + seen.skew[:, None])
        sides.append(seen.normal)
        noise.append(each / np.sqrt(rig.design.jig.laser_images))
        weight.append(np.full(len(lit), np.sqrt(len(lit) / lines)))  # of each place, which stands for several lines
    if len(points) < 2:
        raise CalibrationError(
            f"the sheet of light crosses the spots at {len(points)} of {len(planes)} stand-offs; two are needed: aim the laser "
            "through the middle of the jig, or turn it about its axis (roll)"
        )
    flat = np.concatenate(points)
    base, order, frame = _shape(rig, points, names, noise, rng)
    terms = frame.terms(flat, order=order)
    spread = np.nan_to_num(np.concatenate(noise) * np.concatenate(weight), posinf=1.0)
    side = np.sign(np.concatenate(sides) @ base.normal)
    height = base.distance(flat)[:, None] + side[:, None] * np.concatenate(off)
    drawn = spread[:, None] * rng.standard_normal((len(flat), _DRAWS))
    height[:, 1:] += drawn
    line = np.nan_to_num(np.concatenate(noise), posinf=1.0)
    # as the sheet is fitted: by the stripes' noise about its median, and by how many lines a place stands for
    balance = 1.0 / (np.clip(line / np.median(line), 0.5, 3.0) * np.concatenate(weight)) ** 2
    root = np.sqrt(balance * _robust(terms, height[:, 0], line, balance, rng))[:, None]
    sheet = np.linalg.lstsq(terms * root, height * root, rcond=None)[0]
    return PlannedCalibration(rig, field, wrong, volume, base, frame, np.asarray(sheet), order)


def _robust(terms: Array, height: Array, noise: Array, balance: Array, rng: np.random.Generator) -> Array:
    """Tukey's weights (n,) that the fit of the sheet will end with: a misplaced plane's stripe is left out by it."""
    weight, line = np.ones(len(height)), noise * rng.standard_normal(len(height))
    for _ in range(20):
        root = np.sqrt(balance * weight)
        off = height - terms @ np.linalg.lstsq(terms * root[:, None], height * root, rcond=None)[0]
        scale = max(1.4826 * float(np.median(np.abs(off + line))), 1e-9)
        weight = np.where(np.abs(off) < TUKEY * scale, (1.0 - (off / (TUKEY * scale)) ** 2) ** 2, 1e-9)
    return np.asarray(weight)


def _shape(
    rig: VirtualRig, points: list[Array], names: list[str], noise: list[Array], rng: np.random.Generator
) -> tuple[Plane, int, SheetFrame]:
    """Plane, order and frame in which the sheet will be described: flat, or as curved as noise lets it be seen."""
    flat = np.concatenate(points)
    base = fit_plane(flat)
    if rig.camera.window is not None:
        normal = base.normal
        noisy = [p + (s * rng.standard_normal(len(p)))[:, None] * normal for p, s in zip(points, noise, strict=True)]
        stripes = [StripePoints(name, p, np.maximum(s, 1e-6)) for name, p, s in zip(names, noisy, noise, strict=True)]
        found = fit_laser("planned", stripes, along=rig.along, channel="gray")
        if isinstance(found.sheet, CurvedSheet):
            return found.sheet.plane, order_of(len(found.covariance)), found.frame
    centre = flat.mean(axis=0)
    axes = np.linalg.svd(flat - centre, full_matrices=False)[2][:2]
    return base, 1, SheetFrame(centre, axes, max(float(np.abs((flat - centre) @ axes.T).max()), 1e-9))


def stripe_on_plane(rig: VirtualRig, plane: PlannedPlane, pose: Pose) -> Array:
    """Points (n, 3) mm in C of the stripe on a plane, between its marks and in view."""
    angle = np.linspace(-rig.laser.half_fan, rig.laser.half_fan, 3201)[1:-1]
    rays = rig.laser.rays(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((pose.translation - rays.origin) @ pose.rotation[:, 2]) / (rays.direction @ pose.rotation[:, 2])
    points = rays.at(np.where(t > 0, t, np.nan))
    flat = pose.inverse.apply(points)[:, :2]
    pixels = project(rig.camera, points)
    columns, rows = rig.camera.size
    low, high = plane.points.min(axis=0), plane.points.max(axis=0)
    inside = (
        np.isfinite(pixels).all(axis=1) & (pixels > 2).all(axis=1) & (pixels < [columns - 3, rows - 3]).all(axis=1)
        & (flat >= low).all(axis=1) & (flat <= high).all(axis=1)
    )  # fmt: skip
    kept = np.asarray(points[inside])
    most = _LINES if rig.camera.window is None else _LINES_BENT
    if len(kept) > most:
        kept = kept[np.unique(np.linspace(0, len(kept) - 1, most).astype(int))]
    return np.asarray(kept)
