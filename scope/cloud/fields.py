"""Columns of any file to a cloud: which names are known, and what no scan can have is refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.errors import FileError
from calibration.geometry import Array, Bools
from scope.cloud.columns import Columns, Sensors, Systematic

VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("sigma", "<f4"), ("sigma_cal", "<f4"),
     ("u", "<f4"), ("v", "<f4"), ("frame", "<i4"), ("laser", "u1")]
)  # fmt: skip
NORMAL = [("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
SENSOR = np.dtype(
    [("frame", "<i4"), ("laser", "u1"), ("cx", "<f4"), ("cy", "<f4"), ("cz", "<f4"), ("qw", "<f4"), ("qx", "<f4"),
     ("qy", "<f4"), ("qz", "<f4"), ("lx", "<f4"), ("ly", "<f4"), ("lz", "<f4")]
)  # fmt: skip
NODE = [
    ("laser", "u1"),
    ("u", "<f4"),
    ("v", "<f4"),
    ("local", "<f4"),
]  # of the element systematic; then x0 y0 z0 x1 ...
MOST_ERRORS = 16  # of the calibration, that are told apart
SCAN = {"u", "v", "frame"}  # what makes points a scan in order
MOST_FRAMES = 1_000_000  # between the first and the last number of a frame
_FURTHEST = 1e9  # mm from the origin
_LINE, _LINES = 240, 64  # letters of a line of origin, and lines
_LARGEST_IMAGE = 1 << 20  # px


@dataclass(frozen=True, slots=True, eq=False)
class Stored:
    """What a reader found in a file."""

    fields: Mapping[str, NDArray[Any]]  # each (N,); x, y, z in mm
    comments: tuple[str, ...] = ()  # as `scope.cloud.files.comments` writes them; empty for files of others
    sensors: NDArray[np.void] | None = None  # as SENSOR
    systematic: NDArray[np.void] | None = None  # as NODE
    gaps: bool = False  # whether a point without coordinates is a usual thing in this format, and is left out
    notes: tuple[str, ...] = field(default=())


def columns_of(path: Path, stored: Stored) -> Columns:
    """Cloud of what was read from ``path``.

    Any columns but x, y, z may be missing; those with names of SCOPE's own are taken (also behind CloudCompare's ``scalar_``).
    Pixels and frames count only together.

    Raises
    ------
    FileError
        Without x, y, z; with coordinates that are not finite (unless the format has such gaps); with values that no scan has.
    """
    fields = {name.removeprefix("scalar_").lower(): values for name, values in stored.fields.items()}
    if not {"x", "y", "z"} <= set(fields):
        raise FileError(f"{path}: has no points with x, y, z; give a point cloud")
    points = np.stack([np.asarray(fields[name], dtype=np.float64) for name in "xyz"], axis=1)
    finite = np.asarray(np.isfinite(points).all(axis=1))
    bad, notes = int((~finite).sum()), stored.notes
    if bad and not stored.gaps:
        raise FileError(
            f"{path}: {bad} of {len(points)} points are NaN or infinite; remove them and say so, then try again"
        )
    if bad:
        points, fields = points[finite], {name: values[finite] for name, values in fields.items()}
        notes = (*notes, f"{bad} of {len(finite)} rows had no coordinates and were left out")
    _require(path, np.abs(points).max(axis=1, initial=0.0) < _FURTHEST, "lie further than 1000 km from the origin")
    n = len(points)
    intensity = _known(fields, "intensity", rows=n)[:, 0]
    _require(path, np.asarray(~(np.abs(intensity) > _FURTHEST)), "have an intensity that is infinite")
    own = any(text.startswith("written by SCOPE") for text in stored.comments) or set(VERTEX.names or ()) <= set(fields)
    scan = set(fields) >= SCAN
    normals = _known(fields, "nx", "ny", "nz") if own and {"nx", "ny", "nz"} <= set(fields) else None
    cloud = Columns(
        points=points,
        intensity=intensity.astype(np.float32),
        sigma=_sigma(path, fields, "sigma", n),
        sigma_cal=_sigma(path, fields, "sigma_cal", n),
        pixels=_pixels(path, fields) if scan else np.full((n, 2), np.nan, dtype=np.float32),
        frame=_whole(path, fields, "frame", MOST_FRAMES * 100) if scan else np.zeros(n, dtype=np.int32),
        laser=(_whole(path, fields, "laser", 255) if scan and "laser" in fields else np.zeros(n)).astype(np.uint8),
        normals=normals,
        notes=notes,
    )
    if n and scan and int(np.ptp(cloud.frame)) > MOST_FRAMES:
        raise FileError(
            f"{path}: frames run from {cloud.frame.min()} to {cloud.frame.max()}; no scan has more than {MOST_FRAMES}: the file "
            "is damaged, copy or write it again"
        )
    return _described(path, cloud, stored) if own else cloud


def _described(path: Path, cloud: Columns, stored: Stored) -> Columns:
    """Cloud with what the comments tell of the scan."""
    told = dict(text.split(" ", 1) for text in stored.comments if " " in text)
    lasers = [text.split(" ", 2) for text in stored.comments if text.startswith("laser ")]
    try:
        centre = np.array([float(x) for x in told.get("camera_centre_C", "nan nan nan").split()])
    except ValueError:
        centre = np.full(3, np.nan)
    stripes = _stripes(path, stored.comments)
    names = tuple(parts[2] for parts in lasers if len(parts) == 3)
    if not names:  # text with titles alone
        names = (
            tuple(f"laser {i}" for i in range(int(cloud.laser.max(initial=0)) + 1)) if cloud.laser.any() else ("laser",)
        )
    _require(path, cloud.laser < len(names), f"are of a laser beyond the {len(names)} that the file names")
    return replace(
        cloud,
        sensors=_sensors(path, cloud, stored.sensors),
        laser_names=names,
        rig_sha256=told.get("rig_sha256", "").replace("unknown", ""),
        verified=told.get("verified") == "yes",
        complete=told.get("complete", "yes") == "yes",
        stripe_width=tuple(width for width, _ in stripes),
        stripe_corrected=tuple(corrected for _, corrected in stripes),
        origin=tuple(text.removeprefix("origin ")[:_LINE] for text in stored.comments if text.startswith("origin "))[
            :_LINES
        ],
        systematic=_systematic(path, len(names), stored.systematic),
        camera_centre=centre if centre.shape == (3,) else np.full(3, np.nan),
    )


def _sensors(path: Path, cloud: Columns, rows: NDArray[np.void] | None) -> Sensors | None:
    if rows is None or len(rows) == 0 or not set(SENSOR.names or ()) <= set(rows.dtype.names or ()):
        return None
    told = {name: rows[name] for name in rows.dtype.names or ()}
    sensors = Sensors(
        frame=_whole(path, told, "frame", MOST_FRAMES * 100),
        laser=_whole(path, told, "laser", 255).astype(np.uint8),
        centre=_known(told, "cx", "cy", "cz"),
        rotation=_known(told, "qw", "qx", "qy", "qz"),
        laser_origin=_known(told, "lx", "ly", "lz"),
    )
    length = np.linalg.norm(sensors.rotation, axis=1)
    whole = np.abs(length - 1.0) < 1e-3
    whole &= ~(np.abs(sensors.centre) > _FURTHEST).any(axis=1) & ~(np.abs(sensors.laser_origin) > _FURTHEST).any(axis=1)
    _require(path, whole, "of the sensor are no pose of a camera", what="rows")
    known = np.isin(cloud.frame, sensors.frame)
    _require(path, known, "are of a frame that the sensor's rows do not name")
    if int(np.ptp(sensors.frame)) > MOST_FRAMES:
        raise FileError(f"{path}: the sensor's frames run from {sensors.frame.min()} to {sensors.frame.max()}: damaged")
    return sensors


def _systematic(path: Path, lasers: int, rows: NDArray[np.void] | None) -> Systematic | None:
    """What errors of the calibration do; ``FileError`` where the nodes of a laser are no lattice of pixels."""
    names = () if rows is None else rows.dtype.names or ()
    count = (len(names) - len(NODE)) // 3
    if rows is None or not len(rows) or not 0 < count <= MOST_ERRORS or names != systematic_names(count):
        return None
    told = {name: rows[name] for name in names}
    laser = _whole(path, told, "laser", 255).astype(np.uint8)
    pixels, local = _known(told, "u", "v"), _known(told, "local")[:, 0]
    moves = np.stack([_known(told, *(f"{axis}{k}" for axis in "xyz")) for k in range(count)], axis=1)
    good = (np.abs(moves) < _FURTHEST).all(axis=(1, 2)) & (np.abs(pixels) <= _LARGEST_IMAGE).all(axis=1)
    good &= (local >= 0) & (local < _FURTHEST) & (laser < lasers)
    for k in np.unique(laser):
        mine = np.flatnonzero(laser == k)
        u, v = np.unique(pixels[mine, 0]), np.unique(pixels[mine, 1])
        whole = len(u) > 1 and len(v) > 1 and len(mine) == len(u) * len(v)
        if not whole or (pixels[mine] != np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)).any():
            good[mine] = False
    _require(path, good, "of the calibration's errors are none, or no lattice", what="rows")
    return Systematic(laser, pixels, moves, local)


def systematic_names(count: int) -> tuple[str, ...]:
    """Properties of the element systematic with so many errors."""
    return (*(name for name, _ in NODE), *(f"{axis}{k}" for k in range(count) for axis in "xyz"))


def _require(path: Path, good: Bools, wrong: str, *, what: str = "points") -> None:
    bad = np.flatnonzero(~np.asarray(good))
    if len(bad):
        raise FileError(
            f"{path}: {len(bad)} of {len(good)} {what} (the first is number {bad[0]}) {wrong}: the file is damaged or edited, "
            "copy or write it again"
        )


def _known(fields: Mapping[str, NDArray[Any]], *names: str, rows: int = 0) -> Array:
    """Columns (N, len(names)) in double precision; NaN (rows, 1) where a single one is missing."""
    if names[0] not in fields:
        return np.full((rows, len(names)), np.nan)
    return np.stack([np.asarray(fields[name], dtype=np.float64) for name in names], axis=1)


def _sigma(path: Path, fields: Mapping[str, NDArray[Any]], name: str, n: int) -> NDArray[np.float32]:
    values = _known(fields, name, rows=n)[:, 0]
    _require(path, np.asarray(~((values < 0.0) | (values > _FURTHEST))), f"have a {name} that is negative or infinite")
    return values.astype(np.float32)


def _pixels(path: Path, fields: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    pixels = _known(fields, "u", "v")
    _require(path, np.asarray(~(np.abs(pixels) > _LARGEST_IMAGE).any(axis=1)), "have a pixel that no image has")
    known = np.asarray(np.isfinite(pixels).all(axis=1))
    if known.any():  # a cloud knows all of its pixels or none: one without would cost all their order
        _require(path, known, "have no pixel, and others have")
    return pixels.astype(np.float32)


def _whole(path: Path, fields: Mapping[str, NDArray[Any]], name: str, most: int) -> NDArray[np.int32]:
    """Whole numbers from 0 to ``most``."""
    values = np.asarray(fields[name], dtype=np.float64)
    good = (values >= 0) & (values <= most) & (values == np.rint(values))
    _require(path, np.asarray(good), f"have a {name} that is no count from 0", what="rows")
    return values.astype(np.int32)


def _stripes(path: Path, comments: tuple[str, ...]) -> list[tuple[float, float]]:
    """Width (mm) of each laser's stripe and the share of its effect that was corrected; empty where a line is no such thing."""
    lines = [text.split() for text in comments if text.startswith("stripe ")]
    try:
        told = [(float(width), float(corrected)) for _, _, width, corrected in lines]
    except ValueError:
        return []
    for width, corrected in told:
        if width <= 0.0 or width > _LARGEST_IMAGE or not 0.0 <= corrected <= 1.0:
            raise FileError(
                f"{path}: a stripe {width:g} mm wide of which {corrected:g} was corrected is none; the header is damaged"
            )
    return told
