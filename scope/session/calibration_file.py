"""calibration.toml: how a camera and its lasers are calibrated (docs/formats.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, Strict, ValidationError, model_validator

from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array, Pose
from calibration.targets import Charuco, Chessboard, Polarity, SpotGrid
from scope.session.images import Stored
from scope.session.toml_file import (
    MM,
    Flag,
    Number,
    Positive,
    Section,
    Units,
    Vector,
    describe,
    matching,
    numbers,
    read_csv,
    read_toml,
)

_LEAST_MARKS = 4  # from which a plane follows
_MOST_MARKS = 100_000


def _pair(value: Any) -> Any:
    return (value, value) if isinstance(value, int | float) and not isinstance(value, bool) else value


def _list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


Index = Annotated[int, Strict(), Field(ge=0, le=1000)]
Count = Annotated[int, Strict(), Field(ge=2, le=1000)]
Along = Literal["auto", "rows", "columns"]
Channel = Literal["auto", "red", "green", "blue", "gray"]
Images = Annotated[list[str], BeforeValidator(_list), Field(min_length=1)]
ByLaser = str | dict[str, str]


class TargetSection(Section):
    """[target]: the marks."""

    kind: Literal["spots", "chessboard", "charuco", "listed"]
    polarity: Polarity = "light"
    rows: Count | None = None
    columns: Count | None = None
    pitch: Annotated[tuple[Positive, Positive] | None, BeforeValidator(_pair)] = None
    diameter: Positive | None = None
    fiducials: list[tuple[Index, Index]] = []
    fiducial_diameter: Positive | None = None
    dictionary: str = "DICT_5X5_100"
    marker: Positive | None = None
    legacy: Flag = False

    @model_validator(mode="after")
    def _complete(self) -> TargetSection:
        if self.kind == "listed":
            return self
        need = {"spots": ("rows", "columns", "pitch", "diameter"), "chessboard": ("rows", "columns", "pitch")}
        for key in need.get(self.kind, ("rows", "columns", "pitch", "marker")):
            if getattr(self, key) is None:
                raise ValueError(f"{key} is missing; kind = {self.kind!r} needs it")
        if self.fiducials and self.fiducial_diameter is None:
            raise ValueError("fiducial_diameter is missing; fiducials need it")
        for row, column in self.fiducials:
            if row >= (self.rows or 0) or column >= (self.columns or 0):
                raise ValueError(
                    f"fiducial [{row}, {column}] is outside the grid of {self.rows} rows, {self.columns} columns"
                )
        if self.diameter and self.pitch and self.diameter >= min(self.pitch):
            raise ValueError(
                f"diameter {self.diameter} is not less than the pitch {min(self.pitch)}; spots would touch"
            )
        if self.fiducial_diameter and self.diameter and self.fiducial_diameter <= 1.1 * self.diameter:
            raise ValueError(
                f"fiducial_diameter {self.fiducial_diameter} must exceed diameter {self.diameter} by more than 10 %"
            )
        return self


class AcceptSection(Section):
    """[accept]: what passed means for this work."""

    ray_mm: Positive | None = None
    laser_mm: Positive | None = None
    repeat_px: Positive | None = None


class LaserSection(Section):
    """[laser.NAME]."""

    along: Along = "auto"
    channel: Channel = "auto"
    origin: Vector | None = None


class PlaneSection(Section):
    """[[plane]]: the target at one stand-off, or held by hand."""

    name: str | None = None
    images: Images
    origin: Vector | None = None
    rotation: Vector = (0.0, 0.0, 0.0)
    laser: ByLaser | None = None
    background: ByLaser | None = None
    points: str | None = None
    refine: Flag = True
    turned: Literal[0, 90, 180, 270] = 0


class StageSection(Section):
    """[[stage]]: the target carried by the stage."""

    kind: Literal["linear", "turntable"]
    images: Images
    positions: list[Number] = Field(min_length=2)


class CalibrationSection(Section):
    """The whole file."""

    format: Literal[1]
    units: Units = "mm"
    camera_id: str = ""
    target: TargetSection
    accept: AcceptSection = AcceptSection()
    laser: dict[str, Any] = {}
    plane: list[PlaneSection] = Field(min_length=1)
    stage: list[StageSection] = []


@dataclass(frozen=True, slots=True, eq=False)
class ListedMarks:
    """Marks listed one by one for one plane."""

    path: Path
    points: Array  # (n, 3) mm, target frame
    pixels: Array  # (n, 2) px, about where each is seen
    refine: bool  # whether the centroid nearest to the pixel is measured


@dataclass(frozen=True, slots=True, eq=False)
class PlanePlan:
    """One [[plane]], its files found."""

    name: str
    images: tuple[Stored, ...]
    c_from_target: Pose | None  # None: freehand
    lasers: Mapping[str, tuple[Stored, ...]]  # by laser name
    backgrounds: Mapping[str, tuple[Stored, ...]]
    listed: ListedMarks | None
    turned: int | None  # degrees; None where the file does not say


@dataclass(frozen=True, slots=True, eq=False)
class LaserPlan:
    """One laser as the file describes it."""

    name: str
    along: Along
    channel: Channel
    origin: Array | None  # (3,) mm


@dataclass(frozen=True, slots=True, eq=False)
class StagePlan:
    """One [[stage]], its files found, one image a position."""

    kind: Literal["linear", "turntable"]
    images: tuple[Path, ...]
    positions: Array  # (n,) mm or degrees


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPlan:
    """A calibration file with lengths in mm and every image found."""

    path: Path
    camera_id: str
    target: SpotGrid | Chessboard | Charuco | None  # None: listed
    polarity: Polarity
    accept: dict[str, float]  # limits given: ray_mm, laser_mm, repeat_px
    lasers: tuple[LaserPlan, ...]
    planes: tuple[PlanePlan, ...]
    stages: tuple[StagePlan, ...]

    @property
    def files(self) -> list[Path]:
        """Every file that was named, the TOML first; images in memory are none."""
        found: list[Stored] = [self.path] if self.path.suffix else []
        for plane in self.planes:
            found += plane.images
            found += [] if plane.listed is None else [plane.listed.path]
            for group in (*plane.lasers.values(), *plane.backgrounds.values()):
                found += group
        for stage in self.stages:
            found += stage.images
        return list(dict.fromkeys(file for file in found if isinstance(file, Path)))


def read_calibration(path: Path, *, only: str | None = None) -> CalibrationPlan:
    """Read calibration.toml; ``FileError`` names file, key, what was found and what is allowed.

    With ``only``, the plane of that name alone, without its lasers: what is judged at the jig needs no other image.
    """
    raw = read_toml(path, CalibrationSection)
    if only is not None:
        raw = _alone(path, raw, only)
    mm = MM[raw.units]
    lasers = _lasers(path, raw, mm)
    names = [laser.name for laser in lasers]
    planes = tuple(_plane(path, section, names, mm) for section in raw.plane)
    seen: set[str] = set()
    for plane in planes:
        if plane.name in seen:
            raise FileError(f"{path}: two planes are called {plane.name!r}; give each a name of its own")
        seen.add(plane.name)
    stages = tuple(_stage(path, section, mm) for section in raw.stage)
    limits = {key: value for key, value in raw.accept if value is not None}  # their names say their units
    try:
        target = _target(raw.target, mm)
    except CalibrationError as error:
        raise FileError(f"{path}: {error}") from error
    if target is None:
        for plane in planes:
            if plane.listed is None:
                raise FileError(
                    f"{path}: plane {plane.name}: target.kind is 'listed' and `points` is missing; name its CSV"
                )
    return CalibrationPlan(path, raw.camera_id, target, raw.target.polarity, limits, lasers, planes, stages)


def _alone(path: Path, raw: CalibrationSection, name: str) -> CalibrationSection:
    """The file as if it had one plane and neither lasers nor stages; ``FileError`` where none, or two, are called ``name``."""
    names = []
    for section in raw.plane:
        try:
            names.append(section.name or _images(path, section.images, "plane.images")[0].stem)
        except FileError:  # its images are still to be taken
            names.append("")
    chosen = [section for section, found in zip(raw.plane, names, strict=True) if found == name]
    if not chosen:
        known = ", ".join(found for found in names if found)
        raise FileError(f"{path}: no plane is called {name!r}; the planes are {known}")
    if len(chosen) > 1:
        raise FileError(f"{path}: two planes are called {name!r}; give each a name of its own")
    one = chosen[0].model_copy(update={"name": name, "laser": None, "background": None})
    return raw.model_copy(update={"plane": [one], "stage": []})


def _target(section: TargetSection, mm: float) -> SpotGrid | Chessboard | Charuco | None:
    if section.kind == "listed" or section.rows is None or section.columns is None or section.pitch is None:
        return None
    pitch = (section.pitch[0] * mm, section.pitch[1] * mm)
    if section.kind == "chessboard":
        return Chessboard(section.rows, section.columns, pitch)
    if section.kind == "charuco":
        return Charuco(
            section.rows, section.columns, pitch, (section.marker or 0.0) * mm, section.dictionary, section.legacy
        )
    grid = SpotGrid(
        section.rows, section.columns, pitch, (section.diameter or 0.0) * mm, section.polarity,
        tuple(section.fiducials), None if section.fiducial_diameter is None else section.fiducial_diameter * mm,
    )  # fmt: skip
    grid.check_fiducials()
    return grid


def _lasers(path: Path, raw: CalibrationSection, mm: float) -> tuple[LaserPlan, ...]:
    content: dict[str, Any] = raw.laser or {"laser": {}}
    tables = {"laser": content} if not all(isinstance(value, dict) for value in content.values()) else content
    plans = []
    for name, table in tables.items():
        try:
            section = LaserSection.model_validate(table)
        except ValidationError as error:
            raise FileError(f"{path}: laser.{name}.{describe(error)}") from error
        origin = None if section.origin is None else np.array(section.origin) * mm
        plans.append(LaserPlan(name, section.along, section.channel, origin))
    return tuple(plans)


def _plane(path: Path, section: PlaneSection, lasers: list[str], mm: float) -> PlanePlan:
    images = _images(path, section.images, "plane.images")
    name = section.name or images[0].stem
    pose = None
    if section.origin is not None:
        pose = Pose.from_rotation_vector(np.deg2rad(section.rotation), np.array(section.origin) * mm)
    elif any(section.rotation):
        raise FileError(f"{path}: plane {name}: has a rotation and no origin; give both (jig) or neither (freehand)")
    listed = None
    if section.points is not None:
        listed = _listed(path.parent / section.points, section.refine, mm)
    return PlanePlan(
        name, images, pose, _by_laser(path, name, "laser", section.laser, lasers),
        _by_laser(path, name, "background", section.background, lasers), listed,
        section.turned if "turned" in section.model_fields_set else None,
    )  # fmt: skip


def _by_laser(
    path: Path, plane: str, key: str, value: ByLaser | None, lasers: list[str]
) -> dict[str, tuple[Path, ...]]:
    if value is None:
        return {}
    if isinstance(value, str):
        if key == "laser" and len(lasers) > 1:
            raise FileError(
                f"{path}: plane {plane}: laser = {value!r} does not say which of {', '.join(lasers)} is on; write "
                f'laser = {{ {lasers[0]} = "..." }}'
            )
        value = dict.fromkeys(lasers, value)
    unknown = [name for name in value if name not in lasers]
    if unknown:
        raise FileError(
            f"{path}: plane {plane}: {key} names {unknown[0]!r}; the lasers are {', '.join(lasers)}: correct it"
        )
    return {name: tuple(matching(path.parent, glob, owner=path, key=f"plane.{key}")) for name, glob in value.items()}


def _images(path: Path, patterns: list[str], key: str) -> tuple[Path, ...]:
    return tuple(file for pattern in patterns for file in matching(path.parent, pattern, owner=path, key=key))


def _listed(path: Path, refine: bool, mm: float) -> ListedMarks:
    columns = read_csv(path, ("x", "y", "z", "u", "v"))
    values = {name: numbers(path, name, texts) for name, texts in columns.items()}
    if len(values["x"]) < _LEAST_MARKS:
        raise FileError(
            f"{path}: {len(values['x'])} marks; {_LEAST_MARKS} or more are needed for a plane: list more of them"
        )
    if len(values["x"]) > _MOST_MARKS:
        raise FileError(f"{path}: {len(values['x'])} marks; at most {_MOST_MARKS} are read: is it the right file?")
    points = np.stack([values["x"], values["y"], values["z"]], axis=1) * mm
    return ListedMarks(path, points, np.stack([values["u"], values["v"]], axis=1), refine)


def _stage(path: Path, section: StageSection, mm: float) -> StagePlan:
    images = _images(path, section.images, "stage.images")
    if len(images) != len(section.positions):
        raise FileError(
            f"{path}: stage: {len(images)} images and {len(section.positions)} positions; one position an image is needed"
        )
    scale = mm if section.kind == "linear" else 1.0
    return StagePlan(section.kind, images, np.array(section.positions) * scale)
