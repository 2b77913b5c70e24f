"""Regions as people write them: box:..., polygon:file, mesh:file, with or without a name before them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Pose
from scope.cloud.region import Box, Interval, Polygon, Region

GRAMMAR = "[NAME=]box:x0,x1,y0,y1[,z0,z1] | polygon:file.csv | mesh:file.stl"


def parse_region(text: str, *, cloud_from_model: Pose | None = None) -> tuple[str, Region]:
    """Read ``[NAME=]kind:rest`` into a name and a region in the cloud frame, mm.

    A box is ``box:x0,x1,y0,y1`` or ``box:x0,x1,y0,y1,z0,z1``; ``polygon:file`` is a CSV of corners x,y; ``mesh:file`` what
    stands over a mesh, within 2 mm of it, which stands in the cloud frame, or in that of ``cloud_from_model``. Without a name the region is called by its own text.

    Raises
    ------
    ValueError
        A text of another form.
    FileError
        A file that is missing or holds no region.
    """
    head, separator, rest = text.partition(":")
    name, named, kind = head.rpartition("=")
    if not separator or kind not in {"box", "polygon", "mesh"} or (named and not name):
        raise ValueError(f"region {text!r} is not {GRAMMAR}")
    label = name or f"{kind}:{rest if kind == 'box' else Path(rest).name}"
    if kind == "box":
        return label, _box(rest, text)
    if kind == "polygon":
        return label, _polygon(Path(rest))
    from scope.cloud.near_mesh import NearMesh, read_mesh

    return label, NearMesh(read_mesh(Path(rest), cloud_from_model=cloud_from_model))


def require_names(names: Sequence[str]) -> None:
    """``ValueError`` where two regions have one name: their results could not be told apart."""
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{names.count(name)} regions are called {name!r}; give each a NAME of its own")


def _box(rest: str, text: str) -> Box:
    try:
        sides = [float(part) for part in rest.split(",")]
    except ValueError as error:
        raise ValueError(f"region {text!r}: its sides are not numbers; write {GRAMMAR}") from error
    if len(sides) not in {4, 6} or any(math.isnan(side) for side in sides):
        raise ValueError(f"region {text!r}: {len(sides)} numbers, 4 or 6 are needed; write {GRAMMAR}")
    pairs: list[Interval] = [(sides[i], sides[i + 1]) for i in range(0, len(sides), 2)]
    return Box(*pairs)


def _polygon(path: Path) -> Polygon:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path}: the polygon could not be read ({error}); give a CSV with header x,y") from error
    rows = [line.split(",") for line in lines if line.strip()]
    if rows and [cell.strip().lower() for cell in rows[0]] == ["x", "y"]:
        rows = rows[1:]
    try:
        return Polygon(np.array([[float(cell) for cell in row] for row in rows], dtype=np.float64))
    except ValueError as error:
        raise FileError(
            f"{path}: {len(rows)} lines are no polygon ({error}); give a CSV x,y in mm with three corners or more"
        ) from error
