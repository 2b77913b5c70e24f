"""How a capture, or frames in memory, and a rig fit: all that stays the same from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

from calibration.errors import FileError
from calibration.geometry import Array
from calibration.rig import Rig
from calibration.sheet import Laser
from ranging.background import Channel, Image, saturation_level
from ranging.motion import Motion
from ranging.stripe import StripeOptions
from scope.scanning.options import ScanOptions
from scope.scanning.table import Table
from scope.session import shape_text


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """What a capture file, or a caller with frames in memory, says of the frames."""

    owner: str  # the capture file, for messages
    motion: Motion
    lasers: tuple[Laser, ...]
    channel: Channel = "auto"
    laser_off: bool = False  # laser-off images are subtracted: one mean for all frames, or one with each frame
    background: tuple[Image, ...] = ()  # laser-off images whose mean serves all frames
    in_turn: bool = False  # lasers take turns from frame to frame; else they shine together
    table: Table | None = None  # how the markers of a table move, where the motion is theirs


@dataclass(frozen=True, slots=True, eq=False)
class ScanSetup:
    """What turns frames into points."""

    owner: str  # the capture file, for messages
    rig: Rig
    options: ScanOptions
    motion: Motion
    lasers: tuple[Laser, ...]
    channels: tuple[Channel, ...]  # of each laser
    darks: tuple[Image | None, ...]  # mean laser-off image in each laser's channel
    in_turn: bool
    stripe: StripeOptions  # with the noise of the camera, where some frames have told it
    centre: Array  # (3,) mm, camera centre in C
    like: Image | None  # with whose depth and channels all frames must agree; None before any has come
    table: Table | None = None  # how the markers of a table move, where the motion is theirs
    origin: tuple[str, ...] = ()  # who scans, when, and of which files

    def saturation(self, image: Image) -> float:
        """Grey level at which the camera of an image clips."""
        known = self.stripe.saturation
        return float(saturation_level(image.dtype) if known is None else known)

    def require_alike(self, image: Image, name: str) -> None:
        """Refuse with ``FileError`` a frame of another size, depth or number of channels than the rig's or the first's."""
        require_size(image, self.rig, f"{self.owner}: {name}")
        if self.like is not None and (image.dtype != self.like.dtype or image.ndim != self.like.ndim):
            raise FileError(
                f"{self.owner}: {name}: {shape_text(image)}, others have {shape_text(self.like)}; all frames of "
                "a scan must agree: take them with the same settings"
            )


def require_size(image: Image, rig: Rig, whose: str) -> None:
    """Refuse with ``FileError`` an image of another size than the rig was calibrated at."""
    width, height = rig.camera.size
    if image.shape[:2] != (height, width):
        raise FileError(
            f"{whose}: {shape_text(image)}; the rig was calibrated at {width} x {height} px: use the camera "
            "settings of the calibration, or the rig of this camera"
        )
