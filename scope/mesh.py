"""A mesh file of any CAD program to triangles in mm: STL, OBJ, PLY, GLB, 3MF, and STEP by its exact surfaces."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

from calibration.errors import FileError
from scope.errors import MissingLibraryError

ENDINGS = (".stl", ".obj", ".ply", ".glb", ".3mf", ".step", ".stp")
KINDS = "STL, OBJ, PLY, GLB, 3MF or STEP"
CHORD = (
    0.002  # mm between a curved surface of a STEP and its triangles, a fifth of what a pose takes as known of the form
)
TURN = 0.2  # rad between neighbouring triangles of such a surface
_MM = {  # of the units that GLB (metres, unless its meshes tell another) and 3MF name
    "micron": 1e-3, "micrometer": 1e-3, "millimeter": 1.0, "mm": 1.0, "centimeter": 10.0, "cm": 10.0, "meter": 1000.0, "m": 1000.0,
    "inch": 25.4, "inches": 25.4, "in": 25.4, "foot": 304.8, "feet": 304.8,
}  # fmt: skip
_NEEDS = {  # packages that an ending needs beside trimesh, and the extra that brings them
    ".3mf": (("networkx", "lxml"), "3mf"),
    ".step": (("cascadio",), "step"),
    ".stp": (("cascadio",), "step"),
}
_LARGEST = 1 << 30  # bytes that a packed mesh may unpack to
_MOST = 20_000_000  # numbers of one kind that a GLB may announce
_FAILURES = (
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    OSError,
    RuntimeError,
    NotImplementedError,
    MemoryError,
)


def load_mesh(path: Path) -> Any:
    """The triangles of a mesh file as a ``trimesh.Trimesh``, lengths in mm, all bodies of the file in their places.

    STL, OBJ and PLY tell no unit and are taken as mm. 3MF names its unit, glTF measures in metres
    (its specification, section 3.4) unless its meshes name another unit in their extras, as trimesh writes it; STEP names
    its unit and is cut into triangles that leave its surface by 0.002 mm at most.

    Raises
    ------
    FileError
        An ending that is not known, no mesh, no triangles, vertices that are not finite.
    MissingLibraryError
        3MF or STEP without the package that reads it.
    """
    import trimesh

    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise FileError(f"{path}: ending {path.suffix!r} is not known; give an {KINDS} mesh")
    try:
        _require_sane(path, ending)
        _require_packages(path, ending)
        more = {"tol_linear": CHORD, "tol_angular": TURN} if ending in {".step", ".stp"} else {}
        loaded: Any = trimesh.load_scene(path, process=True, **more)
        parts = [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
        for part in parts:
            if (mm := _unit(path, ending, part)) != 1.0:
                part.apply_scale(mm)
        mesh: Any = parts[0] if len(parts) == 1 else trimesh.util.concatenate(parts) if parts else None
    except _FAILURES as error:
        text = " ".join(str(error).split())[:80] or type(error).__name__
        raise FileError(f"{path}: no mesh could be read from it ({text}); export it again as STL") from error
    if mesh is None:
        raise FileError(f"{path}: holds no triangles; a point cloud is no model: give an {KINDS} mesh")
    _require_finite(path, mesh)
    return mesh


def _unit(path: Path, ending: str, part: Any) -> float:
    """Length, mm, of the unit of a part."""
    if ending in {".stl", ".obj", ".ply"}:
        return 1.0
    name = str(part.units or ("millimeter" if ending == ".3mf" else "meter")).lower()
    mm = _MM.get(name, _MM.get(name.removesuffix("s")))
    if mm is None:
        raise FileError(f"{path}: its unit {name[:20]!r} is not known; export it again in mm")
    return mm


def _require_packages(path: Path, ending: str) -> None:
    import importlib.util

    packages, extra = _NEEDS.get(ending, ((), ""))
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingLibraryError(
            f"{path}: {ending} needs the package {' and '.join(missing)}; install it: pip install 'scope-scanner[{extra}]'"
        )


def _require_sane(path: Path, ending: str) -> None:
    """Refuse files that are something else, or that would unpack to more than any mesh, before a library opens them."""
    try:
        with path.open("rb") as stream:
            begin = stream.read(20)
            if ending == ".glb":
                _require_sane_glb(path, begin, stream.read(int.from_bytes(begin[12:16], "little")))
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); name an {KINDS} mesh") from error
    if ending in {".step", ".stp"} and not begin.lstrip().startswith(b"ISO-10303-21"):
        raise FileError(f"{path}: does not begin with ISO-10303-21: not a STEP file; export it again")
    if ending == ".3mf":
        try:
            with zipfile.ZipFile(path) as held:
                size = sum(member.file_size for member in held.infolist())
        except zipfile.BadZipFile as error:
            raise FileError(f"{path}: is no 3MF ({error}); export it again") from error
        if size > _LARGEST:
            raise FileError(
                f"{path}: unpacks to {size / 1e9:.1f} GB, at most {_LARGEST / 1e9:.1f} GB are taken; decimate it"
            )


def _require_sane_glb(path: Path, begin: bytes, scene: bytes) -> None:
    if begin[:4] != b"glTF" or begin[16:20] != b"JSON":
        raise FileError(f"{path}: does not begin with glTF and a scene: not a GLB of version 2; export it again")
    try:
        told = json.loads(scene)
        counts = [int(each["count"]) for each in told.get("accessors", [])]
        outside = any("uri" in each for each in told.get("buffers", []))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileError(f"{path}: its scene cannot be read ({str(error)[:60]}); export it again") from error
    if outside:
        raise FileError(f"{path}: keeps its numbers in another file; export it as one .glb")
    if any(not 0 <= count <= _MOST for count in counts):
        raise FileError(f"{path}: announces {max(counts, key=abs)} numbers, at most {_MOST} are taken; decimate it")


def _require_finite(path: Path, mesh: Any) -> None:
    import numpy as np

    bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
    if bad:
        raise FileError(f"{path}: {bad} vertices are not finite; export it again")
