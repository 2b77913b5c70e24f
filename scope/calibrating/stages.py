"""Images of the target carried by a stage to the stage's direction or axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.camera import Camera
from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array, Ints
from calibration.grouping import grouped
from calibration.rays import PlaneMarks, centre_covariance, locate_target
from calibration.stages import Stage, fit_linear, fit_turntable
from scope.calibrating.left_out import LeftOut, small
from scope.calibrating.marks import measure_plane
from scope.session import CalibrationPlan, PlanePlan, StagePlan, read_image

_LEAST = 6  # marks of a position, from which its place follows


def find_stages(plan: CalibrationPlan, camera: Camera) -> tuple[tuple[Stage, ...], tuple[LeftOut, ...]]:
    """Fit every [[stage]] of a calibration file, each from the target's pose at its positions; and the images left out."""
    found = [_find(plan, camera, stage, number) for number, stage in enumerate(plan.stages, start=1)]
    return tuple(stage for stage, _ in found), tuple(each for _, left_out in found for each in left_out)


def _find(plan: CalibrationPlan, camera: Camera, stage: StagePlan, number: int) -> tuple[Stage, list[LeftOut]]:
    if stage.target is None:
        raise CalibrationError(
            f"{plan.path}: stage {number}: listed marks belong to single planes; a stage needs a target of kind spots, "
            "chessboard, charuco, circles or markers: give it as [stage.target]"
        )
    views, known, left_out = _views(replace(plan, target=stage.target), camera, stage, number)
    if len(views) < 2:
        told = grouped([(each.name, each.reason) for each in left_out], len(stage.images), "images", longest=150)
        raise CalibrationError(
            f"{plan.path}: stage {number}: its target is seen at {len(views)} positions, two are needed: {told}"
        )
    positions = stage.positions[known]
    common = np.array(sorted(set.intersection(*(set(view.mark.tolist()) for view in views))))
    if len(common) >= _LEAST:
        tracks = np.stack([_of_marks(view, common) for view in views])
    else:  # no part of the target is in view throughout: its places as a whole tell the same
        tracks = np.stack([view.c_from_plane.apply(stage.target.marks) for view in views])
    try:
        if stage.kind == "linear":
            covariance = np.stack([centre_covariance(camera, view) for view in views])
            return fit_linear(tracks, positions, covariance=covariance), left_out
        return fit_turntable(tracks, np.deg2rad(positions)), left_out
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error


def _views(
    plan: CalibrationPlan, camera: Camera, stage: StagePlan, number: int
) -> tuple[list[PlaneMarks], list[int], list[LeftOut]]:
    """The target at the positions where it can be placed, which these are, and what was left out."""
    views: list[PlaneMarks] = []
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
            views.append(locate_target(camera, view.marks))
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
