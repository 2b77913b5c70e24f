"""The part of the PLY format that clouds need: elements of scalars, and lists that can be skipped.

Source: G. Turk, The PLY Polygon File Format (1994).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from calibration.errors import FileError

Records = NDArray[np.void]

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_COUNT = re.compile(r"[0-9]{1,18}")
_HEADER_LIMIT = 1 << 16  # bytes


@dataclass(frozen=True, slots=True, eq=False)
class Ply:
    """Elements by name, each a structured array, and the comments of the header."""

    elements: dict[str, Records]
    comments: tuple[str, ...]


def header(elements: dict[str, tuple[np.dtype[Any], int]], comments: tuple[str, ...]) -> bytes:
    """Header of a binary little-endian file whose elements follow in order."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, (dtype, count) in elements.items():
        lines.append(f"element {name} {count}")
        for field in dtype.names or ():
            lines.append(f"property {_NAMES[dtype[field].str[1:]]} {field}")
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "replace")


def write(stream: BinaryIO, ply: Ply) -> None:
    """Write binary little-endian; every element must have packed little-endian fields."""
    stream.write(header({name: (rows.dtype, len(rows)) for name, rows in ply.elements.items()}, ply.comments))
    for rows in ply.elements.values():
        stream.write(rows.tobytes())


def read(path: Path) -> Ply:
    """Read every element up to the first that holds a list (faces); what follows it is not read.

    ``FileError`` for anything that is no PLY, is truncated, or announces more than the file holds: nothing is
    allocated before the announced size has been compared with the size of the file.
    """
    try:
        with path.open("rb") as stream:
            return _read(path, stream, path.stat().st_size)
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def _read(path: Path, stream: BinaryIO, size: int) -> Ply:
    order, layout, comments = _read_header(path, stream)
    elements: dict[str, Records] = {}
    for name, count, fields in layout:
        if any(kind is None for _, kind in fields):
            break
        if not fields:
            raise FileError(f"{path}: its element {name} has no property; write or copy the file again")
        native = np.dtype([(field, f"<{kind}") for field, kind in fields])
        if order == "ascii":
            elements[name] = _read_ascii(path, stream, name, count, native, size)
            continue
        stored = np.dtype([(field, f"{order}{kind}") for field, kind in fields])
        need = count * stored.itemsize
        if need > size - stream.tell():
            raise FileError(
                f"{path}: truncated: {count} rows of element {name} need {need} bytes and {size - stream.tell()} are "
                "left; write or copy the file again"
            )
        elements[name] = np.frombuffer(stream.read(need), dtype=stored).astype(native)
    return Ply(elements, tuple(comments))


def _read_header(
    path: Path, stream: BinaryIO
) -> tuple[str, list[tuple[str, int, list[tuple[str, str | None]]]], list[str]]:
    if stream.readline(8).strip() != b"ply":
        raise FileError(f"{path}: does not start with 'ply': not a PLY file; give a cloud written by scope scan")
    order = ""
    layout: list[tuple[str, int, list[tuple[str, str | None]]]] = []
    comments: list[str] = []
    while stream.tell() < _HEADER_LIMIT:
        line = stream.readline(_HEADER_LIMIT).decode("ascii", "replace").strip()
        words = line.split()
        match words:
            case ["end_header"]:
                if not order:
                    break
                return order, layout, comments
            case ["format", "binary_little_endian", _]:
                order = "<"
            case ["format", "binary_big_endian", _]:
                order = ">"
            case ["format", "ascii", _]:
                order = "ascii"
            case ["comment", *_]:
                comments.append(line[len("comment") :].strip())
            case ["element", name, count] if _COUNT.fullmatch(count) and name not in {told[0] for told in layout}:
                layout.append((name, int(count), []))
            case ["property", "list", _, _, field] if layout:
                layout[-1][2].append((field, None))
            case ["property", kind, field] if layout and kind in _TYPES and field not in dict(layout[-1][2]):
                layout[-1][2].append((field, _TYPES[kind]))
            case [] | ["obj_info", *_]:
                if not line and stream.tell() >= path.stat().st_size:
                    break
            case _:
                raise FileError(f"{path}: header line {line[:60]!r} is no PLY; write the file again")
    raise FileError(f"{path}: its PLY header does not end or names no format; write or copy the file again")


def _read_ascii(path: Path, stream: BinaryIO, name: str, count: int, dtype: np.dtype[Any], size: int) -> Records:
    fields = dtype.names or ()
    if count * 2 * len(fields) > size:  # a number and a separator are two bytes at least
        raise FileError(f"{path}: truncated: {count} rows of element {name} do not fit its {size} bytes; copy it again")
    rows = np.zeros(count, dtype=dtype)
    for i in range(count):
        words = stream.readline().split()
        try:
            rows[i] = tuple(
                float(word) if dtype[field].kind == "f" else int(float(word))
                for word, field in zip(words[: len(fields)], fields, strict=True)
            )
        except (ValueError, OverflowError) as error:
            shown = b" ".join(words[:6]).decode("ascii", "replace")[:60]
            raise FileError(
                f"{path}: row {i} of element {name} holds {shown!r}, not {len(fields)} numbers of its types"
            ) from error
    return rows
