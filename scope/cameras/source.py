"""A camera as the source of a scan: frames in order, none lost for want of speed, and what broke off told in one line."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np

from calibration.errors import ScopeError
from scope.cameras.camera import Camera, Shot
from scope.cameras.drivers import open_camera
from scope.errors import CameraError
from scope.session import HELD, Capture, Clock, Follower, Frame, Source, shape_text
from scope.session import open_source as open_files

_SLOW = 1.25  # times the interval asked for, at which a camera counts as too slow
_LOOKED = 32  # frames over which that is judged


class Grabber:
    """Reads a camera in a thread of its own into a queue of bounded size, so that ranging never holds it up.

    Frames that find the queue full are lost, and counted; a camera that waits is read when a frame is wanted. ``keep`` is called with
    each frame as soon as it has come, before anybody has it.
    """

    def __init__(self, camera: Camera, keep: Callable[[Grabber, Shot], None] | None = None) -> None:
        self.camera, self._keep = camera, keep
        self.lost = 0
        self._began: tuple[float, float] | None = None  # Unix time at which the first frame came, and its own
        self._queue: deque[Shot] = deque()
        self._bytes = 0
        self._ready = threading.Condition()
        self._end: ScopeError | None = None
        self._stopped = self._done = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the camera and, where it does not wait, the thread."""
        self.camera.start()
        if not self.camera.waits:
            self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
            self._thread.start()

    def next(self) -> Shot | None:
        """Next frame, waited for; None at the end. Raises what the camera raised, after the frames before it."""
        if self._thread is None:
            return None if self._stopped else self._read()
        with self._ready:
            self._ready.wait_for(lambda: self._queue or self._done)
            if self._queue:
                shot = self._queue.popleft()
                self._bytes -= shot.image.nbytes
                return shot
            if self._end is not None:
                raise self._end
            return None

    def moment(self, shot: Shot, clock: Clock) -> float | None:
        """When a frame was taken by the clock that a log has, s; None where the camera has no such clock."""
        if clock == "camera":
            return shot.stamp
        if clock == "first-frame" or self._began is None:
            return shot.at
        return self._began[0] + shot.at - self._began[1]

    def end(self) -> None:
        """Take no more frames; those that came are still given."""
        self._stopped = True

    def stop(self) -> None:
        """End the thread and close the camera."""
        self.end()
        if self._thread is not None:
            self._thread.join()
        self.camera.close()

    def _read(self) -> Shot | None:
        shot = self.camera.read()
        if shot is None:
            return None
        if self._began is None:
            self._began = (time.time(), shot.at)
        if self._keep is not None:
            self._keep(self, shot)
        return shot

    def _run(self) -> None:
        while not self._stopped:
            try:
                shot, end = self._read(), None
            except ScopeError as error:
                shot, end = None, error
            except Exception as error:  # noqa: BLE001  (a driver may throw anything; whoever waits for frames must be told)
                shot, end = (
                    None,
                    CameraError(f"camera {self.camera.info.driver}: {type(error).__name__}: {error}"[:200]),
                )
            with self._ready:
                if shot is None:
                    self._end, self._stopped = end, True
                elif self._bytes + shot.image.nbytes > HELD:
                    self.lost += 1
                else:
                    self._queue.append(shot)
                    self._bytes += shot.image.nbytes
                self._ready.notify_all()
        with self._ready:
            self._done = True
            self._ready.notify_all()


