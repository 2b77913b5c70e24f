"""capture.toml: one scan (docs/formats.md)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, Strict, Tag, model_validator

from calibration.errors import FileError
from calibration.geometry import Array, Pose
from calibration.notation import Notation
from calibration.targets import MarkerBoard
from ranging.motion import Fixed, Linear, Motion, Poses, Positions, ToldPositions, Turntable
from ranging.robot import Robot
from scope.session.camera_section import TIMEOUT_S, CameraSection, CameraSettings, camera_settings
from scope.session.following import GAP_S, Clock, Follow
from scope.session.hand_eye import HandEye
from scope.session.positions import csv_by_frame, listed_positions, logged_positions, rows_of_frames
from scope.session.robot_section import Gives, read_pose_log
from scope.session.target_section import MarkersSection, board_of
from scope.session.toml_file import MM, Number, Positive, Section, Units, Vector, matching, numbers, read_toml

Channel = Literal["auto", "red", "green", "blue", "gray"]
_MOST_NUMBERS = 1_000_000  # between the first and the last frame
_ROBOT = ("hand_eye", "poses", "units", "notation", "gives")
_LOGGED = ("log", "times", "clock", "delay", "gap")
_MATRIX = tuple(f"m{i}{j}" for i in range(4) for j in range(4))


# tags hold a dash, so that messages leave them out of the key
Camera = Annotated[
    Annotated[int, Strict(), Field(ge=0, le=63), Tag("by-number")] | Annotated[CameraSection, Tag("by-table")],
    Discriminator(lambda value: "by-table" if isinstance(value, dict | CameraSection) else "by-number"),
]


class MotionSection(Section):
    """[motion]: how object and sensor move against each other."""

    kind: Literal["fixed", "linear", "turntable", "poses", "robot"] = "fixed"
    moves: Literal["object", "sensor"] | None = None
    direction: Vector | Literal["rig", "markers"] | None = None
    axis: Literal["rig", "markers"] | None = None
    markers: MarkersSection | None = None
    axis_point: Vector | None = None
    axis_direction: Vector | None = None
    step: Number | None = None
    start: Number = 0.0
    positions: str | None = None
    log: str | None = None
    times: str | None = None
    clock: Clock | None = None
    delay: Number | None = None
    gap: Positive | None = None
    poses: str | None = None
    convention: Literal["camera_from_object", "object_from_camera"] | None = None
    hand_eye: str | None = None
    units: Units | None = None
    notation: Notation | None = None
    gives: Gives | None = None
    index: Literal["order", "filename"] = "order"

    @model_validator(mode="after")
    def _complete(self) -> MotionSection:
        allowed: dict[str, set[str]] = {
            "fixed": set(),
            "linear": {"markers", "direction", "step", "start", "positions", "index", "moves", *_LOGGED},
            "turntable": {
                "markers",
                "axis",
                "axis_point",
                "axis_direction",
                "step",
                "start",
                "positions",
                "index",
                "moves",
                *_LOGGED,
            },
            "poses": {"poses", "convention", "index"},
            "robot": {*_ROBOT, "index"},
        }
        for key in self.model_fields_set - {"kind", "moves"} - allowed[self.kind]:
            raise ValueError(f"{key} has no meaning for kind = {self.kind!r}; remove it")
        if self.kind == "linear" and self.direction is None:
            raise ValueError('direction is missing; give [x, y, z] in C, "rig" or "markers"')
        if self.kind == "turntable" and self.axis is None and (self.axis_point is None or self.axis_direction is None):
            raise ValueError('axis_point and axis_direction are needed, or axis = "rig" or "markers"')
        told = [key for key in ("step", "positions", "log") if getattr(self, key) is not None]
        if self.kind in {"linear", "turntable"} and len(told) != 1:
            raise ValueError(f"found {' and '.join(told) or 'none'} of step, positions, log; exactly one is needed")
        if self.log is None and (other := [key for key in _LOGGED if getattr(self, key) is not None]):
            raise ValueError(f"{other[0]} has a meaning with log only; remove it")
        if self.log is not None and self.delay is None:
            raise ValueError("delay is missing: seconds from a frame's time stamp to the log's time of its exposure")
        if ("markers" in {self.direction, self.axis}) != (self.markers is not None):
            raise ValueError(
                'direction or axis = "markers" and [motion.markers] (marker, places) belong together; give both or neither'
            )
        if self.kind in {"linear", "turntable"} and self.moves is None:
            raise ValueError(
                'moves is missing, and the wrong one mirrors the motion; add moves = "object" (the sensor stands still) or '
                'moves = "sensor"'
            )
        if self.step == 0:
            raise ValueError("step is 0: every frame would show the same profile; give the distance between frames")
        for key in ("direction", "axis_direction"):
            vector = getattr(self, key)
            if isinstance(vector, tuple) and not np.linalg.norm(vector) > 0:
                raise ValueError(f"{key} is {list(vector)}; a direction of length zero is none")
        if self.kind == "robot":
            for key in _ROBOT:
                if getattr(self, key) is None:
                    raise ValueError(f'{key} is missing; kind = "robot" needs {", ".join(_ROBOT)}')
        if self.kind == "poses" and self.poses is None:
            raise ValueError("poses is missing; name the CSV with header frame,m00,...,m33")
        if self.kind == "poses" and self.convention is None:
            raise ValueError(
                'convention is missing; "camera_from_object" or "object_from_camera": it cannot be guessed'
            )
        return self


def _names(value: object) -> object:
    return [value] if isinstance(value, str) else value


class CaptureSection(Section):
    """The whole file."""

    format: Literal[1]
    units: Units = "mm"
    camera_id: str = ""
    images: str | None = None
    video: str | None = None
    camera: Camera | None = None
    frames: Annotated[int, Strict(), Field(ge=1)] | None = None
    background: str | None = None
    background_mode: Literal["mean", "paired", "alternate"] | None = None
    channel: Channel = "auto"
    lasers: Annotated[list[str] | None, BeforeValidator(_names)] = None
    sequence: Literal["together", "cycle"] = "together"
    motion: MotionSection | None = None

    @model_validator(mode="after")
    def _complete(self) -> CaptureSection:
        given = [key for key in ("images", "video", "camera") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"found {' and '.join(given) or 'none'} of images, video, camera; exactly one is needed")
        if self.frames is not None and self.camera is None:
            raise ValueError("frames is for a live camera; files say themselves how many they are")
        if self.lasers is not None and not 0 < len(set(self.lasers)) == len(self.lasers):
            raise ValueError(
                f"lasers names {self.lasers or 'none'}; name one or more, each once, or leave it out for all"
            )
        if self.background_mode == "paired" and (self.background is None or self.images is None):
            raise ValueError('background_mode = "paired" needs images and background, one for each frame')
        if self.background_mode == "alternate" and self.background is not None:
            raise ValueError('background_mode = "alternate" takes every second image as background; remove background')
        return self


@dataclass(frozen=True, slots=True, eq=False)
class StageUse:
    """The capture asks for the rig's stage, or for the one that markers on it show in its own frames."""

    kind: Literal["linear", "turntable"]
    positions: Positions
    sign: float
    markers: MarkerBoard | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """A capture file with lengths in mm, angles in rad and its files found."""

    path: Path
    camera_id: str
    images: tuple[Path, ...]  # in order; empty for a video or a camera
    video: Path | None
    camera: int | None
    frames: int | None  # of a camera; None: until interrupted
    background: tuple[Path, ...]
    background_mode: Literal["none", "mean", "paired", "alternate"]
    channel: Channel
    lasers: tuple[str, ...] | None  # None: all of the rig
    sequence: Literal["together", "cycle"]
    motion: Motion | StageUse
    numbers: tuple[int, ...] | None  # frame number of each image where they come from the file names
    by_step: bool = False  # only the count of frames says how far the object has moved
    driven: CameraSettings | None = None  # the camera of [camera]
    follow: Follow | None = None  # where positions are told while the camera runs


