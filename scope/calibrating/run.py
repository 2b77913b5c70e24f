"""calibration.toml to a rig: the stages of a calibration joined."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calibration.errors import CalibrationError, FileError
from calibration.notebook import Picture, Shown, Summary
from calibration.rays import FreehandFit, Order, TwoPlaneFit, fit_freehand, fit_two_plane, locate_target
from calibration.rig import Rig, sha256_of
from calibration.stages import Stage
from scope.calibrating.channels import Choice
from scope.calibrating.lasers import FoundLasers, LaserView, find_lasers
from scope.calibrating.left_out import LeftOut, small
from scope.calibrating.marks import MeasuredPlane, measure_plane
from scope.calibrating.stages import find_stages
from scope.calibrating.verdict import Verdict, judge_freehand, judge_jig, named_faults
from scope.origin import operator
from scope.session import CalibrationPlan, CalibrationSession, PlanePlan, gray, plan_of, read_calibration, read_image
from scope.version import __version__

Model = Literal["auto", "two-plane", "joint", "pinhole"]
Tick = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Calibration(Shown):
    """A rig and everything that led to it."""

    rig: Rig
    plan: CalibrationPlan
    measured: tuple[MeasuredPlane, ...]
    two_plane: TwoPlaneFit | None
    freehand: FreehandFit | None
    views: tuple[LaserView, ...]
    verdict: Verdict
    left_out: tuple[LeftOut, ...] = ()
    choices: Mapping[str, Choice] = field(default_factory=dict)  # by laser: why its channel was taken

    @property
    def result(self) -> dict[str, Any]:
        """What --json gives."""
        return self.verdict.content

    @property
    def passed(self) -> bool:
        """Whether the rig may be used."""
        return bool(self.result["passed"])

    @property
    def why(self) -> str:
        """Why it passed, or did not."""
        return str(self.result["why"])

    @property
    def faults(self) -> list[dict[str, Any]]:
        """Faults by name, as in --json."""
        return list(self.result["faults"])

    @property
    def planes(self) -> list[dict[str, Any]]:
        """A row a plane, as in --json."""
        return list(self.result["planes"])

    def summary(self) -> Summary:
        """The verdict and the figures of the rig."""
        verdict = "passed" if self.passed else "did not pass"
        planes = (
            ("planes", str(len(self.measured))),
            ("left out", str(len(self.left_out))),
            ("faults", str(len(self.faults))),
        )
        return Summary(f"Calibration {verdict}: {self.why}", (*planes, *self.rig.summary().figures))

    def picture(self) -> tuple[Picture | None, str]:
        """The rig's sheets of light."""
        return self.rig.picture()


def _no_tick(_done: int, _total: int) -> None:
    return None


def calibrate(
    path: str | Path | CalibrationSession, *, model: Model = "auto", order: Order = "auto", on_plane: Tick = _no_tick
) -> Calibration:
    """Calibrate after a calibration.toml, or from images in memory.

    Parameters
    ----------
    path : path or CalibrationSession
        The file, or the target and its places with their images.
    model : "auto", "two-plane", "joint" or "pinhole"
        Which rays the camera gives. "auto": a pinhole where no plane has an origin, else the joint field.
    order : "auto", "linear", "paper" or int
        Of the plane maps.
    on_plane : callable
        Called with (done, total) after each plane.

    Raises
    ------
    FileError, CalibrationError
        Images or marks that do not serve.
    ValueError
        A session that holds no images, places or limits.
    """
    plan = plan_of(path) if isinstance(path, CalibrationSession) else read_calibration(Path(path))
    _check_model(plan, model)
    seen: list[MeasuredPlane] = []
    left_out: list[LeftOut] = []  # views by hand: the others may do without them
    for k, plane in enumerate(plan.planes):
        try:
            found = measure_plane(plan, plane)
            if plane.c_from_target is None and found.spoilt:
                raise CalibrationError(found.spoilt)
            seen.append(found)
        except (CalibrationError, FileError) as error:
            if plane.c_from_target is not None or (isinstance(error, FileError) and plane.name not in plan.globbed):
                raise
            left_out.append(_view_left_out(plan, plane, error))
        on_plane(k + 1, len(plan.planes))
    seen, odd = _one_size(plan, seen)
    if any(s.plan.c_from_target is not None for s in seen):
        return _finish_jig(plan, seen, model, order, [*left_out, *odd])
    return _finish_freehand(plan, seen, [*left_out, *odd])


def _check_model(plan: CalibrationPlan, model: Model) -> None:
    """Refuse a model that the planes cannot give, before their images are read."""
    on_jig = any(plane.c_from_target is not None for plane in plan.planes)
    if on_jig and model == "pinhole":
        raise CalibrationError(
            f"{plan.path}: planes with an `origin` are known stand-offs, which the method of planes uses as they are; "
            "--model pinhole is for freehand views: remove the origins or choose auto, joint or two-plane"
        )
    if not on_jig and model not in {"auto", "pinhole"}:
        raise CalibrationError(
            f"{plan.path}: no plane has an `origin`, so model {model!r} has no known stand-offs to stand on; give the planes "
            "their origins or use --model pinhole"
        )


def _view_left_out(plan: CalibrationPlan, plane: PlanePlan, error: Exception) -> LeftOut:
    reason = (
        str(error)
        .removeprefix(f"{plan.path}: ")
        .removeprefix(f"plane {plane.name}: ")
        .removeprefix(f"view {plane.name}: ")
    )
    try:
        picture = small(read_image(plane.images[0]))[0]
    except FileError:
        picture = None
    return LeftOut("view", plane.name, reason, image=picture)


