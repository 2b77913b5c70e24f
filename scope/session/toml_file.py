"""TOML files that people write: read, checked, and refused in one line."""

from __future__ import annotations

import csv
import math
import re
import tomllib
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, ValidationError

from calibration.errors import FileError
from calibration.geometry import Array

FORMAT = 1
_LARGEST = 16 << 20  # bytes of a TOML or CSV file
MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}

Units = Literal["mm", "cm", "m", "inch"]


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("must be finite")
    return value


Number = Annotated[float, Strict(), AfterValidator(_finite)]
Positive = Annotated[float, Strict(), Field(gt=0), AfterValidator(_finite)]
Flag = Annotated[bool, Strict()]
Vector = tuple[Number, Number, Number]


class Section(BaseModel):
    """A table of a TOML file: unknown keys are refused, and nothing is converted between types in silence."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, arbitrary_types_allowed=False)


Model = TypeVar("Model", bound=Section)


def read_toml(path: Path, model: type[Model]) -> Model:
    """Read and validate a TOML file; ``FileError`` names file, key, what was found and what is allowed."""
    try:
        if path.stat().st_size > _LARGEST:
            raise FileError(
                f"{path}: {path.stat().st_size} bytes; a TOML file of at most {_LARGEST} is expected: check the path"
            )
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: is no text in UTF-8 (byte {error.start}); give a TOML file") from error
    except RecursionError as error:
        raise FileError(f"{path}: TOML arrays or tables nested too deeply to be read; write them flat") from error
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{path}: TOML syntax: {error}; correct that line") from error
    version = content.get("format")
    if version != FORMAT or isinstance(version, bool):
        raise FileError(
            f"{path}: format = {version!r}; this version of SCOPE reads format = {FORMAT}: add or correct it"
        )
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise FileError(f"{path}: {describe(error)}") from error


def describe(error: ValidationError) -> str:
    """One line for the first problem pydantic found, and how many more there are."""
    problems = error.errors(include_url=False)
    first = problems[0]
    key = ".".join(str(part) for part in first["loc"] if not str(part).endswith("]") and "-" not in str(part)) or "file"
    found = repr(first["input"])[:60]
    match first["type"]:
        case "extra_forbidden":
            text = f"{key}: unknown key (value {found}); correct its name or remove it"
        case "missing":
            text = f"{key}: missing; it is needed"
        case "value_error":
            text = f"{key}: {first['ctx']['error']!s}"
        case _:
            text = f"{key}: found {found}; needed: {first['msg'][:1].lower()}{first['msg'][1:]}"
    more = len(problems) - 1
    return text if more == 0 else f"{text} (and {more} more problem{'s' if more > 1 else ''})"


def read_csv(path: Path, columns: tuple[str, ...], *, optional: tuple[str, ...] = ()) -> dict[str, list[str]]:
    """Columns of a CSV file with a header, as text; every named column must be there, no row may be short."""
    try:
        if path.stat().st_size > _LARGEST:
            raise FileError(
                f"{path}: {path.stat().st_size} bytes; a CSV of at most {_LARGEST} is expected: check the path"
            )
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = [row for row in csv.reader(stream) if row]
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{path}: is no CSV in UTF-8 ({error}); write it again") from error
    if not rows:
        raise FileError(f"{path}: is empty; needed: a header with {', '.join(columns)} and one row each")
    header = [name.strip() for name in rows[0]]
    missing = [name for name in columns if name not in header]
    if missing:
        raise FileError(f"{path}: the header has {', '.join(header)[:100]!r}; needed too: {', '.join(missing)[:100]}")
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise FileError(f"{path}: row {number} has {len(row)} values; the header names {len(header)}: complete it")
    wanted = [name for name in (*columns, *optional) if name in header]
    return {name: [row[header.index(name)].strip() for row in rows[1:]] for name in wanted}


def numbers(path: Path, column: str, values: list[str]) -> Array:
    """Finite numbers (n,) of one CSV column; ``FileError`` names the row of the first that is none."""
    result = np.empty(len(values))
    for row, text in enumerate(values):
        try:
            result[row] = float(text)
        except ValueError:
            result[row] = math.nan
        if not math.isfinite(result[row]):
            raise FileError(f"{path}: row {row + 2}, {column}: found {text[:40]!r}; needed: a finite number")
    return result


def matching(folder: Path, pattern: str, *, owner: Path, key: str) -> list[Path]:
    """Files that match a glob relative to the file ``owner``, sorted naturally (frame2 before frame10)."""
    given = Path(pattern)
    root, relative = (
        (Path(given.anchor), str(given.relative_to(given.anchor))) if given.is_absolute() else (folder, pattern)
    )
    try:
        found = [p for p in root.glob(relative) if p.is_file()]
    except (ValueError, NotImplementedError) as error:
        raise FileError(f"{owner}: {key}: {pattern!r} is no usable pattern ({error}); correct it") from error
    if not found:
        raise FileError(f"{owner}: {key}: no file matches {pattern!r} in {root}; correct the pattern or add the images")
    return sorted(found, key=lambda p: natural_key(str(p)))


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """Key that sorts runs of digits as numbers."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text)]
