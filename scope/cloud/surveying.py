"""LAS, LAZ and E57, the formats of surveyors, by the libraries that know them."""

from __future__ import annotations

import importlib
import struct
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.atomic import beside, written_whole
from calibration.errors import FileError
from calibration.geometry import Array
from scope.cloud.columns import Columns
from scope.cloud.fields import Stored
from scope.errors import MeasurementError, MissingLibraryError

LIBRARIES = {".las": "laspy", ".laz": "laspy", ".e57": "pye57"}
_USER, _RECORD = "SCOPE", 1  # of the variable length record with the comments
_EXTRA = (
    ("sigma", np.float32), ("sigma_cal", np.float32), ("u", np.float32), ("v", np.float32), ("frame", np.int32),
    ("laser", np.uint8),
)  # fmt: skip
_MOST_LINES = 65_535
_FAILURES = (
    OSError,
    ArithmeticError,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    RuntimeError,
    struct.error,
    MemoryError,
)


def library(path: Path) -> ModuleType:
    """Return the package that reads and writes files of this ending; `MissingLibraryError` says what to install."""
    name = LIBRARIES[path.suffix.lower()]
    try:
        found = importlib.import_module(name)
        if path.suffix.lower() == ".laz":
            importlib.import_module("lazrs")
    except ImportError as error:
        raise MissingLibraryError(
            f"{path}: {path.suffix} needs the package {error.name or name}; install it: pip install 'scope-scanner[clouds]'"
        ) from error
    return found


def write_las(path: Path, cloud: Columns, comments: tuple[str, ...]) -> None:
    """Write LAS 1.4 (LAZ by its ending), mm to 0.1 um, with the scan's columns as extra bytes and comments in a record."""
    laspy = library(path)
    if len(cloud) == 0:
        raise MeasurementError(f"{path}: the cloud is empty; LAS needs a point")
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 1e-4), np.rint(cloud.points.mean(axis=0))
    values = {"u": cloud.pixels[:, 0], "v": cloud.pixels[:, 1]}
    values |= {name: getattr(cloud, name) for name, _ in _EXTRA if name not in values}
    extra = [*_EXTRA, ("intensity_32", np.float32)]
    values["intensity_32"] = cloud.intensity
    if cloud.normals is not None:
        extra += [(name, np.float32) for name in ("nx", "ny", "nz")]
        values |= dict(zip(("nx", "ny", "nz"), cloud.normals.T, strict=True))
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=kind) for name, kind in extra])
    header.vlrs.append(laspy.VLR(_USER, _RECORD, "SCOPE cloud", "\n".join(comments).encode()))
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    las.intensity = np.clip(np.nan_to_num(cloud.intensity), 0, 65535).astype(np.uint16)
    for name, value in values.items():
        las[name] = value
    with written_whole(path) as stream:
        las.write(stream, do_compress=path.suffix.lower() == ".laz")


def read_las(path: Path) -> Stored:
    """Read LAS or LAZ, lengths as they stand (mm); ``FileError`` where it is damaged or truncated."""
    laspy = library(path if path.suffix.lower() in LIBRARIES else path.with_suffix(".las"))
    try:
        size = path.stat().st_size
        with laspy.open(str(path)) as reader:
            header = reader.header
            stored = header.point_count * header.point_format.size
            if not header.are_points_compressed and stored > size - header.offset_to_point_data:
                raise ValueError(f"{header.point_count} points do not fit its {size} bytes")
            if header.point_count > 100 * size:
                raise ValueError(f"{header.point_count} points in {size} bytes")
            las = reader.read()
            names = {*las.point_format.dimension_names}
            fields: dict[str, NDArray[Any]] = {axis: np.asarray(las[axis], dtype=np.float64) for axis in "xyz"}
            own = [vlr.record_data_bytes() for vlr in header.vlrs if (vlr.user_id, vlr.record_id) == (_USER, _RECORD)]
            wanted = [name for name, _ in _EXTRA] + ["nx", "ny", "nz"] if own else []
            fields |= {name: np.asarray(las[name]) for name in wanted if name in names}
            fields["intensity"] = np.asarray(las["intensity_32" if own and "intensity_32" in names else "intensity"])
    except (*_FAILURES, laspy.errors.LaspyException) as error:
        raise FileError(f"{path}: cannot be read as LAS ({_short(error)}); write or copy the file again") from error
    comments = tuple(own[0].decode("utf-8", "replace").splitlines()) if own else ()
    return Stored(fields, comments, gaps=True)


def write_e57(path: Path, cloud: Columns) -> None:
    """Write E57: places (in metres, as ASTM E2807 asks), intensity, and frame and line as row and column, which is all that its writer takes."""
    pye57 = library(path)
    data: dict[str, NDArray[Any]] = {
        "cartesianX": cloud.points[:, 0] * 1e-3,
        "cartesianY": cloud.points[:, 1] * 1e-3,
        "cartesianZ": cloud.points[:, 2] * 1e-3,
        "intensity": np.nan_to_num(cloud.intensity).astype(np.float64),
    } | _rows_and_columns(cloud)
    with beside(path) as part:
        file = pye57.E57(str(part), mode="w")
        file.write_scan_raw(data)
        file.close()


def _rows_and_columns(cloud: Columns) -> dict[str, NDArray[Any]]:
    """Frame and line of each point as E57's row and column; nothing where they are not known or beyond 65,535."""
    for line in cloud.pixels.T:
        whole = np.isfinite(line) & (line == np.rint(line)) & (line >= 0) & (line <= _MOST_LINES)
        if whole.all() and len(cloud) and cloud.frame.min() >= 0 and cloud.frame.max() <= _MOST_LINES:
            return {"rowIndex": cloud.frame.astype(np.uint16), "columnIndex": line.astype(np.uint16)}
    return {}


def read_e57(path: Path) -> Stored:
    """Read all scans of an E57, each put in its place, metres to mm; ``FileError`` where it is damaged."""
    pye57 = library(path if path.suffix.lower() in LIBRARIES else path.with_suffix(".e57"))
    points: list[Array] = []
    intensity: list[Array] = []
    try:
        size = path.stat().st_size
        file = pye57.E57(str(path))
        try:
            for k in range(file.scan_count):
                if file.get_header(k).point_count > 100 * size:
                    raise ValueError(f"{file.get_header(k).point_count} points in {size} bytes")
                told = file.read_scan(k, intensity=True, ignore_missing_fields=True)
                points.append(np.stack([told[f"cartesian{axis}"] for axis in "XYZ"], axis=1) * 1e3)
                intensity.append(np.asarray(told.get("intensity", np.full(len(points[-1]), np.nan)), dtype=np.float64))
        finally:
            file.close()
    except (*_FAILURES, pye57.libe57.E57Exception) as error:
        raise FileError(f"{path}: cannot be read as E57 ({_short(error)}); write or copy the file again") from error
    if not points:
        raise FileError(f"{path}: holds no scan; give a point cloud")
    placed = np.concatenate(points)
    notes = (f"{len(points)} scans were joined",) if len(points) > 1 else ()
    return Stored(
        {**dict(zip("xyz", placed.T, strict=True)), "intensity": np.concatenate(intensity)}, gaps=True, notes=notes
    )


def _short(error: BaseException) -> str:
    """The beginning of what a library says, in one line."""
    return " ".join(str(error).split("\n", 1)[0].split())[:80] or type(error).__name__
