"""calibration.toml: how a camera and its lasers are calibrated (docs/formats.md)."""

from __future__ import annotations

import glob
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array, Pose
from calibration.targets import Polarity, Target
from scope.session.camera_section import CameraSection, CameraSettings, camera_settings
from scope.session.images import Stored
from scope.session.target_section import PlaceSection, Plate, TargetSection, plate_of, polarity_of, target_of
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


def _list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


Along = Literal["auto", "rows", "columns"]
Channel = Literal["auto", "red", "green", "blue", "gray", "red-excess", "green-excess", "blue-excess"]
Images = Annotated[list[str], BeforeValidator(_list), Field(min_length=1)]
ByLaser = str | dict[str, str]


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


class ViewsSection(Section):
    """[[views]]: many views by hand at once, each image a pose of its own."""

    images: Images
    laser: ByLaser | None = None
    background: ByLaser | None = None


class StageSection(Section):
    """[[stage]]: the target carried by the stage."""

    kind: Literal["linear", "turntable"]
    images: Images
    positions: list[Number] = Field(min_length=2)
    target: TargetSection | None = None
    dictionary: str | None = None
    marker: Positive | None = None
    places: list[PlaceSection] = []

    @model_validator(mode="after")
    def _one_target(self) -> StageSection:
        if self.target is not None and self.target.kind == "listed":
            raise ValueError(
                "a stage's target cannot be 'listed'; it needs marks that are found: spots, a board or markers"
            )
        if bool(self.places) != (self.marker is not None):
            raise ValueError("marker (their side) and places are needed both where the stage carries markers")
        return self


class CalibrationSection(Section):
    """The whole file."""

    format: Literal[1]
    units: Units = "mm"
    camera_id: str = ""
    camera: CameraSection | None = None
    target: TargetSection
    accept: AcceptSection = AcceptSection()
    laser: dict[str, Any] = {}
    plane: list[PlaneSection] = []
    views: list[ViewsSection] = []
    stage: list[StageSection] = []

    @model_validator(mode="after")
    def _some(self) -> CalibrationSection:
        if not self.plane and not self.views:
            raise ValueError(
                "no [[plane]] and no [[views]]; add one table for each pose of the target, or a glob of views"
            )
        if self.views and self.target.kind == "listed":
            raise ValueError(
                "[[views]] cannot have listed marks, which belong to single planes; write [[plane]] tables"
            )
        return self


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
    target: Target | None  # that it carries


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPlan:
    """A calibration file with lengths in mm and every image found."""

    path: Path
    camera_id: str
    target: Target | None  # None: listed
    polarity: Polarity
    accept: dict[str, float]  # limits given: ray_mm, laser_mm, repeat_px
    lasers: tuple[LaserPlan, ...]
    planes: tuple[PlanePlan, ...]
    stages: tuple[StagePlan, ...]
    plate: Plate = "auto"  # where the target's plane reaches beyond its marks
    globbed: frozenset[str] = frozenset()  # names of the planes that a glob of [[views]] brought
    camera: CameraSettings | None = None  # that takes the images

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
    tables = len(raw.plane)
    raw = with_views(path, raw, lasers=only is None)
    if only is not None:
        raw = _alone(path, raw, only)
    mm = MM[raw.units]
    lasers = _lasers(path, raw, mm)
    names = [laser.name for laser in lasers]
    planes = _distinct(path, [_plane(path, section, names, mm) for section in raw.plane], raw.plane)
    stages = tuple(_stage(path, section, raw.target, mm) for section in raw.stage)
    limits = {key: value for key, value in raw.accept if value is not None}  # their names say their units
    try:
        target = target_of(raw.target, mm)
    except CalibrationError as error:
        raise FileError(f"{path}: {error}") from error
    if target is None:
        for plane in planes:
            if plane.listed is None:
                raise FileError(
                    f"{path}: plane {plane.name}: target.kind is 'listed' and `points` is missing; name its CSV"
                )
    return CalibrationPlan(path, raw.camera_id, target, polarity_of(raw.target), limits, lasers, planes, stages,
                           plate_of(raw.target, mm), frozenset(p.name for p in planes[tables:]),
                           None if raw.camera is None else camera_settings(raw.camera, path.parent))  # fmt: skip


@dataclass(frozen=True, slots=True)
class PlannedPlane:
    """One [[plane]] whose images may still be to take: patterns relative to the file."""

    name: str
    images: tuple[str, ...]
    laser: dict[str, tuple[str, ...]]  # by laser, "" for the only one; empty where the file asks for none
    background: dict[str, tuple[str, ...]]
    c_from_target: Pose | None = None  # None: by hand


def planned_planes(path: Path) -> tuple[PlannedPlane, ...]:
    """The [[plane]] tables of calibration.toml without their images; ``FileError`` as `read_calibration`."""
    raw = read_toml(path, CalibrationSection)
    return tuple(
        PlannedPlane(
            section.name or Path(_patterns(section.images)[0]).parent.name or f"plane {k + 1}",
            _patterns(section.images),
            _patterns_by_laser(section.laser),
            _patterns_by_laser(section.background),
            None if section.origin is None else _stated(section.origin, section.rotation, MM[raw.units]),
        )
        for k, section in enumerate(raw.plane)
    )


