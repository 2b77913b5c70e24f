"""Meshes in, prepared models kept: the only place of pose estimation that touches the disk."""

from __future__ import annotations

import hashlib
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from calibration.atomic import written_whole
from calibration.errors import FileError
from calibration.geometry import Array, Ints, Pose
from scope.mesh import KINDS, load_mesh
from scope.model.grid import DistanceGrid
from scope.model.model import Axis, Model, prepare_model

MOST_FACES = 2_000_000
OPEN_SHARE = 0.002  # of the surface: what filling may add to a mesh that is not watertight
VERSION = "pose-model-2"  # change with anything that `prepare_model` makes


def load_model(path: str | Path, *, cache: Path | None = None, use_cache: bool = True) -> Model:
    """Read a mesh (STL, OBJ, PLY, GLB, 3MF, STEP) and prepare it, or take what was prepared of the same content before.

    Parameters
    ----------
    path : path
        Mesh file.
    cache : Path, optional
        Folder of prepared models; by default `cache_folder`. What cannot be written there is prepared each time.
    use_cache : bool
        Neither read nor write it.

    Raises
    ------
    FileError
        No mesh, too many faces, or a surface too open to be closed.
    MeasurementError
        A closed mesh whose bodies overlap.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); name an {KINDS} mesh") from error
    _require_few_faces(path, _announced_faces(path, content))
    kind = "" if path.suffix.lower() in {".stl", ".obj", ".ply"} else path.suffix.lower()
    digest = hashlib.sha256(VERSION.encode() + kind.encode() + content).hexdigest()
    folder = cache_folder() if cache is None else cache
    stored = folder / f"{digest}.npz"
    if use_cache and stored.is_file():
        model = _read_prepared(stored)
        if model is not None:
            return model
    vertices, faces = read_mesh(path)
    model = prepare_model(vertices, faces, name=path.name, sha256=digest)
    if use_cache:
        _write_prepared(stored, model)
    return model


def cache_folder() -> Path:
    """Where prepared models are kept: ``SCOPE_CACHE``, else the system's folder for caches."""
    told = os.environ.get("SCOPE_CACHE")
    if told:
        return Path(told)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "scope-scanner"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "scope-scanner"


def read_mesh(path: Path) -> tuple[Array, Ints]:
    """Vertices (V, 3) mm and faces (F, 3), closed and outwards, of a mesh file; small holes are filled."""
    mesh = load_mesh(path)
    _require_few_faces(path, len(mesh.faces))
    return _closed(path, mesh)


def _closed(path: Path, mesh: Any) -> tuple[Array, Ints]:
    import trimesh

    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.unique_faces())
    mesh.update_faces(mesh.nondegenerate_faces())
    before = float(mesh.area)
    if not mesh.is_watertight:
        count = _open_edges(mesh)
        if count:
            mesh = _filled(mesh)
            left = _open_edges(mesh)
            grown = float(mesh.area) - before
            if left or grown > OPEN_SHARE * before:
                raise FileError(
                    f"{path}: the mesh is open ({count} edges belong to one face only, {left} after filling, which adds "
                    f"{100 * grown / max(before, 1e-300):.1f} % of surface); close it in the CAD program and export it again"
                )
    if not mesh.is_winding_consistent or mesh.volume < 0:
        trimesh.repair.fix_normals(mesh, multibody=True)
    if mesh.volume < 0:
        mesh.invert()
    mesh.remove_unreferenced_vertices()
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _filled(mesh: Any) -> Any:
    """The mesh with a fan of triangles over each closed loop of open edges; branching borders stay open."""
    import trimesh

    edges = mesh.edges
    _, where, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    border = edges[count[where.ravel()] == 1]
    follow = {int(a): int(b) for a, b in border}
    if len(follow) != len(border):
        return mesh
    vertices, faces = [np.asarray(mesh.vertices)], [np.asarray(mesh.faces)]
    added = len(mesh.vertices)
    while follow:
        loop = [next(iter(follow))]
        while loop[-1] in follow:
            loop.append(follow.pop(loop[-1]))
        if loop[0] != loop[-1]:
            return mesh
        ring = np.array(loop[:-1])
        vertices.append(mesh.vertices[ring].mean(axis=0)[None])
        # against the sense of the faces that end there
        faces.append(np.stack([np.roll(ring, -1), ring, np.full(len(ring), added)], axis=1))
        added += 1
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=True)


def _open_edges(mesh: Any) -> int:
    _, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    return int((count == 1).sum())


def _announced_faces(path: Path, content: bytes) -> int:
    """Faces of a binary STL, from its header, before anything is built of them; 0 for other files."""
    if path.suffix.lower() == ".stl" and len(content) >= 84:
        count = int.from_bytes(content[80:84], "little")
        if len(content) == 84 + 50 * count:
            return count
    return 0


def _require_few_faces(path: Path, count: int) -> None:
    if count > MOST_FACES:
        raise FileError(
            f"{path}: {count} faces, at most {MOST_FACES} are taken; decimate it (a chord error of 0.01 mm needs far fewer)"
        )


_GRIDS = ("fine", "coarse")


def _write_prepared(path: Path, model: Model) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        axis = np.zeros((0, 3)) if model.axis is None else np.stack([model.axis.point, model.axis.direction])
        arrays: dict[str, Any] = {
            "name": np.array(model.name),
            "sha256": np.array(model.sha256),
            "vertices": model.vertices,
            "faces": model.faces.astype(np.int32),
            "samples": model.samples,
            "normals": model.normals,
            "view_direction": model.view_direction,
            "view_centroid": model.view_centroid,
            "likenesses": _stack(model.likenesses),
            "symmetries": _stack(model.symmetries),
            "axis": axis,
        }
        for name in _GRIDS:
            grid: DistanceGrid = getattr(model, name)
            arrays[f"{name}_values"] = grid.values
            arrays[f"{name}_frame"] = np.append(grid.origin, grid.spacing)
        with written_whole(path) as stream:
            np.savez(stream, **arrays)
    except (OSError, FileError):
        return  # a cache that cannot be written costs time, not results


def _read_prepared(path: Path) -> Model | None:
    """The model of a cache file; None where it is damaged, so that it is made anew."""
    import zipfile

    try:
        with np.load(path, allow_pickle=False) as held:
            grids = [
                DistanceGrid(held[f"{n}_frame"][:3], float(held[f"{n}_frame"][3]), held[f"{n}_values"]) for n in _GRIDS
            ]
            vertices = held["vertices"]
            axis = held["axis"]
            return Model(
                name=str(held["name"]),
                sha256=str(held["sha256"]),
                vertices=vertices,
                faces=held["faces"].astype(np.int64),
                diameter=float(np.linalg.norm(np.ptp(vertices, axis=0))),
                fine=grids[0],
                coarse=grids[1],
                samples=held["samples"],
                normals=held["normals"],
                view_direction=held["view_direction"],
                view_centroid=held["view_centroid"],
                likenesses=tuple(Pose(m[:3, :3], m[:3, 3]) for m in held["likenesses"]),
                symmetries=tuple(Pose(m[:3, :3], m[:3, 3]) for m in held["symmetries"]),
                axis=Axis(axis[0], axis[1]) if len(axis) else None,
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _stack(poses: tuple[Pose, ...]) -> Array:
    return np.array([p.matrix for p in poses]).reshape(-1, 4, 4)
