"""Camera images to the light of the laser: channel, laser-off images, noise of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ranging.errors import RangingError

Channel = Literal["auto", "red", "green", "blue", "gray", "red-excess", "green-excess", "blue-excess"]
Image = NDArray[Any]  # (rows, columns) or (rows, columns, channels), uint8 or uint16

_PLACE = {"blue": 0, "green": 1, "red": 2}
_LIT = 12  # of 255: a scene whose other colours are brighter than this at their 90th percentile is a lit one


@dataclass(frozen=True, slots=True)
class Noise:
    """Photon transfer of a camera: the variance of a pixel of value I is I / gain_e + read_noise^2 + 1/12."""

    gain_e: float  # electrons a grey level
    read_noise: float  # grey levels, one standard deviation, without rounding


def check_image(image: Image) -> None:
    """Refuse with ``RangingError`` what is not a gray, BGR or BGRA image of uint8 or uint16."""
    if image.dtype not in (np.uint8, np.uint16):
        raise RangingError(
            f"an image of {image.dtype}; stripes are read from 8- or 16-bit unsigned images: save it as PNG or TIFF of that depth"
        )
    if not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (1, 3, 4))):
        raise RangingError(
            f"an image of shape {image.shape}; one channel, or three or four (BGR, BGRA) are read: convert it first"
        )
    if min(image.shape[:2]) < 8:
        raise RangingError(f"an image of {image.shape[1]} x {image.shape[0]} px; at least 8 x 8 are needed")


def to_gray(image: Image, channel: Channel) -> Image:
    """Take the channel in which the stripe is read, as a contiguous 2-D image of the same depth.

    Parameters
    ----------
    image : (rows, columns) or (rows, columns, 1 | 3 | 4) uint8 or uint16
        As OpenCV reads it unchanged: gray, BGR or BGRA.
    channel : Channel
        A colour, "gray" (ITU-R BT.601 luma), or a colour's excess over the mean of the other two, clamped at 0: the line
        without the scene's white light. "auto" resolves by `choose_channel` on this image alone: resolve it once a capture.

    Raises
    ------
    RangingError
        For another depth or number of channels.
    """
    import cv2

    check_image(image)
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    if channel == "auto":
        channel = choose_channel([image], "auto")
    if channel == "gray":
        return np.asarray(cv2.cvtColor(image[:, :, :3], cv2.COLOR_BGR2GRAY))
    colour, _, excess = channel.partition("-")
    if colour not in _PLACE or excess not in ("", "excess"):
        raise ValueError(f"channel {channel!r}: one of auto, gray, red, green, blue, or a colour and -excess")
    own = cv2.extractChannel(image, _PLACE[colour])
    if not excess:
        return np.asarray(own)
    first, second = (cv2.extractChannel(image, place) for name, place in _PLACE.items() if name != colour)
    return np.asarray(cv2.subtract(own, cv2.addWeighted(first, 0.5, second, 0.5, 0.0)))


def choose_channel(images: Sequence[Image], channel: Channel = "auto", *, laser_off: bool = False) -> Channel:
    """Choose the channel to read a whole capture in.

    Parameters
    ----------
    images : sequence of images
        A few frames with the laser on.
    channel : Channel
        What the user asked for. "auto" takes the colour that stands out most: the one with the greatest median, over
        rows and columns, of the highest excess over the other two. A plain colour is replaced by its excess where the
        other colours show that the scene is lit, since white paper is otherwise as bright as the line.
    laser_off : bool
        A laser-off image will be subtracted; the plain colour is then best, and never replaced.
    """
    for image in images:
        check_image(image)
    coloured = [image[:, :, :3] for image in images if image.ndim == 3 and image.shape[2] >= 3]
    if not coloured:
        return "gray"
    if channel == "gray" or channel.endswith("-excess"):
        return channel
    if channel == "auto":
        strength = {name: float(np.mean([_stands_out(image, name) for image in coloured])) for name in _PLACE}
        best = max(strength, key=lambda name: strength[name])
        if strength[best] < 0.02:
            return "gray"
        channel = best  # type: ignore[assignment]
    if laser_off:
        return channel
    others = [place for name, place in _PLACE.items() if name != channel]
    ambient = max(
        float(np.percentile(image[::8, ::8, others], 90)) / (np.iinfo(image.dtype).max / 255.0) for image in coloured
    )
    return f"{channel}-excess" if ambient > _LIT else channel  # type: ignore[return-value]


def _stands_out(image: Image, colour: str) -> float:
    """Median over the rows of the highest excess of a colour, as a share of full scale."""
    excess = to_gray(image, f"{colour}-excess")  # type: ignore[arg-type]
    top = max(np.percentile(excess.max(axis=1), 75), np.percentile(excess.max(axis=0), 75))
    return float(top - np.median(excess)) / float(np.iinfo(image.dtype).max)


def mean_image(images: Sequence[Image]) -> Image:
    """Mean of laser-off images of one size and depth, rounded to that depth."""
    if not images:
        raise ValueError("at least one image")
    total = np.zeros(images[0].shape, dtype=np.uint32)
    for image in images:
        if image.shape != images[0].shape or image.dtype != images[0].dtype:
            raise RangingError(
                f"laser-off images of {images[0].shape} {images[0].dtype} and {image.shape} {image.dtype} are mixed; "
                "one size and depth is needed: take them with the settings of the scan"
            )
        total += image
    return np.asarray((total + len(images) // 2) // len(images), dtype=images[0].dtype)


def saturation_level(dtype: Any) -> int:
    """Return the value at which a camera clips, as far as the depth tells."""
    return int(np.iinfo(dtype).max)


def clipping_level(images: Sequence[Image]) -> int:
    """Value at which a camera clips, where images of 16 bits show that it has fewer: 10, 12 or 14, low or high in the word.

    Clipped pixels are many and of one value, with few just below it. Where none are, the end of the depth is returned.
    """
    level = saturation_level(images[0].dtype)
    top = max(int(image.max()) for image in images)
    if level == 255 or top not in {((1 << bits) - 1) << shift for bits in (10, 12, 14) for shift in (0, 16 - bits)}:
        return level
    clipped = sum(int(np.count_nonzero(image == top)) for image in images)
    close = sum(int(np.count_nonzero(image >= top - top // 64)) for image in images) - clipped
    return top if clipped >= 16 and clipped > 2 * close else level


def typical_noise(level: float) -> Noise:
    """Assume a camera that clips at a ``level`` of 9,000 electrons, with 40 electrons of read noise: where nothing better is known."""
    return Noise(gain_e=9000.0 / level, read_noise=1.2 * min(level / 255.0, 4.0))
