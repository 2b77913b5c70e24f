"""The frames of a capture, from a folder, a video or a camera, decoded ahead and in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sized
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from calibration.errors import FileError
from calibration.threads import own_threads
from ranging.background import Image
from ranging.errors import RangingError
from scope.session.capture import Capture
from scope.session.images import read_image

T = TypeVar("T")
AHEAD = 20  # frames held at once, at most: while one run of frames is ranged, the threads go on with the next
HELD = 256 << 20  # bytes of images held so, or four frames
THREADS = 2  # that load and work ahead, unless told (--threads)


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One exposure: the image, and the laser-off image that belongs to it alone."""

    number: int  # for the motion
    name: str
    image: Image
    background: Image | None = None
    at: float | None = None  # s, as the container of a video tells


class Source(Protocol):
    """Frames to come; ``loaders`` are called in threads, in order of issue."""

    @property
    def count(self) -> int | None:
        """Frames to come in all; None: unknown before the end."""
        ...

    @property
    def trouble(self) -> str:
        """Why fewer or other frames came than were announced; empty where all is well."""
        ...

    @property
    def endless(self) -> bool:
        """Whether only the user ends it, so that an interrupt is no loss."""
        ...

    def first(self, count: int) -> list[Frame]:
        """The first frames, ``count`` at most and fewer of large ones; they come again from `loaders`."""
        ...

    def loaders(self, first: int) -> Iterator[Callable[[], Frame | None]]:
        """Calls that give the frames from the ``first`` on; one that gives None ends the stream."""
        ...


@dataclass(slots=True, eq=False)
class Folder:
    """Image files."""

    capture: Capture
    _ahead: dict[int, Frame] = field(default_factory=dict)  # frames read before they were asked for

    @property
    def count(self) -> int:
        """Frames, each of one image or of a pair."""
        return len(self.capture.images) // (2 if self.capture.background_mode == "alternate" else 1)

    @property
    def trouble(self) -> str:
        """Empty: a file that cannot be read is an error of its own."""
        return ""

    @property
    def endless(self) -> bool:
        """False: the files are counted."""
        return False

    def first(self, count: int) -> list[Frame]:
        """The first frames, kept for `loaders`."""
        for k in range(min(count, self.count)):
            if k >= frames_in_memory(self._ahead[0].image if k else None, count):
                break
            try:
                self._ahead[k] = self._load(k)
            except FileError:  # told when its turn comes
                break
        return [self._ahead[k] for k in sorted(self._ahead)]

    def loaders(self, first: int) -> Iterator[Callable[[], Frame | None]]:
        """One loader a frame: files are decoded in the threads that call them."""
        for k in [k for k in self._ahead if k < first]:
            del self._ahead[k]
        for k in range(first, self.count):
            yield lambda k=k: self._load(k)  # type: ignore[misc]

    def _load(self, k: int) -> Frame:
        if k in self._ahead:
            return self._ahead.pop(k)
        capture = self.capture
        number = k if capture.numbers is None else capture.numbers[k]
        if capture.background_mode == "alternate":
            on, off = capture.images[2 * k : 2 * k + 2]
            return Frame(number, on.name, read_image(on), read_image(off))
        image = capture.images[k]
        dark = read_image(capture.background[k]) if capture.background_mode == "paired" else None
        return Frame(number, image.name, read_image(image), dark)


