"""A scan at the console: frames kept as they come, ranged meanwhile, and a cloud in the end as `scope scan` gives it."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calibration.atomic import write_text
from calibration.errors import FileError
from calibration.geometry import Array
from calibration.rig import Rig
from scope.cameras import CameraSource
from scope.console.folder import SessionFolder, save_image, stamp, write_toml
from scope.console.jobs import Job
from scope.console.station import Station
from scope.scanning import Chunk, gathered, open_scan
from scope.session import ON_FILES, Frame, Source, read_capture

MOTIONS = ("linear", "turntable", "fixed")
_SHOWN = 60_000  # points of the growing cloud that are drawn


@dataclass(slots=True, eq=False)
class Growth:
    """A scan while it runs."""

    name: str = ""
    frames: int = 0
    points: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    version: int = 0
    _parts: list[Array] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def begin(self, name: str) -> None:
        """Empty it for a new scan."""
        with self._lock:
            self.name, self.frames, self.points, self.rejected, self._parts = name, 0, 0, Counter(), []
            self.version += 1

    def add(self, chunk: Chunk) -> None:
        """One more run of frames."""
        with self._lock:
            self.points += len(chunk.cloud)
            self.rejected += chunk.rejected
            self._parts.append(chunk.cloud.points[:: max(1, len(chunk.cloud) // 2000)])
            self.version += 1

    def shown(self) -> Array:
        """Points (N, 3) to draw."""
        with self._lock:
            points = np.concatenate([np.zeros((0, 3)), *self._parts])
        return points[:: max(1, len(points) // _SHOWN)]


@dataclass(slots=True, eq=False)
class Recording:
    """Source that keeps each frame in the scan's folder before it is ranged, and ends when it is told to stop."""

    inner: Source
    save: Callable[[Frame], None]
    stop: threading.Event
    _kept: int = 0
    _stopped: bool = False

    @property
    def count(self) -> int | None:
        """Frames to come in all."""
        return self.inner.count

    @property
    def trouble(self) -> str:
        """What broke off; empty for a scan that was stopped: what came is whole."""
        return "" if self._stopped else self.inner.trouble

    @property
    def endless(self) -> bool:
        """As of the camera."""
        return self.inner.endless

    def first(self, count: int) -> list[Frame]:
        """The first frames."""
        return self.inner.first(count)

    def loaders(self, first: int) -> Iterator[Callable[[], Frame | None]]:
        """Frames, each kept as it comes."""
        for load in self.inner.loaders(first):
            if self.stop.is_set():
                self._stopped = True
                return
            frame = load()
            if frame is None:
                return
            self.save(frame)
            yield lambda frame=frame: frame  # type: ignore[misc]


def motion_of(asked: dict[str, Any]) -> dict[str, Any]:
    """[motion] of what a page or the API asks for; ``ValueError`` for anything else than numbers in their places."""
    kind = asked.get("kind", "fixed")
    if kind not in MOTIONS:
        raise ValueError(f"kind must be one of {', '.join(MOTIONS)}")
    if kind == "fixed":
        return {"kind": "fixed"}
    moves = asked.get("moves", "object")
    if moves not in {"object", "sensor"}:
        raise ValueError("moves must be object or sensor")
    motion: dict[str, Any] = {
        "kind": kind,
        "moves": moves,
        "step": _number(asked, "step"),
        "start": _number(asked, "start", 0.0),
    }
    if kind == "linear":
        motion["direction"] = "rig" if asked.get("direction") == "rig" else _vector(asked, "direction")
    elif asked.get("axis") == "rig":
        motion["axis"] = "rig"
    else:
        motion |= {"axis_point": _vector(asked, "axis_point"), "axis_direction": _vector(asked, "axis_direction")}
    return {**motion, "index": "filename"}


def _number(asked: dict[str, Any], key: str, default: float | None = None) -> float:
    value = asked.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f"{key} must be a number")
    return float(value)


def _vector(asked: dict[str, Any], key: str) -> list[float]:
    value = asked.get(key)
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError(f"{key} must be three numbers")
    return [_number({key: each}, key) for each in value]


def record(folder: SessionFolder, station: Station, growth: Growth, asked: dict[str, Any], job: Job) -> dict[str, Any]:
    """Scan with the session's rig; frames, capture.toml, cloud.ply and report.html land in ``scans/NAME``."""
    from scope.report import scan_page, scan_result

    if not folder.rig.is_file():
        raise FileError("there is no rig.json in the session folder yet; calibrate first, or start with --rig")
    rig = Rig.load(folder.rig)
    name = asked.get("name") or stamp()
    place = folder.new_scan(name)
    growth.begin(name)
    motion = asked["motion"]
    count = asked.get("frames")
    kept = {"format": 1, "units": "mm", "images": "frames/*.png", "motion": motion}
    write_toml(
        place / "capture.toml",
        kept,
        "Taken by scope console; ranged again by: scope scan capture.toml --rig ../../rig.json",
    )
    settings = station.settings
    live = {"format": 1, "units": "mm", "camera": {"driver": settings.driver, "id": settings.id or "0"}, "motion": {
        key: value for key, value in motion.items() if key != "index"}}  # fmt: skip
    if count:
        live["frames"] = count
    write_toml(place / ".live.toml", live, "The camera while the scan ran.")
    plan = read_capture(place / ".live.toml")

    def save(frame: Frame) -> None:
        save_image(place / "frames" / f"{frame.number:06d}.png", frame.image)

    def tick(done: int, total: int) -> None:
        growth.frames = done
        job.tick(done, total)

    with station.lent() as grabber:
        total = count or (getattr(grabber.camera, "frames", None) if settings.driver in ON_FILES else None)
        source = Recording(
            CameraSource(plan, grabber, total, None if settings.trigger else settings.rate), save, job.stop
        )
        setup, _ = open_scan(place / ".live.toml", rig, source=source)
        found = gathered(setup, source, on_frame=tick, on_chunk=growth.add)
    (place / ".live.toml").unlink(missing_ok=True)
    found.cloud.save(place / "cloud.ply")
    write_text(place / "report.html", scan_page(found, place / "capture.toml"))
    return {**scan_result(found), "scan": name, "files": ["cloud.ply", "report.html", "capture.toml"]}
