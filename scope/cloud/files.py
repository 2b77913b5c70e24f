"""Clouds in and out: the ending, or what a file begins with, chooses the format."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from calibration.atomic import written_whole
from calibration.errors import FileError
from calibration.geometry import Array
from scope.cloud import pcd, ply, surveying, text
from scope.cloud.columns import Columns, Sensors, Systematic
from scope.cloud.fields import NODE, NORMAL, SENSOR, VERTEX, Stored, columns_of, systematic_names
from scope.errors import MeasurementError
from scope.version import __version__

READ = (".ply", ".pcd", *text.ENDINGS, *surveying.LIBRARIES)  # endings of clouds that can be read
_BEGINNINGS = {
    b"ply": ".ply",
    b"# .PCD": ".pcd",
    b"VERSION": ".pcd",
    b"FIELDS": ".pcd",
    b"LASF": ".las",
    b"ASTM-E57": ".e57",
}
_KEPT = {  # what a format carries beside x, y and z
    ".pcd": {"intensity", "sigma", "pixels and frames", "normals", "verification"},
    ".las": {"intensity", "sigma", "pixels and frames", "normals", "verification"},
    ".laz": {"intensity", "sigma", "pixels and frames", "normals", "verification"},
    ".e57": {"intensity"},
    ".xyz": set[str](),
    ".stl": set[str](),
}
_NOT_OTHER = {
    *(VERTEX.names or ()),
    "nx",
    "ny",
    "nz",
    "quality",
    "red",
    "green",
    "blue",
    "alpha",
    "rgb",
    "rgba",
    "r",
    "g",
    "b",
}
_MOST_OTHER, _LARGEST = 16, 1e30


def require_format(path: Path) -> None:
    """Refuse a name whose ending no writer knows, or whose writer is not installed, before any work is done for it."""
    ending = path.suffix.lower()
    if ending in surveying.LIBRARIES:
        surveying.library(path)
    elif ending not in {".ply", ".pcd", ".xyz", ".stl"}:
        raise FileError(f"{path}: ending {ending!r} is not known; use .ply, .pcd, .xyz, .las, .laz, .e57 or .stl")


def write_cloud(path: Path, cloud: Columns) -> None:
    """Write a cloud in the format that the name's ending asks for: ply, pcd, xyz, las, laz, e57 or stl."""
    require_format(path)
    match path.suffix.lower():
        case ".las" | ".laz":
            surveying.write_las(path, cloud, comments(cloud))
        case ".e57":
            surveying.write_e57(path, cloud)
        case ending:
            writers = {".ply": write_ply, ".pcd": _write_pcd, ".xyz": _write_xyz, ".stl": _write_stl}
            with written_whole(path) as stream:
                writers[ending](stream, cloud)


def read_cloud(path: Path) -> Columns:
    """Read a cloud of any maker: PLY, PCD, XYZ and other text, LAS, LAZ, E57; lengths are taken as mm (E57 tells metres).

    What SCOPE wrote comes back as whole as the format allows, anything else as bare points with intensity. ``notes`` of the
    cloud say what was left out.

    Raises
    ------
    FileError
        No cloud, a damaged one, coordinates that are not finite where the format has no gaps, values that no scan has.
    MissingLibraryError
        LAS, LAZ or E57 without the package that reads it.
    """
    with np.errstate(all="ignore"):  # damaged numbers are refused by their values
        return columns_of(path, _stored(path))


def other_scalars(path: Path, rows: int) -> dict[str, Array]:
    """Scalars (rows,) of a cloud's file that are no columns of a scan, such as a deviation; NaN where not finite.

    Colours, and the copies under the names of other programs, are left out; so are all where the file has other ``rows`` than
    the cloud that was read of it, and more than the first 16.
    """
    fields = {name.removeprefix("scalar_"): values for name, values in _stored(path).fields.items()}
    found: dict[str, Array] = {}
    for name, values in fields.items():
        if name.lower() in _NOT_OTHER or len(values) != rows or values.ndim != 1 or values.dtype.kind not in "fiu":
            continue
        held = np.asarray(values, dtype=np.float64)
        if len(found) < _MOST_OTHER:
            found[name] = np.where(np.abs(held) < _LARGEST, held, np.nan)
    return found


def _stored(path: Path) -> Stored:
    ending = _kind(path)
    if ending == ".ply":
        return _stored_ply(path)
    if ending == ".pcd":
        return pcd.read(path)
    if ending in {".las", ".laz"}:
        return surveying.read_las(path)
    if ending == ".e57":
        return surveying.read_e57(path)
    if ending in text.ENDINGS:
        return text.read(path)
    raise FileError(f"{path}: not a PLY, PCD, XYZ, LAS or E57 file; give a cloud, such as scope scan writes")


def _kind(path: Path) -> str:
    """Ending that says what a file is: what it begins with counts more than its name."""
    try:
        with path.open("rb") as stream:
            begin = stream.read(16)
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    found = next((ending for magic, ending in _BEGINNINGS.items() if begin.startswith(magic)), "")
    return path.suffix.lower() if not found or path.suffix.lower() == ".laz" else found


def _stored_ply(path: Path) -> Stored:
    content = ply.read(path)
    rows = content.elements.get("vertex")
    if rows is None:
        raise FileError(f"{path}: has no element vertex with x, y, z; give a point cloud")
    fields = {name: rows[name] for name in rows.dtype.names or ()}
    return Stored(fields, content.comments, content.elements.get("sensor"), content.elements.get("systematic"))