@dataclass(slots=True, eq=False)
class Stream:
    """A video file, or a live camera by its index: frames come one after the other."""

    capture: Capture
    opened: Any  # cv2.VideoCapture
    name: str
    count: int | None
    trouble: str = ""
    _ahead: deque[Frame] = field(default_factory=deque)  # frames read before they were asked for
    _read: int = 0
    _at: float | None = None  # s, of the last frame
    _skipped: int = 0  # frames that the timestamps miss

    @classmethod
    def open(cls, capture: Capture) -> Stream:
        """Open the capture's video or camera; ``FileError`` or ``RangingError`` where it cannot be."""
        import cv2

        if capture.video is not None:
            opened = open_video(capture.video)
            announced = int(opened.get(cv2.CAP_PROP_FRAME_COUNT))
            pair = 2 if capture.background_mode == "alternate" else 1
            return cls(capture, opened, capture.video.name, announced // pair if announced > 0 else None)
        opened = cv2.VideoCapture(capture.camera or 0)
        if not opened.isOpened():
            raise RangingError(
                f"{capture.path}: camera {capture.camera} does not answer; check the cable, the index and that no other program "
                "uses it"
            )
        return cls(capture, opened, f"camera {capture.camera}", capture.frames)

    @property
    def endless(self) -> bool:
        """Whether this is a camera of which no number of frames was asked."""
        return self.capture.video is None and self.count is None

    def first(self, count: int) -> list[Frame]:
        """The first frames: a stream cannot be wound back, so they are kept for `loaders`."""
        _fill(self._ahead, self._next, count)
        return list(self._ahead)

    def loaders(self, first: int) -> Iterator[Callable[[], Frame | None]]:
        """Loaders of frames that were read here, in order; a stream ends with its last frame."""
        given = 0
        try:
            while self.count is None or given < self.count:
                frame = self._ahead.popleft() if self._ahead else self._next()
                if frame is None:
                    if self.count is not None:
                        self.trouble = f"{self.name} ended after {given} of {self.count} frames"
                    elif self.endless:
                        self.trouble = f"{self.name} stopped after {given} frames"
                    return
                if given >= first:
                    yield lambda frame=frame: frame  # type: ignore[misc]
                given += 1
        finally:
            self.opened.release()

    def _next(self) -> Frame | None:
        import cv2

        done, image = self.opened.read()
        if not done:
            return None
        at = float(self.opened.get(cv2.CAP_PROP_POS_MSEC)) * 1e-3 if self.capture.video is not None else None
        dark = None
        if self.capture.background_mode == "alternate":
            done, dark = self.opened.read()
            if not done:
                return None
        k, self._read = self._read, self._read + 1
        if at is not None:
            self._compare(k, at)
        return Frame(k, f"{self.name} frame {k}", image, dark, at)

    def _compare(self, k: int, at: float) -> None:
        """Notice frames that a recorder dropped: with `step`, every frame after them would be misplaced."""
        import cv2

        rate = float(self.opened.get(cv2.CAP_PROP_FPS)) / (2 if self.capture.background_mode == "alternate" else 1)
        missing = round((at - self._at) * rate) - 1 if self._at is not None and 0.1 < rate < 1e5 else 0
        self._at = at
        if missing > 0 and self.capture.by_step:
            self._skipped += missing
            self.trouble = (
                f"{self.name}: by its timestamps {self._skipped} frames were dropped before frame {k} and with `step` what "
                "follows is misplaced; list `positions`"
            )


@dataclass(slots=True, eq=False)
class Iterated:
    """Frames in memory, or as they come from anywhere: an iterable of images, or of (image, laser-off image)."""

    images: Iterator[Image | tuple[Image, Image]]
    count: int | None = None
    trouble: str = ""
    endless: bool = False
    _ahead: deque[Frame] = field(default_factory=deque)
    _read: int = 0

    @classmethod
    def of(cls, images: Iterable[Image | tuple[Image, Image]]) -> Iterated:
        """Source of any iterable; its length is known where it has one."""
        return cls(iter(images), len(images) if isinstance(images, Sized) else None)

    def first(self, count: int) -> list[Frame]:
        """The first frames, kept for `loaders`."""
        _fill(self._ahead, self._next, count)
        return list(self._ahead)

    def loaders(self, first: int) -> Iterator[Callable[[], Frame | None]]:
        """The frames as they come."""
        while (frame := self._ahead.popleft() if self._ahead else self._next()) is not None:
            if frame.number >= first:
                yield lambda frame=frame: frame  # type: ignore[misc]

    def _next(self) -> Frame | None:
        given = next(self.images, None)
        if given is None:
            return None
        image, dark = given if isinstance(given, tuple) else (given, None)
        k, self._read = self._read, self._read + 1
        return Frame(k, f"frame {k}", image, dark)


def _fill(ahead: deque[Frame], read: Callable[[], Frame | None], count: int) -> None:
    """Read frames ahead until there are ``count``, or as many as may be held."""
    while len(ahead) < min(count, frames_in_memory(ahead[0].image if ahead else None, count)):
        frame = read()
        if frame is None:
            return
        ahead.append(frame)


def open_video(path: Path) -> Any:
    """Opened ``cv2.VideoCapture`` of a video file; ``FileError`` where it cannot be decoded."""
    import cv2

    opened = cv2.VideoCapture(str(path), _decoder())
    if not opened.isOpened():
        raise FileError(f"{path}: is no video that can be decoded; record it again or give images")
    return opened


def _decoder() -> int:
    """FFmpeg where OpenCV has it: the decoders that are tried after it print what they do not understand."""
    import cv2

    known = cv2.videoio_registry.getStreamBackends()
    return int(cv2.CAP_FFMPEG if cv2.CAP_FFMPEG in known else cv2.CAP_ANY)


def open_source(capture: Capture) -> Source:
    """Where the frames of a capture come from."""
    return Folder(capture) if capture.images else Stream.open(capture)


def frames_in_memory(image: Image | None, most: int) -> int:
    """How many frames like this one are held at once: ``most`` of them, fewer of large ones."""
    return most if image is None else max(4, min(most, HELD // max(1, image.nbytes)))


def in_order(source: Source, work: Callable[[Frame], T], *, first: int = 0, ahead: int = AHEAD) -> Iterator[T]:
    """Results of ``work`` on every frame, in order; loading and work run ahead in threads, few frames are held."""
    with ThreadPoolExecutor(max_workers=own_threads(THREADS)) as pool:
        waiting: deque[Future[T | None]] = deque()

        def job(load: Callable[[], Frame | None]) -> T | None:
            frame = load()
            return None if frame is None else work(frame)

        try:
            for load in source.loaders(first):
                waiting.append(pool.submit(job, load))
                if len(waiting) >= ahead:
                    result = waiting.popleft().result()
                    if result is not None:
                        yield result
            while waiting:
                result = waiting.popleft().result()
                if result is not None:
                    yield result
        finally:
            for future in waiting:
                future.cancel()
