"""Every export in every reader that is installed: which scalars come back, compared number by number.

    python -m benchmarks.exports            the table of docs/formats.md

The readers are other people's: nothing of SCOPE reads here but in the last column. A scalar counts where each of its numbers is the
one that was written, within the last digit of the type that the format keeps (places: 1e-4 mm).
"""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scope.cloud import ScanCloud, Sensors
from scope.export import PROGRAMS, export_for

PLACES = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
SCALARS = ("intensity", "sigma", "sigma_cal", "u", "v", "frame", "laser")
Columns = dict[str, Any]


def cloud(frames: int = 6, lines: int = 10) -> ScanCloud:
    """A scan with a value of its own in every field, frames above 255, two lasers, and places with digits beyond float32."""
    rng = np.random.default_rng(3)
    frame, line = (part.ravel() for part in np.mgrid[300 : 300 + frames, 0:lines])
    n = len(frame)
    normals = rng.normal(size=(n, 3))
    turn = rng.normal(size=(frames, 4))
    return ScanCloud(
        points=np.stack([0.7 * line + rng.uniform(0, 0.1, n), 0.5 * frame, 400 + rng.uniform(0, 9, n)], axis=1),
        intensity=rng.uniform(1, 255, n).astype(np.float32),
        sigma=rng.uniform(0.001, 0.1, n).astype(np.float32),
        sigma_cal=rng.uniform(0.001, 0.1, n).astype(np.float32),
        pixels=np.stack([40.0 + line, rng.uniform(0, 480, n)], axis=1).astype(np.float32),
        frame=frame.astype(np.int32),
        laser=(np.arange(n) % 2).astype(np.uint8),
        sensors=Sensors(
            np.repeat(np.arange(300, 300 + frames), 2).astype(np.int32), np.tile([0, 1], frames).astype(np.uint8),
            np.repeat(rng.normal(size=(frames, 3)), 2, axis=0),
            np.repeat(turn / np.linalg.norm(turn, axis=1, keepdims=True), 2, axis=0),
            100.0 + rng.normal(size=(2 * frames, 3)),
        ),
        normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32).astype(np.float64),
        laser_names=("red", "green"),
        rig_sha256="ef" * 32,
        verified=True,
        camera_centre=np.array([0.25, -0.5, 1.0]),
    )  # fmt: skip


def columns(made: ScanCloud) -> Columns:
    """What was written, by name."""
    held = {name: getattr(made, name) for name in ("intensity", "sigma", "sigma_cal", "frame", "laser")}
    held |= {"u": made.pixels[:, 0], "v": made.pixels[:, 1]}
    held |= dict(zip(PLACES, made.points.T, strict=True))
    return held if made.normals is None else held | dict(zip(NORMALS, made.normals.T, strict=True))


# --- readers: path to columns by the names that they give, brought to mm ------------------------------------------------


def by_plyfile(path: Path) -> Columns:
    import plyfile

    vertex = plyfile.PlyData.read(str(path))["vertex"]
    return {prop.name: np.asarray(vertex[prop.name]) for prop in vertex.properties}


def by_trimesh(path: Path) -> Columns:
    import trimesh

    read: Any = trimesh.load(str(path))
    raw = read.metadata["_ply_raw"]["vertex"]["data"]
    return {name: np.ravel(raw[name]) for name in raw.dtype.names}


def by_open3d(path: Path) -> Columns:
    import open3d

    held = open3d.t.io.read_point_cloud(str(path)).point
    read = {name: held[name].numpy() for name in held if held[name].numpy().shape[1:] in {(1,), ()}}
    found = {name: np.ravel(value) for name, value in read.items()}
    found |= dict(zip(PLACES, held.positions.numpy().T, strict=True))
    legacy = open3d.io.read_point_cloud(str(path))
    if legacy.has_normals():
        found |= dict(zip(NORMALS, np.asarray(legacy.normals).T, strict=True))
    return found


def by_pymeshlab(path: Path) -> Columns:
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(path))
    mesh = meshes.current_mesh()
    found = dict(zip(PLACES, mesh.vertex_matrix().T, strict=True))
    found |= dict(zip(NORMALS, mesh.vertex_normal_matrix().T, strict=True))
    if mesh.has_vertex_scalar():
        found["quality"] = mesh.vertex_scalar_array()
    if mesh.has_vertex_tex_coord():
        found |= dict(zip(("texture_u", "texture_v"), mesh.vertex_tex_coord_matrix().T, strict=True))
    if mesh.has_vertex_color():
        found["grey"] = np.rint(255 * mesh.vertex_color_matrix()[:, 0])
    return found


def by_pyvista(path: Path) -> Columns:
    import pyvista

    read: Any = pyvista.read(str(path))
    found = {name: np.asarray(read.point_data[name]) for name in read.point_data if read.point_data[name].ndim == 1}
    if "Normals" in read.point_data:
        found |= dict(zip(NORMALS, np.asarray(read.point_data["Normals"]).T, strict=True))
    return found | dict(zip(PLACES, np.asarray(read.points).T, strict=True))


def by_laspy(path: Path) -> Columns:
    import laspy

    las = laspy.read(str(path))
    found = {name: np.asarray(las[name]) for name in las.point_format.extra_dimension_names}
    return (
        found
        | {"intensity": found.get("intensity_32", np.asarray(las.intensity))}
        | {a: np.asarray(las[a]) for a in PLACES}
    )


