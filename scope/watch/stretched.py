"""A rig under a small affine map of its own coordinates: what planes cannot see of it, once an artefact has shown it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.geometry import Array, Plane, Pose
from calibration.rays import PinholeCamera, PlaneMap, RayField, TwoPlaneCamera, exponents
from calibration.rig import AnyCamera, Rig
from calibration.sheet import CurvedSheet, Laser, Sheet, SheetFrame
from calibration.stages import Stage
from calibration.volume import Volume

_ORTHOGONAL = 1e-9


def stretched(rig: Rig, matrix: Array) -> Rig:
    """The rig whose points are ``matrix`` (3, 3) times those of ``rig``: G x for every x in C.

    Rays stay rays and sheets sheets, so that every pixel's point moves exactly so. The direction of a linear stage stays as it
    is (the motion is a standard of its own), the axis of a turntable moves. Covariances are kept, since G is near 1.

    Raises
    ------
    ValueError
        A pinhole camera, whose rays only stay its rays under a turn and one scale, and another matrix; a mirror.
    """
    g = np.asarray(matrix, dtype=np.float64)
    if g.shape != (3, 3) or not np.isfinite(g).all() or np.linalg.det(g) <= 0:
        raise ValueError("a finite matrix (3, 3) that mirrors nothing is needed")
    return replace(
        rig, camera=_camera(rig.camera, g), lasers={name: _laser(laser, g) for name, laser in rig.lasers.items()},
        stages=tuple(_stage(stage, g) for stage in rig.stages),
    )  # fmt: skip


def _camera(camera: AnyCamera, g: Array) -> AnyCamera:
    if isinstance(camera, PinholeCamera):
        scale = float(np.cbrt(np.linalg.det(g)))
        turn = g / scale
        if np.abs(turn @ turn.T - np.eye(3)).max() > _ORTHOGONAL:
            raise ValueError("a pinhole camera can be turned and scaled as a whole, and no more")
        pose = Pose(turn @ camera.c_from_camera.rotation, g @ camera.c_from_camera.translation)
        return replace(camera, c_from_camera=pose, volume=_volume(camera.volume, g))
    maps = tuple(_map(m, g) for m in camera.maps)
    return TwoPlaneCamera(maps, _field(camera.field, g), camera.size, _volume(camera.volume, g), camera.model)


def _volume(volume: Volume, g: Array) -> Volume:
    normals = volume.normals @ np.linalg.inv(g)
    length = np.linalg.norm(normals, axis=1)
    return Volume(normals / length[:, None], volume.offsets / length)


def _map(plane: PlaneMap, g: Array) -> PlaneMap:
    turn, across = np.linalg.qr(g @ plane.c_from_plane.rotation[:, :2])
    sign = np.sign(np.diag(across))
    turn, across = turn * sign, across * sign[:, None]
    rotation = np.column_stack([turn, np.cross(turn[:, 0], turn[:, 1])])
    return replace(
        plane,
        coefficients=plane.coefficients @ across.T,
        c_from_plane=Pose(rotation, g @ plane.c_from_plane.translation),
    )


def _field(field: RayField, g: Array) -> RayField:
    """In the depth frame the map is a turn after an upper triangle, under which planes of one depth stay so."""
    turn, upper = np.linalg.qr(field.c_from_d.T @ g @ field.c_from_d)
    sign = np.sign(np.diag(upper))
    turn, upper = turn * sign, upper * sign[:, None]
    coefficients = field.coefficients @ upper[:2, :2].T
    slope = len(exponents(field.slope_order))
    for first, lever in ((0, field.reach), (slope, field.pivot)):
        constant = first + exponents(field.slope_order if first == 0 else field.origin_order).index((0, 0))
        coefficients[constant] += lever * upper[:2, 2]
    depth = float(upper[2, 2])
    return replace(
        field, c_from_d=field.c_from_d @ turn, pivot=field.pivot * depth, reach=field.reach * depth, coefficients=coefficients,
        depths=field.depths * depth,
    )  # fmt: skip


def _laser(laser: Laser, g: Array) -> Laser:
    sheet = laser.sheet
    base = sheet.plane if isinstance(sheet, CurvedSheet) else sheet
    plane = _plane(base, g)  # type: ignore[arg-type]
    frame = _frame(laser.frame, plane, g)
    moved: Sheet = plane
    if isinstance(sheet, CurvedSheet):
        moved = _curved(sheet, plane, g)
    return replace(laser, sheet=moved, frame=frame, origin=g @ laser.origin)


def _plane(plane: Plane, g: Array) -> Plane:
    normal = plane.normal @ np.linalg.inv(g)
    length = float(np.linalg.norm(normal))
    return Plane(normal / length, plane.offset / length)


def _frame(frame: SheetFrame, plane: Plane, g: Array) -> SheetFrame:
    """Axes within the moved plane, as near to the moved ones as right angles allow."""
    moved = frame.axes @ g.T
    moved = moved - (moved @ plane.normal)[:, None] * plane.normal
    left, _, right = np.linalg.svd(moved, full_matrices=False)
    return SheetFrame(g @ frame.centre, left @ right, frame.reach)


def _curved(sheet: CurvedSheet, plane: Plane, g: Array) -> CurvedSheet:
    """The departure fitted anew at moved points of the sheet: of the same order, since the map is linear."""
    a, b = (side.ravel() for side in np.meshgrid(np.linspace(-1, 1, 25), np.linspace(-1, 1, 25)))
    frame = sheet.frame
    flat = frame.centre + frame.reach * (np.outer(a, frame.axes[0]) + np.outer(b, frame.axes[1]))
    flat = flat - sheet.plane.distance(flat)[:, None] * sheet.plane.normal
    points = (flat + sheet.departure(flat)[:, None] * sheet.plane.normal) @ g.T
    new = _frame(frame, plane, g)
    terms = new.terms(points, order=sheet.order)
    found = np.linalg.lstsq(terms, plane.distance(points), rcond=None)[0]
    # tilts and offset of the fit belong to the base plane
    lift = new.centre - plane.distance(new.centre[None])[0] * plane.normal
    corners = lift + new.reach * np.array([[0, 0], [1, 0], [0, 1]]) @ new.axes
    height = np.array([[0.0, 0, 1], [1, 0, 1], [0, 1, 1]]) @ found[:3]
    p = corners + height[:, None] * plane.normal
    normal = np.cross(p[1] - p[0], p[2] - p[0])
    base = Plane.through(p[0], normal * np.sign(normal @ plane.normal))
    curvature = np.asarray(
        np.linalg.lstsq(new.terms(points, order=sheet.order)[:, 3:], base.distance(points), rcond=None)[0],
        dtype=np.float64,
    )
    return CurvedSheet(base, new, curvature)


def _stage(stage: Stage, g: Array) -> Stage:
    if stage.kind == "linear":
        return replace(stage, point=g @ stage.point)
    axis = g @ stage.direction
    return replace(stage, direction=axis / np.linalg.norm(axis), point=g @ stage.point)
