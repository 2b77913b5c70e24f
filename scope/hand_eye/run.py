"""The stages of hand and eye joined: marks, poses, agreement, adjustment, verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array
from calibration.grouping import grouped
from calibration.notation import NOTATIONS, numbers_of
from calibration.rig import Rig
from calibration.stages import HandEyeFit, Mount, SeenTarget, consensus, require_turns, solve_hand_eye
from scope.calibrating import measure_plane
from scope.hand_eye.covariance import by_place_first
from scope.hand_eye.planes import planes_answer
from scope.hand_eye.readings import Reading, readings_of
from scope.hand_eye.sphere import passes_of, sphere_answer
from scope.hand_eye.timing import Delay, with_delay
from scope.hand_eye.views import require_size, seen_target
from scope.session import SENSOR, TARGET, HandEye, HandEyePlan, read_hand_eye_plan

Tick = Callable[[int, int], None]
_BETTER = 4.0  # times by which another reading of the log must agree better to be named
_SUSPECT = 0.1  # mm; and so many times what the views themselves are unsure of, below which no other reading is tried
_UNUSABLE_MM = 10.0  # scatter of a robot's poses (one sigma) that is none


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeResult:
    """Where the camera is on the robot, or why that is not known."""

    plan: HandEyePlan
    fit: HandEyeFit | None  # None: no answer
    answer: HandEye | None
    dropped: tuple[dict[str, Any], ...]  # part, name, reason, count
    warnings: tuple[str, ...]
    passed: bool
    why: str
    likely: Reading | None = None  # the way to read the log in which the views agree
    measured: Mapping[str, Any] = field(default_factory=dict)  # by view: what the finder of marks gave

    @property
    def result(self) -> dict[str, Any]:
        """What --json gives."""
        mount = self.plan.mount
        if self.answer is None:
            return {
                "kind": "scope hand-eye", "mount": mount, SENSOR[mount]: None, TARGET[mount]: None, "covariance": None,
                "rms_mm": None, "loo_mm": None, "views": [], "dropped": list(self.dropped), "warnings": list(self.warnings),
                "reading": None if self.likely is None else self.likely.told, "passed": False, "why": self.why,
            }  # fmt: skip
        return self.answer.content()


def _no_tick(_done: int, _total: int) -> None:
    return None


def hand_eye(path: str | Path, rig: Rig | str | Path, *, on_view: Tick = _no_tick) -> HandEyeResult:
    """Where a rig's camera is on a robot, after a hand-eye.toml.

    Parameters
    ----------
    path : path
        hand-eye.toml.
    rig : Rig or path
        Whose frame C the answer is about.
    on_view : callable
        Called with (done, total) after each view.

    Returns
    -------
    HandEyeResult
        Without an answer where the poses do not determine it, or where the views agree only if the log is read in another
        way than was stated: ``why`` then says which.

    Raises
    ------
    FileError, CalibrationError
        Files that cannot be read, or fewer than three views with marks and a pose.
    """
    plan = read_hand_eye_plan(Path(path))
    rig = rig if isinstance(rig, Rig) else Rig.load(rig)
    if plan.camera_id and rig.camera_id and plan.camera_id != rig.camera_id:
        raise FileError(f"{plan.path}: camera_id {plan.camera_id!r}, the rig is of {rig.camera_id!r}; use its own rig")
    if plan.radius is not None or plan.planes is not None:
        return _by_stripes(plan, rig, on_view)
    views, (rows, seconds), dropped, measured = _views(plan, rig, on_view)
    if len(views) < 3:
        told = grouped([(d["name"], d["reason"]) for d in dropped], len(plan.marks.planes), "views", longest=150)
        raise CalibrationError(
            f"{plan.path}: {len(views)} views with marks and a pose; 10 are wanted, 3 the least: {told}"
        )
    try:
        require_turns(views)
    except CalibrationError as error:
        return HandEyeResult(plan, None, None, tuple(dropped), (), False, str(error), measured=measured)
    camera = _known(rig.camera.covariance)
    if plan.track is not None and plan.delay is None:
        try:
            _, _, fit, delay = with_delay(plan, plan.track, views, np.array(seconds), camera)
        except CalibrationError as error:
            return HandEyeResult(plan, None, None, tuple(dropped), (), False, str(error), measured=measured)
        return _judged(plan, rig, fit, dropped, measured, delay)
    start = consensus(views, plan.mount)
    unsure = float(np.median([_unsure(view) for view in views]))
    likely = None
    if plan.track is None and start.typical_mm > max(_SUSPECT, 5.0 * unsure):
        likely = next(iter(readings_of(plan.log, rows, views, plan.mount)), None)
    if likely is not None and likely.start.typical_mm * _BETTER < start.typical_mm:
        why = (
            f"the views contradict the poses by {start.typical_mm:.3g} mm (median) as they were stated, and agree to "
            f"{likely.start.typical_mm:.2g} mm when read with {likely.told}{_as_well(plan.mount, likely)}: correct that and run again"
        )
        return HandEyeResult(plan, None, None, tuple(dropped), (), False, why, likely, measured)
    try:
        fit = solve_hand_eye(
            views, plan.mount, repeatability=plan.repeatability, camera_covariance=camera, start=start
        )  # fmt: skip
    except CalibrationError as error:
        return HandEyeResult(plan, None, None, tuple(dropped), (), False, str(error), measured=measured)
    return _judged(plan, rig, fit, dropped, measured)


def _by_stripes(plan: HandEyePlan, rig: Rig, on_view: Tick) -> HandEyeResult:
    passes, dropped = passes_of(plan, rig, on_view)
    what = "sphere" if plan.radius is not None else "planes"
    if not passes:
        told = grouped([(d["name"], d["reason"]) for d in dropped], len(plan.marks.planes), "passes", longest=150)
        raise CalibrationError(f"{plan.path}: no pass with a stripe on the {what} and a pose: {told}")
    try:
        answer = (sphere_answer if plan.radius is not None else planes_answer)(plan, rig, passes, dropped)
    except CalibrationError as error:
        return HandEyeResult(plan, None, None, tuple(dropped), (), False, str(error))
    return HandEyeResult(plan, None, answer, tuple(dropped), (), answer.passed, answer.why)


def _views(
    plan: HandEyePlan, rig: Rig, on_view: Tick
) -> tuple[list[SeenTarget], tuple[list[int], list[float]], list[dict[str, Any]], dict[str, Any]]:
    """Views with marks and a pose, the rows of their poses and when they were taken, what was left out, and what the finder gave."""
    views: list[SeenTarget] = []
    rows: list[int] = []
    seconds: list[float] = []
    dropped: list[dict[str, Any]] = []
    measured: dict[str, Any] = {}
    named = {plan.log.row_of(plane.images[0]) for plane in plan.marks.planes if isinstance(plane.images[0], Path)}
    total = len(plan.marks.planes)
    if plan.track is None and named <= {None}:
        raise FileError(
            f"{plan.log.path}: none of its {len(plan.log.names)} rows names one of {total} images; column image holds file "
            f"names such as {Path(str(plan.marks.planes[0].images[0])).name}"
        )
    for done, plane in enumerate(plan.marks.planes, start=1):
        image = Path(str(plane.images[0]))
        row = plan.log.row_of(image)
        try:
            pose = plan.pose_of(image)
            if pose is None:
                raise CalibrationError(f"no row of {plan.log.path.name} names {image.name}")
            found = measure_plane(plan.marks, plane)
            require_size(found.size, rig.camera, str(image))
            views.append(seen_target(rig.camera, found.marks, pose, plan.marks.target))
            rows.append(-1 if row is None else row)
            seconds.append(plan.times.get(image.name, 0.0))
            measured[plane.name] = found
        except CalibrationError as error:
            dropped.append(_left_out(plane.name, _bare(str(error), plan, plane.name)))
        on_view(done, total)
    extra = [name for k, name in enumerate(plan.log.names) if k not in named]
    dropped += [_left_out(Path(name).stem, "no image of this name") for name in extra]
    return views, (rows, seconds), dropped, measured


def _judged(
    plan: HandEyePlan,
    rig: Rig,
    fit: HandEyeFit,
    dropped: list[dict[str, Any]],
    measured: dict[str, Any],
    delay: Delay | None = None,
) -> HandEyeResult:
    dropped = [*dropped, *(_left_out(view.name, view.reason) for view in fit.views if not view.used)]
    covariance = by_place_first(fit.covariance[:6, :6])
    warnings = _warnings(plan, rig, fit)
    passed, why = _verdict(plan, fit)
    told = {
        "covariance_target": by_place_first(fit.covariance[6:, 6:]).tolist(),
        "covariance_calibration": by_place_first(fit.of_camera[:6, :6]).tolist(),
        "rms_mm": fit.rms_mm,
        "rms_px": fit.rms_px,
        "mark_px": fit.pixel_sigma,
        "loo_mm": fit.loo_mm,
        "loo_ray_mm": float(np.median([view.loo_ray_mm for view in fit.views if view.used])),
        "repeatability": "stated" if fit.robot_stated else "from the scatter of the views",
        "views": [
            {"name": v.name, "used": v.used, "loo_mm": v.loo_mm, "loo_ray_mm": v.loo_ray_mm, "robot_off_mm": v.off_mm,
             "robot_off_deg": float(np.rad2deg(v.off_rad))}
            for v in fit.views
        ],
        "notations": {name: numbers_of(name, fit.sensor).tolist() for name in NOTATIONS},
        "dropped": dropped,
        "warnings": list(warnings),
        **({} if delay is None else {"delay_s": delay.seconds, "delay_sigma_s": delay.sigma}),
    }  # fmt: skip
    answer = HandEye(fit.mount, fit.sensor, fit.target, covariance, fit.robot, rig.sha256, passed, why, told)
    return HandEyeResult(plan, fit, answer, tuple(dropped), warnings, passed, why, measured=measured)


def _verdict(plan: HandEyePlan, fit: HandEyeFit) -> tuple[bool, str]:
    n = len(fit.views)
    if fit.robot.mm > _UNUSABLE_MM or fit.used < 0.6 * n:
        return False, (
            f"{fit.used} of {n} views agree, to {fit.robot.mm:.3g} mm and {np.rad2deg(fit.robot.rad):.2g} degrees of the robot's "
            "poses, and no usual convention fits better: check that each image has the pose it was taken at, that the arm stood "
            "still, and that the target did not move"
        )
    if plan.loo_mm is not None and not fit.loo_mm <= plan.loo_mm:
        return (
            False,
            f"left out in turn, views are off by {fit.loo_mm:.3g} mm (median); accept.loo_mm allows {plan.loo_mm:g}",
        )
    if fit.used < 5:
        return (
            False,
            f"{fit.used} views leave too little to tell whether one of them is wrong; add views, 10 are wanted",
        )
    limit = "" if plan.loo_mm is None else f" (allowed {plan.loo_mm:g})"
    return True, f"{fit.used} of {n} views agree; left out in turn they are off by {fit.loo_mm:.2g} mm (median){limit}"


def _warnings(plan: HandEyePlan, rig: Rig, fit: HandEyeFit) -> tuple[str, ...]:
    found = []
    if fit.beyond > 1.0 and plan.repeatability is not None:
        found.append(
            f"the poses scatter by {fit.robot.mm:.2g} mm and {np.rad2deg(fit.robot.rad):.2g} degrees, more than the stated "
            f"{plan.repeatability.mm:.2g} mm and {np.rad2deg(plan.repeatability.rad):.2g} degrees: a robot is less accurate than "
            "repeatable; the scatter was taken"
        )
    sigma = float(np.sqrt(np.diag(fit.covariance)[3:6].max()))
    if sigma > 1.0:
        found.append(
            f"the camera's place is known to {sigma:.2g} mm only: turn the arm further about two axes, and add views nearer to "
            "the target"
        )
    if not rig.verification.passed:
        found.append(f"the rig is not verified ({rig.verification.why})"[:280])
    return tuple(found)


def _as_well(mount: Mount, likely: Reading) -> str:
    """The other key that would explain the same numbers."""
    if likely.mount == mount and "gives" in likely.told:
        other = "fixed" if mount == "hand" else "hand"
        return f' (or mount = "{other}", if the camera is {"beside the arm" if other == "fixed" else "on the arm"})'
    if likely.mount != mount:
        return " (or the other `gives`)"
    return ""


def _unsure(view: SeenTarget) -> float:
    """About by how many mm a view's marks, as it puts them, are unsure along the sight: from a third of a pixel over the target."""
    scale = float(np.median(np.linalg.norm(view.to_pixels, axis=2)))  # px/mm
    size = float(np.ptp(view.points[0], axis=0).max())
    away = float(
        np.linalg.norm(view.camera_from_target[0].apply(view.points[0]).mean(axis=0) - view.origin.mean(axis=0))
    )
    return float(0.1 / max(scale, 1e-9) * (1.0 + away / max(size, 1e-9)) / np.sqrt(max(len(view.points[0]), 1) / 12.0))


def _known(covariance: Array) -> Array | None:
    return covariance if np.isfinite(covariance).all() else None


def _left_out(name: str, reason: str) -> dict[str, Any]:
    return {"part": "view", "name": name, "reason": reason, "count": 1}


def _bare(text: str, plan: HandEyePlan, name: str) -> str:
    return text.removeprefix(f"{plan.path}: ").removeprefix(f"plane {name}: ").removeprefix(f"view {name}: ")
