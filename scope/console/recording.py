"""A scan at the console: frames kept as they come, ranged meanwhile, and a cloud in the end as `scope scan` gives it."""

from __future__ import annotations

import shutil
import threading
import tomllib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np

from calibration.atomic import write_text, written_whole
from calibration.errors import FileError, ScopeError
from calibration.geometry import Array
from calibration.rig import Rig
from scope.cameras import CameraSource, Grabber, Placed, Shot
from scope.console.folder import NAME, SessionFolder, frame_numbers, write_toml
from scope.console.jobs import Job
from scope.console.station import Station
from scope.scanning import Chunk, Scan, gathered, open_scan
from scope.session import ON_FILES, CameraSettings, Clock, Folder, Follower, Frame, Source, read_capture, save_image

CLOCKS: tuple[Clock, ...] = get_args(Clock)
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
    """The frames that are in the scan's folder already, then the camera's; told to stop, it ends with those that came."""

    kept: Source | None
    camera: CameraSource
    stop: threading.Event
    _stopped: bool = False

    @property
    def count(self) -> int | None:
        """Frames in all."""
        there = 0 if self.kept is None else self.kept.count or 0
        return None if self.camera.count is None else there + self.camera.count

    @property
    def trouble(self) -> str:
        """What broke off; empty for a scan that was stopped: what came is whole."""
        return "" if self._stopped else self.camera.trouble

    @property
    def endless(self) -> bool:
        """As of the camera."""
        return self.camera.endless

    def first(self, count: int) -> list[Frame]:
        """The first frames."""
        there = [] if self.kept is None else self.kept.first(count)
        return there if len(there) >= count else [*there, *self.camera.first(count - len(there))]

    def loaders(self, first: int) -> Iterator[Callable[[], Frame | None]]:
        """Frames in order, from the first on."""
        if self.kept is not None:
            yield from self.kept.loaders(first)
        with closing(self.camera.loaders(0)) as loaders:  # type: ignore[type-var]
            for load in loaders:
                if self.stop.is_set() and not self._stopped:
                    self._stopped = True
                    self.camera.grabber.end()
                yield load


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
    motion: dict[str, Any] = {"kind": kind, "moves": moves, **_place(asked)}
    if kind == "linear":
        motion["direction"] = "rig" if asked.get("direction") == "rig" else _vector(asked, "direction")
    elif asked.get("axis") == "rig":
        motion["axis"] = "rig"
    else:
        motion |= {"axis_point": _vector(asked, "axis_point"), "axis_direction": _vector(asked, "axis_direction")}
    return {**motion, "index": "filename"}


def _place(asked: dict[str, Any]) -> dict[str, Any]:
    """How the position of a frame is told: by step, in a CSV by frame, or in a log over time."""
    for key in ("positions", "log"):
        if (name := asked.get(key)) is None:
            continue
        if not isinstance(name, str) or not NAME.fullmatch(name):
            raise ValueError(f"{key} must be the name of a CSV in the session folder, such as stage.csv")
        if key == "positions":
            return {"positions": name}
        clock = asked.get("clock", "first-frame")
        if clock not in CLOCKS:
            raise ValueError(f"clock must be one of {', '.join(CLOCKS)}")
        return {"log": name, "delay": _number(asked, "delay"), "clock": clock}
    return {"step": _number(asked, "step"), "start": _number(asked, "start", 0.0)}


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


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """The folder of one scan, and what is in it while the scan runs."""

    folder: SessionFolder
    path: Path

    @property
    def capture(self) -> Path:
        """What `scope scan` reads."""
        return self.path / "capture.toml"

    @property
    def live(self) -> Path:
        """The camera, while the scan runs or where it was broken off."""
        return self.path / ".live.toml"

    def begin(self, settings: CameraSettings, asked: dict[str, Any]) -> None:
        """Write both files."""
        motion = _from_scan(asked["motion"])
        common = {"format": 1, "units": "mm"} | {key: asked[key] for key in ("lasers", "sequence") if asked.get(key)}
        times = {"times": "times.csv"} if "log" in motion else {}
        after = {key: value for key, value in motion.items() if key != "clock"}
        write_toml(
            self.capture,
            {**common, "images": "frames/*.png", "motion": {**after, **times}},
            "Taken by scope console; ranged again by: scope scan capture.toml --rig ../../rig.json",
        )
        camera = {"driver": settings.driver, "id": settings.id or "0", "timeout_s": settings.timeout_s}
        if settings.driver == "genicam":
            camera["producer"] = settings.producer or ""
        frames = {"frames": asked["frames"]} if asked.get("frames") else {}
        live = {key: value for key, value in motion.items() if key != "index"}
        write_toml(self.live, {**common, **frames, "camera": camera, "motion": live}, "The camera while the scan ran.")

    def keep(self, shot: Shot, moment: float | None) -> None:
        """Write a frame, and when it was taken."""
        if moment is not None:
            with (self.path / "times.csv").open("a", encoding="utf-8") as stream:
                if stream.tell() == 0:
                    stream.write("frame,seconds\n")
                stream.write(f"{shot.number},{moment!r}\n")
        save_image(self.path / "frames" / f"{shot.number:06d}.png", shot.image)

    def end(self, placed: Collection[int] | None) -> None:
        """Take what the positions were read from into the folder; frames that no position was told of are put aside."""
        if placed is not None:
            for path in sorted((self.path / "frames").glob("*.png")):
                if int(path.stem) not in placed:
                    aside = self.path / "frames-without-position"
                    aside.mkdir(exist_ok=True)
                    path.replace(aside / path.name)
            content = tomllib.loads(self.capture.read_text(encoding="utf-8"))
            key = "log" if "log" in content["motion"] else "positions"
            source = self.path / content["motion"][key]
            with written_whole(self.path / source.name) as stream:
                stream.write(source.read_bytes())
            content["motion"][key] = source.name
            write_toml(self.capture, content, "Taken by scope console.")
        self.live.unlink(missing_ok=True)


