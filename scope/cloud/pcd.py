"""Point Cloud Library's PCD, version 0.7: ascii, binary and binary_compressed are read, binary is written.

Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html; LZF after M. Lehmann's liblzf.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from calibration.errors import FileError
from scope.cloud.fields import Stored

_KINDS = {
    "F4": "f4",
    "F8": "f8",
    "I1": "i1",
    "I2": "i2",
    "I4": "i4",
    "I8": "i8",
    "U1": "u1",
    "U2": "u2",
    "U4": "u4",
    "U8": "u8",
}
_LONGEST = 1 << 16  # bytes of a header
_TIGHTEST = 100  # no LZF stream grows by more than this


def read(path: Path) -> Stored:
    """Read a PCD; rows whose coordinates are NaN are gaps of an organised cloud.

    ``FileError`` for anything that is no PCD, is truncated, or announces more than the file holds: nothing is allocated
    before the announced size has been compared with the size of the file.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            header, comments = _header(path, stream)
            dtype, points = _layout(path, header)
            data = stream.read(size)
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    match header.get("DATA"):
        case ["ascii"]:
            rows = _ascii(path, data, dtype, points)
        case ["binary"]:
            _require_size(path, len(data), points * dtype.itemsize)
            rows = np.frombuffer(data, dtype=dtype, count=points)
        case ["binary_compressed"]:
            rows = _compressed(path, data, dtype, points)
        case other:
            raise FileError(f"{path}: DATA {' '.join(other or [])[:30]!r} is no PCD; write the file again")
    names = {"normal_x": "nx", "normal_y": "ny", "normal_z": "nz"}
    fields = {names.get(name, name): rows[name] for name in dtype.names or () if rows[name].ndim == 1}
    return Stored(fields, comments, gaps=True)


def write(stream: BinaryIO, rows: NDArray[np.void], comments: tuple[str, ...]) -> None:
    """Write rows of packed little-endian scalars, comments in the header."""
    names = [f"normal_{name[1]}" if name in {"nx", "ny", "nz"} else name for name in rows.dtype.names or ()]
    kinds = [rows.dtype[name].str[1:] for name in rows.dtype.names or ()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format", *(f"# {text}" for text in comments), "VERSION 0.7",
        f"FIELDS {' '.join(names)}", f"SIZE {' '.join(kind[1] for kind in kinds)}",
        f"TYPE {' '.join(kind[0].upper() for kind in kinds)}", f"COUNT {' '.join('1' for _ in kinds)}", f"WIDTH {len(rows)}",
        "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(rows)}", "DATA binary",
    ]  # fmt: skip
    stream.write(("\n".join(header) + "\n").encode("ascii", "replace"))
    stream.write(rows.tobytes())


def _header(path: Path, stream: BinaryIO) -> tuple[dict[str, list[str]], tuple[str, ...]]:
    header: dict[str, list[str]] = {}
    comments = []
    while stream.tell() < _LONGEST and "DATA" not in header:
        line = stream.readline(_LONGEST).decode("ascii", "replace")
        if not line:
            break
        words = line.split()
        if line.startswith("#"):
            comments.append(line[1:].strip())
        elif words:
            header[words[0]] = words[1:]
    if "DATA" not in header:
        raise FileError(f"{path}: its PCD header does not end; write or copy the file again")
    return header, tuple(comments)


def _layout(path: Path, header: dict[str, list[str]]) -> tuple[np.dtype[Any], int]:
    names = header.get("FIELDS", [])
    sizes, types = header.get("SIZE", []), header.get("TYPE", [])
    counts = header.get("COUNT", ["1"] * len(names))
    told = header.get("POINTS") or header.get("WIDTH") or []
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    try:
        for k, (name, size, kind, count) in enumerate(zip(names, sizes, types, counts, strict=True)):
            n = int(count[:9])
            if n < 1 or n > _LONGEST:
                raise ValueError(f"COUNT {n}")
            unique = f"_{k}" if name == "_" else name
            fields.append((unique, "<" + _KINDS[kind.upper() + size], () if n == 1 else (n,)))
        points = int(told[0][:18])
        if points < 0 or not fields:
            raise ValueError("no fields or points")
        return np.dtype(fields), points
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise FileError(
            f"{path}: its PCD header contradicts itself ({str(error)[:60]}); write or copy the file again"
        ) from error


def _require_size(path: Path, found: int, needed: int) -> None:
    if found < needed:
        raise FileError(
            f"{path}: truncated: its points need {needed} bytes and {found} are there; write or copy it again"
        )


def _ascii(path: Path, data: bytes, dtype: np.dtype[Any], points: int) -> NDArray[np.void]:
    width = sum(int(np.prod(dtype[name].shape, dtype=np.int64)) for name in dtype.names or ())
    _require_size(path, len(data) + 1, 2 * width * points)  # a number and a separator are two bytes at least
    try:
        numbers = np.array(data.split(), dtype=np.float64)
    except ValueError as error:
        raise FileError(f"{path}: {str(error)[:80]}; numbers are expected") from error
    if len(numbers) != width * points:
        raise FileError(
            f"{path}: holds {len(numbers)} numbers; {points} points of {width} are announced: copy it again"
        )
    rows = numbers.reshape(points, width)
    plain = np.zeros(points, dtype=[(name, "<f8", dtype[name].shape) for name in dtype.names or ()])
    at = 0
    for name in dtype.names or ():
        n = int(np.prod(dtype[name].shape, dtype=np.int64))
        plain[name] = rows[:, at] if dtype[name].shape == () else rows[:, at : at + n]
        at += n
    return plain


def _compressed(path: Path, data: bytes, dtype: np.dtype[Any], points: int) -> NDArray[np.void]:
    """Rows of a compressed block: every field for itself, one after the other."""
    needed = points * dtype.itemsize
    _require_size(path, len(data), 8)
    small, large = (int(n) for n in np.frombuffer(data, dtype="<u4", count=2))
    _require_size(path, len(data) - 8, small)
    if large != needed or large > _TIGHTEST * small + _TIGHTEST:
        raise FileError(f"{path}: {small} compressed bytes announce {large}; its points need {needed}: copy it again")
    plain = _inflated(path, data[8 : 8 + small], needed)
    rows, at = np.zeros(points, dtype=dtype), 0
    for name in dtype.names or ():
        field = dtype[name]
        rows[name] = np.frombuffer(plain, dtype=field, count=points, offset=at)
        at += points * field.itemsize
    return rows


def _inflated(path: Path, data: bytes, size: int) -> bytes:
    """LZF: runs of literal bytes, and references to what has already been written."""
    out, at, end = bytearray(), 0, len(data)
    try:
        while at < end and len(out) <= size:
            control = data[at]
            at += 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            back = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            if back < 0:
                raise IndexError
            for _ in range(length + 2):  # may overlap itself, so byte by byte
                out.append(out[back])
                back += 1
    except IndexError as error:
        raise FileError(
            f"{path}: its compressed block is damaged at byte {at}; copy or write the file again"
        ) from error
    if len(out) != size:
        raise FileError(f"{path}: its compressed block gives {len(out)} bytes; {size} are needed: copy the file again")
    return bytes(out)
