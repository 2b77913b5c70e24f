"""hand-eye.toml: views of a target from a robot, and the log of its poses (docs/formats.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from calibration.errors import CalibrationError, FileError
from calibration.stages import Mount, Repeatability
from scope.session.calibration_file import CalibrationPlan, PlanePlan
from scope.session.robot_section import PoseLog, RobotSection, read_pose_log
from scope.session.target_section import TargetSection, plate_of, polarity_of, target_of
from scope.session.toml_file import MM, Positive, Section, Units, matching, read_toml


class SphereSection(Section):
    """[target] kind = "sphere": stripes across it are seen, and no marks."""

    kind: Literal["sphere"]
    diameter: Positive
    laser: str | None = None


class HandEyeAccept(Section):
    """[accept]: what "passed" means for this work."""

    loo_mm: Positive | None = None


class HandEyeSection(Section):
    """The whole file."""

    format: Literal[1]
    units: Units = "mm"
    camera_id: str = ""
    mount: Mount
    target: Annotated[TargetSection | SphereSection, Field(discriminator="kind")]
    robot: RobotSection
    accept: HandEyeAccept = HandEyeAccept()

    @model_validator(mode="after")
    def _complete(self) -> HandEyeSection:
        if self.target.kind == "listed":
            raise ValueError("target.kind = 'listed' names marks of single images; give a target whose marks are found")
        if (self.robot.repeatability_mm is None) != (self.robot.repeatability_deg is None):
            raise ValueError("robot.repeatability_mm and robot.repeatability_deg belong together; give both or neither")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class HandEyePlan:
    """A hand-eye file with lengths in mm and every image found."""

    path: Path
    mount: Mount
    camera_id: str
    marks: CalibrationPlan  # the target and the views, for the finder of marks
    log: PoseLog
    repeatability: Repeatability | None
    loo_mm: float | None  # limit of [accept]
    radius: float | None = None  # mm, of the sphere that the stripes cross; None for a target with marks
    laser: str | None = None  # that shines on it; None: the rig's only one


def read_hand_eye_plan(path: Path) -> HandEyePlan:
    """Read hand-eye.toml and its log of poses; ``FileError`` names file, key, what was found and what is allowed."""
    raw = read_toml(path, HandEyeSection)
    mm = MM[raw.units]
    images = matching(path.parent, raw.robot.images, owner=path, key="robot.images")
    names = [image.name for image in images]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise FileError(
            f"{path}: robot.images: two images are called {twice}; the log of poses could not tell them apart"
        )
    section = raw.target if isinstance(raw.target, TargetSection) else TargetSection(kind="listed")
    try:
        target = target_of(section, mm)
    except CalibrationError as error:
        raise FileError(f"{path}: {error}") from error
    views = tuple(PlanePlan(image.stem, (image,), None, {}, {}, None, None) for image in images)
    marks = CalibrationPlan(path, raw.camera_id, target, polarity_of(section), {}, (), views, (), plate_of(section, mm))
    robot = raw.robot
    log = read_pose_log(path.parent / robot.poses, robot.notation, robot.units, robot.gives)
    stated = None
    if robot.repeatability_mm is not None and robot.repeatability_deg is not None:
        stated = Repeatability(robot.repeatability_mm * mm, float(np.deg2rad(robot.repeatability_deg)))
    sphere = raw.target if isinstance(raw.target, SphereSection) else None
    radius, laser = (None, None) if sphere is None else (0.5 * sphere.diameter * mm, sphere.laser)
    limit = None if raw.accept.loo_mm is None else raw.accept.loo_mm * mm
    return HandEyePlan(path, raw.mount, raw.camera_id, marks, log, stated, limit, radius, laser)
