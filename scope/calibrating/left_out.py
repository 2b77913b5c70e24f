"""What a calibration did without, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from calibration.geometry import Array
from ranging.background import Image

Part = Literal["view", "laser", "mark"]
_WIDTH = 480  # px of a picture that is kept


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """A view, the laser image of a view or marks of a view that were not used."""

    part: Part
    name: str  # of the view
    reason: str
    count: int = 1
    laser: str = ""  # whose image it is
    image: Image | None = None  # a small picture of it
    pixels: Array | None = None  # (n, 2) px of that picture: the light that was found

    @property
    def content(self) -> dict[str, Any]:
        """One entry of `dropped` in --json."""
        told: dict[str, Any] = {"part": self.part, "name": self.name, "reason": self.reason, "count": self.count}
        return {**told, "laser": self.laser} if self.laser else told


def small(image: Image) -> tuple[Image, float]:
    """Picture of at most 480 px width, and its scale."""
    import cv2

    scale = min(1.0, _WIDTH / image.shape[1])
    if scale == 1.0:
        return image, 1.0
    size = (round(image.shape[1] * scale), max(round(image.shape[0] * scale), 1))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)), scale