def _one_size(plan: CalibrationPlan, seen: list[MeasuredPlane]) -> tuple[list[MeasuredPlane], list[LeftOut]]:
    """Planes whose images have the size that most have. Of [[views]] others are left out; of planes they are refused."""
    if not seen:
        return [], []
    usual = Counter(s.size for s in seen).most_common(1)[0][0]
    kept: list[MeasuredPlane] = []
    odd: list[LeftOut] = []
    for other in seen:
        if other.size == usual:
            kept.append(other)
        elif other.plan.name in plan.globbed:
            told = f"its image is {other.size[0]} x {other.size[1]} px, others are {usual[0]} x {usual[1]} px"
            odd.append(LeftOut("view", other.plan.name, told, image=small(gray(other.image))[0]))
        else:
            first = next(s for s in seen if s.size != other.size)
            raise FileError(
                f"{plan.path}: plane {other.plan.name} has images of {other.size[0]} x {other.size[1]} px and plane "
                f"{first.plan.name} of {first.size[0]} x {first.size[1]} px; one camera setting is needed for all"
            )
    return kept, odd


def _finish_jig(
    plan: CalibrationPlan,
    seen: list[MeasuredPlane],
    model: Model,
    order: Order,
    left_out: list[LeftOut],
) -> Calibration:
    try:
        fit = _fit_jig(seen, model, order)
        named = named_faults(plan, fit, seen)
        alone = [fault for fault in named if fault.mark is not None]
        if alone:  # what no plane shows by itself, but all together
            seen = [s.without([fault for fault in alone if fault.plane == s.plan.name]) for s in seen]
            fit = _fit_jig(seen, model, order)
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error
    named = tuple(fault for fault in named if fault.mark is None)
    left_out += _marks_left_out(seen)
    placed = {marks.name: marks for marks in fit.marks}
    planes = []
    for s in seen:
        try:
            planes.append((s.plan, placed.get(s.plan.name) or locate_target(fit.camera, s.marks)))
        except CalibrationError as error:
            left_out.append(_view_left_out(plan, s.plan, error))
    found = find_lasers(plan, fit.camera, planes, curved=None)
    stages = find_stages(plan, fit.camera, found.lasers)
    left_out += [*found.left_out, *stages.left_out]
    verdict = judge_jig(plan, seen, fit, found.lasers, stages, left_out, named)
    return _calibration(plan, seen, fit, found, stages.stages, verdict, left_out)


def _fit_jig(seen: list[MeasuredPlane], model: Model, order: Order) -> TwoPlaneFit:
    jig = [s.marks for s in seen if s.plan.c_from_target is not None]
    return fit_two_plane(jig, seen[0].size, order=order, model="two-plane" if model == "two-plane" else "joint")


def _marks_left_out(seen: list[MeasuredPlane]) -> list[LeftOut]:
    told = [(s.plan.name, fault.remedy) for s in seen for fault in s.bad]
    return [LeftOut("mark", name, words.removeprefix(f"plane {name}: ")) for name, words in told]


def _finish_freehand(plan: CalibrationPlan, seen: list[MeasuredPlane], left_out: list[LeftOut]) -> Calibration:
    size = seen[0].size if seen else (0, 0)
    try:
        fit = fit_freehand([s.marks for s in seen], size, dropped=[(each.name, each.reason) for each in left_out])
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error
    before, of = {each.name for each in left_out}, {s.plan.name: s for s in seen}
    left_out += [
        LeftOut("view", name, reason, image=small(gray(of[name].image))[0])
        for name, reason in fit.dropped
        if name not in before
    ]
    left_out += _marks_left_out(seen)
    placed = {view.name: view for view in fit.views}
    planes = [(s.plan, placed[s.plan.name]) for s in seen if s.plan.name in placed]
    found = find_lasers(plan, fit.camera, planes, curved=False)
    stages = find_stages(plan, fit.camera, found.lasers)
    left_out += [*found.left_out, *stages.left_out]
    verdict = judge_freehand(plan, seen, fit, found.lasers, stages, left_out)
    return _calibration(plan, seen, fit, found, stages.stages, verdict, left_out)


def _calibration(
    plan: CalibrationPlan, seen: list[MeasuredPlane], fit: TwoPlaneFit | FreehandFit, found: FoundLasers,
    stages: tuple[Stage, ...], verdict: Verdict, left_out: list[LeftOut],
) -> Calibration:  # fmt: skip
    folder = plan.path.parent.resolve()
    blur = [s.blur_px for s in seen if np.isfinite(s.blur_px)]
    rig = Rig(
        camera=fit.camera,
        lasers=found.lasers,
        stages=stages,
        verification=verdict.verification,
        accept=plan.accept,
        camera_id=plan.camera_id,
        blur_px=float(np.median(blur)) if blur else float("nan"),
        written=datetime.now(UTC).isoformat(timespec="seconds"),
        software=f"scope {__version__}",
        operator=operator(),
        inputs={_relative(path, folder): sha256_of(path) for path in plan.files},
    )
    two_plane, freehand = (fit, None) if isinstance(fit, TwoPlaneFit) else (None, fit)
    return Calibration(
        rig, plan, tuple(seen), two_plane, freehand, found.views, verdict, tuple(left_out), found.choices
    )


def _relative(path: Path, folder: Path) -> str:
    path = path.resolve()
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)
