"""All that is predicted at points of the sheet of light, and where within the working volume they lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Bools
from calibration.volume import Volume
from scope.design.planned import PlannedCalibration
from scope.design.stripe import StripeLook, look
from scope.simulation import VirtualRig, project

_DEPTHS, _ACROSS = 21, 41  # of the maps


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Figures at N points."""

    points: Array  # (N, 3) mm in C, on the sheet
    look: StripeLook
    sigma_cal: Array  # (N,) mm along the ray
    angle: Array  # (N,) rad between sighting ray and sheet
    inside: Bools  # (N,) in the image, in the laser's fan and within the calibrated volume


@dataclass(frozen=True, slots=True, eq=False)
class WorkingMap:
    """The sheet of light within the working volume, on a grid of depth and place across."""

    depth: Array  # (D,) mm, z in C
    across: Array  # (A,) mm, x in C where the stripe runs along rows, y where along columns
    axis: str  # "x" or "y"
    prediction: Prediction  # of D * A points, row by row
    volume: Volume  # that is calibrated

    def holds(self, rig: VirtualRig, points: Array) -> Bools:
        """Whether points (N, 3) of the sheet are in the image, in the fan and within the calibrated volume."""
        return in_view(rig, self.volume, points, project(rig.camera, points))

    def grid(self, values: Array) -> Array:
        """Values (N,) as (D, A), NaN outside the volume."""
        return np.where(self.prediction.inside, values, np.nan).reshape(len(self.depth), len(self.across))


@dataclass(frozen=True, slots=True)
class Surface:
    """What the laser will shine on."""

    albedo: float = 1.0
    tilt: tuple[float, float] = (0.0, 0.0)  # rad about x, then y, from facing the camera

    @property
    def normal(self) -> Array:
        """Unit normal (3,), towards the camera."""
        about_x, about_y = self.tilt
        return np.array([-np.sin(about_y) * np.cos(about_x), np.sin(about_x), -np.cos(about_y) * np.cos(about_x)])


def predict(rig: VirtualRig, planned: PlannedCalibration, points: Array, surface: Surface) -> Prediction:
    """Predict at points (N, 3) mm of the sheet."""
    motion = rig.design.motion
    seen = look(
        rig, points, surface.normal, albedo=surface.albedo, dark_images=0 if motion is None else motion.off_images
    )
    inside = in_view(rig, planned.volume, points, seen.pixels)
    with np.errstate(invalid="ignore"):
        angle = np.arcsin(np.clip(np.abs(np.einsum("ni,ni->n", seen.normal, seen.view)), 0.0, 1.0))
    return Prediction(points, seen, planned.sigma_at(points), angle, inside)


def in_view(rig: VirtualRig, volume: Volume, points: Array, pixels: Array) -> Bools:
    """Whether points (N, 3) of the sheet, seen at pixels (N, 2), are in the image, in the fan and within the volume."""
    columns, rows = rig.camera.size
    with np.errstate(invalid="ignore"):
        shown = (pixels > 2).all(axis=1) & (pixels < [columns - 3, rows - 3]).all(axis=1)
        return np.asarray(shown & volume.contains(points) & _in_fan(rig, points))


def working_map(rig: VirtualRig, planned: PlannedCalibration, surface: Surface) -> WorkingMap:
    """Predict all over the sheet between the first and the last stand-off.

    Raises
    ------
    CalibrationError
        A sheet that has no point in the image and between the spots.
    """
    low, high = min(rig.design.jig.stand_offs), max(rig.design.jig.stand_offs)
    depth = np.linspace(low, high, _DEPTHS)
    column = 0 if rig.along == "rows" else 1
    angle = np.linspace(-rig.laser.half_fan, rig.laser.half_fan, 801)[1:-1]
    lines = [rig.laser.rays(angle).at_depth(z) for z in depth]
    fine = np.concatenate(lines)
    pixels = project(rig.camera, fine)
    columns, rows = rig.camera.size
    with np.errstate(invalid="ignore"):
        kept = (pixels > 2).all(axis=1) & (pixels < [columns - 3, rows - 3]).all(axis=1) & planned.volume.contains(fine)
    if not kept.any():
        raise CalibrationError(
            f"the sheet of light misses the working volume: between z = {low:g} and {high:g} mm no point of it is in the image "
            "and between the spots; aim [laser] `through` a point that the camera sees there"
        )
    across = np.linspace(fine[kept, column].min(), fine[kept, column].max(), _ACROSS)
    points = np.concatenate([_at(line, across, column) for line in lines])
    return WorkingMap(depth, across, "xy"[column], predict(rig, planned, points, surface), planned.volume)


def _at(line: Array, across: Array, column: int) -> Array:
    """Points (A, 3) of the sheet at one depth, by their place across; NaN beyond the fan."""
    order = np.argsort(line[:, column])
    found = [np.interp(across, line[order, column], line[order, k], left=np.nan, right=np.nan) for k in range(3)]
    return np.stack(found, axis=1)


def _in_fan(rig: VirtualRig, points: Array) -> Bools:
    rays, _ = rig.laser.reach(points)
    angle = np.arctan2(rays.direction @ rig.laser.along, rays.direction @ rig.laser.axis)
    return np.asarray(np.abs(angle) < rig.laser.half_fan)


def onto_sheet(rig: VirtualRig, points: Array) -> tuple[Array, Array]:
    """Where points (N, 3) mm meet the sheet, in C, and by how much (N,) the motion moves them for that (mm; NaN: it does not).

    A linear motion carries a point along; without one, the nearest point of the sheet at the same depth is taken.
    """
    motion = rig.design.motion
    if motion is not None and motion.kind == "linear" and motion.direction is not None:
        along = np.array(motion.direction) / np.linalg.norm(motion.direction)
        along = np.broadcast_to(along if motion.moves == "object" else -along, points.shape)
        way = 1.0
    else:
        along, way = rig.laser.sheet_normal(points) * [1.0, 1.0, 0.0], np.nan
        along = along / np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
    travel = np.zeros(len(points))
    for _ in range(20):
        here = points + travel[:, None] * along
        off = rig.laser.reach(here)[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            steep = np.einsum("ni,ni->n", rig.laser.sheet_normal(here), along)
            travel = np.where(np.abs(steep) > 1e-6, travel - off / steep, np.nan)
        if np.nanmax(np.abs(off), initial=0.0) < 1e-9:
            break
    never = ~np.isfinite(travel)
    met = points + np.where(never, 0.0, travel)[:, None] * along
    moved = np.where(np.abs(np.nan_to_num(travel)) < 1e-6, 0.0, travel * way)  # on the sheet as it is
    return met, np.where(never, np.nan, moved)
