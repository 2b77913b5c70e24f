"""The camera of the console: read in a thread of its own, watched by the pages, lent to a scan."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, TypeVar

from calibration.errors import ScopeError
from scope.cameras import Camera, Grabber, ReplayCamera, Shot, SimulatedCamera, View, open_camera
from scope.errors import CameraError
from scope.session import ON_FILES, CameraSettings

T = TypeVar("T")
RATE = 15.0  # frames a second shown of a camera that waits
_RETRY = 2.0  # s between attempts to find a camera that is gone
_AWAY = 3.0  # s after which nobody is thought to look, and frames that wait are rendered once a second only
_PATIENCE = 30.0  # s that a page waits for the camera


class Station:
    """Camera, the newest frame, and what is wrong where there is none.

    Everything that touches the camera runs in the station's thread, between two frames.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self.settings = settings
        self.trouble = ""
        self.frames = 0
        self.shot: Shot | None = None
        self._camera: Camera | None = None
        self._news = threading.Condition()
        self._asked: deque[Callable[[], None]] = deque()
        self._times: deque[float] = deque(maxlen=30)
        self._stopped = self._lent = False
        self._watched = 0.0  # when somebody looked last
        self._told: dict[str, Any] = {}
        self._thread = threading.Thread(target=self._run, name="station", daemon=True)
        self._thread.start()

    @property
    def status(self) -> dict[str, Any]:
        """Camera, frames, rate, drops and trouble, for pages and the API."""
        with self._news:
            times = list(self._times)
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0
        if self.shot is not None and times and time.monotonic() - times[-1] > 2.0:
            rate = 0.0
        return {**self._told, "frames": self.frames, "rate": round(rate, 1), "trouble": self.trouble}

    @property
    def simulated(self) -> bool:
        """Whether the camera is a virtual one, which can show whatever is asked for."""
        return self.settings.driver == "simulated"

    @property
    def switches_laser(self) -> bool:
        """Whether the camera switches the laser."""
        return bool(self._told.get("switches_laser", False))

    def wait(self, after: int, timeout: float) -> tuple[int, Shot | None]:
        """The newest frame once there is one behind the ``after``-th, or what there is after ``timeout`` s."""
        self._watched = time.monotonic()
        with self._news:
            self._news.wait_for(lambda: self.frames > after or self._stopped, timeout)
            return self.frames, self.shot

    def take(self, count: int, *, laser: bool | None = None, plane: str = "") -> list[Shot]:
        """``count`` fresh frames, with the laser as asked for where it can be switched.

        ``plane`` is the place of the target that a simulated camera is to show. ``CameraError`` where none comes.
        """

        def taken(camera: Camera) -> list[Shot]:
            if isinstance(camera, SimulatedCamera):
                camera.show(View(plane, laser=bool(laser), moving=False))
            elif laser is not None and camera.switches_laser:
                camera.switch_laser(laser)
                camera.read()  # exposed while it was switched
            shots = [shot for _ in range(count) if (shot := camera.read()) is not None]
            if len(shots) < count:
                raise CameraError(
                    f"{self.settings.name}: gave {len(shots)} of {count} frames; check it and take them again"
                )
            self._show(shots[-1])
            return shots

        return self.do(taken)

    def show(self, view: View) -> None:
        """Put something before a simulated camera."""

        def shown(camera: Camera) -> None:
            if isinstance(camera, SimulatedCamera):
                camera.show(view)

        self.do(shown)

    def set(self, name: str, value: float) -> None:
        """Set "exposure_us" or "gain"."""
        self.do(lambda camera: camera.set(name, value))

    def do(self, work: Callable[[Camera], T]) -> T:
        """Run work on the camera between two frames; what it raises is raised here."""
        done = threading.Event()
        answer: list[T] = []
        failed: list[Exception] = []

        def job() -> None:
            try:
                if self._camera is None:
                    raise CameraError(self.trouble or f"{self.settings.name}: is not open yet; try again")
                answer.append(work(self._camera))
                self._tell(self._camera)
            except Exception as error:  # noqa: BLE001  (raised again in the thread that asked)
                failed.append(error)
            finally:
                done.set()

        if self._lent:
            raise CameraError(f"{self.settings.name}: is busy with a scan; wait for its end or stop it")
        self._asked.append(job)
        if not done.wait(_PATIENCE):
            raise CameraError(f"{self.settings.name}: does not answer; check cable and power")
        if failed:
            raise failed[0]
        return answer[0]

    @contextmanager
    def lent(self, keep: Callable[[Grabber, Shot], None] | None = None, *, first: int = 0) -> Iterator[Grabber]:
        """Lend the camera to a scan, as a started `Grabber`; the pages see its frames meanwhile.

        ``keep`` is called with each frame as soon as it has come, in the thread that reads the camera; frames are numbered from
        ``first``, from where on cameras on files go on.
        """

        def let_go(_: Camera) -> None:
            self._lent = True

        self.do(let_go)
        camera = self._camera
        try:
            if camera is None:
                raise CameraError(f"{self.settings.name}: is gone; check cable and power")
            if self.settings.driver in ON_FILES:
                other = open_camera(self.settings)
                if isinstance(other, SimulatedCamera) and isinstance(camera, SimulatedCamera):
                    other.exposure = camera.exposure
                grabber = Grabber(_Watched(other, self._show, first), keep)
            else:
                if camera.switches_laser:
                    camera.switch_laser(True)
                grabber = Grabber(_Watched(camera, self._show, first, close=False), keep)
            grabber.start()
            try:
                yield grabber
            finally:
                grabber.stop()
        finally:
            self._lent = False

    def close(self) -> None:
        """Stop."""
        self._stopped = True
        with self._news:
            self._news.notify_all()
        self._thread.join(5.0)

    def _run(self) -> None:
        while not self._stopped:
            try:
                if self._camera is None:
                    self._camera = open_camera(self.settings, again=True)
                    if isinstance(self._camera, SimulatedCamera):
                        self._camera.show(View(moving=False))
                    self._camera.start()
                    self._tell(self._camera)
                    self.trouble = ""
                self._step(self._camera)
            except Exception as error:  # noqa: BLE001  (a driver may throw anything; the page tells it, and the camera is sought again)
                self._lose(error)
        if self._camera is not None:
            self._camera.close()

    def _step(self, camera: Camera) -> None:
        while self._asked:
            self._asked.popleft()()
        if self._lent:
            time.sleep(0.02)
            return
        began = time.monotonic()
        shot = camera.read()
        if shot is None:
            raise CameraError(f"{self.settings.name}: has no more frames")
        self._show(shot)
        if camera.waits and self.settings.rate is None:
            idle = time.monotonic() - self._watched > _AWAY
            until = began + (1.0 if idle else 1.0 / RATE)
            while time.monotonic() < until and not self._asked and not self._stopped:
                time.sleep(0.02)

    def _lose(self, error: Exception) -> None:
        told = str(error) if isinstance(error, ScopeError) else f"{self.settings.name}: {type(error).__name__}"
        self.trouble = " ".join(told.split())
        if self._camera is not None:
            with suppress(Exception):
                self._camera.close()
            self._camera = None
        until = time.monotonic() + _RETRY
        while time.monotonic() < until and not self._stopped:
            while self._asked:
                self._asked.popleft()()
            time.sleep(0.05)

    def _show(self, shot: Shot) -> None:
        with self._news:
            self.shot, self.frames = shot, self.frames + 1
            self._times.append(time.monotonic())
            if self._camera is not None:
                self._told["dropped"] = self._camera.dropped
            self._news.notify_all()

    def _tell(self, camera: Camera) -> None:
        self._told = {
            **camera.info.result, "settings": dict(camera.settings), "dropped": camera.dropped,
            "switches_laser": camera.switches_laser,
        }  # fmt: skip


class _Watched:
    """A camera whose frames are shown while somebody else reads them."""

    def __init__(self, camera: Camera, show: Callable[[Shot], None], first: int, *, close: bool = True) -> None:
        self._camera, self._show, self._first, self._close = camera, show, first, close

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def start(self) -> None:
        """Start, behind the frames that are there already."""
        self._camera.start()
        if isinstance(self._camera, ReplayCamera | SimulatedCamera):
            self._camera.skip(self._first)
            self._first = 0  # it counts on by itself

    def read(self) -> Shot | None:
        """Next frame, shown."""
        shot = self._camera.read()
        if shot is None:
            return None
        if self._first:
            shot = replace(shot, number=shot.number + self._first)
        self._show(shot)
        return shot

    def close(self) -> None:
        """Close what was opened for the scan alone."""
        if self._close:
            self._camera.close()
