"""What the drivers of GenICam cameras share: numbers of frames that wrap around, and settings by the names of nodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from scope.cameras.camera import CameraInfo, Setting
from scope.errors import CameraError
from scope.session import CameraSettings

BUFFERS = 24  # of one frame each, that the library fills while we work

_WRAP = 65535  # GigE Vision 1.x counts blocks from 1 to 65535 and then from 1 again; 0 is never used


@dataclass(slots=True)
class FrameIds:
    """Numbers from 0 of frames by the ids that a camera gives them, and how many are missing between."""

    count: int = 0  # frames so far
    missing: int = 0  # ids that never came
    _last: int = 0
    _number: int = -1
    _began: float = 0.0

    def next(self, identity: int, seconds: float) -> tuple[int, float]:
        """Number from 0, and time from the first frame, s, of the next frame."""
        if self.count == 0:
            self._began, gap = seconds, 1
        else:
            gap = identity - self._last
            if gap <= 0 and self._last <= _WRAP:
                gap += _WRAP
            if gap <= 0:
                gap = 1  # the camera counts anew
        self.missing += gap - 1
        self.count, self._last, self._number = self.count + 1, identity, self._number + gap
        return self._number, seconds - self._began


def laser_nodes(line: str | None, *, on: bool) -> list[tuple[str, str | bool]]:
    """Nodes to set, in order, so that an output line is on or off.

    Source: GenICam Standard Features Naming Convention 2.7, Digital I/O Control.
    """
    if line is None:
        return []
    return [
        ("LineSelector", line),
        ("LineMode", "Output"),
        ("LineSource", "UserOutput1"),
        ("UserOutputSelector", "UserOutput1"),
        ("UserOutputValue", on),
    ]


class LiveCamera:
    """What all cameras share that run free and number their frames."""

    _asked: CameraSettings
    _info: CameraInfo
    _ids: FrameIds

    @property
    def info(self) -> CameraInfo:
        """Driver, id, model and size."""
        return self._info

    @property
    def dropped(self) -> int:
        """By the numbers of the frames, and those that came in part."""
        return self._ids.missing

    @property
    def waits(self) -> bool:
        """A camera does not wait."""
        return False

    @property
    def switches_laser(self) -> bool:
        """Where a line was named."""
        return self._asked.laser is not None

    def _silent(self) -> CameraError:
        return CameraError(
            f"{self._asked.name}: gave no frame for {self._asked.timeout_s:g} s; check cable, power and trigger"
        )

    def _failed(self, error: Exception) -> CameraError:
        return CameraError(
            f"{self._asked.name}: {self._told(error)}; check cable and power, and that no other program uses it"
        )

    @staticmethod
    def _told(error: Exception) -> str:
        return " ".join(str(error).split())[:160] or type(error).__name__


class NodeCamera(LiveCamera):
    """What drivers share that read and write a camera's nodes; a driver says how, by `_find`, `_get` and `_put`."""

    _NODES: ClassVar[Mapping[str, tuple[str, ...]]] = {  # by setting: the names that generations of cameras give it
        "exposure_us": ("ExposureTime", "ExposureTimeAbs"),
        "gain": ("Gain", "GainAbs"),
        "rate": ("AcquisitionFrameRate", "AcquisitionFrameRateAbs"),
        "pixel_format": ("PixelFormat",),
    }

    def _find(self, name: str) -> Any:
        """Node of a name; None where the camera has none."""
        raise NotImplementedError

    def _get(self, node: Any) -> Any:
        raise NotImplementedError

    def _put(self, node: Any, value: float | str | bool) -> None:
        """Write a node; whatever the library raises."""
        raise NotImplementedError

    @property
    def settings(self) -> Mapping[str, Setting]:
        """As the camera tells them; what it does not tell is None."""
        told: dict[str, Setting] = {}
        for setting, names in self._NODES.items():
            node = self._first(names)
            value = None if node is None else self._get(node)
            told[setting] = value if value is None or isinstance(value, str) else float(value)
        return {**told, "trigger": self._asked.trigger}

    def set(self, name: str, value: float) -> None:
        """Set "exposure_us" or "gain"."""
        self._write(self._NODES[name], float(value))

    def switch_laser(self, on: bool) -> None:
        """By the output line of the settings."""
        for name, value in laser_nodes(self._asked.laser, on=on):
            self._write((name,), value)

    def _apply(self) -> None:
        """Set what was asked for."""
        asked = self._asked
        for setting in ("pixel_format", "exposure_us", "gain"):
            if (value := getattr(asked, setting)) is not None:
                self._write(self._NODES[setting], value)
        if asked.trigger is not None:
            for name, text in (
                ("TriggerSelector", "FrameStart"),
                ("TriggerSource", asked.trigger),
                ("TriggerMode", "On"),
            ):
                self._write((name,), text)
        elif asked.rate is not None:
            enable = self._find("AcquisitionFrameRateEnable")
            if enable is not None:
                self._put(enable, True)
            self._write(self._NODES["rate"], asked.rate)

    def _first(self, names: tuple[str, ...]) -> Any:
        return next((node for name in names if (node := self._find(name)) is not None), None)

    def _write(self, names: tuple[str, ...], value: float | str | bool) -> None:
        node = self._first(names)
        if node is None:
            raise CameraError(f"{self._asked.name}: has no {names[0]}; leave it out")
        try:
            self._put(node, value)
        except Exception as error:  # whatever a producer throws
            raise CameraError(f"{self._asked.name}: refuses {names[0]} = {value}: {self._told(error)}") from error
