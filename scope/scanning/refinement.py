"""Third stage: points judged and corrected by those of the frames before and after, a run of frames at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, repeat
from typing import TypeVar

import numpy as np

from calibration.reason import Reason
from ranging.motion import Fixed
from ranging.surface import CONTEXT, REACH, Lattice, refine
from scope.cloud import ScanCloud
from scope.scanning.assembly import joined
from scope.scanning.points import FramePoints
from scope.scanning.setup import ScanSetup
from scope.scanning.statistics import Chunk, Footprint

FIRST = 2  # frames of the first run, so that points are seen at once
T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A run of frames with those before and after that have a say in it."""

    frames: tuple[FramePoints, ...]
    at: int  # position of the first of them in the capture
    begin: int  # position of the run's first frame in the capture
    end: int  # position behind its last
    settled: bool  # False: frames that follow would have a say in it, and did not come


def batches(items: Iterable[T], first: int, length: int) -> Iterator[list[T]]:
    """Group items so that each group completes the context of one more run of frames.

    An interrupt (KeyboardInterrupt) hands over what has come, and goes on.
    """
    start = max(0, first - CONTEXT)
    sizes = chain([_run(first, length) + first - start + CONTEXT], repeat(length))
    held: list[T] = []
    wanted = next(sizes)
    try:
        for item in items:
            held.append(item)
            if len(held) == wanted:
                yield held
                held, wanted = [], next(sizes)
    except KeyboardInterrupt:
        if held:
            yield held
        raise
    if held:
        yield held


def windows(groups: Iterable[list[FramePoints]], first: int, length: int) -> Iterator[Window]:
    """Runs of frames from position ``first`` on, each with its context; see `batches` for the groups.

    What is left at the end, or at an interrupt, is not settled.
    """
    at, begin = max(0, first - CONTEXT), first
    held: list[FramePoints] = []
    stopped = False
    try:
        for group in groups:
            held += group
            end = begin + _run(begin, length)
            if at + len(held) < end + CONTEXT:
                continue  # the last group
            yield Window(tuple(held), at, begin, end, settled=True)
            old = max(0, end - CONTEXT - at)
            held, at, begin = held[old:], at + old, end
            for frame in held[: max(0, begin - REACH - at)]:
                frame.timeframes.clear()  # no longer looked at: their images may go
    except KeyboardInterrupt:
        stopped = True
    while begin < at + len(held):
        end = min(begin + _run(begin, length), at + len(held))
        yield Window(tuple(held), at, begin, end, settled=False)
        begin = end
    if stopped:
        raise KeyboardInterrupt


def _run(begin: int, length: int) -> int:
    """Frames of the run that begins at a position."""
    return length if begin else FIRST


def refine_window(setup: ScanSetup, window: Window) -> Chunk:
    """Correct and judge the points of a window's run of frames, and gather those that stand."""
    parts: list[ScanCloud] = []
    rejected: Counter[str] = Counter()
    stripes: dict[int, Footprint] = {}
    for k in range(len(setup.lasers)):
        refined = _of_laser(setup, window, k)
        if refined is None:
            continue
        part, counts, stripe = refined
        parts.append(part)
        rejected += counts
        if stripe is not None:
            stripes[k] = stripe
    numbers = {frame.number for frame in window.frames[window.begin - window.at : window.end - window.at]}
    with_points = {int(number) for part in parts for number in np.unique(part.frame)}
    empty = len(numbers - with_points)
    return Chunk(window.begin, window.end - window.begin, joined(parts), rejected, empty, stripes, window.settled)


def _of_laser(setup: ScanSetup, window: Window, k: int) -> tuple[ScanCloud, Counter[str], Footprint | None] | None:
    """Points of one laser, counts of the reasons of all other lines, and the stripe on the surface; None: it did not shine."""
    shown = [(window.at + i, frame) for i, frame in enumerate(window.frames) if k in frame.profiles]
    first, last = (sum(1 for position, _ in shown if position < edge) for edge in (window.begin, window.end))
    if first == last:
        return None
    frames = [frame for _, frame in shown]
    lattice = Lattice.of([frame.profiles[k] for frame in frames])
    timeframes = [] if isinstance(setup.motion, Fixed) else [frame.timeframes.get(k) for frame in frames]
    found = refine(lattice, first, last, timeframes, blur_px=setup.rig.blur_px)
    reason = found.reason
    if setup.options.max_sigma is not None:
        reason[(reason == Reason.RANGED) & ~(found.sigma <= setup.options.max_sigma)] = Reason.UNCERTAIN
    keep = reason == Reason.RANGED
    lines = np.broadcast_to(np.arange(reason.shape[1], dtype=np.float64), reason.shape)
    pair = (lines, found.position) if setup.lasers[k].along == "rows" else (found.position, lines)
    numbers = np.array([frame.number for frame in frames[first:last]], dtype=np.int32)
    codes, counts = np.unique(reason[~keep], return_counts=True)
    cloud = ScanCloud(
        points=found.points[keep],
        intensity=lattice.peak[first:last][keep].astype(np.float32),
        sigma=found.sigma[keep].astype(np.float32),
        sigma_cal=lattice.sigma_cal[first:last][keep].astype(np.float32),
        pixels=np.stack(pair, axis=2)[keep].astype(np.float32),
        frame=np.broadcast_to(numbers[:, None], reason.shape)[keep],
        laser=np.full(int(keep.sum()), k, dtype=np.uint8),
    )
    told = Counter({Reason(int(code)).key: int(n) for code, n in zip(codes, counts, strict=True)})
    known = np.isfinite(found.footprint)
    return cloud, told, Footprint(found.footprint, found.corrected, len(cloud)) if known else None
