"""What a camera is: one protocol for all drivers, the frames that it gives, and what is told of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from ranging.background import Image

Setting = float | str | None


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """What `scope cameras` lists."""

    driver: str
    id: str
    model: str
    size: tuple[int, int] | None  # px, columns and rows; None: only an opened camera tells

    @property
    def result(self) -> dict[str, Any]:
        """What --json gives."""
        size = None if self.size is None else list(self.size)
        return {"driver": self.driver, "id": self.id, "model": self.model, "size": size}


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One frame as a camera gave it."""

    image: Image  # (rows, columns) or (rows, columns, 3) in the order blue, green, red
    number: int  # from 0, as the camera counts: where frames were lost, numbers are missing
    at: float  # s, by the clock of the camera, from its first frame
    name: str = ""  # of the file, where there is one
    background: Image | None = None  # the same with the laser off, where the camera took a pair
    stamp: float | None = None  # s, the same moment as the camera's clock has it (PTP: of the day); None: it has none


class Camera(Protocol):
    """An opened camera. Methods are called from one thread at a time."""

    @property
    def info(self) -> CameraInfo:
        """Driver, id, model and size."""
        ...

    @property
    def settings(self) -> Mapping[str, Setting]:
        """Exposure, gain, rate, pixel format and trigger as the camera has them now."""
        ...

    @property
    def dropped(self) -> int:
        """Frames that were exposed and never came, since `start`."""
        ...

    @property
    def waits(self) -> bool:
        """Whether a frame waits until it is read, so that a slow reader loses none."""
        ...

    @property
    def switches_laser(self) -> bool:
        """Whether `switch_laser` does anything."""
        ...

    def start(self) -> None:
        """Begin to take frames, numbered from 0."""
        ...

    def read(self) -> Shot | None:
        """Next frame; None where the camera has no more to give. ``CameraError`` where none comes in time."""
        ...

    def set(self, name: str, value: float) -> None:
        """Set "exposure_us" or "gain"; ``CameraError`` where the camera refuses."""
        ...

    def switch_laser(self, on: bool) -> None:
        """Switch the laser by the camera's line; nothing happens where there is none."""
        ...

    def close(self) -> None:
        """Stop and let go of the camera; may be called twice."""
        ...
