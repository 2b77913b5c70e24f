"""What each program takes: endings, names of the scalars, order of the elements.

===========  =====================================================================================================
CloudCompare  PLY of one element; scalars are taken behind the prefix ``scalar_`` only, as float. Text with a title ``//X Y Z``
MeshLab       PLY of one element; ``quality``, ``radius``, ``texture_u texture_v``, colours and normals, and nothing else
Open3D        PLY or PCD; its tensor reader takes every scalar under its own name, its older reader places and normals
PCL           PCD with ``normal_x``; x, y, z and intensity as 32-bit floats, as its point types have them
PyVista       VTK's XML (.vtp): VTK's PLY reader drops scalars and takes ``u v`` for the coordinates of a texture
ROS 2         MCAP with sensor_msgs/PointCloud2 and tf; lengths in metres (REP 103)
===========  =====================================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.atomic import written_whole
from scope.cloud import ScanCloud, comments, not_carried, pcd, ply, told, vertex_records
from scope.export import ros2, vtp

SCALARS = ("intensity", "sigma", "sigma_cal", "u", "v", "frame", "laser")
_NORMALS = ("nx", "ny", "nz")
_EXACT = 1 << 24  # whole numbers up to this are exact as float32
_POINTS = frozenset({"intensity", "sigma", "pixels and frames", "normals"})


@dataclass(frozen=True, slots=True)
class Program:
    """A program that reads clouds."""

    name: str  # as people write it
    keeps: Mapping[str, frozenset[str]]  # by ending, the usual one first: what it takes of what a cloud tells
    only: str = ""  # what it takes in part, in words

    @property
    def endings(self) -> tuple[str, ...]:
        """Endings of files that are written for it, the usual one first."""
        return tuple(self.keeps)


PROGRAMS: dict[str, Program] = {
    "cloudcompare": Program(
        "CloudCompare",
        {".ply": _POINTS, ".xyz": _POINTS, ".las": _POINTS, ".laz": _POINTS, ".e57": frozenset({"intensity"})},
    ),
    "meshlab": Program(
        "MeshLab",
        {".ply": frozenset({"intensity", "sigma", "pixels and frames", "normals"})},
        only="sigma is its quality, sigma_cal its radius, pixels are texture_u texture_v, intensity a grey of 8 bits; frame and laser "
        "stay in the file, unread",
    ),
    "open3d": Program("Open3D", {".ply": _POINTS, ".pcd": _POINTS}),
    "pcl": Program("PCL", {".pcd": _POINTS, ".ply": _POINTS}),
    "pyvista": Program("PyVista", {".vtp": _POINTS | {"places of the sensor", "verification"}}),
    "ros2": Program("ROS 2", {".mcap": _POINTS | {"places of the sensor", "verification"}}),
}  # fmt: skip


def program_for(path: Path) -> str:
    """Program whose format nobody else has, by the ending of a file; empty for every other ending."""
    return {".vtp": "pyvista", ".mcap": "ros2"}.get(path.suffix.lower(), "")


def require_program(path: Path, program: str) -> Program:
    """Return what is known of a program; ``ValueError`` for one that is not known or an ending that it does not take."""
    if program not in PROGRAMS:
        raise ValueError(f"--for {program!r}: the programs are {', '.join(PROGRAMS)}")
    known = PROGRAMS[program]
    if path.suffix.lower() not in known.endings:
        raise ValueError(f"{path.name}: for {known.name} a cloud is written as {' or '.join(known.endings)}")
    return known


def export_for(cloud: ScanCloud, path: Path, program: str) -> str:
    """Write a cloud for a program, whole or not at all; the answer is one line on what is lost, empty for nothing.

    Raises
    ------
    ValueError
        An unknown program, or an ending that it does not take.
    FileError, MissingLibraryError
        The file cannot be written, or the package that writes it is missing.
    """
    require_program(path, program)
    match program, path.suffix.lower():
        case "pyvista", _:
            with written_whole(path) as stream:
                vtp.write(stream, cloud)
        case "ros2", _:
            ros2.write(path, cloud)
        case "cloudcompare", ".xyz":
            _write_text(path, cloud)
        case _, ".ply":
            with written_whole(path) as stream:
                ply.write(stream, ply.Ply({"vertex": _RECORDS[program](cloud)}, comments(cloud)))
        case _, ".pcd":
            with written_whole(path) as stream:
                pcd.write(stream, _own(cloud), comments(cloud))
        case _:
            cloud.save(path)
    return lost_by(cloud, path, program)


def lost_by(cloud: ScanCloud, path: Path, program: str) -> str:
    """One line on what of a cloud a program does not take from a file of this ending; empty where it takes all."""
    known, ending = PROGRAMS[program], path.suffix.lower()
    if ending in {".las", ".laz", ".e57"}:
        return not_carried(cloud, path)
    lost = [what for what, there in told(cloud).items() if there and what not in known.keeps[ending]]
    parts = [f"{known.name} takes no {', '.join(lost)}"] if lost else []
    if known.only:
        parts.append(known.only)
    if program == "cloudcompare" and len(cloud) and int(cloud.frame.max()) > _EXACT:
        parts.append(f"frames beyond {_EXACT} are rounded to float")
    return f"{path.name}: {'; '.join(parts)}" if parts else ""


def _known(cloud: ScanCloud) -> tuple[str, ...]:
    """Scalars that a cloud tells: those that are NaN everywhere are none, nor frames without pixels."""
    scan = bool(np.isfinite(cloud.pixels).any())
    there = {
        "intensity": bool(np.isfinite(cloud.intensity).any()),
        "sigma": bool(np.isfinite(cloud.sigma).any()),
        "sigma_cal": bool(np.isfinite(cloud.sigma_cal).any()),
    }
    return tuple(name for name in SCALARS if there.get(name, scan))


def _picked(cloud: ScanCloud, fields: list[tuple[str, str, str]]) -> NDArray[np.void]:
    """Rows of (new name, type, name in SCOPE's own file)."""
    own = vertex_records(cloud)
    rows = np.zeros(len(own), dtype=[(name, kind) for name, kind, _ in fields])
    for name, _, source in fields:
        rows[name] = own[source]
    return rows


def _place(cloud: ScanCloud) -> list[tuple[str, str, str]]:
    return [(name, "<f4", name) for name in ("x", "y", "z", *(() if cloud.normals is None else _NORMALS))]


def _own(cloud: ScanCloud) -> NDArray[np.void]:
    """Scalars under SCOPE's names, those that are not known left out."""
    kinds = {"frame": "<i4", "laser": "u1"}
    return _picked(cloud, _place(cloud) + [(name, kinds.get(name, "<f4"), name) for name in _known(cloud)])


def _for_cloudcompare(cloud: ScanCloud) -> NDArray[np.void]:
    return _picked(cloud, _place(cloud) + [(f"scalar_{name}", "<f4", name) for name in _known(cloud)])


def _for_meshlab(cloud: ScanCloud) -> NDArray[np.void]:
    known = _known(cloud)
    names = {"sigma": "quality", "sigma_cal": "radius", "u": "texture_u", "v": "texture_v"}
    fields = _place(cloud) + [(names[name], "<f4", name) for name in known if name in names]
    if "intensity" in known:
        fields += [(colour, "u1", "laser") for colour in ("red", "green", "blue")]
    # whole again for SCOPE and CloudCompare; under the bare name, MeshLab would take intensity for a colour of 0 to 1
    fields += [(f"scalar_{name}", "<f4", name) for name in known]
    rows = _picked(cloud, fields)
    if "intensity" in known:
        grey = np.nan_to_num(cloud.intensity) * (255.0 / max(255.0, float(np.nanmax(cloud.intensity))))
        for colour in ("red", "green", "blue"):
            rows[colour] = np.rint(np.clip(grey, 0.0, 255.0))
    return rows


_RECORDS = {"cloudcompare": _for_cloudcompare, "meshlab": _for_meshlab, "open3d": _own, "pcl": _own}


def _write_text(path: Path, cloud: ScanCloud) -> None:
    """Lines of x y z and every scalar under a title that CloudCompare takes for the names."""
    rows = _own(cloud)
    names = [name for name in rows.dtype.names or () if name not in {"x", "y", "z"}]
    formats = ["%.5f"] * 3 + ["%d" if rows.dtype[name].kind in "iu" else "%.9g" for name in names]
    title = "//" + " ".join(["X", "Y", "Z", *(name.capitalize() if name in _NORMALS else name for name in names)])
    with written_whole(path) as stream:
        table = np.column_stack([cloud.points, *(rows[name].astype(np.float64) for name in names)])
        np.savetxt(stream, table, fmt=formats, header=title, comments="")