@dataclass(slots=True, eq=False)
class CameraSource:
    """Frames of the camera of a capture; see `scope.session.Source`."""

    capture: Capture
    grabber: Grabber
    count: int | None
    rate: float | None  # frames a second asked for, where the camera runs free
    trouble: str = ""
    _ahead: deque[Frame] = field(default_factory=deque)
    _like: Shot | None = None
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=_LOOKED))
    _read: int = 0
    _ended: bool = False

    @classmethod
    def open(cls, capture: Capture) -> CameraSource:
        """Open and start the camera; ``CameraError``, ``FileError`` or ``MissingLibraryError`` where it cannot be."""
        if capture.driven is None:
            raise ValueError("the capture names no camera")
        grabber = Grabber(open_camera(capture.driven))
        count = capture.frames
        if count is None and grabber.camera.waits:
            count = getattr(grabber.camera, "frames", None)
        grabber.start()
        return cls(capture, grabber, count, None if capture.driven.trigger else capture.driven.rate)

    @property
    def endless(self) -> bool:
        """Whether only the user ends it: a live camera of which no number of frames was asked."""
        return self.count is None and not self.grabber.camera.waits

    def first(self, count: int) -> list[Frame]:
        """The first frames; they are kept for `loaders`."""
        while len(self._ahead) < count and (self.count is None or len(self._ahead) < self.count):
            frame = self._next()
            if frame is None:
                break
            self._ahead.append(frame)
        return list(self._ahead)

    def loaders(self, first: int) -> Iterator[Callable[[], Frame | None]]:
        """Frames that were read here, in order."""
        given = 0
        try:
            while self.count is None or given < self.count:
                frame = self._ahead.popleft() if self._ahead else self._next()
                if frame is None:
                    return
                if given >= first:
                    yield lambda frame=frame: frame  # type: ignore[misc]
                given += 1
        finally:
            self._tell_lost()
            self.grabber.stop()

    def _next(self) -> Frame | None:
        if self._ended:
            return None
        shot, why = self._taken()
        if shot is not None and not why:
            why = self._unlike(shot) or self._slow(shot)
        if shot is None or why:
            self._ended = True
            name = self.grabber.camera.info.driver
            if why:
                self.trouble = f"{why}; {self._read} frames are kept"
            elif self.count is not None:
                self.trouble = f"camera {name} ended after {self._read} of {self.count} frames"
            return None
        number = shot.number // 2 if self.capture.background_mode == "alternate" else shot.number
        self._read += 1
        clock = "first-frame" if self.capture.follow is None else self.capture.follow.clock
        return Frame(
            number, shot.name or f"frame {number}", shot.image, shot.background, self.grabber.moment(shot, clock)
        )

    def _taken(self) -> tuple[Shot | None, str]:
        """Next frame or pair, and why there is none where the camera says so."""
        try:
            return self._pair(), ""
        except ScopeError as error:
            return None, str(error)

    def _pair(self) -> Shot | None:
        shot = self.grabber.next()
        if shot is None or self.capture.background_mode != "alternate":
            return shot
        dark = self.grabber.next()
        while dark is not None:
            if shot.number % 2 == 0 and dark.number == shot.number + 1:
                return Shot(shot.image, shot.number, shot.at, shot.name, dark.image, shot.stamp)
            shot, dark = dark, self.grabber.next()  # a lost frame must not turn on into off
        return None

    def _unlike(self, shot: Shot) -> str:
        """What is wrong where a frame is unlike the first; empty where nothing is."""
        if self._like is None:
            self._like = shot
        for image in (shot.image, shot.background):
            if image is not None and (image.shape != self._like.image.shape or image.dtype != self._like.image.dtype):
                return (
                    f"{self.grabber.camera.info.driver} gave frame {shot.number} as {shape_text(image)} after "
                    f"{shape_text(self._like.image)}; do not change the camera's settings while scanning"
                )
        return ""

    def _slow(self, shot: Shot) -> str:
        """What is wrong where frames come slower than asked; empty where nothing is."""
        self._times.append(shot.at)
        if self.rate is None or not self.capture.by_step or len(self._times) < _LOOKED:
            return ""
        interval = float(np.median(np.diff(np.array(self._times))))
        if interval * self.rate <= _SLOW:
            return ""
        return (
            f"camera {self.grabber.camera.info.driver} gives {1 / interval:.3g} frames a second and {self.rate:g} were asked for, "
            "so that `step` would misplace them; expose shorter, or ask for a lower rate"
        )

    def _tell_lost(self) -> None:
        lost = self.grabber.lost + self.grabber.camera.dropped
        if lost and not self.trouble:
            self.trouble = f"{lost} frames were lost ({self._read} came); each of the others keeps its own place"


@dataclass(slots=True, eq=False)
class Placed:
    """Source whose frames wait until it is known where they stand; it ends with the first of which nobody tells."""

    inner: Source
    follower: Follower
    _why: str = ""

    @property
    def count(self) -> int | None:
        """Of the frames within."""
        return self.inner.count

    @property
    def trouble(self) -> str:
        """A position that did not come, or what troubles the frames within."""
        return self._why or self.inner.trouble

    @property
    def endless(self) -> bool:
        """As the frames within."""
        return self.inner.endless

    def first(self, count: int) -> list[Frame]:
        """The first frames, wherever they stand."""
        return self.inner.first(count)

    def loaders(self, first: int) -> Iterator[Callable[[], Frame | None]]:
        """Frames whose positions are known."""
        placed = first
        with closing(self.inner.loaders(first)) as loaders:  # type: ignore[type-var]
            for load in loaders:
                frame = load()
                if frame is None:
                    return
                why = self.follower.place(frame.number, frame.at)
                if why:
                    self._why = f"{why}; {placed} frames are kept"
                    return
                placed += 1
                yield lambda frame=frame: frame  # type: ignore[misc]


def open_source(capture: Capture) -> Source:
    """Where the frames of a capture come from: files, or a camera; with their positions where these come meanwhile."""
    source = open_files(capture) if capture.driven is None else CameraSource.open(capture)
    return source if capture.follow is None else Placed(source, Follower(capture.follow))
