"""What a scan gave: its runs of frames, their running counts, and the scan as a whole."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scope.cloud import ScanCloud
from scope.scanning.agreement import Agreement
from scope.scanning.table import Table

_LEAST, _MOST, _STEP = np.log(1e-7), np.log(1e4), 5e-4  # mm; a bin of the histogram is 0.05 % wide


class Footprint(NamedTuple):
    """The stripe of one laser on the surface, over a number of points."""

    width: float  # mm, one sigma
    corrected: float  # share (0 to 1) of what it does to a curved surface that ranging took off
    points: int

    def __or__(self, other: Footprint) -> Footprint:
        """Both together, weighted by their points."""
        total = self.points + other.points
        part = other.points / total if total else 0.0
        width = self.width + part * (other.width - self.width)
        return Footprint(width, self.corrected + part * (other.corrected - self.corrected), total)


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """What a run of frames gave."""

    first: int  # position of the first frame in the capture
    frames: int
    cloud: ScanCloud  # without sensors
    rejected: Counter[str]
    empty: int  # frames without a single point
    stripes: Mapping[int, Footprint] = field(default_factory=dict)  # by laser
    settled: bool = True  # False: frames that follow would have a say in it, and did not come


@dataclass(slots=True, eq=False)
class Median:
    """Running median of positive values to within 0.05 %, in memory that does not grow."""

    _bins: NDArray[np.int64] = field(default_factory=lambda: np.zeros(int((_MOST - _LEAST) / _STEP) + 1, np.int64))

    def add(self, values: NDArray[np.float32]) -> None:
        """Count values (N,); those that are not finite do not count."""
        known = values[np.isfinite(values)].astype(np.float64)
        place = (np.log(np.maximum(known, 1e-7)) - _LEAST) / _STEP
        self._bins += np.bincount(np.clip(place, 0, len(self._bins) - 1).astype(np.int64), minlength=len(self._bins))

    @property
    def value(self) -> float:
        """Median of what was counted; NaN for nothing."""
        total = np.cumsum(self._bins)
        if total[-1] == 0:
            return float("nan")
        return float(np.exp(_LEAST + (np.searchsorted(total, (total[-1] + 1) // 2) + 0.5) * _STEP))


@dataclass(slots=True, eq=False)
class ScanStatistics:
    """Counts of the chunks so far."""

    frames: int = 0
    empty: int = 0
    points: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    sigma: Median = field(default_factory=Median)
    sigma_cal: Median = field(default_factory=Median)
    stripes: dict[int, Footprint] = field(default_factory=dict)  # by laser

    def add(self, chunk: Chunk) -> None:
        """Count one more chunk."""
        self.frames += chunk.frames
        self.empty += chunk.empty
        self.points += len(chunk.cloud)
        self.rejected += chunk.rejected
        self.sigma.add(chunk.cloud.sigma)
        self.sigma_cal.add(chunk.cloud.sigma_cal)
        for laser, stripe in chunk.stripes.items():
            self.stripes[laser] = self.stripes[laser] | stripe if laser in self.stripes else stripe


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A cloud and how it came about."""

    load: Callable[[], ScanCloud]  # the cloud: held in memory, or read from its file
    points: int
    frames: int
    empty_frames: int
    rejected: Mapping[str, int]  # reason: image lines without a point
    seconds: float
    why_incomplete: str  # empty where complete
    sigma_mm: float  # median sigma of the points, mm; NaN for an empty cloud
    sigma_cal_mm: float  # the same of sigma_cal
    verified: bool
    filtered: Mapping[str, int] = field(default_factory=dict)  # filter: points it removed
    agreement: tuple[Agreement, ...] = ()  # of every two lasers
    table: Table | None = None  # how the markers of a table move, where the motion is theirs
    troubles: tuple[str, ...] = ()  # in what the scan contradicts itself, a sentence each: it must not be used

    @property
    def cloud(self) -> ScanCloud:
        """The points; a cloud that was streamed to a file is read from it each time."""
        return self.load()
