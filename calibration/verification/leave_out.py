"""How good the rays are: on planes that the camera has not seen, and by the covariance of their own fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calibration.camera import Camera
from calibration.errors import CalibrationError
from calibration.geometry import Array, Rays
from calibration.rays import FreehandFit, PlaneMap, PlaneMarks, RayField, TwoPlaneFit, locate_target, refit_without, rms
from calibration.verification.support import AROUND, support_of

FEWEST = 0.2  # of a plane's marks that others must support


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Marks of one plane against the rays of a camera that has not seen that plane."""

    name: str
    rms_mm: float  # rms distance of the marks from their rays
    rms_px: float  # the same in px
    bias_mm: Array  # (3,) mean offset of the marks from their rays, in C
    n: int  # marks
    between: bool  # whether the plane stands between others, so that rays were interpolated
    why: str = ""  # why the figures are withheld (NaN), where they are


def held_out(fit: TwoPlaneFit, *, model: Literal["two-plane", "joint"] = "joint") -> tuple[HeldOut, ...]:
    """Leave every plane out in turn and test the rays of the others on it.

    Parameters
    ----------
    fit : TwoPlaneFit
        Orders, domain and pivot of its joint field are kept and the coefficients fitted again without the plane; the
        plane maps need no new fit.
    model : "two-plane" or "joint"
        Which rays are tested: of the two planes nearest to the one left out, or of the joint field.

    Returns
    -------
    tuple of HeldOut, by depth
        Empty for two planes, of which one alone makes no rays. Planes at either end are extrapolated
        (``between`` False) and so are worse than anything ranged inside the calibrated volume. Only marks are counted around
        whose pixels two other planes have marks, too (within 1.3 of their hull): elsewhere nothing but the smoothness of the
        field says anything. Where they are fewer than `FEWEST` of the plane, its figures are withheld.
    """
    if len(fit.marks) < 3:
        return ()
    field = fit.joint.field
    without = _fields_without(field, fit.marks) if model == "joint" else []
    found = []
    for k, marks in enumerate(fit.marks):
        others, maps = fit.marks[:k] + fit.marks[k + 1 :], fit.camera.maps[:k] + fit.camera.maps[k + 1 :]
        if model == "two-plane":
            pair = _nearest(maps, field, marks)
            others, maps = tuple(others[i] for i in pair), tuple(maps[i] for i in pair)
        seen = support_of(marks.pixels, others, enlarged=AROUND).sum(axis=0) >= 2
        between = 0 < k < len(fit.marks) - 1
        if seen.sum() < max(FEWEST * len(marks), 3):
            found.append(_withheld(marks, int(seen.sum()), between=between))
            continue
        marks = marks.select(seen)
        rays = without[k].rays(marks.pixels) if model == "joint" else _two_plane_rays(maps, field, marks)
        found.append(_against(rays, field, marks, between=between))
    return tuple(found)


def _withheld(marks: PlaneMarks, seen: int, *, between: bool) -> HeldOut:
    nan = float("nan")
    why = f"two other planes have marks around {seen} of its {len(marks)} marks only"
    return HeldOut(marks.name, nan, nan, np.full(3, nan), 0, between, why)


def _fields_without(field: RayField, planes: Sequence[PlaneMarks]) -> list[RayField]:
    """The joint field fitted again without each plane.

    The rows of the plane are taken out of the normal equations of an orthonormal basis: (I - Q_k' Q_k) c = Q_-k' y.
    """
    depth = [field.depth(p.world) for p in planes]
    across = [(p.world @ field.c_from_d)[:, :2] for p in planes]
    root = [
        1.0 / np.sqrt(np.maximum(np.abs(np.linalg.det(field.jacobian(p.pixels, d))), 1e-30))
        for p, d in zip(planes, depth, strict=True)
    ]
    rows = np.concatenate([field.design(p.pixels, d) * w[:, None] for p, d, w in zip(planes, depth, root, strict=True)])
    q, r = np.linalg.qr(rows)
    y = np.concatenate([x * w[:, None] for x, w in zip(across, root, strict=True)])
    last = np.cumsum([len(p) for p in planes])
    found = []
    for first, end in zip(np.concatenate([[0], last[:-1]]), last, strict=True):
        own = q[first:end]
        left = np.eye(q.shape[1]) - own.T @ own
        rhs = q.T @ y - own.T @ y[first:end]
        found.append(replace(field, coefficients=np.linalg.solve(r, np.linalg.lstsq(left, rhs, rcond=1e-10)[0])))
    return found