def by_pye57(path: Path) -> Columns:
    import pye57

    file = pye57.E57(str(path))
    read = file.read_scan(0, intensity=True, row_column=True, ignore_missing_fields=True)
    file.close()
    found = {axis: 1e3 * read[f"cartesian{axis.upper()}"] for axis in PLACES}
    names = {"intensity": "intensity", "rowIndex": "frame", "columnIndex": "line"}
    return found | {mine: np.asarray(read[theirs]) for theirs, mine in names.items() if theirs in read}


def by_mcap(path: Path) -> Columns:
    from mcap_ros2.reader import read_ros2_messages

    kinds = {2: "u1", 5: "<i4", 7: "<f4", 8: "<f8"}
    for message in read_ros2_messages(str(path), topics=["/scope/cloud"]):
        told = message.ros_msg
        layout = np.dtype({
            "names": [field.name for field in told.fields],
            "formats": [kinds[field.datatype] for field in told.fields],
            "offsets": [field.offset for field in told.fields],
            "itemsize": told.point_step,
        })  # fmt: skip
        rows = np.frombuffer(told.data, dtype=layout, count=told.width * told.height)
        metres = {*PLACES, "sigma", "sigma_cal"}
        return {name: 1e3 * rows[name].astype(float) if name in metres else rows[name] for name in layout.names or ()}
    return {}


def by_numpy(path: Path) -> Columns:
    lines = path.read_text(encoding="ascii").splitlines()
    title = lines[0].lstrip("/").lower().split() if lines[0].startswith("//") else list(PLACES)
    return dict(zip(title, np.loadtxt(lines, comments="//").T, strict=True))


def by_scope(path: Path) -> Columns:
    return columns(ScanCloud.load(path))


PLY = (".ply",)
READERS: dict[str, tuple[str, tuple[str, ...], Callable[[Path], Columns]]] = {  # module, endings, reader
    "plyfile": ("plyfile", PLY, by_plyfile),
    "trimesh": ("trimesh", PLY, by_trimesh),
    "open3d": ("open3d", (".ply", ".pcd"), by_open3d),
    "pymeshlab": ("pymeshlab", PLY, by_pymeshlab),
    "pyvista": ("pyvista", (".ply", ".vtp"), by_pyvista),
    "laspy": ("laspy", (".las", ".laz"), by_laspy),
    "pye57": ("pye57", (".e57",), by_pye57),
    "mcap": ("mcap_ros2", (".mcap",), by_mcap),
    "numpy": ("numpy", (".xyz",), by_numpy),
    "SCOPE": ("scope", (".ply", ".pcd", ".xyz", ".las", ".laz", ".e57"), by_scope),
}
MEANT = {  # names under which programs hold what SCOPE calls otherwise
    "quality": "sigma", "radius": "sigma_cal", "texture_u": "u", "texture_v": "v", "normal_x": "nx", "normal_y": "ny", "normal_z": "nz",
}  # fmt: skip
EXPORTS = [("", ending) for ending in (".ply", ".pcd", ".xyz", ".las", ".laz", ".e57")]
EXPORTS += [(name, ending) for name, program in PROGRAMS.items() for ending in program.endings]


def installed(reader: str) -> bool:
    """Whether a reader is there (for LAZ, ask for its own decoder too)."""
    return importlib.util.find_spec(READERS[reader][0]) is not None


def write(made: ScanCloud, path: Path, program: str) -> None:
    """Export as the command does."""
    if program:
        export_for(made, path, program)
    else:
        made.save(path)


def equal(made: ScanCloud, read: Columns) -> set[str]:
    """Columns that came back, by SCOPE's names."""
    found = {
        MEANT.get(name.removeprefix("scalar_"), name.removeprefix("scalar_")): value for name, value in read.items()
    }
    same = set()
    for name, value in columns(made).items():
        if name not in found or found[name] is None:
            continue
        tolerance = 1e-4 if name in PLACES else 2e-7 * (1.0 + np.abs(value).max())
        back = np.asarray(found[name], dtype=np.float64)
        if back.shape == value.shape and np.abs(back - value).max() < tolerance:
            same.add(name)
    return same


def cell(same: set[str]) -> str:
    """What came back, in a word where it is all or nothing but places."""
    every = {*PLACES, *NORMALS, *SCALARS}
    if same == every:
        return "all"
    if not set(PLACES) <= same:
        return "none"
    parts = ["places", *(["normals"] if set(NORMALS) <= same else []), *(name for name in SCALARS if name in same)]
    lost = [name for name in SCALARS if name not in same] + ([] if set(NORMALS) <= same else ["normals"])
    return f"all but {', '.join(lost)}" if len(lost) < 4 else ", ".join(parts)


def table() -> list[list[str]]:
    """Rows of export, then one cell a reader; '-' where a reader does not know the ending."""
    made, rows = cloud(), []
    readers = [name for name in READERS if installed(name)]
    with tempfile.TemporaryDirectory() as folder:
        for program, ending in EXPORTS:
            path = Path(folder) / f"cloud{ending}"
            write(made, path, program)
            row = [f"`--for {program}` {ending}" if program else ending]
            for name in readers:
                _, endings, read = READERS[name]
                row.append(cell(equal(made, read(path))) if ending in endings else "-")
            rows.append(row)
    return [["export", *readers], *rows]


def main() -> None:
    rows = table()
    for k, row in enumerate(rows):
        print(f"| {' | '.join(row)} |")
        if k == 0:
            print("|" + " --- |" * len(row))


if __name__ == "__main__":
    main()
