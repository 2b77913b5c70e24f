"""Positions of images that are all there: by a row a frame, or by time stamps in a log of the stage."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array
from scope.session.following import interpolated
from scope.session.toml_file import numbers, read_csv


def logged_positions(
    log: Path, times: Path, images: tuple[Path, ...], names: tuple[int, ...] | None, *, delay: float, gap: float
) -> Array:
    """Positions of images by when they were taken, interpolated in a log, in the units of the log."""
    columns = csv_by_frame(times, ("seconds",))
    at = numbers(times, "seconds", columns["seconds"])[rows_of_frames(times, columns, images, names)] + delay
    told = read_csv(log, ("seconds", "position"))
    seconds, positions = (numbers(log, name, told[name]) for name in ("seconds", "position"))
    return _spread(interpolated(log, seconds, positions, at, gap), names)


def rows_of_frames(
    path: Path, columns: dict[str, list[str]], images: tuple[Path, ...], names: tuple[int, ...] | None = None
) -> list[int]:
    """Row of the CSV for each frame, which ``names`` number where they do not count from 0; every frame must have one row."""
    count = len(next(iter(columns.values())))
    if "image" in columns:
        rows = {name: k for k, name in enumerate(columns["image"])}
        if len(rows) < count:
            raise FileError(f"{path}: an image is named twice; keep one row for each")
        missing = [image.name for image in images if image.name not in rows]
        if missing:
            raise FileError(
                f"{path}: no row for {missing[0]} ({len(missing)} of {len(images)} frames missing); add them"
            )
        return [rows[image.name] for image in images]
    frames = numbers(path, "frame", columns["frame"])
    if not np.array_equal(frames, np.rint(frames)) or frames.min(initial=0) < 0:
        raise FileError(f"{path}: column frame must hold whole numbers from 0")
    rows_of = {int(frame): k for k, frame in enumerate(frames)}
    if len(rows_of) < count:
        raise FileError(f"{path}: a frame is listed twice; keep one row for each")
    wanted = names or range(len(images) or count)
    absent = [k for k in wanted if k not in rows_of]
    if absent:
        raise FileError(
            f"{path}: {count} rows for {len(wanted)} frames; frame {absent[0]} has none: every frame needs its row (frames count "
            "from 0 in the order of the sorted file names)"
        )
    return [rows_of[k] for k in wanted]


def csv_by_frame(path: Path, wanted: tuple[str, ...]) -> dict[str, list[str]]:
    """Columns of a CSV whose rows are of frames, by number or by image."""
    columns = read_csv(path, wanted, optional=("frame", "image"))
    if "frame" not in columns and "image" not in columns:
        raise FileError(f"{path}: the header names neither frame nor image; one of them must say which row is whose")
    return columns


def listed_positions(path: Path, images: tuple[Path, ...], names: tuple[int, ...] | None) -> Array:
    """Positions by the row of each frame, in the units of the file."""
    columns = csv_by_frame(path, ("position",))
    return _spread(numbers(path, "position", columns["position"])[rows_of_frames(path, columns, images, names)], names)


def _spread(positions: Array, names: tuple[int, ...] | None) -> Array:
    """Positions at the places that names give them; NaN at those of no frame."""
    if names is None:
        return positions
    spread = np.full(max(names) + 1, np.nan)
    spread[list(names)] = positions
    return spread
