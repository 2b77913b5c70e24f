"""The console's parts joined: folder, camera, steps, jobs, and what is looked at."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from calibration.errors import FileError, ScopeError
from calibration.rig import Rig
from scope.cameras import View
from scope.cloud import ScanCloud
from scope.console import measuring
from scope.console.folder import SessionFolder, stamp
from scope.console.jobs import Job, Jobs
from scope.console.look import Look, Subject, look_at, picture
from scope.console.pictures import jpeg_of
from scope.console.recording import Growth, finish, motion_of, record
from scope.console.station import Station
from scope.console.steps import Steps
from scope.history import Journal, Record, calibration_figures, check_figures, journal_beside, scan_figures
from scope.scanning import Scanner
from scope.session import CameraSettings, planned_limits, read_capture, read_target
from scope.version import __version__
from scope.viewer import cloud_scene, scene_bytes

MOST_FRAMES = 1_000_000
_AWAY = 3.0  # s after which nobody is thought to look


@dataclass(slots=True, eq=False)
class Console:
    """State of one console; pages and API read it and ask it for work."""

    folder: SessionFolder
    station: Station
    steps: Steps
    motion: dict[str, Any]  # offered for the next scan
    journal: Journal | None = None
    jobs: Jobs = field(default_factory=Jobs)
    growth: Growth = field(default_factory=Growth)
    subject: Subject = "stripe"
    overlay: bool = True
    look: Look | None = None
    laser: str = ""  # the one that the live profile is read of; empty: the first
    _jpeg: tuple[int, bytes] = (0, b"")
    _scanner: tuple[tuple[float, str], Scanner | None] = ((0.0, ""), None)
    _expected: tuple[float, int | None] = (0.0, None)
    _eye: threading.Lock = field(default_factory=threading.Lock)
    _watched: float = 0.0
    _looking: threading.Thread | None = None

    @classmethod
    def open(
        cls, folder: SessionFolder, settings: CameraSettings, motion: dict[str, Any], *, history: bool = True
    ) -> Console:
        """Open the camera and take up the session where it was left."""
        return cls(folder, Station(settings), Steps(folder), motion, journal_beside(folder.rig) if history else None)

    def rig(self) -> Rig | None:
        """The session's rig; None where there is none that can be read."""
        scanner = self.scanner()
        return None if scanner is None else scanner.rig

    def scanner(self) -> Scanner | None:
        """Scanner of the session's rig, read anew where the file has changed."""
        try:
            when = self.folder.rig.stat().st_mtime
        except OSError:
            return None
        if self._scanner[0] != (when, self.laser):
            made: Scanner | None = None
            with suppress(ScopeError):
                rig = Rig.load(self.folder.rig)
                made = Scanner(rig, laser=self.laser if self.laser in rig.lasers else next(iter(rig.lasers), None))
            self._scanner = ((when, self.laser), made)
        return self._scanner[1]

    def frame(self, after: int, timeout: float = 2.0) -> tuple[int, bytes]:
        """JPEG of the newest frame behind the ``after``-th, with what was found last drawn on it; made once for all who look.

        Judging the image goes on in a thread of its own, and neither the camera nor the picture waits for it.
        """
        count, shot = self.station.wait(after, timeout)
        if shot is None:
            return 0, b""
        with self._eye:
            self._watched = time.monotonic()
            if self._looking is None:
                self._looking = threading.Thread(target=self._look_on, name="eye", daemon=True)
                self._looking.start()
            if self._jpeg[0] != count:
                self._jpeg = (count, picture(shot.image, self.look if self.overlay else None, overlay=self.overlay))
            return self._jpeg

    def _look_on(self) -> None:
        """Judge the newest image, again and again, while somebody looks."""
        seen = 0
        while True:
            with self._eye:
                if time.monotonic() - self._watched > _AWAY:
                    self._looking = None
                    return
            seen, shot = self.station.wait(seen, 0.5)
            subject, began = self.subject, time.monotonic()
            if shot is not None and self.overlay:
                found = look_at(shot.image, subject, self.scanner() if subject == "stripe" else None)
                if subject == self.subject:
                    self.look = found
            spent = time.monotonic() - began
            # what ranges or calibrates comes first
            time.sleep(max(0.5, 2.0 * spent) if self.jobs.running is not None else max(0.1, 0.5 * spent))

    def show(self, subject: Subject, plane: str = "") -> None:
        """Look at the stripe or at the target; a simulated camera shows it, on the object or at a stand-off."""
        self.subject, self.look = subject, None
        if self.station.simulated:
            self.station.show(View(plane, laser=subject == "stripe", moving=False))

    def expected_marks(self) -> int | None:
        """Marks of the target; None where the file lists them by plane, or cannot be read."""
        try:
            when = self.folder.calibration.stat().st_mtime
            if self._expected[0] != when:
                self._expected = (when, len(read_target(self.folder.calibration).marks))
        except (OSError, ScopeError):
            return None
        return self._expected[1]

    def status(self) -> dict[str, Any]:
        """What GET /api/v1/status answers."""
        rig, job = self.rig(), self.jobs.running
        state = "error" if self.station.trouble else job.kind if job is not None else "ready"
        told = (
            None if rig is None else {"sha256": rig.sha256, "verified": rig.verification.passed, "written": rig.written}
        )
        return {
            "state": state, "camera": self.station.status, "rig": told, "job": None if job is None else job.content,
            "version": __version__,
        }  # fmt: skip

    def start_scan(self, asked: dict[str, Any], identity: str = "") -> Job:
        """Start a scan; ``ValueError`` for what is asked wrongly, ``Busy`` while another job runs."""
        motion = motion_of(asked["motion"]) if asked.get("motion") is not None else self.motion
        frames = asked.get("frames")
        if frames is not None and (
            isinstance(frames, bool) or not isinstance(frames, int) or not 1 <= frames <= MOST_FRAMES
        ):
            raise ValueError(f"frames must be a whole number from 1 to {MOST_FRAMES}")
        known = self.jobs.get(identity) if identity else None
        name = str(known.asked["name"]) if known is not None and "name" in known.asked else identity or stamp()
        if self.jobs.running is None:
            self.show("stripe")
        wanted = {"motion": motion, "frames": frames, "name": name, **self._lit(asked)}
        return self.jobs.start(
            "scan",
            wanted,
            self._noted(lambda job: record(self.folder, self.station, self.growth, wanted, job)),
            identity,
        )

    def _lit(self, asked: dict[str, Any]) -> dict[str, Any]:
        """Lasers of a scan and how they take turns, as [lasers] and [sequence] of a capture; ``ValueError`` for others."""
        rig, lasers, sequence = self.rig(), asked.get("lasers"), asked.get("sequence")
        told: dict[str, Any] = {}
        if lasers:
            names = () if rig is None else tuple(rig.lasers)
            if not isinstance(lasers, list) or not all(name in names for name in lasers):
                raise ValueError(f"lasers must be of the rig: {', '.join(names) or 'it has none'}")
            told["lasers"] = lasers
        if sequence is not None:
            if sequence not in ("together", "cycle"):
                raise ValueError("sequence must be together or cycle")
            told["sequence"] = sequence
        return told

    def resume_scan(self, name: str, *, camera: bool) -> Job:
        """Range the frames of a scan that broke off, and with ``camera`` let it go on behind them."""
        if name not in self.folder.unfinished():
            raise FileError("there is no unfinished scan of this name")
        asked = {"name": name, "resume": True}
        if camera:
            return self.jobs.start(
                "scan", asked, self._noted(lambda job: record(self.folder, self.station, self.growth, asked, job))
            )
        return self.jobs.start("scan", asked, self._noted(lambda job: finish(self.folder, self.growth, name, job)))

    def can_go_on(self, name: str) -> bool:
        """Whether the camera can go on behind a scan that broke off: where only steps say how things moved."""
        try:
            return read_capture(self.folder.scan(name) / ".live.toml").follow is None
        except ScopeError:
            return False

    def _noted(self, work: Callable[[Job], dict[str, Any]]) -> Callable[[Job], dict[str, Any]]:
        """A scan whose result is recorded in the history."""

        def noted(job: Job) -> dict[str, Any]:
            found = work(job)
            good = bool(found["complete"] and found["verified"] and not found["troubles"])
            self.note(Record("scan", good, scan_figures(found), file=str(found["scan"])))
            return found

        return noted

    def start_calibration(self, identity: str = "") -> Job:
        """Calibrate with what was taken."""

        def work(job: Job) -> dict[str, Any]:
            found = self.steps.calibrate(job)
            self.note(Record("calibrate", bool(found["passed"]), calibration_figures(found), file="rig.json"))
            return found

        return self.jobs.start("calibration", {}, work, identity)

    def growing(self, side: str) -> bytes:
        """JPEG of the growing cloud from above or from the side; empty where there is none yet."""
        points = self.growth.shown()
        if len(points) < 10:
            return b""
        return jpeg_of(points, side)

    def cloud_bytes(self, name: str) -> bytes:
        """A scan's cloud as the viewer reads it."""
        return scene_bytes(cloud_scene(ScanCloud.load(self.file("scans", name, "cloud.ply"))))

    def cloud_of(self, scan: str) -> Path:
        """Cloud of a scan, or of the newest where none is named."""
        name = scan or next(iter(self.folder.clouds()), "")
        if not name:
            raise FileError("there is no cloud in the session yet; scan first")
        return self.file("scans", name, "cloud.ply")

    def keep_model(self, name: str, data: bytes) -> str:
        """Take a mesh into the session."""
        return measuring.keep_model(self.folder, name, data)

    def start_roughness(self, scan: str, region: str | None, identity: str = "") -> Job:
        """Roughness of a region of a scan."""
        return self._measure(
            "roughness", scan, {"region": region}, lambda cloud: measuring.roughness(cloud, region), identity
        )

    def start_pose(self, scan: str, model: str, identity: str = "", *, region: str | None = None) -> Job:
        """Pose of a part whose mesh stands in ``models``, anywhere in a scan or within a region of it."""
        path = self.file("models", model)
        asked = {"model": model, "region": region}
        return self._measure("pose", scan, asked, lambda cloud: measuring.pose(cloud, path, region), identity)

    def start_check(
        self, scan: str, artefact: str, tolerance: float | None, region: str | None, identity: str = ""
    ) -> Job:
        """Accuracy on an artefact."""
        asked = {"artefact": artefact, "tolerance": tolerance, "region": region}
        return self._measure(
            "check", scan, asked, lambda cloud: measuring.check(cloud, artefact, tolerance, region), identity
        )

    def _measure(
        self, kind: str, scan: str, asked: dict[str, Any], work: Callable[[Path], dict[str, Any]], identity: str
    ) -> Job:
        cloud = self.cloud_of(scan)

        def measured(job: Job) -> dict[str, Any]:
            try:
                found = work(cloud)
            except ValueError as error:  # what was typed, in words
                raise FileError(str(error)) from error
            if kind == "check":
                self.note(Record("check", found["good"], _with_tolerance(found), file=cloud.parent.name))
            return {**found, "scan": cloud.parent.name, "asked": job.asked}

        return self.jobs.start(kind, {**asked, "scan": cloud.parent.name}, measured, identity)

    def note(self, record: Record) -> None:
        """Keep a record in the session's history, where that is not switched off."""
        if self.journal is None:
            return
        rig = self.rig()
        with suppress(FileError):  # a full disk must not spoil the result
            self.journal.add(replace(record, rig="" if rig is None else rig.sha256, camera=self.station.settings.name))

    def limits(self) -> dict[str, float]:
        """Limits of the session's [accept]; none where there is no file that can be read."""
        try:
            return planned_limits(self.folder.calibration)
        except ScopeError:
            return {}

    def history(self) -> list[Record]:
        """Records of the session, the newest first."""
        return [] if self.journal is None else self.journal.records()[::-1]

    def stop(self) -> None:
        """Stop the job that runs; what it has is kept."""
        if (job := self.jobs.running) is not None:
            job.stop.set()

    def file(self, *parts: str) -> Path:
        """A file of the session to be sent; ``FileError`` where it is not one."""
        path = self.folder.inside(*parts)
        if not path.is_file():
            raise FileError("there is no such file in the session")
        return path

    def close(self) -> None:
        """End: a scan that runs keeps what it has."""
        self.stop()
        self.jobs.wait(20.0)
        self.station.close()


def _with_tolerance(found: dict[str, Any]) -> dict[str, float]:
    """Figures of a check, with the tolerance that it was held against."""
    tolerance = found.get("tolerance_mm")
    return {**check_figures(found["check"]), **({} if tolerance is None else {"tolerance_mm": float(tolerance)})}