def against(camera: Camera, marks: PlaneMarks) -> HeldOut:
    """Marks that the camera has not seen (``scope verify --with``) against its rays."""
    depth = float(marks.world[:, 2].mean())
    rays = camera.rays(marks.pixels, near=depth if camera.model == "two-plane" else None)
    world = marks.world
    offset = _perpendicular(rays, world)
    movement = camera.shift(marks.pixels, world)  # (n, 3, 2)
    px = _to_px(movement, rays, offset)
    inside = camera.volume.contains(world, margin=0.0)
    return HeldOut(marks.name, rms(offset), rms(px), offset.mean(axis=0), len(marks), bool(inside.mean() > 0.5))


def leave_views_out(fit: FreehandFit) -> tuple[HeldOut, ...]:
    """Leave every freehand view out in turn and test the pinhole of the others on it.

    The view's own pose has to be estimated from it, by the rays of the others, so that the six numbers of a pose are
    missing from the error: what is left is how well the rays of a camera that never saw the view fit its flat target.
    Empty with fewer than four views. No view is "between" others.
    """
    if len(fit.views) < 4:
        return ()
    found = []
    for k, view in enumerate(fit.views):
        camera = refit_without(fit, k)
        try:
            placed = locate_target(camera, view)
        except CalibrationError:
            placed = view  # the pose from the fit with all views
        rays = camera.rays(view.pixels)
        offset = _perpendicular(rays, placed.world)
        px = _to_px(camera.shift(view.pixels, placed.world), rays, offset)
        found.append(HeldOut(view.name, rms(offset), rms(px), offset.mean(axis=0), len(view), False))
    return tuple(found)


def _nearest(maps: tuple[PlaneMap, ...], field: RayField, marks: PlaneMarks) -> list[int]:
    """The two maps nearest in depth to the plane of the marks."""
    depth = np.array([float(field.depth(m.points(marks.pixels)).mean()) for m in maps])
    here = float(field.depth(marks.world).mean())
    return sorted(int(i) for i in np.argsort(np.abs(depth - here))[:2])


def _two_plane_rays(maps: tuple[PlaneMap, ...], field: RayField, marks: PlaneMarks) -> Rays:
    """Rays through two maps."""
    a, b = maps[0].points(marks.pixels), maps[1].points(marks.pixels)
    if field.forward < 0:
        a, b = b, a
    return Rays(a, (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True))


def _against(rays: Rays, field: RayField, marks: PlaneMarks, *, between: bool) -> HeldOut:
    offset = _perpendicular(rays, marks.world)
    across = field.jacobian(marks.pixels, field.depth(marks.world))
    movement = np.einsum("ij,njk->nik", field.c_from_d[:, :2], across)
    px = _to_px(movement, rays, offset)
    return HeldOut(marks.name, rms(offset), rms(px), offset.mean(axis=0), len(marks), between)


def _perpendicular(rays: Rays, points: Array) -> Array:
    away = points - rays.origin
    along = np.einsum("ni,ni->n", away, rays.direction)
    return np.asarray(away - along[:, None] * rays.direction)


def _to_px(movement: Array, rays: Rays, offset: Array) -> Array:
    """Offsets (n, 3) across the rays as movements (n, 2) px in the image, by least squares across the ray."""
    along = np.einsum("nik,ni->nk", movement, rays.direction)
    across = movement - rays.direction[:, :, None] * along[:, None, :]
    return np.asarray(np.einsum("nki,ni->nk", np.linalg.pinv(across), offset))
