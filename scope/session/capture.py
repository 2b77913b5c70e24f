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
from ranging.motion import Fixed, Linear, Motion, Poses, Positions, Turntable
from ranging.robot import Robot
from scope.session.camera_section import CameraSection, CameraSettings, camera_settings
from scope.session.hand_eye import HandEye
from scope.session.robot_section import Gives, read_pose_log
from scope.session.toml_file import MM, Number, Section, Units, Vector, matching, numbers, read_csv, read_toml

Channel = Literal["auto", "red", "green", "blue", "gray"]
_MOST_NUMBERS = 1_000_000  # between the first and the last frame
_ROBOT = ("hand_eye", "poses", "units", "notation", "gives")
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
    direction: Vector | Literal["rig"] | None = None
    axis: Literal["rig"] | None = None
    axis_point: Vector | None = None
    axis_direction: Vector | None = None
    step: Number | None = None
    start: Number = 0.0
    positions: str | None = None
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
            "linear": {"direction", "step", "start", "positions", "index", "moves"},
            "turntable": {"axis", "axis_point", "axis_direction", "step", "start", "positions", "index", "moves"},
            "poses": {"poses", "convention", "index"},
            "robot": {*_ROBOT, "index"},
        }
        for key in self.model_fields_set - {"kind", "moves"} - allowed[self.kind]:
            raise ValueError(f"{key} has no meaning for kind = {self.kind!r}; remove it")
        if self.kind == "linear" and self.direction is None:
            raise ValueError('direction is missing; give [x, y, z] in C, or "rig"')
        if self.kind == "turntable" and self.axis is None and (self.axis_point is None or self.axis_direction is None):
            raise ValueError('axis_point and axis_direction are needed, or axis = "rig"')
        if self.kind in {"linear", "turntable"} and (self.step is None) == (self.positions is None):
            raise ValueError("give either step or positions")
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
    """The capture asks for the rig's stage."""

    kind: Literal["linear", "turntable"]
    positions: Positions
    sign: float


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
    motion = _motion(path, section, shown, mm)
    lasers = None if raw.lasers is None else tuple(raw.lasers)
    index = raw.camera if isinstance(raw.camera, int) else None
    driven = camera_settings(raw.camera, folder) if isinstance(raw.camera, CameraSection) else None
    return Capture(
        path, raw.camera_id, images, video, index, raw.frames, background, mode, raw.channel, lasers, raw.sequence,
        motion, frame_numbers, section.step is not None, driven,
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
        return tuple(v - min(values) for v in values) if raw.motion.step is not None else None
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


def _motion(path: Path, section: MotionSection, images: tuple[Path, ...], mm: float) -> Motion | StageUse:
    if section.kind == "fixed":
        return Fixed()
    if section.kind == "robot":
        return _robot(path, section, images)
    if section.kind == "poses":
        return _poses(path, section, images, mm)
    scale = mm if section.kind == "linear" else np.pi / 180.0
    listed = None
    if section.positions is not None:
        listed = _listed_positions(path.parent / section.positions, images) * scale
    positions = Positions(section.start * scale, (section.step or 0.0) * scale, listed)
    sign = -1.0 if section.moves == "sensor" else 1.0
    if section.kind == "linear":
        if isinstance(section.direction, tuple):
            return Linear(section.direction, positions=positions, sign=sign)
        return StageUse("linear", positions, sign)
    if section.axis_direction is None or section.axis_point is None:
        return StageUse("turntable", positions, sign)
    return Turntable(np.array(section.axis_point) * mm, section.axis_direction, positions=positions, sign=sign)


def _rows_of_frames(path: Path, columns: dict[str, list[str]], images: tuple[Path, ...]) -> list[int]:
    """Row of the CSV for each frame; every frame must have exactly one row."""
    count = len(next(iter(columns.values())))
    if "image" in columns:
        rows = {name: k for k, name in enumerate(columns["image"])}
        if len(rows) < count:
            raise FileError(f"{path}: an image is named twice; keep one row for each")
        missing = [image.name for image in images if image.name not in rows]
        if missing:
            raise FileError(
                f"{path}: no row for {missing[0]} ({len(missing)} of {len(images)} frames missing); add them"
            )
        return [rows[image.name] for image in images]
    frames = numbers(path, "frame", columns["frame"])
    if not np.array_equal(frames, np.rint(frames)) or frames.min(initial=0) < 0:
        raise FileError(f"{path}: column frame must hold whole numbers from 0")
    rows_of = {int(frame): k for k, frame in enumerate(frames)}
    if len(rows_of) < count:
        raise FileError(f"{path}: a frame is listed twice; keep one row for each")
    needed = len(images) or count
    absent = [k for k in range(needed) if k not in rows_of]
    if absent:
        raise FileError(
            f"{path}: {count} rows for {needed} frames; frame {absent[0]} has none: every frame needs its row (frames count "
            "from 0 in the order of the sorted file names)"
        )
    return [rows_of[k] for k in range(needed)]


def _header(path: Path, wanted: tuple[str, ...]) -> dict[str, list[str]]:
    columns = read_csv(path, wanted, optional=("frame", "image"))
    if "frame" not in columns and "image" not in columns:
        raise FileError(f"{path}: the header names neither frame nor image; one of them must say which row is whose")
    return columns


def _listed_positions(path: Path, images: tuple[Path, ...]) -> Array:
    columns = _header(path, ("position",))
    return numbers(path, "position", columns["position"])[_rows_of_frames(path, columns, images)]


def _robot(path: Path, section: MotionSection, images: tuple[Path, ...]) -> Robot:
    """Motion by a robot's log of poses and what `scope hand-eye` found."""
    if section.hand_eye is None or section.poses is None:
        raise FileError(f"{path}: motion needs hand_eye and poses")
    found = HandEye.load(path.parent / section.hand_eye)
    if not found.passed:
        raise FileError(f"{path}: {section.hand_eye} did not pass ({found.why[:120]}); run scope hand-eye again")
    file = path.parent / section.poses
    log = read_pose_log(file, section.notation or "matrix", section.units or "mm", section.gives or "base_from_flange")
    rows = _rows_of_frames(file, {log.key: list(log.names)}, images)
    poses = tuple(log.base_from_flange(row) for row in rows)
    return Robot(
        found.mount, found.sensor, poses, found.covariance, (found.robot.mm, found.robot.rad), found.rig_sha256
    )


def _poses(path: Path, section: MotionSection, images: tuple[Path, ...], mm: float) -> Poses:
    file = path.parent / (section.poses or "")
    columns = _header(file, _MATRIX)
    stacked = np.stack([numbers(file, name, columns[name]) for name in _MATRIX], axis=1).reshape(-1, 4, 4)
    poses = []
    for row in _rows_of_frames(file, columns, images):
        try:
            pose = Pose.from_matrix(stacked[row], tolerance=1e-3)
        except ValueError as error:
            raise FileError(f"{file}: row {row + 2}: {error}; correct the pose") from error
        pose = Pose(pose.rotation, pose.translation * mm)
        poses.append(pose.inverse if section.convention == "camera_from_object" else pose)
    return Poses(tuple(poses))
