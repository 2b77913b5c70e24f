"""[target] of calibration.toml: which marks there are, and where the plate that carries them reaches."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BeforeValidator, ConfigDict, Field, Strict, ValidationError, model_validator

from calibration.errors import CalibrationError, FileError
from calibration.targets import Charuco, Chessboard, CircleGrid, MarkerBoard, MarkerPlace, Polarity, SpotGrid, Target
from scope.session.toml_file import MM, Flag, Number, Positive, Section, Units, describe, read_toml

Rectangle: TypeAlias = tuple[float, float, float, float]  # x0, x1, y0, y1
Plate: TypeAlias = Literal["auto", "marks"] | Rectangle  # a rectangle in the target's frame, mm


def _pair(value: Any) -> Any:
    return (value, value) if isinstance(value, int | float) and not isinstance(value, bool) else value


Index = Annotated[int, Strict(), Field(ge=0, le=1000)]
Length = Annotated[Positive, Field(ge=1e-6, le=1e6)]  # of something that is printed or drilled, in any unit
Count = Annotated[int, Strict(), Field(ge=2, le=1000)]
_NEEDED = {
    "spots": ("rows", "columns", "pitch"),
    "chessboard": ("rows", "columns", "pitch"),
    "charuco": ("rows", "columns", "pitch", "marker"),
    "circles": ("rows", "columns", "pitch"),
    "markers": ("marker", "places"),
    "listed": (),
}


class PlaceSection(Section):
    """One entry of `places`: a marker's number, its centre and its turn in the target's frame."""

    id: Annotated[int, Strict(), Field(ge=0)]
    x: Number
    y: Number
    turn: Number = 0.0


class TargetSection(Section):
    """[target]: the marks."""

    kind: Literal["spots", "chessboard", "charuco", "circles", "markers", "listed"]
    polarity: Polarity | None = None
    rows: Count | None = None
    columns: Count | None = None
    pitch: Annotated[tuple[Length, Length] | None, BeforeValidator(_pair)] = None
    diameter: Length | None = None
    fiducials: list[tuple[Index, Index]] = Field(default_factory=list)
    fiducial_diameter: Length | None = None
    dictionary: str | None = None
    marker: Length | None = None
    legacy: Flag = False
    places: list[PlaceSection] = Field(default_factory=list)
    plate: Literal["auto", "marks"] | tuple[Number, Number, Number, Number] = "auto"

    @model_validator(mode="after")
    def _complete(self) -> TargetSection:
        for key in _NEEDED[self.kind]:
            if not getattr(self, key):
                raise ValueError(f"{key} is missing; kind = {self.kind!r} needs it")
        ids = [place.id for place in self.places]
        if len(set(ids)) < len(ids):
            raise ValueError(f"places names marker {max(ids, key=ids.count)} twice; each marker has one place")
        if self.kind == "circles" and self.pitch and self.pitch[0] != self.pitch[1]:
            raise ValueError(
                "pitch of circles is one length: neighbours along a diagonal are that far apart in x and in y"
            )
        if self.kind == "charuco" and self.pitch and self.marker and self.marker >= min(self.pitch):
            raise ValueError(
                f"marker {self.marker:g} is not less than the pitch {min(self.pitch):g}; a marker stands within its square"
            )
        if not isinstance(self.plate, str) and not (self.plate[0] < self.plate[1] and self.plate[2] < self.plate[3]):
            raise ValueError(
                f"plate {list(self.plate)} is no rectangle; give [x0, x1, y0, y1] with x0 < x1 and y0 < y1"
            )
        self._check_spots()
        return self

    def _check_spots(self) -> None:
        if self.fiducials and self.fiducial_diameter is None and self.diameter is not None:
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


class MarkersSection(Section):
    """[motion.markers]: what is stuck to a table, and is seen in the frames of the scan themselves."""

    dictionary: str | None = None
    marker: Positive
    places: Annotated[list[PlaceSection], Field(min_length=1, max_length=1000)]


def board_of(section: MarkersSection, mm: float) -> MarkerBoard:
    """The markers in mm."""
    places = tuple(MarkerPlace(p.id, p.x * mm, p.y * mm, math.radians(p.turn)) for p in section.places)
    return MarkerBoard(section.dictionary or "DICT_4X4_50", section.marker * mm, places)


def polarity_of(section: TargetSection) -> Polarity:
    """Of round marks: as told; light where nothing is told, but dark for circles, as OpenCV's pattern is printed."""
    return section.polarity or ("dark" if section.kind == "circles" else "light")


def target_of(section: TargetSection, mm: float) -> Target | None:
    """The target in mm; None where each plane lists its own marks.

    Raises
    ------
    CalibrationError
        Fiducials that look like themselves after a turn or in a mirror.
    """
    if section.kind == "markers":
        return board_of(
            MarkersSection(dictionary=section.dictionary, marker=section.marker or 1.0, places=section.places), mm
        )
    if section.kind == "listed" or section.rows is None or section.columns is None or section.pitch is None:
        return None
    pitch = (section.pitch[0] * mm, section.pitch[1] * mm)
    diameter = None if section.diameter is None else section.diameter * mm
    if section.kind == "circles":
        return CircleGrid(section.rows, section.columns, pitch[0], diameter, polarity_of(section))
    if section.kind == "chessboard":
        return Chessboard(section.rows, section.columns, pitch)
    if section.kind == "charuco":
        return Charuco(
            section.rows, section.columns, pitch, (section.marker or 0.0) * mm, section.dictionary or "DICT_5X5_100",
            section.legacy,
        )  # fmt: skip
    grid = SpotGrid(
        section.rows, section.columns, pitch, diameter, polarity_of(section), tuple(section.fiducials),
        None if section.fiducial_diameter is None else section.fiducial_diameter * mm,
    )  # fmt: skip
    grid.check_fiducials()
    return grid


def plate_of(section: TargetSection, mm: float) -> Plate:
    """Where the plate reaches, mm."""
    if isinstance(section.plate, str):
        return section.plate
    x0, x1, y0, y1 = (value * mm for value in section.plate)
    return (x0, x1, y0, y1)


class _TargetAlone(Section):
    """A calibration file of which only the target is read: its images need not exist yet."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    units: Units = "mm"
    target: TargetSection


def read_target(path: Path) -> Target:
    """Target of a calibration.toml, mm, whatever else the file holds or lacks.

    Raises
    ------
    FileError
        No such file, no TOML, no [target], or marks that are listed plane by plane, which are no target of their own.
    """
    return _alone(path, read_toml(path, _TargetAlone))


def target_in(path: Path, content: dict[str, Any]) -> Target:
    """Target, mm, of what a calibration.toml holds; ``path`` for messages."""
    try:
        return _alone(path, _TargetAlone.model_validate(content))
    except ValidationError as error:
        raise FileError(f"{path}: {describe(error)}") from error


def _alone(path: Path, found: _TargetAlone) -> Target:
    try:
        target = target_of(found.target, MM[found.units])
    except CalibrationError as error:
        raise FileError(f"{path}: {error}") from error
    if target is None:
        raise FileError(
            f"{path}: target.kind = 'listed' lists marks plane by plane and describes no target of its own; needed: spots, "
            "chessboard, charuco, markers or circles"
        )
    return target