def read_capture(path: Path) -> Capture:
    """Read capture.toml; ``FileError`` names file, key, what was found and what is allowed."""
    raw = read_toml(path, CaptureSection)
    mm = MM[raw.units]
    folder = path.parent
    images: tuple[Path, ...] = ()
    video = None
    if raw.images is not None:
        images = tuple(matching(folder, raw.images, owner=path, key="images"))
    if raw.video is not None:
        video = folder / raw.video
        if not video.is_file():
            raise FileError(f"{path}: video: {video} is not there; correct the name")
    background = () if raw.background is None else tuple(matching(folder, raw.background, owner=path, key="background"))
    mode: Literal["none", "mean", "paired", "alternate"] = raw.background_mode or ("mean" if background else "none")
    if raw.background_mode == "mean" and not background:
        raise FileError(f'{path}: background_mode = "mean" needs background; name its images')
    if mode == "paired" and len(background) != len(images):
        raise FileError(f"{path}: {len(background)} backgrounds for {len(images)} images; paired needs one for each")
    if mode == "alternate" and images and len(images) % 2:
        raise FileError(f"{path}: {len(images)} images; alternate needs pairs of on and off: complete the last")
    shown = images[::2] if mode == "alternate" else images
    frame_numbers = _frame_numbers(path, raw, shown)
    require_motion(path, raw, len(shown))
    section = raw.motion or MotionSection()
    follow = _follow(path, raw, mm)
    motion = _motion(path, section, shown, mm, follow)
    lasers = None if raw.lasers is None else tuple(raw.lasers)
    index = raw.camera if isinstance(raw.camera, int) else None
    driven = camera_settings(raw.camera, folder) if isinstance(raw.camera, CameraSection) else None
    return Capture(
        path, raw.camera_id, images, video, index, raw.frames, background, mode, raw.channel, lasers, raw.sequence,
        motion, frame_numbers, section.step is not None, driven, follow,
    )  # fmt: skip


