"""A scan written while it runs, so that an interrupted one can be resumed.

``cloud.ply.part`` is a line of JSON that says what is scanned, followed by chunks: a line of JSON with the counts of a
run of frames, and its points as the vertex records of `scope.files`. A chunk that is cut short is not read.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from calibration.atomic import require_folder
from calibration.errors import FileError, ScopeError
from calibration.rig import Rig, sha256_of
from scope.cloud import ScanCloud
from scope.files import VERTEX, require_format, vertex_records
from scope.scanning import Chunk, Scan, ScanOptions, run_scan

_LONGEST = 1 << 16  # bytes of a line of JSON


def scan_to_file(
    capture: Path,
    rig_path: Path,
    out: Path,
    options: ScanOptions,
    *,
    resume: bool = False,
    on_frame: Callable[[int, int], None] = lambda _done, _total: None,
) -> Scan:
    """Scan, keep each chunk in ``out`` + ``.part`` while it runs, and write the cloud in the end.

    The part is removed when the scan is complete; an interrupted or failed scan leaves it, to be resumed.
    """
    require_folder(out)
    require_format(out)
    rig = Rig.load(rig_path)
    identity = {"capture": sha256_of(capture) if capture.is_file() else "", "rig": rig.sha256, "options": repr(options)}
    part = out.with_name(out.name + ".part")
    done = _read_part(part, identity) if resume else []
    found_points = sum(len(chunk.cloud) for chunk in done)
    stream: BinaryIO | None = None

    def keep(chunk: Chunk) -> None:
        nonlocal stream, found_points
        found_points += len(chunk.cloud)
        try:
            if stream is None:
                stream = _open_part(part, identity, done)
            _write_chunk(stream, chunk)
        except OSError as error:
            raise FileError(
                f"{part}: could not be written ({error.strerror}); free space or choose another place for the cloud"
            ) from error

    try:
        found = run_scan(capture, rig, options=options, on_frame=on_frame, done=done, on_chunk=keep)
    except ScopeError:
        if stream is not None and found_points == 0:  # nothing that were worth resuming
            part.unlink(missing_ok=True)
        raise
    finally:
        if stream is not None:
            with suppress(OSError):  # what could not be written has been told
                stream.close()
    found.cloud.save(out)
    if not found.why_incomplete:
        part.unlink(missing_ok=True)
    return found


def _open_part(part: Path, identity: dict[str, str], done: list[Chunk]) -> BinaryIO:
    stream = part.open("wb")
    stream.write(json.dumps(identity).encode() + b"\n")
    for chunk in done:
        _write_chunk(stream, chunk)
    return stream


def _write_chunk(stream: BinaryIO, chunk: Chunk) -> None:
    head = {
        "first": chunk.first,
        "frames": chunk.frames,
        "points": len(chunk.cloud),
        "empty": chunk.empty,
        "rejected": chunk.rejected,
    }
    stream.write(json.dumps(head).encode() + b"\n" + vertex_records(chunk.cloud).tobytes())
    stream.flush()


def _read_part(part: Path, identity: dict[str, str]) -> list[Chunk]:
    try:
        stream = part.open("rb")
    except OSError as error:
        raise FileError(f"{part}: nothing to resume ({error.strerror}); scan without --resume") from error
    with stream:
        told = _json_line(stream)
        if told != identity:
            raise FileError(f"{part}: is of another capture, rig or options; scan without --resume, or restore them")
        chunks: list[Chunk] = []
        while (head := _json_line(stream)) is not None:
            chunk = _chunk(head, stream)
            if chunk is None or chunk.first != sum(c.frames for c in chunks):
                break
            chunks.append(chunk)
    return chunks


def _json_line(stream: BinaryIO) -> dict[str, Any] | None:
    line = stream.readline(_LONGEST)
    try:
        content = json.loads(line) if line.endswith(b"\n") else None
    except ValueError:
        return None
    return content if isinstance(content, dict) else None


def _chunk(head: dict[str, Any], stream: BinaryIO) -> Chunk | None:
    """Chunk whose head was read; None where it is cut short or damaged."""
    try:
        first, frames, points, empty = (int(head[key]) for key in ("first", "frames", "points", "empty"))
        rejected = Counter({str(key): int(value) for key, value in head["rejected"].items()})
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    if min(first, frames, points, empty) < 0 or points > 1 << 28:
        return None
    data = stream.read(points * VERTEX.itemsize)
    if len(data) < points * VERTEX.itemsize:
        return None
    rows = np.frombuffer(data, dtype=VERTEX)
    cloud = ScanCloud(
        points=np.stack([rows["x"], rows["y"], rows["z"]], axis=1).astype(np.float64),
        intensity=rows["intensity"].copy(),
        sigma=rows["sigma"].copy(),
        sigma_cal=rows["sigma_cal"].copy(),
        pixels=np.stack([rows["u"], rows["v"]], axis=1),
        frame=rows["frame"].copy(),
        laser=rows["laser"].copy(),
    )
    return Chunk(first, frames, cloud, rejected, empty)
