"""artefact.toml: an object of known shape that lies beside the part (docs/formats.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, Strict

from calibration.errors import FileError
from scope.cloud import Region, parse_region
from scope.session import MM, Positive, Section, Units, read_toml


class WatchAccept(Section):
    """[accept]: what the scanner may be off."""

    error: Positive | None = None
    scale_percent: Positive | None = None


class WatchSection(Section):
    """The whole file."""

    format: Literal[1]
    units: Units = "mm"
    name: str = ""
    mesh: str
    uncertainty: Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]
    region: str | None = None
    accept: WatchAccept = WatchAccept()


@dataclass(frozen=True, slots=True, eq=False)
class WatchPlan:
    """An artefact file with lengths in mm."""

    path: Path
    name: str
    mesh: Path
    uncertainty: float  # mm, k = 2, of its lengths
    region: Region | None
    error: float | None  # mm, limit of [accept]
    scale: float | None  # limit of [accept], 1


def read_artefact(path: Path) -> WatchPlan:
    """Read artefact.toml; ``FileError`` names file, key, what was found and what is allowed."""
    raw = read_toml(path, WatchSection)
    mm = MM[raw.units]
    mesh = path.parent / raw.mesh
    if not mesh.is_file():
        raise FileError(f"{path}: mesh: {mesh} is not there; correct the name")
    try:
        region = None if raw.region is None else parse_region(raw.region)[1]
    except ValueError as error:
        raise FileError(f"{path}: region: {error}") from error
    limit = raw.accept
    return WatchPlan(
        path, raw.name or mesh.stem, mesh, raw.uncertainty * mm, region, None if limit.error is None else limit.error * mm,
        None if limit.scale_percent is None else limit.scale_percent / 100.0,
    )  # fmt: skip
