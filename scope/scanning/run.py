"""frames -> stripes -> points -> refined points -> cloud: the one place that joins the stages of a scan."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TypeVar

from calibration.rig import Rig
from ranging.errors import RangingError
from ranging.surface import CONTEXT
from scope.cameras import open_source
from scope.cloud import ScanCloud
from scope.scanning.assembly import assembled, joined
from scope.scanning.options import ScanOptions
from scope.scanning.overlap import with_turn_trouble
from scope.scanning.points import triangulate_frames
from scope.scanning.preparation import LOOK, asked_by_capture, set_up
from scope.scanning.refinement import batches, refine_window, windows
from scope.scanning.setup import ScanSetup
from scope.scanning.statistics import Chunk, Scan, ScanStatistics
from scope.scanning.stripes import find_stripes
from scope.session import AHEAD, Capture, Source, frames_in_memory, in_order, read_capture

CHUNK = 24  # frames ranged at once; fewer where they are large
Tick = Callable[[int, int], None]
T = TypeVar("T")


def _no_tick(_done: int, _total: int) -> None:
    return None


def _no_chunk(_chunk: Chunk) -> None:
    return None


def scan(capture: str | Path, rig: Rig | str | Path, *, options: ScanOptions | None = None) -> ScanCloud:
    """Range every frame of a capture; see `run_scan` for the cloud with its bookkeeping.

    Raises
    ------
    FileError, RangingError
        As `run_scan`, and for a scan that contradicts its motion.
    """
    return trusted(run_scan(capture, rig, options=options))


def trusted(found: Scan) -> ScanCloud:
    """Cloud of a scan; ``RangingError`` where the scan contradicts its motion."""
    if found.troubles:
        raise RangingError(f"the scan contradicts its motion: {found.troubles[0]}")
    return found.cloud


def run_scan(
    capture: str | Path,
    rig: Rig | str | Path,
    *,
    options: ScanOptions | None = None,
    on_frame: Tick = _no_tick,
) -> Scan:
    """Range every frame of a capture.

    Parameters
    ----------
    capture, rig : path, and Rig or path
        The capture file and the calibrated rig.
    options : ScanOptions
        Defaults range within the calibrated volume and reject nothing by sigma.
    on_frame : callable
        Called with (done, total) after each frame; total is 0 where nobody knows it.

    Returns
    -------
    Scan
        Incomplete where the source broke off or the user interrupted; what was found until then is kept.

    Raises
    ------
    FileError, RangingError
        Files that do not fit the rig, or no stripe in any frame.
    """
    setup, source = open_scan(capture, rig if isinstance(rig, Rig) else Rig.load(rig), options)
    return gathered(setup, source, on_frame=on_frame)


def open_scan(
    capture: str | Path | Capture, rig: Rig, options: ScanOptions | None = None, *, source: Source | None = None
) -> tuple[ScanSetup, Source]:
    """Setup and frames of a capture file, read already or not, or of the ``source`` that is given; ``FileError`` where file and rig do not fit, ``RangingError`` for a silent camera."""
    file = capture if isinstance(capture, Capture) else read_capture(Path(capture))
    asked = asked_by_capture(file, rig)
    source = source or open_source(file)
    return set_up(asked, rig, options or ScanOptions(), source.first(LOOK)), source


def gathered(
    setup: ScanSetup, source: Source, *, on_frame: Tick = _no_tick, on_chunk: Callable[[Chunk], None] = _no_chunk
) -> Scan:
    """All runs of a source in one cloud, held in memory; ``on_chunk`` is called with each as soon as it is ranged."""
    started = time.perf_counter()
    statistics, parts = ScanStatistics(), []
    try:
        for chunk in runs(setup, source, on_frame=on_frame):
            statistics.add(chunk)
            parts.append(chunk.cloud)
            on_chunk(chunk)
        why = source.trouble
    except KeyboardInterrupt:
        why = interrupted(source, statistics)
    found = assembled(setup, joined(parts), statistics, why, time.perf_counter() - started)
    return with_turn_trouble(found, setup.motion)


def runs(setup: ScanSetup, source: Source, *, first: int = 0, on_frame: Tick = _no_tick) -> Iterator[Chunk]:
    """Refined points, a run of frames at a time and in order: what a scan, a resumed one, a streamed file and a camera share.

    Parameters
    ----------
    setup, source : ScanSetup, Source
    first : int
        Position of the frame to begin with; ``CONTEXT`` frames before it are looked at too.
    on_frame : callable
        Called with (frames done, frames in all or 0).

    Raises
    ------
    KeyboardInterrupt
        After the runs that the user's interrupt leaves unsettled.
    """
    length, ahead = frames_in_memory(setup.like, CHUNK), frames_in_memory(setup.like, AHEAD)
    start = max(0, first - CONTEXT)
    stripes = in_order(source, partial(find_stripes, setup), first=start, ahead=ahead)
    told = _told(stripes, on_frame, start, first, source.count or 0)
    points = (triangulate_frames(setup, group) for group in batches(told, first, length))
    for window in windows(points, first, length):
        yield refine_window(setup, window)


def interrupted(source: Source, statistics: ScanStatistics) -> str:
    """Why a scan that the user ended is incomplete; empty for a camera that was to run until then."""
    return "" if source.endless else f"interrupted after {statistics.frames} frames"


def _told(items: Iterable[T], on_frame: Tick, start: int, first: int, total: int) -> Iterator[T]:
    """The same items, each told to ``on_frame`` once it was taken, so that an interrupt while telling loses none."""
    for done, item in enumerate(items, start + 1):
        yield item
        if done > first:
            on_frame(done, total)
