"""The verdict on a calibration, in numbers and in plain words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from calibration.geometry import Array
from calibration.grouping import grouped
from calibration.rays import (
    TERMS,
    Coverage,
    FreehandFit,
    TwoPlaneFit,
    coverage_of,
    next_view,
    rms,
    undetermined,
)
from calibration.reason import see
from calibration.rig import Verification
from calibration.sheet import Laser
from calibration.stages import Stage
from calibration.targets import SpotGrid
from calibration.verification import (
    Fault,
    HeldOut,
    Interplane,
    Intraplane,
    Lattice,
    RayBound,
    beyond_reach,
    expected_interplane_px,
    find_faults,
    held_out,
    interplane,
    intraplane,
    leave_views_out,
    ray_bound,
)
from scope.calibrating.left_out import LeftOut
from scope.calibrating.marks import MeasuredPlane
from scope.calibrating.stages import FoundStages
from scope.session import CalibrationPlan

NAN = float("nan")
OPEN_PX = 1.0  # by which rays or marks that are left out may be off without a limit that says so
AMISS = 10.0  # times the centroids' own noise, beyond which left-out marks are told
ADVICE = (
    "an error that is affine (all stand-offs or the pitch wrong by one factor) is invisible to planes: check a known "
    "artefact with scope check"
)


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What goes into the rig and what --json gives."""

    verification: Verification
    content: dict[str, Any]
    intraplane: Intraplane | None = None
    interplane: Interplane | None = None
    held_out: tuple[HeldOut, ...] = ()
    coverage: Coverage | None = None


def judge_jig(
    plan: CalibrationPlan,
    seen: list[MeasuredPlane],
    fit: TwoPlaneFit,
    lasers: dict[str, Laser],
    stages: FoundStages,
    left_out: Sequence[LeftOut] = (),
    named: Sequence[Fault] = (),
) -> Verdict:
    """Judge a calibration on known stand-offs: the faults that `named_faults` gave, held-out planes, and the limits of [accept]."""
    held = held_out(fit, model=fit.camera.model)
    agreement, inside = interplane(fit.camera, fit.marks), intraplane(fit)
    bound = ray_bound(fit, untested=any(h.why for h in held))
    corner = beyond_reach(fit)
    of_plane = {h.name: h for h in held}
    at = {m.name: k for k, m in enumerate(fit.marks)}
    rows = []
    for s in seen:
        k = at.get(s.plan.name)
        if k is None:
            rows.append(_row(s))
            continue
        plane = fit.planes[k]
        figures = {
            "used": len(fit.marks[k]),
            "fit_px": plane.fit_px,
            "fit_px_mean": plane.fit_px_mean,
            "fit_mm": inside.planes[k].fit_mm,
            "loo_px": plane.loo_px,
            "loo_mm": plane.loo_mm,
            "placement_px": float(inside.split.plane_px[k]),
        }
        rows.append(_row(s, of_plane.get(s.plan.name), **figures))
    faults = [*_moved(seen), *[mirrored_fault(s.plan.name) for s in seen if s.mirrored], *map(fault_content, named)]
    faults += _of_marks(seen)
    content = {
        "interplane_px": agreement.interplane_px,
        "interplane_expected_px": expected_interplane_px(fit, agreement),
        "ray_sigma_mm": bound.mm,
        "ray_mm": _rms([h.rms_mm for h in held if h.between and not h.why]),
        "order": fit.planes[0].map.terms,
        "model": fit.camera.model,
        "interplane_mm": agreement.interplane_mm,
        "interplane_sum_abs_mm": _mean(agreement.sum_abs),
        "line_disagreement_rad": agreement.disagreement,
        "residual_px": {
            "target": inside.split.target_px,
            "placement": inside.split.placement_px,
            "random": inside.split.random_px,
        },
        "dropped": [each.content for each in left_out],
        "stages": [stage_content(stage) for stage in stages.stages],
        "warnings": [*([corner] if corner else []), *stages.warnings],
    }
    open_, notes = _open(fit, held, bound)
    verdict = _verdict(plan, seen, rows, lasers, faults, content, _Said(len(fit.marks), open_, notes))
    return Verdict(verdict.verification, verdict.content, inside, agreement, held)


