"""A scan written while it runs, so that memory stays flat and an interrupted scan can be resumed.

``cloud.ply.part`` is a line of JSON that says what is scanned, followed by chunks: a line of JSON with the counts of a
run of frames, and its points as the vertex records of `scope.cloud.files`. A chunk that is cut short is not read. The last
frames before an interruption were judged without those that follow them: they count for the cloud of what was found, and
are ranged again when the scan goes on.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from calibration.atomic import require_folder, written_whole
from calibration.errors import FileError, ScopeError
from calibration.rig import Rig, sha256_of
from scope.cloud import (
    SENSOR,
    VERTEX,
    ScanCloud,
    comments,
    ply,
    require_format,
    sensor_records,
    systematic_records,
    vertex_records,
)
from scope.scanning.assembly import (
    assembled,
    described,
    joined,
    require_points,
    scan_of,
    sensors_of,
    systematic_errors,
)
from scope.scanning.covariance import boxes_of
from scope.scanning.options import ScanOptions
from scope.scanning.overlap import with_turn_trouble
from scope.scanning.run import interrupted, open_scan, runs
from scope.scanning.setup import ScanSetup
from scope.scanning.statistics import Chunk, Footprint, Scan, ScanStatistics

_LONGEST = 1 << 16  # bytes of a line of JSON
_FRAMES = 1024  # whose sensors are held at once


def scan_to_file(
    capture: Path,
    rig: Rig | Path,
    out: Path,
    options: ScanOptions,
    *,
    resume: bool = False,
    origin: tuple[str, ...] = (),
    on_frame: Callable[[int, int], None] = lambda _done, _total: None,
) -> Scan:
    """Scan, keep each chunk in ``out`` + ``.part`` while it runs, and write the cloud in the end.

    The part is removed when the scan is complete; an interrupted or failed scan leaves it, to be resumed. A PLY of one
    laser without normals and filters is written from the part, so that the points are never all in memory; anything else
    needs the whole cloud at once. ``origin`` are lines that the file says of itself, as `scope.origin` gives them.
    """
    require_folder(out)
    require_format(out)
    started = time.perf_counter()
    rig = rig if isinstance(rig, Rig) else Rig.load(rig)
    identity = {"capture": sha256_of(capture) if capture.is_file() else "", "rig": rig.sha256, "options": repr(options)}
    part = out.with_name(out.name + ".part")
    statistics = ScanStatistics()
    end = 0  # of what is already in the part, bytes
    if resume:
        end = _resumed(part, identity, statistics)
    setup, source = open_scan(capture, rig, options)
    setup = replace(setup, origin=origin)
    stream: BinaryIO | None = None
    try:
        for chunk in runs(setup, source, first=statistics.frames, on_frame=on_frame):
            if stream is None:
                stream = _continued(part, end) if end else _begun(part, identity)
            _write_chunk(stream, chunk)
            statistics.add(chunk)
        why = source.trouble
    except KeyboardInterrupt:
        why = interrupted(source, statistics)
    except ScopeError as error:
        if statistics.points and stream is not None and not stream.closed:
            raise type(error)(
                f"{error}; {statistics.frames} frames are kept in {part.name}: then go on with --resume"
            ) from error
        raise
    finally:
        if stream is not None:
            with suppress(OSError):  # what could not be written has been told
                stream.close()
            if statistics.points == 0:  # nothing that were worth resuming
                part.unlink(missing_ok=True)
    require_points(setup, statistics, why)
    if out.suffix.lower() == ".ply" and len(setup.lasers) == 1 and not options.normals and not options.filters.any:
        _write_streamed(out, part, setup, statistics, why)
        found = scan_of(
            setup, lambda: ScanCloud.load(out), statistics.points, statistics, why, time.perf_counter() - started
        )
    else:
        cloud = joined([_chunk(head, rows).cloud for head, rows in _records(part)])
        found = assembled(setup, cloud, statistics, why, time.perf_counter() - started)
        found.cloud.save(out)
    if not why:
        part.unlink(missing_ok=True)
    return with_turn_trouble(found, setup.motion)


def _begun(part: Path, identity: dict[str, str]) -> BinaryIO:
    try:
        stream = part.open("wb")
    except OSError as error:
        raise FileError(f"{part}: cannot be written ({error.strerror}); choose another place for the cloud") from error
    stream.write(json.dumps(identity).encode() + b"\n")
    return stream


def _continued(part: Path, end: int) -> BinaryIO:
    """Part, opened behind its last whole chunk."""
    try:
        stream = part.open("r+b")
        stream.truncate(end)
    except OSError as error:
        raise FileError(f"{part}: cannot be written ({error.strerror}); scan without --resume") from error
    stream.seek(end)
    return stream


def _write_chunk(stream: BinaryIO, chunk: Chunk) -> None:
    head = {
        "first": chunk.first,
        "frames": chunk.frames,
        "points": len(chunk.cloud),
        "empty": chunk.empty,
        "rejected": chunk.rejected,
        "stripes": {str(laser): list(stripe) for laser, stripe in chunk.stripes.items()},
        "settled": chunk.settled,
    }
    try:
        stream.write(json.dumps(head).encode() + b"\n" + vertex_records(chunk.cloud).tobytes())
        stream.flush()
    except OSError as error:
        raise FileError(
            f"{stream.name}: could not be written ({error.strerror}); free space or choose another place for the cloud"
        ) from error


def _write_streamed(out: Path, part: Path, setup: ScanSetup, statistics: ScanStatistics, why: str) -> None:
    """PLY from the chunks of a part, each held alone."""
    with written_whole(out) as stream:
        seen, corners = [], []
        for _, rows in _records(part):
            seen.append(np.unique(rows["frame"]))
            pixels = np.stack([rows["u"], rows["v"]], axis=1)
            corners += [pixels.min(axis=0), pixels.max(axis=0)] if len(pixels) else []
        frames, ends = np.unique(np.concatenate(seen)), np.array(corners)
        systematic = systematic_errors(setup, boxes_of(np.zeros(len(ends), dtype=np.uint8), ends))
        nothing = described(setup, ScanCloud.from_points(np.zeros((0, 3))), why, statistics)
        counts = {"vertex": (VERTEX, statistics.points), "sensor": (SENSOR, len(frames) * len(setup.lasers))}
        nodes = None if systematic is None else systematic_records(systematic)
        if nodes is not None:
            counts["systematic"] = (nodes.dtype, len(nodes))
        stream.write(ply.header(counts, comments(nothing)))
        for _, rows in _records(part):
            stream.write(rows.tobytes())
        for start in range(0, len(frames), _FRAMES):
            sensors = sensors_of(setup, frames[start : start + _FRAMES].tolist())
            stream.write(sensor_records(sensors).tobytes())
        if nodes is not None:
            stream.write(nodes.tobytes())


def _resumed(part: Path, identity: dict[str, str], statistics: ScanStatistics) -> int:
    """Count the chunks of a part; returns where the last whole one ends, bytes."""
    try:
        with part.open("rb") as stream:
            told = _json_line(stream)
    except FileNotFoundError:
        return 0  # nothing to resume: the scan begins
    except OSError as error:
        raise FileError(f"{part}: cannot be read ({error.strerror}); scan without --resume") from error
    if told != identity:
        raise FileError(f"{part}: is of another capture, rig or options; scan without --resume, or restore them")
    end = len(json.dumps(identity)) + 1
    for head, rows in _records(part):
        if not head.settled:
            break
        statistics.add(_chunk(head, rows))
        end = head.end
    return end


@dataclass(frozen=True, slots=True)
class _Head:
    """Line of JSON before the points of a chunk."""

    first: int
    frames: int
    points: int
    empty: int
    rejected: Counter[str]
    settled: bool
    end: int = 0  # of the chunk, bytes from the start of the file
    stripes: Mapping[int, Footprint] = field(default_factory=dict)

    @classmethod
    def read(cls, stream: BinaryIO) -> _Head | None:
        """Head at the stream's place; None at its end and where it is damaged."""
        told = _json_line(stream)
        try:
            if told is None:
                return None
            numbers = [int(told[key]) for key in ("first", "frames", "points", "empty")]
            rejected = Counter({str(key): int(value) for key, value in told["rejected"].items()})
            stripes = {
                int(laser): Footprint(float(width), float(corrected), int(count))
                for laser, (width, corrected, count) in told["stripes"].items()
            }
        except (KeyError, TypeError, ValueError, AttributeError):
            return None
        if min(numbers) < 0 or numbers[2] > 1 << 28:
            return None
        first, frames, points, empty = numbers
        settled = told.get("settled") is True
        end = stream.tell() + points * VERTEX.itemsize
        return cls(first, frames, points, empty, rejected, settled, end, stripes)


