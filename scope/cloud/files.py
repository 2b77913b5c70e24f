"""Clouds in and out; with `scope.cloud.ply`, the only place that knows cloud file formats."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from calibration.atomic import beside, written_whole
from calibration.errors import FileError
from calibration.geometry import Array
from scope.cloud import ply
from scope.cloud.columns import Columns, Sensors
from scope.errors import MeasurementError, MissingLibraryError
from scope.version import __version__

VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("sigma", "<f4"), ("sigma_cal", "<f4"),
     ("u", "<f4"), ("v", "<f4"), ("frame", "<i4"), ("laser", "u1")]
)  # fmt: skip
NORMAL = [("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
SENSOR = np.dtype(
    [("frame", "<i4"), ("laser", "u1"), ("cx", "<f4"), ("cy", "<f4"), ("cz", "<f4"), ("qw", "<f4"), ("qx", "<f4"),
     ("qy", "<f4"), ("qz", "<f4"), ("lx", "<f4"), ("ly", "<f4"), ("lz", "<f4")]
)  # fmt: skip


_LIBRARIES = {".las": "laspy", ".e57": "pye57"}


def require_format(path: Path) -> None:
    """Refuse a name whose ending no writer knows, or whose writer is not installed, before any work is done for it."""
    ending = path.suffix.lower()
    if ending in _LIBRARIES:
        _optional(_LIBRARIES[ending], path)
    elif ending not in {".ply", ".pcd", ".xyz", ".stl"}:
        raise FileError(f"{path}: ending {ending!r} is not known; use .ply, .pcd, .xyz, .las, .e57 or .stl")


def write_cloud(path: Path, cloud: Columns) -> None:
    """Write a cloud in the format that the name's ending asks for: ply, pcd, xyz, las, e57 or stl."""
    require_format(path)
    writers = {".ply": write_ply, ".pcd": _write_pcd, ".xyz": _write_xyz, ".stl": _write_stl}
    ending = path.suffix.lower()
    if ending in writers:
        with written_whole(path) as stream:
            writers[ending](stream, cloud)
    elif ending == ".las":
        _write_las(path, cloud)
    else:
        _write_e57(path, cloud)


def read_cloud(path: Path) -> Columns:
    """Read a PLY. What SCOPE wrote comes back whole; any other with x, y, z comes back as bare points, mm.

    Rows whose coordinates are not finite cannot be points; a file that holds some is refused with their number.
    """
    content = ply.read(path)
    rows = content.elements.get("vertex")
    names = () if rows is None else rows.dtype.names or ()
    if rows is None or not {"x", "y", "z"} <= set(names):
        raise FileError(f"{path}: has no element vertex with x, y, z; give a point cloud")
    points = np.stack([rows["x"], rows["y"], rows["z"]], axis=1).astype(np.float64)
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    if bad:
        raise FileError(
            f"{path}: {bad} of {len(points)} points are NaN or infinite; remove them and say so, then try again"
        )
    cloud = Columns.from_points(points)
    return _described(cloud, rows, content) if set(VERTEX.names or ()) <= set(names) else cloud


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


def write_ply(stream: BinaryIO, cloud: Columns) -> None:
    """Write the cloud as SCOPE's own PLY (docs/formats.md)."""
    elements = {"vertex": vertex_records(cloud), "sensor": sensor_records(cloud.sensors)}
    ply.write(stream, ply.Ply(elements, comments(cloud)))


