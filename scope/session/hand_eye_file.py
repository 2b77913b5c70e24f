"""hand-eye.toml: views of a target from a robot, and the log of its poses (docs/formats.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from calibration.errors import CalibrationError, FileError
from calibration.geometry import Pose
from calibration.stages import Mount, Repeatability
from scope.session.calibration_file import CalibrationPlan, PlanePlan
from scope.session.robot_section import (
    PoseLog,
    PoseTrack,
    RobotSection,
    read_pose_log,
    read_pose_track,
    read_times,
)
from scope.session.target_section import TargetSection, plate_of, polarity_of, target_of
from scope.session.toml_file import MM, Positive, Section, Units, matching, read_toml


class SphereSection(Section):
    """[target] kind = "sphere": stripes across it are seen, and no marks."""

    kind: Literal["sphere"]
    diameter: Positive
    laser: str | None = None


class PlanesSection(Section):
    """[target] kind = "planes": stripes across flat faces that stand still are seen, and no marks."""

    kind: Literal["planes"]
    planes: dict[str, str] | None = None
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
    target: Annotated[TargetSection | SphereSection | PlanesSection, Field(discriminator="kind")]
    robot: RobotSection
    accept: HandEyeAccept = HandEyeAccept()

    @model_validator(mode="after")
    def _complete(self) -> HandEyeSection:
        if self.target.kind == "listed":
            raise ValueError("target.kind = 'listed' names marks of single images; give a target whose marks are found")
        if (self.robot.repeatability_mm is None) != (self.robot.repeatability_deg is None):
            raise ValueError("robot.repeatability_mm and robot.repeatability_deg belong together; give both or neither")
        if self.robot.delay is not None and self.robot.times is None:
            raise ValueError(
                "robot.delay needs robot.times, a CSV with header image,seconds; robot.poses then has seconds in place of image"
            )
        if self.robot.delay == "find" and not isinstance(self.target, TargetSection):
            raise ValueError("robot.delay = 'find' needs a target with marks; state the delay in seconds for stripes")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class HandEyePlan:
    """A hand-eye file with lengths in mm and every image found."""

    path: Path
    mount: Mount
    camera_id: str
    marks: CalibrationPlan  # the target and the views, for the finder of marks
    log: PoseLog  # without rows where there is a track
    repeatability: Repeatability | None
    loo_mm: float | None  # limit of [accept]
    radius: float | None = None  # mm, of the sphere that the stripes cross; None for a target with marks
    laser: str | None = None  # that shines on it; None: the rig's only one
    planes: Mapping[str, str] | None = None  # name of the plane of each view, where stripes cross planes
    track: PoseTrack | None = None  # the log over time
    times: Mapping[str, float] = field(default_factory=dict)  # s, of each image by name, where there is a track
    delay: float | None = 0.0  # s, to be added to an image's time; None: to be found

    def plane_of(self, view: str) -> str:
        """Name of the plane that a view shows."""
        return "" if self.planes is None else self.planes[view]

    def pose_of(self, image: Path) -> Pose | None:
        """The robot's pose at an image, mm, with the delay that is stated (0 where it is to be found); None where none is told."""
        if self.track is None:
            row = self.log.row_of(image)
            return None if row is None else self.log.base_from_flange(row)
        taken = self.times.get(image.name)
        if taken is None:
            return None
        at = taken + (self.delay or 0.0)
        if not self.track.seconds[0] <= at <= self.track.seconds[-1]:
            return None
        return self.track.at(np.array([at]))[0]


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
    file = path.parent / robot.poses
    track, times = None, {}
    if robot.times is None:
        log = read_pose_log(file, robot.notation, robot.units, robot.gives)
    else:
        track, times = (
            read_pose_track(file, robot.notation, robot.units, robot.gives),
            read_times(path.parent / robot.times),
        )
        log = PoseLog(file, (), np.zeros((0, 0)), robot.notation, robot.units, robot.gives)
    delay = None if robot.delay == "find" else float(robot.delay or 0.0)
    stated = None
    if robot.repeatability_mm is not None and robot.repeatability_deg is not None:
        stated = Repeatability(robot.repeatability_mm * mm, float(np.deg2rad(robot.repeatability_deg)))
    sphere = raw.target if isinstance(raw.target, SphereSection) else None
    radius = None if sphere is None else 0.5 * sphere.diameter * mm
    laser = None if isinstance(raw.target, TargetSection) else raw.target.laser
    planes = _planes(path, raw.target, images) if isinstance(raw.target, PlanesSection) else None
    limit = None if raw.accept.loo_mm is None else raw.accept.loo_mm * mm
    return HandEyePlan(
        path, raw.mount, raw.camera_id, marks, log, stated, limit, radius, laser, planes, track, times, delay
    )


def _planes(path: Path, section: PlanesSection, images: list[Path]) -> dict[str, str]:
    """Name of the plane of each view (the image's stem); ``FileError`` where an image is of none or of two."""
    if section.planes is None:
        return {image.stem: "plane" for image in images}
    found = {}
    for image in images:
        mine = [name for name, pattern in section.planes.items() if fnmatchcase(image.name, pattern)]
        if len(mine) != 1:
            raise FileError(
                f"{path}: target.planes: {image.name} is matched by {' and '.join(mine) or 'none'} of {', '.join(section.planes)}; each image shows one "
                "plane: correct the patterns"
            )
        found[image.stem] = mine[0]
    return found