def _records(part: Path) -> Iterator[tuple[_Head, ply.Records]]:
    """Whole chunks of a part, one after the other, up to the first that is cut short or does not follow."""
    with part.open("rb") as stream:
        _json_line(stream)
        frames = 0
        while (head := _Head.read(stream)) is not None and head.first == frames:
            data = stream.read(head.points * VERTEX.itemsize)
            if len(data) < head.points * VERTEX.itemsize:
                return
            frames += head.frames
            yield head, np.frombuffer(data, dtype=VERTEX)


def _chunk(head: _Head, rows: ply.Records) -> Chunk:
    """Chunk as it was ranged, rounded to single precision."""
    cloud = ScanCloud(
        points=np.stack([rows["x"], rows["y"], rows["z"]], axis=1).astype(np.float64),
        intensity=rows["intensity"].copy(),
        sigma=rows["sigma"].copy(),
        sigma_cal=rows["sigma_cal"].copy(),
        pixels=np.stack([rows["u"], rows["v"]], axis=1),
        frame=rows["frame"].copy(),
        laser=rows["laser"].copy(),
    )
    return Chunk(head.first, head.frames, cloud, head.rejected, head.empty, head.stripes, head.settled)


def _json_line(stream: BinaryIO) -> dict[str, Any] | None:
    line = stream.readline(_LONGEST)
    try:
        content = json.loads(line) if line.endswith(b"\n") else None
    except ValueError:
        return None
    return content if isinstance(content, dict) else None
