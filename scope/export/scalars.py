"""Points with figures of their own (deviations, heights), so that they look right wherever they are opened.

Each scalar stands under its own name and behind ``scalar_`` (CloudCompare), the first one also as ``quality`` (MeshLab) and as a colour
from blue over white to red (or, where it has no sign, from dark to light), which every viewer shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.atomic import written_whole
from calibration.geometry import Array
from scope.cloud import pcd, ply
from scope.export import vtp

ENDINGS = (".ply", ".pcd", ".xyz", ".vtp")
_UNKNOWN = (96, 96, 96)
_SIDES = np.array([[33, 102, 172], [247, 247, 247], [178, 24, 43]], dtype=np.float64)  # below, at and above zero
_RAMP = np.array([[40, 20, 80], [33, 130, 140], [240, 230, 80]], dtype=np.float64)


def require_scalars(path: Path | None) -> None:
    """Refuse with ``ValueError`` an ending that cannot hold scalars as programs read them."""
    if path is not None and path.suffix.lower() not in ENDINGS:
        raise ValueError(f"{path.name}: points with figures of their own are written as {', '.join(ENDINGS)}")


def write_scalars(
    path: Path, points: Array, scalars: Mapping[str, ArrayLike], told: tuple[str, ...] = (), *, signed: bool = True
) -> None:
    """Write points with scalars, whole or not at all.

    Parameters
    ----------
    path : Path
        ``.ply``, ``.pcd``, ``.xyz`` (under a title that CloudCompare reads) or ``.vtp``.
    points : (N, 3) array
        mm.
    scalars : mapping of str to (N,) array
        The first is the one that is shown; NaN where it is not known.
    told : sequence of str
        Comments, single lines.
    signed : bool
        Zero is what is wanted: blue below it, red above it.

    Raises
    ------
    ValueError
        Another ending, or columns of another length than the points.
    FileError
        The file cannot be written.
    """
    require_scalars(path)
    held = {name: np.asarray(values, dtype=np.float32) for name, values in scalars.items()}
    if not held or any(values.shape != (len(points),) for values in held.values()):
        raise ValueError(f"scalars must be (N,), one for each of {len(points)} points, and at least one")
    shown = next(iter(held))
    lines = ("units mm", *told)
    match path.suffix.lower():
        case ".ply":
            every = held | {"quality": held[shown]} | {f"scalar_{name}": values for name, values in held.items()}
            rows = _rows(points, every, colours(held[shown], signed=signed))
            with written_whole(path) as stream:
                ply.write(stream, ply.Ply({"vertex": rows}, lines))
        case ".pcd":
            with written_whole(path) as stream:
                pcd.write(stream, _rows(points, held), lines)
        case ".xyz":
            with written_whole(path) as stream:
                table = np.column_stack([points, *held.values()])
                np.savetxt(
                    stream,
                    table,
                    fmt=["%.5f"] * 3 + ["%.7g"] * len(held),
                    header=f"//X Y Z {' '.join(held)}",
                    comments="",
                )
        case _:
            with written_whole(path) as stream:
                vtp.write_points(stream, points, held, shown, lines)


def colours(values: ArrayLike, *, signed: bool = True) -> NDArray[np.uint8]:
    """Colours (N, 3) RGB of values (N,); the 2 % that lie furthest off are as those before them, NaN is grey."""
    found = np.asarray(values, dtype=np.float64)
    known = np.isfinite(found)
    picture = np.full((len(found), 3), _UNKNOWN, dtype=np.uint8)
    if not known.any():
        return picture
    low, high = np.percentile(found[known], (2, 98))
    if signed:
        high = max(abs(low), abs(high))
        low = -high
    share = np.clip((found[known] - low) / max(float(high - low), 1e-30), 0.0, 1.0)
    stops = _SIDES if signed else _RAMP
    mixed = [np.interp(share, [0.0, 0.5, 1.0], stops[:, k]) for k in range(3)]
    picture[known] = np.rint(np.stack(mixed, axis=1))
    return picture


def _rows(
    points: Array, scalars: Mapping[str, NDArray[np.float32]], rgb: NDArray[np.uint8] | None = None
) -> ply.Records:
    names = ("red", "green", "blue") if rgb is not None else ()
    rows = np.zeros(
        len(points), dtype=[(name, "<f4") for name in ("x", "y", "z", *scalars)] + [(name, "u1") for name in names]
    )
    rows["x"], rows["y"], rows["z"] = points.T
    for name, values in scalars.items():
        rows[name] = values
    for k, name in enumerate(names):
        rows[name] = rgb[:, k] if rgb is not None else 0
    return rows
