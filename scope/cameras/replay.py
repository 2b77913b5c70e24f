"""Driver `replay`: a folder of images, a glob or a video, as a camera: for demonstrations and support cases."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path

from calibration.errors import FileError
from ranging.background import Image
from scope.cameras.camera import CameraInfo, Setting, Shot
from scope.session import ENDINGS, CameraSettings, image_files, open_video, read_image


class ReplayCamera:
    """Files as frames, in natural order; with ``rate`` at that pace by the clock, without as fast as they are read.

    Parameters
    ----------
    settings : CameraSettings
        ``id`` is a folder, a glob or a video.
    again : bool
        Whether to begin anew after the last frame, as a live view does.

    Raises
    ------
    FileError
        Nothing there, or no image and no video.
    """

    def __init__(self, settings: CameraSettings, *, again: bool = False) -> None:
        self._asked, self._again = settings, again
        self._files, self._video = _found(Path(settings.id))
        first = next(self._images(), None)
        if first is None:
            raise FileError(f"{settings.id}: no frame in it; record it again or give a folder of images")
        height, width = first[1].shape[:2]
        self._info = CameraInfo("replay", settings.id, Path(settings.id).name, (width, height))
        self.start()

    @property
    def info(self) -> CameraInfo:
        """Driver, id, model and size."""
        return self._info

    @property
    def settings(self) -> Mapping[str, Setting]:
        """Rate only: the rest was set when the frames were taken."""
        return {"rate": self._asked.rate}

    @property
    def dropped(self) -> int:
        """None is."""
        return 0

    @property
    def waits(self) -> bool:
        """Files wait."""
        return True

    @property
    def switches_laser(self) -> bool:
        """Recorded frames show what they show."""
        return False

    def start(self) -> None:
        """From the first frame."""
        self._coming, self._number, self._began = self._images(), 0, time.monotonic()

    def read(self) -> Shot | None:
        """Next image; with ``rate``, not before its time. ``FileError`` for a file that cannot be read."""
        given = next(self._coming, None)
        if given is None and self._again:
            self._coming = self._images()
            given = next(self._coming, None)
        if given is None:
            return None
        name, image = given
        number, self._number = self._number, self._number + 1
        at = number / (self._asked.rate or 25.0)
        if self._asked.rate is not None:
            time.sleep(max(0.0, self._began + at - time.monotonic()))
        return Shot(image, number, at, name)

    def skip(self, count: int) -> None:
        """Go on behind the next ``count`` frames."""
        passed = sum(1 for _ in islice(self._coming, count))
        self._number += passed
        self._began -= passed / (self._asked.rate or 25.0)

    def set(self, name: str, value: float) -> None:
        """Nothing can be set on what was recorded."""

    def switch_laser(self, on: bool) -> None:
        """Nothing happens."""

    def close(self) -> None:
        """Let go of the video."""
        self._coming = iter(())

    def _images(self) -> Iterator[tuple[str, Image]]:
        if self._video is None:
            yield from ((file.name, read_image(file)) for file in self._files)
            return
        opened = open_video(self._video)
        try:
            k = 0
            while (told := opened.read())[0]:
                yield f"{self._video.name} frame {k}", told[1]
                k += 1
        finally:
            opened.release()


def _found(place: Path) -> tuple[list[Path], Path | None]:
    """Image files, or the video."""
    if place.is_file() and place.suffix.lower() not in ENDINGS:
        return [], place
    return image_files(place), None