def require_motion(path: Path, raw: CaptureSection, images: int) -> None:
    """``FileError`` where a capture of more than one frame does not say how anything moves: nothing else places its profiles."""
    if raw.motion is not None or images == 1 or (raw.camera is not None and raw.frames == 1):
        return
    found = f"{images} frames" if images else "a video" if raw.video is not None else "a camera"
    raise FileError(
        f'{path}: {found} and no [motion], so that every profile would lie on the first; add [motion] with kind = "linear" '
        '(direction, step, moves), "turntable" (axis_point, axis_direction, step, moves), "poses", "robot", or "fixed" where nothing moves'
    )


def _frame_numbers(path: Path, raw: CaptureSection, images: tuple[Path, ...]) -> tuple[int, ...] | None:
    """Numbers from the file names where asked for; a gap in them is refused where only a step says where frames are."""
    if not images or raw.motion is None or raw.motion.kind == "fixed":
        return None
    found = [re.search(r"(\d+)\D*$", image.stem) for image in images]
    if raw.motion.index == "filename":
        for image, match in zip(images, found, strict=True):
            if match is None:
                raise FileError(f'{path}: index = "filename" and {image.name} has no number; rename it')
        values = tuple(int(m.group(1)) for m in found if m is not None)
        if len(set(values)) < len(values):
            raise FileError(f'{path}: index = "filename" and two images have the same number; rename one')
        if max(values) - min(values) > _MOST_NUMBERS:
            raise FileError(
                f'{path}: index = "filename" and the numbers run from {min(values)} to {max(values)}; frames are counted, '
                f"{_MOST_NUMBERS} at most: rename the images or list `positions`"
            )
        if raw.motion.step is not None:
            return tuple(v - min(values) for v in values)
        return values if raw.motion.kind in {"linear", "turntable"} else None
    if raw.motion.step is None or any(m is None for m in found):
        return None
    values = tuple(int(m.group(1)) for m in found if m is not None)
    steps = np.diff(values)
    regular = int(np.median(steps)) if len(steps) else 1
    wrong = np.flatnonzero(steps != regular)
    if len(wrong) and regular > 0:
        k = int(wrong[0])
        raise FileError(
            f"{path}: a gap in the frame numbers: {images[k].name} is followed by {images[k + 1].name}; with `step` every "
            'frame after it would be misplaced: add the missing frames, list `positions`, or set motion.index = "filename"'
        )
    return None


def _motion(
    path: Path, section: MotionSection, images: tuple[Path, ...], mm: float, follow: Follow | None
) -> Motion | StageUse:
    if section.kind == "fixed":
        return Fixed()
    if section.kind == "robot":
        return _robot(path, section, images)
    if section.kind == "poses":
        return _poses(path, section, images, mm)
    scale = _scale(section, mm)
    listed = None
    if follow is not None:
        positions: Positions = ToldPositions(0.0, 0.0, known=follow.known)
    else:
        if section.log is not None:
            listed = _logged_positions(path, section, images) * scale
        elif section.positions is not None:
            listed = listed_positions(path.parent / section.positions, images, _by_name(section, images)) * scale
        positions = Positions(section.start * scale, (section.step or 0.0) * scale, listed)
    sign = -1.0 if section.moves == "sensor" else 1.0
    if section.kind == "linear":
        if isinstance(section.direction, tuple):
            return Linear(section.direction, positions=positions, sign=sign)
        return StageUse("linear", positions, sign, _table(path, section, images, mm))
    if section.axis_direction is None or section.axis_point is None:
        return StageUse("turntable", positions, sign, _table(path, section, images, mm))
    return Turntable(np.array(section.axis_point) * mm, section.axis_direction, positions=positions, sign=sign)


