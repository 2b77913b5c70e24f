"""Height maps that people already have: .npy, .asc, .xyz, and the standards' SDF and X3P."""

from __future__ import annotations

import importlib
from pathlib import Path
from tokenize import TokenError
from types import ModuleType

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array
from scope.cloud import Region
from scope.errors import MeasurementError, MissingLibraryError
from scope.heightmap.heights import HeightMap


class NoLatticeError(FileError):
    """The points of a file stand on no lattice: they are a cloud and no height map."""


ENDINGS = (".npy", ".asc", ".txt", ".xyz", ".sdf", ".x3p")
_HIGHEST = 1e6  # mm
_MM = 1000.0  # SDF and X3P are in metres


def read_heights(path: Path, *, pitch: tuple[float, float] | None = None) -> HeightMap:
    """Read a height map; the ending of the name chooses the format.

    Parameters
    ----------
    path : Path
        ``.npy``: (rows, columns) mm. ``.asc``, ``.txt``: an ESRI ASCII grid, or a plain table of heights, mm; NaN or
        the header's NODATA value is a gap. ``.xyz``: lines of x y z, mm, whose x and y stand on a lattice in any
        order. ``.sdf``: ISO 25178-71. ``.x3p``: ISO 25178-72.
    pitch : (down, along), mm
        For the formats that tell none (.npy, a plain table); overrides what others tell.

    Raises
    ------
    FileError
        A file that cannot be read, is not what its ending says, or needs a pitch.
    MissingLibraryError
        SDF or X3P without the package that reads it.
    """
    readers = {
        ".npy": _read_npy, ".asc": _read_table, ".txt": _read_table, ".xyz": _read_xyz, ".sdf": _read_sdf,
        ".x3p": _read_x3p,
    }  # fmt: skip
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise FileError(f"{path}: ending {path.suffix!r} is no height map; use {', '.join(ENDINGS)} or a cloud .ply")
    try:
        z, told = reader(path)
    except NoLatticeError as error:
        raise NoLatticeError(f"{path}: {error}; measure it as a cloud") from error
    except (OSError, ValueError, EOFError, SyntaxError, TokenError, MemoryError, RecursionError) as error:
        text = " ".join(str(error).split())[:100]
        raise FileError(f"{path}: could not be read as a height map ({text}); check the file and its ending") from error
    if pitch is None and told is None:
        raise FileError(f"{path}: does not say its pitch; give --pitch in mm")
    if z.ndim != 2 or min(z.shape) < 2:
        raise FileError(f"{path}: holds {' x '.join(map(str, z.shape))} heights; an area of rows and columns is needed")
    z = np.where(np.isfinite(z), z, np.nan)
    if np.nanmax(np.abs(z), initial=0.0) > _HIGHEST:
        raise FileError(
            f"{path}: a height of {np.nanmax(np.abs(z)):.3g} mm; no surface has that: it is damaged, or not in mm"
        )
    steps = pitch or told or (1.0, 1.0)
    if not all(np.isfinite(step) and step > 0.0 for step in steps):
        raise FileError(f"{path}: its pitch is {steps[0]:g} x {steps[1]:g} mm; a positive one is needed: give --pitch")
    return HeightMap(z=z, pitch=steps)


def within(heights: HeightMap, region: Region) -> HeightMap:
    """Turn the heights outside a region into gaps; x runs along the rows and y down them, from the first height.

    ``MeasurementError`` where none is left.
    """
    rows, columns = np.indices(heights.z.shape)
    points = np.stack([columns * heights.pitch[1], rows * heights.pitch[0], heights.z], axis=2)
    known = heights.known
    keep = np.zeros(heights.z.shape, dtype=np.bool_)
    keep[known] = region.contains(points[known])
    if not keep.any():
        raise MeasurementError(
            f"the region is empty: the map spans x 0 to {heights.size[1]:.4g}, y 0 to {heights.size[0]:.4g} mm from its "
            "first height; move the region onto it"
        )
    return heights.with_heights(np.where(keep, heights.z, np.nan))


def _read_npy(path: Path) -> tuple[Array, None]:
    stored = np.load(path, allow_pickle=False)
    if not isinstance(stored, np.ndarray) or stored.dtype.kind not in "fiu":
        raise ValueError("it does not hold an array of real numbers")
    return stored.astype(np.float64), None