def _open(fit: TwoPlaneFit, held: tuple[HeldOut, ...], bound: RayBound) -> tuple[list[str], list[str]]:
    """What the marks of a jig leave open: reasons not to pass, and what must be said although it passes."""
    open_, notes = [], []
    left_out = rms(np.concatenate([plane.left_out for plane in fit.planes]))
    known = np.concatenate([np.trace(m.covariance, axis1=1, axis2=2) for m in fit.marks])
    noise = float(np.sqrt(np.nanmean(known))) if np.isfinite(known).any() else NAN
    sure = f" where their centroids are known to {noise:.2g} px" if np.isfinite(noise) else ""
    if not np.isfinite(left_out):
        open_.append(
            "the maps have as many terms as their planes have marks, so that nothing tests them: lower --order, or show more marks"
        )
    elif left_out > max(OPEN_PX, AMISS * np.nan_to_num(noise)):
        open_.append(
            f"marks that are left out are off by {left_out:.2g} px{sure}: {min(map(len, fit.marks))} marks a plane do not determine "
            "its map, or are not where they are listed: add marks, or measure their places"
        )
    elif left_out > AMISS * noise:
        notes.append(
            f"marks that are left out are off by {left_out:.2g} px{sure}: the target's own errors, or few marks"
        )
    withheld = [(h.name, h.why) for h in held if h.why]
    if withheld:
        told = (
            f"held-out errors withheld: {grouped(withheld, len(held), 'planes', longest=150)}; one smooth field of rays through all "
            f"is used, open by {bound.mm:.2g} mm or {bound.px:.2g} px (one sigma)"
        )
        (open_ if bound.px > OPEN_PX else notes).append(
            f"{told}: show each part of the image at three stand-offs to test it"
        )
    return open_, notes


def judge_freehand(
    plan: CalibrationPlan,
    seen: list[MeasuredPlane],
    fit: FreehandFit,
    lasers: dict[str, Laser],
    stages: FoundStages,
    left_out: Sequence[LeftOut] = (),
) -> Verdict:
    """Judge a calibration from views held by hand: each view against the camera of the others, and what they leave open."""
    held = leave_views_out(fit)
    coverage, advice = coverage_of(fit), next_view(fit).advice
    of_view = {h.name: h for h in held}
    at = {m.name: k for k, m in enumerate(fit.views)}
    rows = []
    for s in seen:
        k = at.get(s.plan.name)
        rows.append(
            _row(s)
            if k is None
            else _row(s, of_view.get(s.plan.name), used=len(fit.views[k]), fit_px=rms(fit.residuals[k]))
        )
    content = {
        "model": "pinhole",
        "ray_mm": _rms([h.rms_mm for h in held]),
        "fit_px": fit.fit_px,
        "camera": camera_content(fit, coverage, advice),
        "dropped": [each.content for each in left_out],
        "stages": [stage_content(stage) for stage in stages.stages],
        "warnings": list(stages.warnings),
    }
    verdict = _verdict(
        plan,
        seen,
        rows,
        lasers,
        [*_moved(seen), *_of_marks(seen, many=False)],
        content,
        _Said(0, undetermined(fit, advice)),
    )
    return Verdict(verdict.verification, verdict.content, held_out=held, coverage=coverage)


def camera_content(fit: FreehandFit, coverage: Coverage, advice: str) -> dict[str, Any]:
    """A freehand camera as --json gives it: its parameters with their standard errors, and what its views leave open."""
    camera = fit.camera
    sigma = np.sqrt(np.maximum(np.diag(camera.covariance), 0.0))
    return {
        "focal_px": camera.matrix[[0, 1], [0, 1]],
        "focal_sigma_px": sigma[:2],
        "centre_px": camera.matrix[:2, 2],
        "centre_sigma_px": sigma[2:4],
        "distortion": camera.distortion,
        "distortion_sigma": sigma[4:],
        "terms": [term for term in TERMS if term in fit.terms],
        "held": [term for term in TERMS if term not in fit.terms],
        "mark_sigma_px": camera.sigma,
        "lens_sigma_px": coverage.worst_px,
        "covered": coverage.share,
        "next_view": advice,
    }


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else NAN


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else NAN


