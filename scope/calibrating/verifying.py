"""A rig or a plane's images put to the test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import CalibrationError, FileError
from calibration.rays import TwoPlaneCamera, locate_target
from calibration.rig import Rig
from calibration.verification import HeldOut, against, faults_against
from scope.calibrating.marks import MeasuredPlane, measure_plane
from scope.calibrating.verdict import fails, fault_content, lattice_of, mirrored_fault
from scope.session import CalibrationPlan, CalibrationSession, PlanePlan, plan_of, read_calibration

SATURATED = 0.05  # share of the spots that may be clipped
BLURRED = 0.12  # blur over diameter beyond which the plateau of a spot is gone


def verify(
    rig_path: Rig | str | Path, other: CalibrationSession | str | Path | None = None, *, allow_edited: bool = False
) -> dict[str, Any]:
    """Verification of a rig: what it says of itself, or its rays against images that it has not seen.

    Parameters
    ----------
    rig_path : Rig or path
        The rig, or rig.json.
    other : CalibrationSession or path, optional
        Other images, or a calibration file that names them. Planes with an ``origin`` test the rays as they stand; freehand views
        are first located by the rays and test their shape only.
    allow_edited : bool
        Take a rig that was altered since it was calibrated, as one that did not pass.

    Returns
    -------
    dict
        ``passed``, ``why``, ``faults``, ``planes`` (name, rms_px, rms_mm, bias_mm), ``sealed``, as JSON.
    """
    rig = rig_path if isinstance(rig_path, Rig) else Rig.load(rig_path, allow_edited=allow_edited)
    if other is None:
        told = rig.verification
        planes = [
            {"name": p["name"], "rms_px": p["loo_px"], "rms_mm": p["heldout_mm"], "bias_mm": None} for p in told.planes
        ]
        return {
            "passed": told.passed,
            "why": told.why,
            "faults": list(told.faults),
            "planes": planes,
            "accept": dict(rig.accept),
            "sealed": rig.sealed,
        }
    plan = plan_of(other) if isinstance(other, CalibrationSession) else read_calibration(Path(other))
    rows, jig, faults = [], [], []
    for plane in plan.planes:
        seen = measure_plane(plan, plane)
        if seen.size != rig.camera.size:
            raise FileError(
                f"{plan.path}: plane {plane.name}: images of {seen.size[0]} x {seen.size[1]} px; the rig was calibrated at "
                f"{rig.camera.size[0]} x {rig.camera.size[1]}: use the same camera settings"
            )
        try:
            marks = seen.marks if plane.c_from_target is not None else locate_target(rig.camera, seen.marks)
        except CalibrationError as error:
            raise CalibrationError(f"{plan.path}: {error}") from error
        rows.append((against(rig.camera, marks), plane.c_from_target is not None))
        faults += [fault_content(f) for f in (seen.too_many, *seen.bad) if f is not None]
        if seen.mirrored:
            faults.append(mirrored_fault(plane.name))
        elif plane.c_from_target is not None:
            jig.append(marks)
    if jig and isinstance(rig.camera, TwoPlaneCamera):
        faults += [fault_content(f) for f in faults_against(rig.camera.field, jig, lattice=lattice_of(plan))]
    return {**_judged(plan, rig, rows, faults), "sealed": rig.sealed}


def _judged(
    plan: CalibrationPlan, rig: Rig, rows: list[tuple[HeldOut, bool]], faults: list[dict[str, Any]]
) -> dict[str, Any]:
    limit = plan.accept.get("ray_mm", rig.accept.get("ray_mm"))
    worst = max((held for held, _ in rows), key=lambda held: held.rms_mm)
    if limit is not None:
        within = {held.name for held, _ in rows if held.rms_mm <= limit}
        faults = [f for f in faults if f["plane"] not in within]  # good enough for the work
    failed = [str(fault["remedy"]) for fault in faults if fails(fault)]
    if not rig.verification.passed:
        failed.insert(0, f"the rig's own calibration did not pass: {rig.verification.why}")
    if limit is not None and worst.rms_mm > limit:
        failed.append(
            f"plane {worst.name}: rays are off by {worst.rms_mm:.4f} mm rms, {limit:g} allowed"
            + ("" if any(map(fails, faults)) else ": has the camera moved, or is the plane misplaced? calibrate again")
        )
    passed = not failed
    if failed:
        why = "; ".join(failed)
    else:
        why = (
            f"rays hold on {len(rows)} plane(s) they have not seen: worst {worst.name}, {worst.rms_mm:.4f} mm rms, "
            + (
                f"{limit:g} allowed"
                if limit is not None
                else "no faults; no limit says whether that is good enough for the work: give accept.ray_mm"
            )
        )
    planes = [
        {
            "name": h.name,
            "rms_px": h.rms_px,
            "rms_mm": h.rms_mm,
            "bias_mm": h.bias_mm,
            "located": not jig,
            "inside": h.between,
        }
        for h, jig in rows
    ]
    return {"passed": passed, "why": why, "faults": faults, "planes": planes}


def check_plane(path: str | Path, name: str) -> dict[str, Any]:
    """Judge one plane's images while the jig still stands.

    Returns
    -------
    dict
        Of the plane: name, found, expected, missing, rejected (reasons counted), saturated, blurred, moved, repeat_px,
        fit_px, loo_px, and ``remedy``, empty where the images are good.
    """
    plan = read_calibration(Path(path), only=name)
    (plane,) = plan.planes
    try:
        return _checked(plan, plane)
    except CalibrationError as error:
        unknown = dict.fromkeys(("missing", "saturated", "blur_px", "repeat_px", "fit_px", "loo_px"))
        return {
            "name": name, "found": 0, "used": 0, "expected": _expected(plan, plane), **unknown, "rejected": {},
            "blurred": None, "moved": None, "mirrored": None, "remedy": str(error).removeprefix(f"{plan.path}: "),
        }  # fmt: skip


def _expected(plan: CalibrationPlan, plane: PlanePlan) -> int | None:
    if plane.listed is not None:
        return len(plane.listed.points)
    return None if plan.target is None else len(plan.target.marks)


def _checked(plan: CalibrationPlan, plane: PlanePlan) -> dict[str, Any]:
    from calibration.rays import fit_plane_map

    seen = measure_plane(plan, plane)
    fit = fit_plane_map(seen.marks, tilted=True)
    blurred = bool(seen.blur_px > BLURRED * seen.diameter_px) if np.isfinite(seen.blur_px) else False
    moved = bool(
        seen.repeat_px > max(plan.accept.get("repeat_px", 0.0), 0.01 + 6 * np.nan_to_num(seen.repeat_noise_px))
    )
    reasons: dict[str, int] = {}
    for _, _, reason in seen.rejected:
        reasons[reason] = reasons.get(reason, 0) + 1
    return {
        "name": plane.name,
        "found": seen.found,
        "used": len(seen.marks),
        "expected": seen.expected,
        "missing": seen.expected - len(seen.marks),
        "rejected": reasons,
        "saturated": seen.saturated,
        "blurred": blurred,
        "blur_px": seen.blur_px,
        "moved": moved,
        "repeat_px": seen.repeat_px,
        "fit_px": fit.fit_px,
        "loo_px": fit.loo_px,
        "mirrored": seen.mirrored,
        "remedy": _remedy(seen, blurred=blurred, moved=moved),
    }


def _remedy(seen: MeasuredPlane, *, blurred: bool, moved: bool) -> str:
    advice = []
    if seen.too_many:
        advice.append(seen.too_many.remedy.removeprefix(f"plane {seen.plan.name}: "))
    if seen.mirrored:
        advice.append("the target is seen mirrored: turn its front to the camera, or correct `fiducials`")
    if len(seen.marks) < 0.5 * seen.expected:
        advice.append(
            f"only {len(seen.marks)} of {seen.expected} marks: bring the target into view, clean it, or expose longer"
        )
    if seen.saturated > SATURATED:
        advice.append(f"{100 * seen.saturated:.0f} % of the spots are clipped: expose shorter or dim the back-light")
    if blurred:
        advice.append(
            f"blurred: an edge of {seen.blur_px:.1f} px on spots of {seen.diameter_px:.0f} px: focus, or close the aperture"
        )
    if moved:
        advice.append(
            f"marks move by {seen.repeat_px:.3f} px between repeats: fix target and camera, and take the images again"
        )
    return "; ".join(advice)
