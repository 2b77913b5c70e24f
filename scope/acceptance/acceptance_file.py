"""acceptance.toml: artefacts with their calibration, limits and scans (docs/formats.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, Strict, model_validator

from calibration.errors import FileError
from scope.acceptance.standards import STANDARDS, Key, Name, Standard
from scope.cloud import Region, parse_region
from scope.session import MM, Positive, Section, Units, matching, read_toml

Kind = Literal["sphere", "ball_bar", "plane"]
_MOST = 1000  # scans of one artefact
NotNegative = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]
Kelvin = Annotated[float, Strict(), Field(ge=-100, le=200, allow_inf_nan=False)]


class ArtefactSection(Section):
    """What every artefact has."""

    scans: str | list[str]
    uncertainty: NotNegative  # of the calibrated size, k = 2
    form: NotNegative = 0.0  # its own deviation of form, as calibrated
    form_uncertainty: NotNegative = 0.0  # k = 2
    expansion: NotNegative = 0.0  # 1e-6 per kelvin
    certificate: str = ""
    region: str | None = None
    positions: Annotated[int, Strict(), Field(ge=1, le=_MOST)] | None = None


class SphereSection(ArtefactSection):
    """[sphere]."""

    diameter: Positive


class BallBarSection(ArtefactSection):
    """[ball_bar]."""

    distance: Positive
    diameters: tuple[Positive, Positive]

    @model_validator(mode="after")
    def _apart(self) -> BallBarSection:
        if self.distance <= 0.5 * sum(self.diameters):
            raise ValueError(
                f"distance {self.distance:g} is that of the centres: spheres of {self.diameters[0]:g} and {self.diameters[1]:g} would touch"
            )
        return self


class PlaneSection(ArtefactSection):
    """[plane]: form is its calibrated flatness."""

    uncertainty: NotNegative = 0.0


class LimitsSection(Section):
    """[limits]: largest errors that the maker permits, or the user."""

    probing_form: Positive | None = None
    probing_size: Positive | None = None
    spacing: Positive | None = None
    flatness: Positive | None = None


class AcceptanceSection(Section):
    """The whole file."""

    format: Literal[1]
    units: Units = "mm"
    standard: Name
    scanner: str = ""
    operator: str = ""
    volume: tuple[Positive, Positive, Positive] | None = None
    temperature: Kelvin = 20.0
    temperature_uncertainty: NotNegative = 0.0
    limits: LimitsSection = LimitsSection()
    sphere: SphereSection | None = None
    ball_bar: BallBarSection | None = None
    plane: PlaneSection | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """An artefact as its certificate has it, at the temperature of the test."""

    kind: Kind
    size: float  # mm: diameter, or distance of the centres; 0 of a plane
    diameters: tuple[float, ...]  # mm
    size_sigma: float  # mm, one sigma, of calibration and temperature
    form: float  # mm
    form_sigma: float  # mm, one sigma: half of the form's own, and its calibration's
    scans: tuple[Path, ...]
    region: Region | None
    positions: int | None  # that were asked for in the file
    certificate: str


@dataclass(frozen=True, slots=True, eq=False)
class AcceptancePlan:
    """An acceptance file with lengths in mm and every scan found."""

    path: Path
    standard: Standard
    artefacts: tuple[Known, ...]
    limits: Mapping[Key, float]  # mm
    diagonal: float | None  # mm, of the measuring volume
    temperature: float = 20.0
    about: Mapping[str, str] = field(default_factory=dict)  # scanner, operator


def read_acceptance(path: Path) -> AcceptancePlan:
    """Read acceptance.toml; ``FileError`` names file, key, what was found and what is allowed."""
    raw = read_toml(path, AcceptanceSection)
    mm = MM[raw.units]
    sections: list[tuple[Kind, ArtefactSection | None]] = [
        ("sphere", raw.sphere),
        ("ball_bar", raw.ball_bar),
        ("plane", raw.plane),
    ]
    artefacts = tuple(_known(path, kind, s, raw, mm) for kind, s in sections if s is not None)
    if not artefacts:
        raise FileError(f"{path}: no artefact; add [sphere], [ball_bar] or [plane] with its scans")
    limits: dict[Key, float] = {key: v * mm for key, v in raw.limits.model_dump().items() if v is not None}  # type: ignore[misc]
    of: dict[Key, str] = {"probing_form": "sphere", "probing_size": "sphere", "spacing": "ball_bar", "flatness": "plane"}  # fmt: skip
    for key in limits:
        if of[key] not in {a.kind for a in artefacts}:
            raise FileError(f"{path}: limits.{key} needs [{of[key]}] with its scans; add it or remove the limit")
    diagonal = None if raw.volume is None else mm * sum(v * v for v in raw.volume) ** 0.5
    about = {"scanner": raw.scanner, "operator": raw.operator}
    return AcceptancePlan(path, STANDARDS[raw.standard], artefacts, limits, diagonal, raw.temperature, about)


def _known(path: Path, kind: Kind, section: ArtefactSection, raw: AcceptanceSection, mm: float) -> Known:
    patterns = [section.scans] if isinstance(section.scans, str) else section.scans
    scans = [p for pattern in patterns for p in matching(path.parent, pattern, owner=path, key=f"{kind}.scans")]
    if len(scans) > _MOST or len(set(scans)) < len(scans):
        raise FileError(
            f"{path}: {kind}.scans: {len(scans)} files, some twice or more than {_MOST}; name each scan once"
        )
    try:
        region = None if section.region is None else parse_region(section.region)[1]
    except ValueError as error:
        raise FileError(f"{path}: {kind}.region: {error}") from error
    size = 0.0
    diameters: tuple[float, ...] = ()
    if isinstance(section, SphereSection):
        size, diameters = section.diameter * mm, (section.diameter * mm,)
    elif isinstance(section, BallBarSection):
        size, diameters = section.distance * mm, tuple(d * mm for d in section.diameters)
    expansion = 1e-6 * section.expansion
    thermal = size * expansion * 0.5 * raw.temperature_uncertainty
    sigma = float((0.25 * (section.uncertainty * mm) ** 2 + thermal**2) ** 0.5)
    form_sigma = 0.5 * mm * float((section.form**2 + section.form_uncertainty**2) ** 0.5)
    return Known(
        kind, size * (1.0 + expansion * (raw.temperature - 20.0)), diameters, sigma, section.form * mm, form_sigma, tuple(scans), region,
        section.positions, section.certificate,
    )  # fmt: skip