def unknown(cloud: Columns, name: str) -> str:
    """One line on what a cloud that was read does not tell and what reading left out; empty where it tells all."""
    missing = [what for what, known in told(cloud).items() if not known]
    parts = list(cloud.notes)
    if missing:
        parts.append(f"it tells no {', '.join(missing)}")
    if not cloud.rig_sha256 and len(cloud):
        parts.append("its lengths are taken as mm")
    return f"{name}: {'; '.join(parts)}" if missing or cloud.notes else ""


def not_carried(cloud: Columns, path: Path) -> str:
    """One line on what of a cloud the format of ``path`` cannot carry; empty where nothing is lost."""
    ending = path.suffix.lower()
    if ending not in _KEPT:
        return ""
    lost = [what for what, known in told(cloud).items() if known and what not in _KEPT[ending]]
    return f"{path.name}: {ending[1:].upper()} does not carry {', '.join(lost)}" if lost else ""


def told(cloud: Columns) -> dict[str, bool]:
    """What a cloud may tell, and whether it does."""
    return {
        "intensity": bool(np.isfinite(cloud.intensity).any()),
        "sigma": bool(np.isfinite(cloud.sigma).any()),
        "pixels and frames": bool(np.isfinite(cloud.pixels).any()),
        "places of the sensor": cloud.sensors is not None,
        "verification": bool(cloud.rig_sha256),
    } | ({} if cloud.normals is None else {"normals": True})


def comments(cloud: Columns) -> tuple[str, ...]:
    """What the header of a PLY says of a cloud."""
    centre = " ".join(f"{x:.9g}" for x in cloud.camera_centre)
    return (
        f"written by SCOPE {__version__}",
        "units mm",
        f"rig_sha256 {cloud.rig_sha256 or 'unknown'}",
        f"verified {'yes' if cloud.verified else 'no'}",
        f"complete {'yes' if cloud.complete else 'no'}",
        f"camera_centre_C {centre}",
        *(f"origin {line}" for line in cloud.origin),
        *(f"laser {i} {name}" for i, name in enumerate(cloud.laser_names)),
        *(
            f"stripe {i} {width:.5g} {corrected:.4g}"
            for i, (width, corrected) in enumerate(zip(cloud.stripe_width, cloud.stripe_corrected, strict=True))
        ),
    )


def vertex_records(cloud: Columns) -> ply.Records:
    """The vertex element of a cloud."""
    rows = np.zeros(len(cloud), dtype=VERTEX if cloud.normals is None else np.dtype(VERTEX.descr + NORMAL))
    rows["x"], rows["y"], rows["z"] = cloud.points.T
    rows["u"], rows["v"] = cloud.pixels.T
    for name in ("intensity", "sigma", "sigma_cal", "frame", "laser"):
        rows[name] = getattr(cloud, name)
    if cloud.normals is not None:
        rows["nx"], rows["ny"], rows["nz"] = cloud.normals.T
    return rows


def sensor_records(sensors: Sensors | None) -> ply.Records:
    """The sensor element of a cloud."""
    rows = np.zeros(0 if sensors is None else len(sensors), dtype=SENSOR)
    if sensors is not None:
        rows["frame"], rows["laser"] = sensors.frame, sensors.laser
        rows["cx"], rows["cy"], rows["cz"] = sensors.centre.T
        rows["qw"], rows["qx"], rows["qy"], rows["qz"] = sensors.rotation.T
        rows["lx"], rows["ly"], rows["lz"] = sensors.laser_origin.T
    return rows


def systematic_records(systematic: Systematic) -> ply.Records:
    """The element of a PLY that tells what errors of the calibration do."""
    count = systematic.moves.shape[1]
    names = systematic_names(count)
    rows = np.zeros(len(systematic.laser), dtype=[*NODE, *((name, "<f4") for name in names[len(NODE) :])])
    rows["laser"], rows["local"] = systematic.laser, systematic.local
    rows["u"], rows["v"] = systematic.pixels.T
    for name, values in zip(names[len(NODE) :], systematic.moves.reshape(len(rows), -1).T, strict=True):
        rows[name] = values
    return rows


def write_ply(stream: BinaryIO, cloud: Columns) -> None:
    """Write the cloud as SCOPE's own PLY (docs/formats.md)."""
    elements = {"vertex": vertex_records(cloud), "sensor": sensor_records(cloud.sensors)}
    if cloud.systematic is not None:
        elements["systematic"] = systematic_records(cloud.systematic)
    ply.write(stream, ply.Ply(elements, comments(cloud)))


def _write_xyz(stream: BinaryIO, cloud: Columns) -> None:
    np.savetxt(stream, cloud.points, fmt="%.5f")


def _write_pcd(stream: BinaryIO, cloud: Columns) -> None:
    pcd.write(stream, vertex_records(cloud), comments(cloud))


def _write_stl(stream: BinaryIO, cloud: Columns) -> None:
    """Binary STL of the surface between neighbours on the scan lattice."""
    from scope.cloud.lattice import lattice_triangles

    triangles = lattice_triangles(cloud)
    if len(triangles) == 0:
        raise MeasurementError(
            f"no triangle joins the {len(cloud)} points: a mesh needs a scan in order with neighbouring frames; "
            "export .ply, .pcd or .xyz instead"
        )
    corners = cloud.points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    facets = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets["normal"], facets["corners"] = normals, corners
    stream.write(b"SCOPE, mm".ljust(80, b" ") + np.uint32(len(corners)).tobytes() + facets.tobytes())