def _read_table(path: Path) -> tuple[Array, tuple[float, float] | None]:
    """Read an ESRI ASCII grid, whose first row is the northernmost, or a plain table of numbers."""
    lines = path.read_text(encoding="utf-8").splitlines()
    header: dict[str, float] = {}
    while lines and len(lines[0].split()) == 2 and lines[0].split()[0][:1].isalpha():
        name, value = lines.pop(0).split()
        if name.lower() == "nan":
            raise ValueError("a header line begins with nan")
        header[name.lower()] = float(value)
    rows = [line.replace(",", " ").replace(";", " ") for line in lines if line.strip()]
    z = np.loadtxt(rows, ndmin=2) if rows else np.zeros((0, 0))
    if z.size == 0:
        raise ValueError("it holds no heights")
    if not header:
        return z, None
    told = tuple(int(header[name]) for name in ("nrows", "ncols") if name in header)
    if told != z.shape:
        raise ValueError(
            f"its header tells {' x '.join(map(str, told))} heights, it holds {' x '.join(map(str, z.shape))}"
        )
    if "nodata_value" in header:
        z[z == header["nodata_value"]] = np.nan
    size = header.get("cellsize")
    return z, None if size is None else (size, size)


def _read_xyz(path: Path) -> tuple[Array, tuple[float, float]]:
    """Read points on a lattice: every x and y is a whole number of steps from the least, to a tenth of a step."""
    x, y, z = read_xyz(path).T
    places = []
    steps = []
    for values in (y, x):
        distinct = np.unique(np.round(values, 9))
        if len(distinct) < 2:
            raise ValueError("all points stand on one line")
        step = float(np.median(np.diff(distinct)))
        place = (values - distinct[0]) / step
        if np.abs(place - np.rint(place)).max() > 0.1:
            raise NoLatticeError("its points stand on no lattice")
        places.append(np.rint(place).astype(np.int64))
        steps.append(step)
    if (places[0].max() + 1) * (places[1].max() + 1) > 100 * len(z):
        raise NoLatticeError("its lattice is nearly empty")
    heights = np.full((places[0].max() + 1, places[1].max() + 1), np.nan)
    heights[places[0], places[1]] = z
    return heights, (steps[0], steps[1])


def read_xyz(path: Path) -> Array:
    """Read points (N, 3) of lines x y z, with blanks or commas between; a first line of names is passed over.

    ``ValueError`` for other lines.
    """
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    lines = [line.replace(",", " ").replace(";", " ") for line in lines if not line.lstrip().startswith(("#", "//"))]
    if lines and lines[0].split()[0][:1].isalpha() and lines[0].split()[0].lower() != "nan":
        lines.pop(0)
    table = np.loadtxt(lines, ndmin=2) if lines else np.zeros((0, 3))
    if table.shape[1] < 3 or len(table) == 0:
        raise ValueError("its lines do not hold x y z")
    return np.asarray(table[:, :3], dtype=np.float64)


def _read_sdf(path: Path) -> tuple[Array, tuple[float, float]]:
    sdfio = _optional("sdfio", path)
    try:
        file = sdfio.read(path)
    except sdfio.SdfError as error:
        raise ValueError(str(error)) from error
    return np.asarray(file.data, dtype=np.float64) * _MM, (file.header.y_scale * _MM, file.header.x_scale * _MM)


def _read_x3p(path: Path) -> tuple[Array, tuple[float, float]]:
    x3pio = _optional("x3pio", path)
    try:
        file = x3pio.read(path)
    except x3pio.X3pError as error:
        raise ValueError(str(error)) from error
    if not isinstance(file, x3pio.Surface):
        raise ValueError("it holds no surface")
    layer = file.layers[0]
    places = np.asarray(layer.points(), dtype=np.float64) * _MM
    steps = [float(np.nanmedian(np.diff(places[:, :, axis], axis=1 - axis))) for axis in (1, 0)]
    return np.asarray(layer.z, dtype=np.float64) * _MM, (abs(steps[0]), abs(steps[1]))


def _optional(name: str, path: Path) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingLibraryError(
            f"{path}: reading {path.suffix} needs the package {name}; install it: pip install 'scope-scanner[heightmaps]'"
        ) from error
