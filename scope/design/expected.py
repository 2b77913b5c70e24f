"""What the predicted points make of things one measures: a sphere, a step, a roughness, a pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.geometry import Array
from scope.design.planned import PlannedCalibration, rms_of
from scope.design.prediction import Surface, WorkingMap
from scope.design.stripe import look
from scope.simulation import VirtualRig

_STEEPEST = np.cos(np.radians(60.0))  # surface seen or lit at a steeper angle is not counted on
SPHERE, BLOCK, PATCH, STEP = 20.0, 40.0, 10.0, 10.0  # mm: radius, edge of a cube, side of a patch, height


@dataclass(frozen=True, slots=True, eq=False)
class _Sampled:
    """Places of an object as the scan would bring them onto the sheet."""

    points: Array  # (n, 3) mm
    normal: Array  # (n, 3)
    count: Array  # (n,) points of the scan that each stands for
    noise: Array  # (n,) mm along the normal, of one point of the scan
    shared: Array  # (n, draws) mm along the normal, by the calibration; column 0 without noise


def expected_figures(
    rig: VirtualRig, planned: PlannedCalibration, area: WorkingMap, surface: Surface
) -> dict[str, Any]:
    """Standard uncertainties (k = 1) of a sphere of 40 mm, a step of 10 mm, Sq, and the pose of a cube of 40 mm.

    Each object stands in the middle of the working volume; its points are spaced by a pixel along the stripe and by the
    scan's step across. ``calibration`` is what the planned calibration shares among all points, ``scatter`` what the
    stripe's noise leaves after a least squares fit. What ranging itself gets wrong on slopes and at edges is in neither.
    """
    inside = area.prediction.inside
    middle = np.median(area.prediction.points[inside], axis=0)
    pitch = float(np.median(area.prediction.look.across_mm[inside]))
    cell = pitch * _step(rig, pitch)

    def sampled(points: Array, normal: Array, size: Array) -> _Sampled:
        return _on_sheet(rig, planned, surface.albedo, (points, normal, size / cell))

    sphere = sampled(*_sphere(middle))
    radius = _solved(sphere, np.column_stack([sphere.normal, np.ones(len(sphere.normal))]))
    cube = sampled(*_cube(middle))
    pose = _solved(cube, np.hstack([cube.normal, np.cross(cube.points - middle, cube.normal)]))
    treads = [sampled(*_patch(middle + side * STEP / 2 * surface.normal, surface.normal)) for side in (-1.0, 1.0)]
    levels = [_solved(tread, np.ones((len(tread.points), 1))) for tread in treads]
    noise = float(np.median(np.concatenate([tread.noise for tread in treads])))
    points = float(np.mean([tread.count.sum() for tread in treads]))
    scatter = float(np.sqrt(sum(level[0][0, 0] for level in levels)))
    apart = levels[1][1] - levels[0][1]
    shared = float(rms_of(apart)[0])
    spread, moved = np.sqrt(np.diag(pose[0])), rms_of(pose[1])
    return {
        "sphere": {"diameter_mm": 2 * SPHERE, **_two(2 * float(np.sqrt(radius[0][3, 3])), 2 * float(rms_of(radius[1])[3]), 2 * radius[1][3, 0])},
        "step": {"height_mm": STEP, **_two(scatter, shared, apart[0, 0])},
        "Sq": {"patch_mm": PATCH, "noise_floor_mm": noise, "sigma_mm": noise / float(np.sqrt(max(points, 1.0)))},
        "pose": {
            "cube_mm": BLOCK,
            **_two(float(np.linalg.norm(spread[:3])), float(np.linalg.norm(moved[:3])), float(np.linalg.norm(pose[1][:3, 0]))),
            "rotation_deg": float(np.degrees(np.hypot(np.linalg.norm(spread[3:]), np.linalg.norm(moved[3:])))),
        },
    }  # fmt: skip


def _two(scatter: float, calibration: float, constant: float) -> dict[str, float]:
    """``constant`` is the part of ``calibration`` that every calibration of this design has alike."""
    total = float(np.hypot(scatter, calibration))
    return {
        "sigma_mm": total,
        "scatter_mm": scatter,
        "calibration_mm": calibration,
        "constant_mm": abs(float(constant)),
    }


def _step(rig: VirtualRig, pitch: float) -> float:
    """Distance, mm across, from frame to frame; without a linear motion, that of neighbours along the stripe."""
    motion = rig.design.motion
    if motion is not None and motion.kind == "linear" and motion.step and motion.direction is not None:
        along = np.array(motion.direction) / np.linalg.norm(motion.direction)
        return max(abs(motion.step) * float(np.linalg.norm(along[:2])), 1e-3)
    return pitch


def _solved(seen: _Sampled, rows: Array) -> tuple[Array, Array]:
    """Covariance (P, P) from the scatter, and errors (P, draws) from the calibration, of a least squares fit."""
    weighted = rows * seen.count[:, None]
    inverse = np.linalg.pinv(weighted.T @ rows)
    covariance = inverse @ ((weighted * (seen.noise**2)[:, None]).T @ rows) @ inverse
    return covariance, inverse @ (weighted.T @ seen.shared)


def _on_sheet(
    rig: VirtualRig, planned: PlannedCalibration, albedo: float, surface: tuple[Array, Array, Array]
) -> _Sampled:
    """Places (points, normals, counts) that camera and laser see, carried across onto the sheet."""
    points, normals, count = surface
    across = np.array([0.0, 1.0, 0.0]) if rig.along == "rows" else np.array([1.0, 0.0, 0.0])
    there = points.copy()
    for _ in range(6):
        off = rig.laser.reach(there)[1]
        there = there - (off / (rig.laser.sheet_normal(there) @ across))[:, None] * across
    seen = look(rig, there, normals, albedo=albedo)
    light, _ = rig.laser.reach(there)
    toward, lit = (-np.einsum("ni,ni->n", rays, normals) for rays in (seen.view, light.direction))
    with np.errstate(invalid="ignore"):
        good = (toward > _STEEPEST) & (lit > _STEEPEST) & np.isfinite(seen.sigma)
    if good.sum() < 3:
        nothing = np.zeros(0)
        return _Sampled(np.zeros((0, 3)), np.zeros((0, 3)), nothing, nothing, np.zeros((0, 2)))
    # along the ray away from the camera is against the normal
    shared = -planned.errors(there[good]) * toward[good, None]
    return _Sampled(points[good], normals[good], count[good], seen.sigma[good] * toward[good], shared)


def _sphere(middle: Array) -> tuple[Array, Array, Array]:
    """Points, normals and areas seen along z (n,) of the half of a sphere that faces the camera: even rings of one area."""
    rings = 30
    radius = SPHERE * np.sqrt((np.arange(rings) + 0.5) / rings)
    angle = 2 * np.pi * (np.arange(36) + 0.5) / 36
    r, a = (grid.ravel() for grid in np.meshgrid(radius, angle))
    normal = np.column_stack([r * np.cos(a), r * np.sin(a), -np.sqrt(SPHERE**2 - r**2)]) / SPHERE
    return middle + SPHERE * normal, normal, np.full(len(r), np.pi * SPHERE**2 / len(r))


def _patch(middle: Array, normal: Array, side: float = PATCH) -> tuple[Array, Array, Array]:
    """A square patch about a point, with the area (n,) that each of its places shows along z."""
    n = 12
    first = np.cross(normal, [0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 else [1.0, 0.0, 0.0])
    first = first / np.linalg.norm(first)
    offset = side * ((np.arange(n) + 0.5) / n - 0.5)
    a, b = (grid.ravel() for grid in np.meshgrid(offset, offset))
    points = middle + a[:, None] * first + b[:, None] * np.cross(normal, first)
    return points, np.broadcast_to(normal, points.shape), np.full(n * n, side**2 / n**2 * abs(float(normal[2])))


def _cube(middle: Array) -> tuple[Array, Array, Array]:
    """The three faces that a cube on its corner turns to the camera."""
    faces = []
    for k in range(3):
        azimuth = 2 * np.pi * k / 3 + 0.3
        normal = np.array([np.sqrt(2 / 3) * np.cos(azimuth), np.sqrt(2 / 3) * np.sin(azimuth), -np.sqrt(1 / 3)])
        faces.append(_patch(middle + BLOCK / 2 * normal, normal, BLOCK))
    points, normals, areas = (np.concatenate(parts) for parts in zip(*faces, strict=True))
    return points, normals, areas