def _described(cloud: Columns, rows: ply.Records, content: ply.Ply) -> Columns:
    told = dict(text.split(" ", 1) for text in content.comments if " " in text)
    lasers = [text.split(" ", 2) for text in content.comments if text.startswith("laser ")]
    try:
        centre = np.array([float(x) for x in told.get("camera_centre_C", "nan nan nan").split()])
    except ValueError:
        centre = np.full(3, np.nan)
    stripes = _stripes(content.comments)
    stored = content.elements.get("sensor")
    sensors = None
    if stored is not None and len(stored) and set(SENSOR.names or ()) <= set(stored.dtype.names or ()):
        sensors = Sensors(
            frame=stored["frame"].astype(np.int32),
            laser=stored["laser"].astype(np.uint8),
            centre=_columns(stored, "cx", "cy", "cz"),
            rotation=_columns(stored, "qw", "qx", "qy", "qz"),
            laser_origin=_columns(stored, "lx", "ly", "lz"),
        )
    with_normals = {"nx", "ny", "nz"} <= set(rows.dtype.names or ())
    return Columns(
        points=cloud.points,
        intensity=np.ascontiguousarray(rows["intensity"], dtype=np.float32),
        sigma=np.ascontiguousarray(rows["sigma"], dtype=np.float32),
        sigma_cal=np.ascontiguousarray(rows["sigma_cal"], dtype=np.float32),
        pixels=np.stack([rows["u"], rows["v"]], axis=1).astype(np.float32),
        frame=np.ascontiguousarray(rows["frame"], dtype=np.int32),
        laser=np.ascontiguousarray(rows["laser"], dtype=np.uint8),
        sensors=sensors,
        normals=_columns(rows, "nx", "ny", "nz") if with_normals else None,
        laser_names=tuple(parts[2] for parts in lasers if len(parts) == 3) or ("laser",),
        rig_sha256=told.get("rig_sha256", "").replace("unknown", ""),
        verified=told.get("verified") == "yes",
        complete=told.get("complete", "yes") == "yes",
        stripe_width=tuple(width for width, _ in stripes),
        stripe_corrected=tuple(corrected for _, corrected in stripes),
        camera_centre=centre if centre.shape == (3,) else np.full(3, np.nan),
    )


def _stripes(comments: tuple[str, ...]) -> list[tuple[float, float]]:
    """Width (mm) of each laser's stripe and the share of its effect that was corrected; empty where a line is no such thing."""
    lines = [text.split() for text in comments if text.startswith("stripe ")]
    try:
        return [(float(width), float(corrected)) for _, _, width, corrected in lines]
    except ValueError:
        return []


def _columns(rows: ply.Records, *names: str) -> Array:
    return np.stack([rows[name] for name in names], axis=1).astype(np.float64)


def _write_xyz(stream: BinaryIO, cloud: Columns) -> None:
    np.savetxt(stream, cloud.points, fmt="%.5f")


def _write_pcd(stream: BinaryIO, cloud: Columns) -> None:
    """Point Cloud Library's own format, version 0.7, binary."""
    rows = vertex_records(cloud)
    names = [
        name.replace("nx", "normal_x").replace("ny", "normal_y").replace("nz", "normal_z")
        for name in rows.dtype.names or ()
    ]
    kinds = [rows.dtype[name].str[1:] for name in rows.dtype.names or ()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(kind[1] for kind in kinds)}", f"TYPE {' '.join(kind[0].upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}", f"WIDTH {len(rows)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}", "DATA binary",
    ]  # fmt: skip
    stream.write(("\n".join(header) + "\n").encode())
    stream.write(rows.tobytes())


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


def _write_las(path: Path, cloud: Columns) -> None:
    laspy = _optional("laspy", path)
    if len(cloud) == 0:
        raise MeasurementError(f"{path}: the cloud is empty; LAS needs a point")
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 1e-4), cloud.points.mean(axis=0)
    for name in ("sigma", "sigma_cal"):
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=np.float32, description="mm"))
    header.add_extra_dim(laspy.ExtraBytesParams(name="frame", type=np.int32))
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    las.intensity = np.clip(np.nan_to_num(cloud.intensity), 0, 65535).astype(np.uint16)
    las.sigma, las.sigma_cal, las.frame = cloud.sigma, cloud.sigma_cal, cloud.frame
    with written_whole(path) as stream:
        las.write(stream, do_compress=False)


def _write_e57(path: Path, cloud: Columns) -> None:
    pye57 = _optional("pye57", path)
    data: dict[str, NDArray[Any]] = {
        "cartesianX": cloud.points[:, 0] * 1e-3,  # E57 is in metres (ASTM E2807)
        "cartesianY": cloud.points[:, 1] * 1e-3,
        "cartesianZ": cloud.points[:, 2] * 1e-3,
        "intensity": np.nan_to_num(cloud.intensity).astype(np.float64),
    }
    with beside(path) as part:
        file = pye57.E57(str(part), mode="w")
        file.write_scan_raw(data)
        file.close()


def _optional(name: str, path: Path) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingLibraryError(
            f"{path}: writing {path.suffix} needs the package {name}; install it: pip install 'scope-scanner[clouds]'"
        ) from error
