"""A rig-design.toml to everything that is known of the rig before it is built."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array
from scope.design.expected import expected_figures
from scope.design.planned import PlannedCalibration, plan_calibration
from scope.design.prediction import Prediction, Surface, WorkingMap, onto_sheet, predict, working_map
from scope.design.spots import PlannedPlane, plan_planes
from scope.design.troubles import troubles
from scope.design.visibility import HiddenMap, hidden_map, unobstructed
from scope.simulation import RigDesign, VirtualRig, read_design


@dataclass(frozen=True, slots=True, eq=False)
class DesignResult:
    """A predicted rig."""

    rig: VirtualRig
    surface: Surface
    planes: list[PlannedPlane]
    planned: PlannedCalibration
    area: WorkingMap
    expected: dict[str, Any]
    troubles: list[str]
    hidden: HiddenMap | None = None  # of the objects that the design has
    place: dict[str, Any] | None = None  # what is predicted at a place that was asked for

    @property
    def result(self) -> dict[str, Any]:
        """What --json gives."""
        inside = self.area.prediction.inside
        seen = self.area.prediction.look
        points = self.area.prediction.points[inside]
        volume = {
            "sigma_mm": spread(seen.sigma[inside]),
            "sigma_cal_mm": spread(self.area.prediction.sigma_cal[inside]),
            "lateral_mm": spread(seen.across_mm[inside]),
            "depth_mm": spread(seen.along_ray[inside]),
            "px_per_mm": spread(1.0 / seen.across_mm[inside]),
            "stripe_px": spread(seen.stripe_px[inside]),
            "blur_px": spread(seen.blur_px[inside]),
            "signal": spread(seen.signal[inside]),
            "clipped": float(np.mean(seen.clipped[inside])),
            "triangulation_deg": spread(np.degrees(self.area.prediction.angle[inside])),
        }
        whole = {
            **volume,
            "volume_mm": {axis: [float(points[:, k].min()), float(points[:, k].max())] for k, axis in enumerate("xyz")},
            "planes": [_plane(plane, self.rig) for plane in self.planes],
            "expected": self.expected,
            "sheet_in_focus": _sheet_in_focus(self.rig),
            "hidden": None if self.hidden is None else self.hidden.shares,
            "troubles": self.troubles,
            "passed": not self.troubles,
        }
        if self.place is None:
            return whole
        there = {key: self.place[key] for key in ("sigma_mm", "sigma_cal_mm", "stripe_px", "blur_px", "visible")}
        return whole | there | {"at": self.place, "volume": volume}


def design_rig(
    design: RigDesign | str | Path,
    *,
    at: tuple[float, float, float] | None = None,
    surface: Surface | None = None,
    seed: int = 0,
) -> DesignResult:
    """Predict a rig without rendering an image.

    Parameters
    ----------
    design : RigDesign or path
        A rig-design.toml; objects and motion may be missing.
    at : (x, y, z), optional
        mm in C, with the object where it stands at position 0 of the motion: a place to tell more about.
    surface : Surface, optional
        Reflectance and tilt of what is scanned; white and facing the camera otherwise.
    seed : int
        Of the calibrations that are drawn.

    Raises
    ------
    FileError
        A design that cannot be read or cannot stand.
    CalibrationError
        One that cannot be calibrated: spots or sheet out of view.
    """
    name = "rig design" if isinstance(design, RigDesign) else str(design)
    read = design if isinstance(design, RigDesign) else read_design(Path(design))
    if read.jig.levels:
        raise FileError(
            f"{name}: jig.levels: stepped plates are simulated, not predicted; leave levels out, or run scope simulate"
        )
    rig = VirtualRig.of(read)
    surface = surface or Surface()
    planes = plan_planes(rig)
    try:
        planned = plan_calibration(rig, planes, np.random.default_rng(seed))
        area = working_map(rig, planned, surface)
    except CalibrationError as error:
        raise CalibrationError(f"{name}: {error}") from error
    expected = expected_figures(rig, planned, area, surface)
    place = None if at is None else _place(rig, planned, surface, np.array(at, dtype=np.float64))
    said = troubles(rig, planes, area)
    return DesignResult(rig, surface, planes, planned, area, expected, said, hidden_map(rig, area), place)


def _place(rig: VirtualRig, planned: PlannedCalibration, surface: Surface, at: Array) -> dict[str, Any]:
    points, moved = onto_sheet(rig, at[None])
    point, travel = points[0], float(moved[0])
    found: Prediction = predict(rig, planned, points, surface)
    seen = found.look
    camera, laser = (bool(reached[0]) for reached in unobstructed(rig, points, moved))
    on_sheet = abs(float(rig.laser.reach(point[None])[1][0])) < rig.laser.width
    return {
        "at_mm": at.tolist(),
        "on_sheet_mm": point.tolist(),
        "travel_mm": travel,
        "visible": bool(found.inside[0]) and camera and laser and on_sheet,
        "inside": bool(found.inside[0]),
        "camera_sees": camera,
        "laser_reaches": laser,
        "pixel": seen.pixels[0].tolist(),
        "sigma_mm": float(seen.sigma[0]),
        "sigma_cal_mm": float(found.sigma_cal[0]),
        "lateral_mm": float(seen.across_mm[0]),
        "depth_mm": float(seen.along_ray[0]),
        "stripe_px": float(seen.stripe_px[0]),
        "blur_px": float(seen.blur_px[0]),
        "signal": float(seen.signal[0]),
        "clipped": bool(seen.clipped[0]),
        "triangulation_deg": float(np.degrees(found.angle[0])),
    }


def _sheet_in_focus(rig: VirtualRig) -> dict[str, Any] | None:
    """Focus and tilt of the sensor that would put the sheet of light in focus (Scheimpflug); None without a lens."""
    if rig.lens is None:
        return None
    found = rig.lens.in_focus(rig.laser.normal, float(rig.laser.normal @ rig.laser.origin))
    return None if found is None else {"focus_mm": found[0], "tilt_deg": [float(a) for a in np.degrees(found[1])]}


def spread(values: Array) -> dict[str, float]:
    """Least, median and largest of the values that are known."""
    known = values[np.isfinite(values)]
    if not len(known):
        return dict.fromkeys(("min", "median", "max"), float("nan"))
    return {"min": float(known.min()), "median": float(np.median(known)), "max": float(known.max())}


def _plane(plane: PlannedPlane, rig: VirtualRig) -> dict[str, Any]:
    return {
        "name": plane.name,
        "seen": len(plane.pixels),
        "of": rig.design.jig.rows * rig.design.jig.columns,
        "diameter_px": spread(plane.diameter),
        "centre_px": spread(plane.sigma),
    }
