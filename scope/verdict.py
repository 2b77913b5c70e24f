"""The verdict on a calibration, in numbers and in plain words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.laser import Laser
from calibration.pinhole import FreehandFit
from calibration.plane_map import rms
from calibration.rig import Verification
from calibration.two_plane import TwoPlaneFit
from scope.calibration_file import CalibrationPlan
from scope.find_marks import SeenPlane

NAN = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What goes into the rig and what --json gives."""

    verification: Verification
    content: dict[str, Any]


def judge_jig(plan: CalibrationPlan, seen: list[SeenPlane], fit: TwoPlaneFit, lasers: dict[str, Laser]) -> Verdict:
    """Judge a calibration on known stand-offs."""
    rows = []
    for s in seen:
        k = next((i for i, m in enumerate(fit.marks) if m.name == s.plan.name), None)
        if k is None:
            rows.append(_row(s))
            continue
        rows.append(
            _row(s, used=len(fit.marks[k]), fit_px=fit.planes[k].fit_px, fit_px_mean=fit.planes[k].fit_px_mean,
                 loo_px=fit.planes[k].loo_px, loo_mm=fit.planes[k].loo_mm)
        )  # fmt: skip
    return _verdict(plan, rows, lasers, NAN, ())


def judge_freehand(plan: CalibrationPlan, seen: list[SeenPlane], fit: FreehandFit, lasers: dict[str, Laser]) -> Verdict:
    """Judge a calibration from views held by hand."""
    rows = []
    for s in seen:
        k = next((i for i, m in enumerate(fit.views) if m.name == s.plan.name), None)
        rows.append(_row(s) if k is None else _row(s, used=len(fit.views[k]), fit_px=rms(fit.residuals[k])))
    return _verdict(plan, rows, lasers, NAN, ())


def _row(seen: SeenPlane, **figures: float) -> dict[str, Any]:
    names = ("used", "fit_px", "fit_px_mean", "loo_px", "loo_mm", "heldout_mm")
    return {
        "name": seen.plan.name,
        "found": seen.found,
        "repeat_px": seen.repeat_px,
        **{name: figures.get(name, 0 if name == "used" else NAN) for name in names},
    }


def _verdict(
    plan: CalibrationPlan,
    rows: list[dict[str, Any]],
    lasers: dict[str, Laser],
    interplane: float,
    faults: tuple[dict[str, Any], ...],
) -> Verdict:
    why = "only self-consistency was tested"
    passed = not faults
    content = {
        "planes": rows,
        "interplane_px": interplane,
        "faults": list(faults),
        "lasers": {name: laser_content(laser) for name, laser in lasers.items()},
        "passed": passed,
        "why": why,
    }
    return Verdict(Verification(passed, why, faults, tuple(rows), interplane), content)


def laser_content(laser: Laser) -> dict[str, Any]:
    """One laser as --json gives it."""
    plane = laser.plane
    return {
        "normal": plane.normal,
        "offset": plane.offset,
        "rms_mm": laser.rms_mm,
        "loo_mm": laser.loo_mm,
        "n": laser.n,
        "flatness_mm": laser.flatness_mm,
        "flatness_sigma_mm": laser.flatness_sigma,
        "sigma_normal_deg": float(np.rad2deg(np.sqrt(np.trace(laser.covariance[:2, :2])) / laser.frame.reach)),
        "planes": [{"name": p.plane, "n": p.n, "rms_mm": p.rms_mm, "loo_mm": p.loo_mm} for p in laser.planes],
    }
