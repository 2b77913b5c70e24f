"""rig-design.toml: a rig to be simulated, read and validated."""

from __future__ import annotations

import json
import tomllib
from dataclasses import KW_ONLY, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from calibration.errors import FileError
from scope.simulation.hardware_design import (
    STRICT,
    CameraDesign,
    FaultDesign,
    JigDesign,
    LaserDesign,
    ToleranceDesign,
    WindowDesign,
    focal_px,
)
from scope.simulation.object_design import OBJECTS, MotionDesign, ObjectDesign
from scope.simulation.wild_design import WildDesign, WildTableDesign


@dataclass(frozen=True, slots=True, config=STRICT)
class RigDesign:
    """A whole rig and one scan by it."""

    camera: CameraDesign
    laser: LaserDesign
    jig: JigDesign
    _: KW_ONLY
    format: Literal[1] = 1
    units: Literal["mm"] = "mm"
    window: WindowDesign | None = None
    objects: Annotated[tuple[ObjectDesign, ...], Field(max_length=200, validation_alias="object")] = ()
    faults: Annotated[tuple[FaultDesign, ...], Field(max_length=200, validation_alias="fault")] = ()
    motion: MotionDesign | None = None
    tolerance: ToleranceDesign | None = None

    @model_validator(mode="after")
    def _joined(self) -> RigDesign:
        for fault in self.faults:
            if fault.plane not in self.jig.names:
                raise ValueError(f"a fault names plane {fault.plane!r}; the planes are {list(self.jig.names)}")
            if any(row >= self.jig.rows or column >= self.jig.columns for row, column in fault.missing):
                raise ValueError(f"a missing spot of plane {fault.plane!r} lies outside the grid")
        self._check_light()
        if bool(self.objects) != (self.motion is not None):
            raise ValueError("[object] and [motion] come together: a scan needs both, a mere calibration neither")
        return self

    def _check_light(self) -> None:
        """What power and speckle need of the other table."""
        c, beam = self.camera, self.laser
        if beam.power_mw is not None:
            missing = [k for k in ("f_number", "exposure_us", "quantum_efficiency") if getattr(c, k) is None]
            if missing or beam.wavelength_nm is None:
                key = f"camera.{missing[0]}" if missing else "laser.wavelength_nm"
                raise ValueError(f"{key} is missing; laser.power_mw needs it to become grey levels")
        if beam.speckle == "aperture" and (c.f_number is None or beam.wavelength_nm is None):
            key = "camera.f_number" if c.f_number is None else "laser.wavelength_nm"
            raise ValueError(f"{key} is missing; laser.speckle = 'aperture' follows from it")


_TABLES: dict[str, type[Any]] = {
    "camera": CameraDesign,
    "window": WindowDesign,
    "laser": LaserDesign,
    "jig": JigDesign,
    "fault": FaultDesign,
    "motion": MotionDesign,
    "wild": WildDesign,
    "tolerance": ToleranceDesign,
}


def read_design(path: str | Path) -> RigDesign:
    """Read and validate a rig-design.toml; a mesh it names is looked for beside it.

    Raises
    ------
    FileError
        A file that is missing, no TOML, or has an unknown key, a wrong type or an impossible value: file, key, what
        was found, what is allowed.
    """
    path = Path(path)
    data = _tables(path)
    for key in ("object", "fault"):  # one table, or an array of them
        if isinstance(data.get(key), dict):
            data[key] = [data[key]]
    camera = data.get("camera")
    if isinstance(camera, dict) and "focal_px" not in camera and (focal := focal_px(camera)) is not None:
        camera["focal_px"] = focal
    for item in data.get("object", []) if isinstance(data.get("object"), list) else []:
        if isinstance(item, dict) and isinstance(item.get("mesh"), str):
            item["mesh"] = str(path.parent / item["mesh"])
    design: RigDesign = _validated(path, data, RigDesign)
    return design


def read_any_design(path: str | Path) -> RigDesign | WildDesign:
    """Read a rig-design.toml of a rig, or of a session that nobody prepared (one with ``[wild]``).

    Raises
    ------
    FileError
        As `read_design`; and a file that holds tables of both.
    """
    path = Path(path)
    data = _tables(path)
    if "wild" not in data:
        return read_design(path)
    others = sorted(set(data) - {"format", "units", "wild"})
    if others:
        raise FileError(f"{path}: holds [wild] and {', '.join(others)}; [wild] stands alone, beside format and units")
    if data.get("format", 1) != 1 or data.get("units", "mm") != "mm" or not isinstance(data["wild"], dict):
        raise FileError(f'{path}: needed are format = 1, units = "mm" and a table [wild]')
    design: WildDesign = _validated(path, data["wild"], WildDesign, "wild")
    return design


def _tables(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileError(f"{path}: no such file; name a rig-design.toml") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path}: could not be read ({error}); needed is a text file in UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{path}: no valid TOML ({error}); correct it there") from error


def _validated(path: Path, data: dict[str, Any], kind: type[Any], table: str = "") -> Any:
    try:
        # by way of JSON, whose arrays may become tuples although types are strict
        return TypeAdapter(kind).validate_json(json.dumps(data, default=str))
    except ValidationError as error:
        raise FileError(f"{path}: {_first_fault(error, table)}") from error


def _first_fault(error: ValidationError, table: str = "") -> str:
    """One line about the first thing that is wrong: key, what was found, what is allowed."""
    first = error.errors(include_url=False)[0]
    if table:
        first["loc"] = (table, *first["loc"])
    place = [part for k, part in enumerate(first["loc"]) if not (k == 2 and first["loc"][0] == "object")]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".") or "the file"
    found = json.dumps(first["input"], default=str)
    found = found if len(found) <= 60 else found[:57] + "..."
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{key}: unknown key (found {found}); allowed here: {', '.join(_allowed(first['loc']))}"
    if first["type"] == "missing":
        return f"{key}: missing; it must be given"
    if first["type"].startswith("union_tag"):
        return f"{key}: neither a mesh nor a known solid; allowed: mesh, or solid = X"
    message = first["msg"].removeprefix("Value error, ")
    return f"{key}: {message}" if first["type"] == "value_error" else f"{key}: found {found}; {message}"


def _allowed(place: tuple[int | str, ...]) -> list[str]:
    """Keys of the table in which ``place`` stands."""
    if "wild" in place[:1] and len(place) == 3:
        return [f.name for f in fields(WildTableDesign)]
    if len(place) == 1:
        return ["format", "units", *_TABLES, "object"]
    table = OBJECTS.get(str(place[2])) if place[0] == "object" and len(place) > 2 else _TABLES.get(str(place[0]))
    return [] if table is None else [f.name for f in fields(table) if f.name != "_"]
