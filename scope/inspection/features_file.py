"""features.toml: what is to be measured on a part (docs/formats.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from calibration.errors import FileError
from calibration.geometry import Array
from scope.session import MM, Positive, Section, Units, Vector, read_toml

Kind = Literal["plane", "hole", "distance", "step", "angle"]
_NEEDED: dict[str, tuple[str, ...]] = {
    "plane": ("point",), "hole": ("point", "axis", "diameter"), "distance": ("of",), "step": ("of",), "angle": ("of",)
}  # fmt: skip


class FeatureSection(Section):
    """One [[feature]]."""

    name: str
    kind: Kind
    point: Vector | None = None
    axis: Vector | None = None
    diameter: Positive | None = None
    of: tuple[str, str] | None = None
    nominal: float | None = None
    tolerance: Positive | None = None
    position_tolerance: Positive | None = None

    @model_validator(mode="after")
    def _complete(self) -> FeatureSection:
        needed = _NEEDED[self.kind]
        for key in needed:
            if getattr(self, key) is None:
                raise ValueError(f"{key} is missing; kind = {self.kind!r} needs it")
        given = self.model_fields_set - {"name", "kind", "tolerance", "nominal", *needed}
        given -= {"position_tolerance"} if self.kind == "hole" else set()
        if given:
            raise ValueError(f"{sorted(given)[0]} has no meaning for kind = {self.kind!r}; remove it")
        if self.axis is not None and not np.linalg.norm(self.axis) > 0:
            raise ValueError("axis is (0, 0, 0); give a direction")
        return self


class FeaturesSection(Section):
    """The whole file."""

    format: Literal[1]
    units: Units = "mm"
    feature: list[FeatureSection] = Field(min_length=1, max_length=1000)


@dataclass(frozen=True, slots=True, eq=False)
class Wanted:
    """One feature to be measured; lengths mm, in the frame of the model."""

    name: str
    kind: Kind
    point: Array | None = None  # (3,) on the plane, or on the axis of the hole
    axis: Array | None = None  # (3,) unit
    diameter: float | None = None
    of: tuple[str, str] | None = None
    nominal: float | None = None  # mm or degrees; None: as the model has it
    tolerance: float | None = None  # mm or degrees
    position_tolerance: float | None = None  # mm, diameter of the zone


def read_features(path: Path) -> tuple[Wanted, ...]:
    """Read features.toml; ``FileError`` names file, key, what was found and what is allowed."""
    raw = read_toml(path, FeaturesSection)
    mm = MM[raw.units]
    names = [f.name for f in raw.feature]
    if len(set(names)) < len(names):
        raise FileError(f"{path}: two features are called {max(names, key=names.count)!r}; give each a name of its own")
    kinds = {f.name: f.kind for f in raw.feature}
    for f in raw.feature:
        for other in f.of or ():
            allowed = {"plane"} if f.kind in {"angle", "step"} else {"plane", "hole"}
            if kinds.get(other) not in allowed:
                raise FileError(
                    f"{path}: feature {f.name}: of names {other!r}, which is no {' or '.join(sorted(allowed))} of this file: correct it"
                )
        if f.of and (f.of[0] == f.of[1] or (f.kind == "distance" and kinds[f.of[0]] != kinds[f.of[1]])):
            raise FileError(f"{path}: feature {f.name}: of needs two planes or two holes; found {' and '.join(f.of)}")
    return tuple(
        Wanted(
            f.name, f.kind, None if f.point is None else np.array(f.point) * mm,
            None if f.axis is None else np.array(f.axis) / float(np.linalg.norm(f.axis)),
            None if f.diameter is None else f.diameter * mm, f.of, _length(f.nominal, f.kind, mm), _length(f.tolerance, f.kind, mm),
            _length(f.position_tolerance, f.kind, mm),
        )
        for f in raw.feature
    )  # fmt: skip


def _length(value: float | None, kind: Kind, mm: float) -> float | None:
    return value if value is None or kind == "angle" else value * mm