def _from_scan(motion: dict[str, Any]) -> dict[str, Any]:
    """[motion] with the session folder's CSV as the scan's folder sees it."""
    return {key: f"../../{value}" if key in {"positions", "log"} else value for key, value in motion.items()}


def record(folder: SessionFolder, station: Station, growth: Growth, asked: dict[str, Any], job: Job) -> dict[str, Any]:
    """Scan with the session's rig; frames, capture.toml, cloud.ply and report.html land in ``scans/NAME``.

    A frame is on the disk before it is ranged. With ``resume`` the frames of a scan that broke off are ranged, and the camera goes
    on behind them.
    """
    rig = _rig(folder)
    place = Place(folder, folder.scan(asked["name"]) if asked.get("resume") else folder.new_scan(asked["name"]))
    growth.begin(asked["name"])
    if not asked.get("resume"):
        place.begin(station.settings, asked)
    kept = frame_numbers(place.path)
    plan = read_capture(place.live)
    if kept and plan.follow is not None:
        raise FileError(f"{place.path.name}: a scan by positions over time cannot be gone on with; finish it")
    first = max(kept) + 1 if kept else 0

    def keep(grabber: Grabber, shot: Shot) -> None:
        by_time = plan.follow is not None and plan.follow.by == "seconds"
        place.keep(shot, grabber.moment(shot, plan.follow.clock) if by_time and plan.follow is not None else None)

    count = None if plan.frames is None else max(plan.frames - len(kept), 0)
    settings = station.settings
    try:
        with station.lent(keep, first=first) as grabber:
            if count is None and settings.driver in ON_FILES:
                total = getattr(grabber.camera, "frames", None)
                count = None if total is None else max(total - first, 0)
            camera = CameraSource(plan, grabber, count, None if settings.trigger else settings.rate)
            source: Source = Recording(Folder(read_capture(place.capture)) if kept else None, camera, job.stop)
            if plan.follow is not None:
                source = Placed(source, Follower(plan.follow, give_up=job.stop.is_set))
            setup, _ = open_scan(place.capture if kept else plan, rig, source=source)
            found = gathered(setup, source, on_frame=_ticks(growth, job), on_chunk=growth.add)
    except ScopeError:
        if not frame_numbers(place.path):  # nothing that were worth keeping
            shutil.rmtree(place.path, ignore_errors=True)
        raise
    place.end(None if plan.follow is None else plan.follow.known)
    return _written(place, found)


def finish(folder: SessionFolder, growth: Growth, name: str, job: Job) -> dict[str, Any]:
    """Range the frames of a scan that broke off, as ``scope scan`` does."""
    rig = _rig(folder)
    place = Place(folder, folder.scan(name))
    growth.begin(name)
    setup, source = open_scan(place.capture, rig)
    found = gathered(setup, source, on_frame=_ticks(growth, job), on_chunk=growth.add)
    place.live.unlink(missing_ok=True)
    return _written(place, found)


def _rig(folder: SessionFolder) -> Rig:
    if not folder.rig.is_file():
        raise FileError("there is no rig.json in the session folder yet; calibrate first, or start with --rig")
    return Rig.load(folder.rig)


def _ticks(growth: Growth, job: Job) -> Callable[[int, int], None]:
    def tick(done: int, total: int) -> None:
        growth.frames = done
        job.tick(done, total)

    return tick


def _written(place: Place, found: Scan) -> dict[str, Any]:
    from scope.report import scan_page, scan_result

    found.cloud.save(place.path / "cloud.ply")
    write_text(place.path / "report.html", scan_page(found, place.capture))
    return {**scan_result(found), "scan": place.path.name, "files": ["cloud.ply", "report.html", "capture.toml"]}
