"""Images of the target carried by a stage to the stage's direction or axis."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from calibration.camera import Camera, centre_of
from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array, Ints
from calibration.grouping import grouped
from calibration.rays import PlaneMarks, centre_covariance, locate_target
from calibration.sheet import Laser, followed
from calibration.stages import Stage, fit_linear, fit_turntable
from calibration.targets import MarkerBoard
from ranging.background import Image
from scope.calibrating.left_out import LeftOut, small
from scope.calibrating.marks import measure_plane
from scope.calibrating.stage_scale import Scale, scale_by_lasers
from scope.session import CalibrationPlan, PlanePlan, StagePlan, gray, read_image

_CLOSE = 0.03  # share by which sides and places of markers may disagree, as they were measured
_LEAST = 6  # marks of a position, from which its place follows


@dataclass(frozen=True, slots=True, eq=False)
class FoundStages:
    """The stages of a calibration, what was left out, and what there is to say about them."""

    stages: tuple[Stage, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    warnings: tuple[str, ...] = ()


def find_stages(plan: CalibrationPlan, camera: Camera, lasers: Mapping[str, Laser]) -> FoundStages:
    """Fit every [[stage]] of a calibration file, each from the target's pose at its positions.

    Where a laser shines on a turntable's target and puts it nearer or farther by one factor than its stated lengths do, the axis
    is put to the laser's scale, in which is scanned; a warning says so where the factor is more than an error of measurement.
    """
    found = FoundStages()
    for number, plan_of_stage in enumerate(plan.stages, start=1):
        plan_of_stage, spread = _spread(plan_of_stage, number)
        views, known, left_out = _views(plan, camera, plan_of_stage, number)
        stage = _fit(plan, camera, plan_of_stage, views, known, left_out, number)
        scale = scale_by_lasers(camera, lasers, views)
        told = spread
        if scale is not None:
            if scale.mistaken:
                told = (*told, _contradiction(number, scale, scaled=stage.kind == "turntable"))
            if stage.kind == "turntable":
                centre = centre_of(camera.rays(views[0][0].pixels))
                stage = replace(stage, point=centre + scale.factor * (stage.point - centre), scale=scale.factor)
                if stage.coupling.size:
                    stage = replace(stage, coupling=stage.coupling * np.repeat([[scale.factor], [1.0]], 3, axis=0))
        found = FoundStages((*found.stages, stage), (*found.left_out, *left_out), (*found.warnings, *told))
    return found


def _spread(stage: StagePlan, number: int) -> tuple[StagePlan, tuple[str, ...]]:
    """The stage with markers as far apart as their sides say, and a warning where that is not as far as was stated."""
    from calibration.targets import spread_of

    if not isinstance(stage.target, MarkerBoard):
        return stage, ()
    target = stage.target
    factors = np.array([spread_of(gray(read_image(image)), target) for image in stage.images])
    factors = factors[np.isfinite(factors)]
    if len(factors) < 2:
        return stage, ()
    middle = float(np.median(factors))
    if abs(middle - 1.0) < _CLOSE or float(np.median(np.abs(factors - middle))) > 0.3 * abs(middle - 1.0):
        return stage, ()
    told = (
        f"stage {number}: in {len(factors)} images its markers stand {middle:.3f} times as far apart as `places` says, if their side "
        f"is {target.side:g} mm: measure both; the side was believed"
    )
    return replace(stage, target=replace(target, spread=middle)), (told,)


def _contradiction(number: int, scale: Scale, *, scaled: bool) -> str:
    return (
        f"stage {number}: laser {scale.laser} puts its target {scale.factor:.3f} times as far away as its stated lengths do, at "
        f"{scale.positions} positions: measure those of both targets; one is wrong"
        + (", and the axis was put to the laser's scale" if scaled else "")
    )


def _fit(
    plan: CalibrationPlan,
    camera: Camera,
    stage: StagePlan,
    seen: list[tuple[PlaneMarks, Image]],
    known: list[int],
    left_out: list[LeftOut],
    number: int,
) -> Stage:
    views = [view for view, _ in seen]
    if len(views) < 2:
        told = grouped([(each.name, each.reason) for each in left_out], len(stage.images), "images", longest=150)
        raise CalibrationError(
            f"{plan.path}: stage {number}: its target is seen at {len(views)} positions, two are needed: {told}"
        )
    positions = stage.positions[known]
    common = np.array(sorted(set.intersection(*(set(view.mark.tolist()) for view in views))))
    if len(common) >= _LEAST:
        tracks = np.stack([_of_marks(view, common) for view in views])
    elif stage.target is not None:  # no part of the target is in view throughout: its places as a whole tell the same
        tracks = np.stack([view.c_from_plane.apply(stage.target.marks) for view in views])

    def fitted(tracks: Array) -> Stage:
        if stage.kind == "linear":
            covariance = np.stack([centre_covariance(camera, view) for view in views])
            return fit_linear(tracks, positions, covariance=covariance)
        return fit_turntable(tracks, np.deg2rad(positions))

    try:
        found = fitted(tracks)
        return replace(found, coupling=_coupling(camera, views, tracks, fitted)) if camera.model == "pinhole" else found
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error


def _coupling(camera: Camera, views: list[PlaneMarks], tracks: Array, fitted: Callable[[Array], Stage]) -> Array:
    """How point and direction (6, P) follow the camera's parameters, by differences of half a standard deviation to either side.

    Of each parameter the target takes the rigid motion, at each position, that follows its marks' rays.
    """
    scale = np.sqrt(np.maximum(np.diag(camera.covariance), 0.0))
    motions = [followed(camera, view.pixels, view.world, view.world.mean(axis=0)) for view in views]
    arms = [track - view.world.mean(axis=0) for track, view in zip(tracks, views, strict=True)]
    found = np.zeros((6, len(scale)))
    for k in np.flatnonzero(scale > 0):
        moved = np.stack([np.cross(m[:3, k], arm) + m[3:, k] for m, arm in zip(motions, arms, strict=True)])
        ends = [fitted(tracks + sign * 0.5 * scale[k] * moved) for sign in (1, -1)]
        found[:, k] = np.concatenate([ends[0].point - ends[1].point, ends[0].direction - ends[1].direction]) / scale[k]
    return found


def _views(
    plan: CalibrationPlan, camera: Camera, stage: StagePlan, number: int
) -> tuple[list[tuple[PlaneMarks, Image]], list[int], list[LeftOut]]:
    """The target at the positions where it can be placed and its image, which these are, and what was left out."""
    if stage.target is None:
        raise CalibrationError(
            f"{plan.path}: stage {number}: listed marks belong to single planes; a stage needs a target of kind spots, "
            "chessboard, charuco, circles or markers: give it as [stage.target]"
        )
    plan = replace(plan, target=stage.target)
    views: list[tuple[PlaneMarks, Image]] = []
    known: list[int] = []
    left_out: list[LeftOut] = []
    for k, (position, image) in enumerate(zip(stage.positions, stage.images, strict=True)):
        name = f"stage {number} at {position:g}"
        try:
            view = measure_plane(plan, PlanePlan(name, (image,), None, {}, {}, None, None))
            if view.size != camera.size:
                raise FileError(
                    f"{image}: stage {number}: {view.size[0]} x {view.size[1]} px; the planes were seen at {camera.size[0]} x "
                    f"{camera.size[1]} px: take both with the same camera settings"
                )
            views.append((locate_target(camera, view.marks), read_image(image)))
            known.append(k)
        except CalibrationError as error:
            reason = (
                str(error).removeprefix(f"{plan.path}: ").removeprefix(f"plane {name}: ").removeprefix(f"view {name}: ")
            )
            left_out.append(LeftOut("view", name, reason, image=small(read_image(image))[0]))
    return views, known, left_out


def _of_marks(view: PlaneMarks, wanted: Ints) -> Array:
    """World points (n, 3) of the wanted marks, in their order."""
    rank = np.argsort(view.mark)
    return np.asarray(view.world[rank[np.searchsorted(view.mark[rank], wanted)]])