def _scale(section: MotionSection, mm: float) -> float:
    return mm if section.kind == "linear" else np.pi / 180.0


def _follow(path: Path, raw: CaptureSection, mm: float) -> Follow | None:
    """Positions that are told while a camera or a video runs; None for images, whose positions are all there."""
    section = raw.motion
    if section is None or raw.images is not None or (section.log is None and section.positions is None):
        return None
    if section.times is not None:
        raise FileError(f"{path}: motion.times is for images; a camera and a video stamp their frames themselves")
    if raw.video is not None and section.log is None:
        return None
    if raw.video is not None and section.clock not in (None, "first-frame"):
        raise FileError(f"{path}: motion.clock = {section.clock!r} needs a [camera]; a video knows its own time only")
    if isinstance(raw.camera, int) and section.log is not None:
        raise FileError(f"{path}: motion.log needs time stamps; name the camera in a section [camera]")
    wait = raw.camera.timeout_s if isinstance(raw.camera, CameraSection) else TIMEOUT_S if raw.video is None else 0.0
    return Follow(
        path.parent / (section.log or section.positions or ""), "frame" if section.log is None else "seconds", _scale(section, mm), {},
        section.clock or "first-frame", section.delay or 0.0, section.gap or GAP_S, wait,
    )  # fmt: skip


def _by_name(section: MotionSection, images: tuple[Path, ...]) -> tuple[int, ...] | None:
    """Frame of each image by the number in its name, where asked for."""
    if section.index != "filename" or not images:
        return None
    return tuple(int(re.findall(r"\d+", image.stem)[-1]) for image in images)


def _logged_positions(path: Path, section: MotionSection, images: tuple[Path, ...]) -> Array:
    """Positions of images by their time stamps in a log of the stage."""
    if section.times is None:
        raise FileError(f"{path}: motion.times is missing; with images, name a CSV with header image,seconds")
    if section.clock == "system":
        raise FileError(f'{path}: motion.clock = "system" is for a [camera]; put the log\'s own time into times')
    times, log = path.parent / section.times, path.parent / (section.log or "")
    names = _by_name(section, images)
    return logged_positions(log, times, images, names, delay=section.delay or 0.0, gap=section.gap or GAP_S)


def _table(path: Path, section: MotionSection, images: tuple[Path, ...], mm: float) -> MarkerBoard | None:
    """Markers on the table; ``FileError`` where there are no files of frames to look for them in."""
    if section.markers is None:
        return None
    if not images:
        raise FileError(
            f'{path}: motion by "markers" looks for them in images; a video or a camera has none yet: calibrate the stage, and say "rig"'
        )
    return board_of(section.markers, mm)


def _robot(path: Path, section: MotionSection, images: tuple[Path, ...]) -> Robot:
    """Motion by a robot's log of poses and what `scope hand-eye` found."""
    if section.hand_eye is None or section.poses is None:
        raise FileError(f"{path}: motion needs hand_eye and poses")
    found = HandEye.load(path.parent / section.hand_eye)
    if not found.passed:
        raise FileError(f"{path}: {section.hand_eye} did not pass ({found.why[:120]}); run scope hand-eye again")
    file = path.parent / section.poses
    log = read_pose_log(file, section.notation or "matrix", section.units or "mm", section.gives or "base_from_flange")
    rows = rows_of_frames(file, {log.key: list(log.names)}, images)
    poses = tuple(log.base_from_flange(row) for row in rows)
    return Robot(
        found.mount, found.sensor, poses, found.covariance, (found.robot.mm, found.robot.rad), found.rig_sha256
    )


def _poses(path: Path, section: MotionSection, images: tuple[Path, ...], mm: float) -> Poses:
    file = path.parent / (section.poses or "")
    columns = csv_by_frame(file, _MATRIX)
    stacked = np.stack([numbers(file, name, columns[name]) for name in _MATRIX], axis=1).reshape(-1, 4, 4)
    poses = []
    for row in rows_of_frames(file, columns, images):
        try:
            pose = Pose.from_matrix(stacked[row], tolerance=1e-3)
        except ValueError as error:
            raise FileError(f"{file}: row {row + 2}: {error}; correct the pose") from error
        pose = Pose(pose.rotation, pose.translation * mm)
        poses.append(pose.inverse if section.convention == "camera_from_object" else pose)
    return Poses(tuple(poses))