def planned_views(path: Path) -> tuple[tuple[str, ...], ...]:
    """Patterns of the [[views]] that one camera can take, target and laser in one image; ``FileError`` for others."""
    found = []
    for section in read_toml(path, CalibrationSection).views:
        if section.laser not in (None, "same") or section.background is not None:
            raise FileError(
                f'{path}: views.laser: the [camera] takes freehand views with laser = "same" or without; record the others by hand'
            )
        found.append(_patterns(section.images))
    return tuple(found)


def planned_camera(path: Path) -> CameraSettings | None:
    """The [camera] of calibration.toml, whose images may still be to take; None where it has none."""
    raw = read_toml(path, CalibrationSection)
    return None if raw.camera is None else camera_settings(raw.camera, path.parent)


def planned_limits(path: Path) -> dict[str, float]:
    """Limits of [accept] that are given: ray_mm, laser_mm, repeat_px; ``FileError`` as `read_calibration`."""
    return {key: value for key, value in read_toml(path, CalibrationSection).accept if value is not None}


def _patterns_by_laser(value: ByLaser | None) -> dict[str, tuple[str, ...]]:
    if isinstance(value, dict) and len(value) > 1:
        return {name: (pattern,) for name, pattern in value.items()}
    return {"": _patterns(value)} if value else {}


def _patterns(value: Any) -> tuple[str, ...]:
    if isinstance(value, dict):
        value = next(iter(value.values()))
    return (value,) if isinstance(value, str) else tuple(value or ())


def with_views(path: Path, raw: CalibrationSection, *, lasers: bool) -> CalibrationSection:
    """The file with every image of its [[views]] as a [[plane]] of its own, called by its folder and stem."""
    planes = list(raw.plane)
    for section in raw.views:
        images = _images(path, section.images, "views.images")
        lit = _spread(path, "laser", section.laser if lasers else None, images)
        dark = _spread(path, "background", section.background if lasers else None, images)
        planes += [
            PlaneSection(name=f"{image.parent.name}/{image.stem}", images=[_literal(image)], laser=on, background=off)
            for image, on, off in zip(images, lit, dark, strict=True)
        ]
    return raw.model_copy(update={"plane": planes, "views": []})


def _spread(path: Path, key: str, value: ByLaser | None, images: tuple[Path, ...]) -> list[ByLaser | None]:
    """What each view has for ``key``: its own image where that is "same", else the one of its rank among the files matched."""
    if value is None:
        return [None] * len(images)
    if isinstance(value, dict):
        each = {name: _spread(path, f"{key}.{name}", pattern, images) for name, pattern in value.items()}
        return [{name: str(files[k]) for name, files in each.items()} for k in range(len(images))]
    files = images if value == "same" else tuple(matching(path.parent, value, owner=path, key=f"views.{key}"))
    if len(files) != len(images):
        raise FileError(
            f"{path}: views.{key}: {len(files)} files match {value!r} for {len(images)} views; one for each is needed, "
            'in the same order, or "same"'
        )
    return [_literal(file) for file in files]


def _literal(file: Path) -> str:
    """A pattern that matches this file only, wherever it is asked from."""
    return glob.escape(str(file.absolute()))


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


def _distinct(path: Path, planes: list[PlanePlan], sections: list[PlaneSection]) -> tuple[PlanePlan, ...]:
    """Planes whose names differ: of those without a name of their own, equal stems are told apart by their folders."""
    stems = Counter(plane.name for plane in planes)
    told = [
        replace(plane, name=f"{Path(str(plane.images[0])).parent.name}/{plane.name}")
        if section.name is None and stems[plane.name] > 1
        else plane
        for plane, section in zip(planes, sections, strict=True)
    ]
    seen: set[str] = set()
    for plane in told:
        if plane.name in seen:
            raise FileError(f"{path}: two planes are called {plane.name!r}; give each a name of its own")
        seen.add(plane.name)
    return tuple(told)


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


def _stated(origin: Vector, rotation: Vector, mm: float) -> Pose:
    return Pose.from_rotation_vector(np.deg2rad(rotation), np.array(origin) * mm)


def _plane(path: Path, section: PlaneSection, lasers: list[str], mm: float) -> PlanePlan:
    images = _images(path, section.images, "plane.images")
    name = section.name or images[0].stem
    pose = None
    if section.origin is not None:
        pose = _stated(section.origin, section.rotation, mm)
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


def _stage(path: Path, section: StageSection, usual: TargetSection, mm: float) -> StagePlan:
    images = _images(path, section.images, "stage.images")
    if len(images) != len(section.positions):
        raise FileError(
            f"{path}: stage: {len(images)} images and {len(section.positions)} positions; one position an image is needed"
        )
    scale = mm if section.kind == "linear" else 1.0
    try:
        target = target_of(_carried(section, usual), mm)
    except CalibrationError as error:
        raise FileError(f"{path}: stage.target: {error}") from error
    return StagePlan(section.kind, images, np.array(section.positions) * scale, target)


def _carried(section: StageSection, usual: TargetSection) -> TargetSection:
    """The target of a stage: its own, markers named by the stage or beside the file's target, or the file's target."""
    if section.target is not None:
        return section.target
    own = section if section.places else usual
    if not own.places:
        return usual
    return TargetSection(kind="markers", dictionary=own.dictionary, marker=own.marker, places=own.places)
