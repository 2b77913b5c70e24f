"""calibration.toml to a rig: the stages of a calibration joined."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calibration.errors import CalibrationError, FileError
from calibration.rays import FreehandFit, Order, PlaneMarks, TwoPlaneFit, fit_freehand, fit_two_plane, locate_target
from calibration.rig import AnyCamera, Rig, sha256_of
from calibration.sheet import Laser
from calibration.stages import Stage
from scope.calibrating.lasers import LaserView, find_lasers
from scope.calibrating.marks import MeasuredPlane, measure_plane
from scope.calibrating.stages import find_stages
from scope.calibrating.verdict import Dropped, Verdict, judge_freehand, judge_jig
from scope.session import CalibrationPlan, CalibrationSession, plan_of, read_calibration
from scope.version import __version__

Model = Literal["auto", "two-plane", "joint", "pinhole"]
Tick = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Calibration:
    """A rig and everything that led to it."""

    rig: Rig
    plan: CalibrationPlan
    measured: tuple[MeasuredPlane, ...]
    two_plane: TwoPlaneFit | None
    freehand: FreehandFit | None
    views: tuple[LaserView, ...]
    verdict: Verdict

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

    def __repr__(self) -> str:
        """The verdict in one line."""
        return f"<Calibration {'passed' if self.passed else 'did not pass'}: {self.why}>"


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
    on_jig = any(plane.c_from_target is not None for plane in plan.planes)
    seen: list[MeasuredPlane] = []
    dropped: list[Dropped] = []  # views by hand: the others may do without them
    for k, plane in enumerate(plan.planes):
        try:
            seen.append(measure_plane(plan, plane))
        except CalibrationError as error:
            if on_jig:
                raise
            dropped.append((plane.name, str(error).removeprefix(f"{plan.path}: plane {plane.name}: ")))
        on_plane(k + 1, len(plan.planes))
    size = _one_size(plan, seen) if seen else (0, 0)
    jig = [s.marks for s in seen if s.plan.c_from_target is not None]
    if jig:
        return _finish_jig(plan, seen, jig, size, model, order)
    return _finish_freehand(plan, seen, dropped, size)


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


def _one_size(plan: CalibrationPlan, seen: list[MeasuredPlane]) -> tuple[int, int]:
    for other in seen[1:]:
        if other.size != seen[0].size:
            raise FileError(
                f"{plan.path}: plane {other.plan.name} has images of {other.size[0]} x {other.size[1]} px and plane "
                f"{seen[0].plan.name} of {seen[0].size[0]} x {seen[0].size[1]} px; one camera setting is needed for all"
            )
    return seen[0].size


def _finish_jig(
    plan: CalibrationPlan,
    seen: list[MeasuredPlane],
    jig: list[PlaneMarks],
    size: tuple[int, int],
    model: Model,
    order: Order,
) -> Calibration:
    try:
        fit = fit_two_plane(jig, size, order=order, model="two-plane" if model == "two-plane" else "joint")
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error
    placed = {marks.name: marks for marks in fit.marks}
    planes = [(s.plan, placed.get(s.plan.name) or _located(plan, fit.camera, s)) for s in seen]
    lasers, views = find_lasers(plan, fit.camera, planes, curved=None)
    stages = find_stages(plan, fit.camera)
    verdict = judge_jig(plan, seen, fit, lasers, stages)
    return _calibration(plan, seen, fit.camera, lasers, views, stages, verdict, fit, None)


def _located(plan: CalibrationPlan, camera: AnyCamera, seen: MeasuredPlane) -> PlaneMarks:
    try:
        return locate_target(camera, seen.marks)
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error


def _finish_freehand(
    plan: CalibrationPlan, seen: list[MeasuredPlane], dropped: list[Dropped], size: tuple[int, int]
) -> Calibration:
    try:
        fit = fit_freehand([s.marks for s in seen], size, dropped=dropped)
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error
    placed = {view.name: view for view in fit.views}
    planes = [(s.plan, placed[s.plan.name]) for s in seen if s.plan.name in placed]
    lasers, views = find_lasers(plan, fit.camera, planes, curved=False)
    stages = find_stages(plan, fit.camera)
    verdict = judge_freehand(plan, seen, fit, lasers, stages)
    return _calibration(plan, seen, fit.camera, lasers, views, stages, verdict, None, fit)


def _calibration(
    plan: CalibrationPlan, seen: list[MeasuredPlane], camera: AnyCamera, lasers: dict[str, Laser], views: tuple[LaserView, ...],
    stages: tuple[Stage, ...], verdict: Verdict, two_plane: TwoPlaneFit | None, freehand: FreehandFit | None,
) -> Calibration:  # fmt: skip
    folder = plan.path.parent.resolve()
    blur = [s.blur_px for s in seen if np.isfinite(s.blur_px)]
    rig = Rig(
        camera=camera,
        lasers=lasers,
        stages=stages,
        verification=verdict.verification,
        accept=plan.accept,
        camera_id=plan.camera_id,
        blur_px=float(np.median(blur)) if blur else float("nan"),
        written=datetime.now(UTC).isoformat(timespec="seconds"),
        software=f"scope {__version__}",
        inputs={_relative(path, folder): sha256_of(path) for path in plan.files},
    )
    return Calibration(rig, plan, tuple(seen), two_plane, freehand, views, verdict)


def _relative(path: Path, folder: Path) -> str:
    path = path.resolve()
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)
