"""Images of the target carried by a stage to the stage's direction or axis."""

from __future__ import annotations

import numpy as np

from calibration.camera import Camera
from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array, Ints
from calibration.rays import PlaneMarks, centre_covariance, locate_target
from calibration.stages import Stage, fit_linear, fit_turntable
from scope.calibrating.marks import measure_plane
from scope.session import CalibrationPlan, PlanePlan, StagePlan


def find_stages(plan: CalibrationPlan, camera: Camera) -> tuple[Stage, ...]:
    """Fit every [[stage]] of a calibration file, each from the target's pose at its positions."""
    return tuple(_find(plan, camera, stage, number) for number, stage in enumerate(plan.stages, start=1))


def _find(plan: CalibrationPlan, camera: Camera, stage: StagePlan, number: int) -> Stage:
    if plan.target is None:
        raise CalibrationError(
            f"{plan.path}: stage {number}: listed marks belong to single planes; a stage needs a target of kind spots, "
            "chessboard or charuco"
        )
    views: list[PlaneMarks] = []
    for position, image in zip(stage.positions, stage.images, strict=True):
        name = f"stage {number} at {position:g}"
        view = measure_plane(plan, PlanePlan(name, (image,), None, {}, {}, None, None))
        if view.size != camera.size:
            raise FileError(
                f"{image}: stage {number}: {view.size[0]} x {view.size[1]} px; the planes were seen at {camera.size[0]} x "
                f"{camera.size[1]} px: take both with the same camera settings"
            )
        try:
            views.append(locate_target(camera, view.marks))
        except CalibrationError as error:
            raise CalibrationError(f"{plan.path}: {error}") from error
    common = np.array(sorted(set.intersection(*(set(view.mark.tolist()) for view in views))))
    if len(common) < 6:
        raise CalibrationError(
            f"{plan.path}: stage {number}: {len(common)} marks are seen at every position; six or more are needed: move less"
        )
    tracks = np.stack([_of_marks(view, common) for view in views])
    try:
        if stage.kind == "linear":
            return fit_linear(
                tracks, stage.positions, covariance=np.stack([centre_covariance(camera, view) for view in views])
            )
        return fit_turntable(tracks, np.deg2rad(stage.positions))
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error


def _of_marks(view: PlaneMarks, wanted: Ints) -> Array:
    """World points (n, 3) of the wanted marks, in their order."""
    rank = np.argsort(view.mark)
    return np.asarray(view.world[rank[np.searchsorted(view.mark[rank], wanted)]])
