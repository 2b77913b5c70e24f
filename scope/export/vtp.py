"""VTK's XML PolyData (.vtp), which PyVista and ParaView read: points, every scalar, and the places of the sensor.

Source: Kitware, VTK File Formats (XML formats, PolyData; inline binary data with a 64-bit count before it).
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array
from scope.cloud import ScanCloud, comments

_TYPES = {"f4": "Float32", "f8": "Float64", "i4": "Int32", "i8": "Int64", "u1": "UInt8"}


def write(stream: BinaryIO, cloud: ScanCloud) -> None:
    """Write a cloud, mm; scalars in the point data, sensors (``sensor_*``) and the comments of the scan in the field data."""
    values: dict[str, NDArray[Any]] = {
        name: getattr(cloud, name)
        for name in ("intensity", "sigma", "sigma_cal")
        if np.isfinite(getattr(cloud, name)).any()
    }
    if np.isfinite(cloud.pixels).any():
        values |= {"u": cloud.pixels[:, 0], "v": cloud.pixels[:, 1], "frame": cloud.frame, "laser": cloud.laser}
    if cloud.normals is not None:
        values["Normals"] = cloud.normals.astype(np.float32)
    field = []
    if cloud.sensors is not None:
        field = [
            _array(f"sensor_{name}", getattr(cloud.sensors, name), field=True)
            for name in ("frame", "laser", "centre", "rotation", "laser_origin")
        ]
    shown = "sigma" if "sigma" in values else next(iter(values), "")
    _write(stream, cloud.points, values, shown, [*field, _texts("comments", comments(cloud))])


def write_points(
    stream: BinaryIO, points: Array, scalars: Mapping[str, NDArray[Any]], shown: str, told: tuple[str, ...]
) -> None:
    """Write points (N, 3) mm with scalars (N,), of which one is shown, and lines of text in the field data."""
    _write(stream, points, scalars, shown, [_texts("comments", told)])


def _write(stream: BinaryIO, points: Array, values: Mapping[str, NDArray[Any]], shown: str, field: list[str]) -> None:
    n = len(points)
    attributes = (f' Scalars="{shown}"' if shown else "") + (' Normals="Normals"' if "Normals" in values else "")
    index = np.arange(n, dtype=np.int64)
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        "<PolyData>", "<FieldData>", *field, "</FieldData>",
        f'<Piece NumberOfPoints="{n}" NumberOfVerts="{n}" NumberOfLines="0" NumberOfStrips="0" NumberOfPolys="0">',
        f"<PointData{attributes}>", *(_array(name, value) for name, value in values.items()), "</PointData>",
        "<Points>", _array("Points", points), "</Points>",
        "<Verts>", _array("connectivity", index), _array("offsets", index + 1), "</Verts>",
        "</Piece>", "</PolyData>", "</VTKFile>", "",
    ]  # fmt: skip
    stream.write("\n".join(lines).encode("ascii"))


def _array(name: str, value: NDArray[Any], *, field: bool = False) -> str:
    value = np.ascontiguousarray(value)
    little = value.astype(value.dtype.newbyteorder("<"), copy=False)
    data = little.tobytes()
    packed = base64.b64encode(np.uint64(len(data)).astype("<u8").tobytes() + data).decode("ascii")
    wide = f' NumberOfComponents="{value.shape[1]}"' if value.ndim == 2 else ""
    count = f' NumberOfTuples="{len(value)}"' if field else ""
    return f'<DataArray type="{_TYPES[value.dtype.str[1:]]}" Name="{name}"{wide}{count} format="binary">{packed}</DataArray>'


def _texts(name: str, lines: tuple[str, ...]) -> str:
    """Strings as VTK keeps them: the codes of their characters, each string ended by 0."""
    codes = " ".join(str(code) for line in lines for code in (*line.encode("ascii", "replace"), 0))
    return f'<Array type="String" Name="{name}" NumberOfTuples="{len(lines)}" format="ascii">{codes}</Array>'