def _row(seen: MeasuredPlane, held: HeldOut | None = None, **figures: float) -> dict[str, Any]:
    """What is told of one plane; null what is not known of it."""
    jig = seen.plan.c_from_target is not None  # a view by hand has no place of its own to be off
    names = ("used", "fit_px", "fit_px_mean", "fit_mm", "loo_px", "loo_mm", "placement_px")
    return {
        "name": seen.plan.name,
        "found": seen.found,
        "repeat_px": seen.repeat_px,
        **{name: figures.get(name, 0 if name == "used" else NAN) for name in names},
        "heldout_mm": NAN if held is None else held.rms_mm,
        "heldout_px": NAN if held is None else held.rms_px,
        "heldout_why": held.why if held is not None and held.why else None,
        "heldout_bias_mm": None if held is None or not jig or held.why else held.bias_mm.tolist(),
        "between": None if held is None or not jig else held.between,
    }


def named_faults(plan: CalibrationPlan, fit: TwoPlaneFit, seen: Sequence[MeasuredPlane]) -> tuple[Fault, ...]:
    """Faults that the planes show against each other; ``remedy`` is a whole sentence that names plane, fault, size and what to do.

    Planes that are seen mirrored have their fault already and are left out.
    """
    mirrored = {s.plan.name for s in seen if s.mirrored}
    planes = [m for m in fit.marks if m.name not in mirrored]
    if len(planes) < 2:
        return ()
    return find_faults(planes, field=fit.joint.field if not mirrored else None, lattice=lattice_of(plan))


def _of_marks(seen: Sequence[MeasuredPlane], *, many: bool = True) -> list[dict[str, Any]]:
    """Planes with too many bad marks (a view by hand is one of many, and has none), and every mark that was left out."""
    spoilt = [s.too_many for s in seen if many and s.plan.c_from_target is not None]
    return [fault_content(f) for f in (*spoilt, *[f for s in seen for f in s.bad]) if f is not None]


def fails(fault: dict[str, Any]) -> bool:
    """Whether a fault makes a session fail: all but a single mark, which is left out."""
    return fault["kind"] != "mark" or fault["mark"] is None


def lattice_of(plan: CalibrationPlan) -> Lattice | None:
    """Grid of the plan's target, where it is one of spots."""
    target = plan.target
    return Lattice(target.rows, target.columns, target.pitch) if isinstance(target, SpotGrid) else None


def fault_content(fault: Fault) -> dict[str, Any]:
    """One fault as --json gives it."""
    return {
        "plane": fault.plane,
        "kind": fault.kind,
        "value": fault.value,
        "standard_error": fault.standard_error,
        "unit": fault.unit,
        "or": list(fault.alternatives),
        "centre": fault.centre,
        "mark": fault.mark,
        "remedy": fault.remedy,
        "see": see(fault.kind),
    }


def mirrored_fault(plane: str) -> dict[str, Any]:
    """The fault ``labelling`` of a plane whose fiducials only match in a mirror."""
    remedy = f"plane {plane}: its fiducials are seen mirrored: turn the front of the target to the camera, or correct `fiducials`"
    return fault_content(Fault(plane, "labelling", NAN, NAN, "", (), None, None, remedy))


def _moved(seen: list[MeasuredPlane]) -> list[dict[str, Any]]:
    """Return a fault ``moved`` for every plane whose marks shift between repeats by more than their noise explains."""
    faults = []
    for s in seen:
        if s.repeat_px > 0.01 + 6 * np.nan_to_num(s.repeat_noise_px):
            faults.append(
                {
                    "plane": s.plan.name,
                    "kind": "moved",
                    "value": s.repeat_px,
                    "standard_error": s.repeat_noise_px,
                    "unit": "px",
                    "or": [],
                    "remedy": f"plane {s.plan.name}: target or camera moved by {s.repeat_px:.3f} px between the repeats: fix both and "
                    "take the images of this plane again",
                    "see": see("moved"),
                }
            )
    return faults


class _Said(NamedTuple):
    """What else there is to a verdict."""

    planes: int  # that were fitted
    left_open: Sequence[str] = ()  # reasons not to pass
    notes: Sequence[str] = ()  # what must be said although it passes


