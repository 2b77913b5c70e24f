"""Driver `v4l2`: webcams and UVC cameras through OpenCV."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scope.cameras.camera import CameraInfo, Setting, Shot
from scope.errors import CameraError
from scope.session import CameraSettings

_MANUAL = 1  # V4L2_EXPOSURE_MANUAL, linux/v4l2-controls.h
_UNIT_US = 100.0  # of V4L2_CID_EXPOSURE_ABSOLUTE
_SYSTEM = Path("/sys/class/video4linux")


def v4l2_cameras() -> list[CameraInfo]:
    """Cameras that the kernel knows, the first node of each; sizes are told by opening one."""
    found = []
    for node in sorted(_SYSTEM.glob("video*"), key=lambda path: (len(path.name), path.name)):
        try:
            name, index = (node / "name").read_text(encoding="utf-8").strip(), (node / "index").read_text().strip()
        except OSError:
            continue
        if index == "0":  # the others carry metadata
            found.append(CameraInfo("v4l2", node.name.removeprefix("video"), name, None))
    return found


class V4l2Camera:
    """One camera by its number; frames are counted by their time stamps where a rate is asked for.

    UVC has no numbers of frames: what a camera drops shows only as a gap in time.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self._asked = settings
        self._opened = self._open()
        size = (int(self._get("FRAME_WIDTH")), int(self._get("FRAME_HEIGHT")))
        self._info = CameraInfo("v4l2", settings.id or "0", f"video{settings.id or 0}", size)
        self.start()

    def _open(self) -> Any:
        import cv2

        said = self._asked.id or "0"
        opened = cv2.VideoCapture(int(said) if said.isdigit() else said, cv2.CAP_V4L2)
        if not opened.isOpened():
            raise CameraError(
                f"{self._asked.name}: does not answer; check cable and number, and that no other program uses it"
            )
        return opened

    @property
    def info(self) -> CameraInfo:
        """Driver, id, model and size."""
        return self._info

    @property
    def settings(self) -> Mapping[str, Setting]:
        """As the driver tells them."""
        return {"exposure_us": self._get("EXPOSURE") * _UNIT_US, "gain": self._get("GAIN"), "rate": self._get("FPS")}

    @property
    def dropped(self) -> int:
        """By gaps in time."""
        return self._dropped

    @property
    def waits(self) -> bool:
        """A camera does not wait."""
        return False

    @property
    def switches_laser(self) -> bool:
        """UVC has no lines."""
        return False

    def start(self) -> None:
        """Apply the settings and count from 0."""
        asked = self._asked
        self._number, self._dropped = -1, 0
        self._first: float | None = None
        self._last: float | None = None
        if asked.rate is not None:
            self._set("FPS", asked.rate)
        for name in ("exposure_us", "gain"):
            if (value := getattr(asked, name)) is not None:
                self.set(name, value)

    def read(self) -> Shot | None:
        """Next frame; ``CameraError`` where the camera is gone."""
        done, image = self._opened.read()
        if not done:
            raise CameraError(f"{self._asked.name}: gave no frame; check the cable, and that no other program uses it")
        at = self._get("POS_MSEC") * 1e-3 or time.monotonic()
        gap = 1
        if self._last is not None and self._asked.rate is not None:
            gap = max(1, round((at - self._last) * self._asked.rate))
        if self._first is None:
            self._first = at
        self._last, self._number, self._dropped = at, self._number + gap, self._dropped + gap - 1
        return Shot(image, self._number, at - self._first)

    def set(self, name: str, value: float) -> None:
        """Set "exposure_us" or "gain"; ``CameraError`` where the driver refuses."""
        if name == "exposure_us":
            self._set("AUTO_EXPOSURE", _MANUAL)
        done = self._set("EXPOSURE", value / _UNIT_US) if name == "exposure_us" else self._set("GAIN", value)
        if not done:
            raise CameraError(f"{self._asked.name}: refuses {name} = {value:g}; leave it out and set it by v4l2-ctl")

    def switch_laser(self, on: bool) -> None:
        """Nothing happens."""

    def close(self) -> None:
        """Let go."""
        self._opened.release()

    def _get(self, name: str) -> float:
        import cv2

        return float(self._opened.get(getattr(cv2, f"CAP_PROP_{name}")))

    def _set(self, name: str, value: float) -> bool:
        import cv2

        return bool(self._opened.set(getattr(cv2, f"CAP_PROP_{name}"), value))