def _verdict(
    plan: CalibrationPlan,
    seen: list[MeasuredPlane],
    rows: list[dict[str, Any]],
    lasers: dict[str, Laser],
    faults: list[dict[str, Any]],
    content: dict[str, Any],
    said: _Said,
) -> Verdict:
    """Faults, limits that do not hold, and what is left open each end in "not passed"; notes are told."""
    planes, open_, notes = said
    failed = [*[str(fault["remedy"]) for fault in faults if fails(fault)], *open_]
    failed += _beyond(plan, seen, lasers, content["ray_mm"])
    passed = not failed
    why = "; ".join([*failed, *notes] if failed else [*notes, _praise(plan, planes, len(faults))])
    content = {
        "passed": passed,
        "why": why,
        "planes": rows,
        "interplane_px": NAN,
        "faults": faults,
        "lasers": {name: laser_content(laser) for name, laser in lasers.items()},
        **content,
    }
    return Verdict(Verification(passed, why, tuple(faults), tuple(rows), content["interplane_px"]), content)


def _beyond(plan: CalibrationPlan, seen: list[MeasuredPlane], lasers: dict[str, Laser], ray_mm: float) -> list[str]:
    """Limits of [accept] that do not hold, or could not be tested."""
    failed = []
    limit = plan.accept.get("ray_mm")
    if limit is not None and not np.isfinite(ray_mm):
        failed.append(
            "accept.ray_mm cannot be tested: held-out rays need three planes with an origin that show the same part of the image, or four "
            "freehand views; add one"
        )
    elif limit is not None and ray_mm > limit:
        failed.append(
            f"held-out rays are off by {ray_mm:.4f} mm rms, {limit:g} allowed: add spots or planes, or a higher --order"
        )
    limit = plan.accept.get("laser_mm")
    if limit is not None and not lasers:
        failed.append("accept.laser_mm cannot be tested: no plane has a laser image; add `laser` to the planes")
    for name, laser in lasers.items():
        if limit is not None and not laser.rms_mm <= limit:
            failed.append(
                f"laser {name}: its points lie {laser.rms_mm:.4f} mm rms off the sheet, {limit:g} allowed: check exposure, "
                "background and that nothing moved"
            )
    limit = plan.accept.get("repeat_px")
    for s in seen:
        if limit is not None and s.repeat_px > limit:
            failed.append(f"plane {s.plan.name}: marks move by {s.repeat_px:.3f} px between repeats, {limit:g} allowed")
    return failed


def _praise(plan: CalibrationPlan, planes: int, bad_marks: int) -> str:
    limits = ", ".join(f"{key} {value:g}" for key, value in plan.accept.items())
    tested = (
        f"no faults, and within {limits}"
        if limits
        else "no faults; no [accept] limits were given, so only self-consistency was tested"
    )
    if bad_marks:
        tested = f"{bad_marks} bad mark{'s' if bad_marks > 1 else ''} left out; else {tested}"
    if planes == 2:
        tested += "; two planes have no redundancy: a misplaced plane would not show, so a third is advised"
    return f"{tested}; {ADVICE}"


def laser_content(laser: Laser) -> dict[str, Any]:
    """One laser as --json gives it."""
    plane = laser.plane
    return {
        "normal": plane.normal,
        "offset": plane.offset,
        "rms_mm": laser.rms_mm,
        "loo_mm": laser.loo_mm,
        "n": laser.n,
        "views": len(laser.planes),
        "flatness_mm": laser.flatness_mm,
        "flatness_sigma_mm": laser.flatness_sigma,
        "curved": len(laser.covariance) > 3,
        "along": laser.along,
        "channel": laser.channel,
        "planes": [{"name": p.plane, "n": p.n, "rms_mm": p.rms_mm, "loo_mm": p.loo_mm} for p in laser.planes],
    }


def stage_content(stage: Stage) -> dict[str, Any]:
    """One stage as --json gives it."""
    return {
        "kind": stage.kind,
        "direction": stage.direction,
        "point": stage.point,
        "direction_sigma_deg": float(np.degrees(stage.direction_sigma)),
        "scale": stage.scale,
        "rms_mm": stage.rms_mm,
    }
