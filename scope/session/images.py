"""Images from files, videos and cameras, one at a time and in order."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.atomic import beside
from calibration.errors import FileError
from calibration.geometry import Array
from ranging.background import Image
from scope.session.toml_file import matching, natural_key

_MOST_PIXELS = 200_000_000


@dataclass(frozen=True, slots=True, eq=False)
class ImageInMemory:
    """An image that is there already, under a name for messages.

    Raises
    ------
    ValueError
        Pixels that are not (rows, columns) or (rows, columns, 3) of uint8 or uint16.
    """

    name: str
    pixels: Image

    def __post_init__(self) -> None:
        image = np.asarray(self.pixels)
        grey_or_colour = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        if image.dtype not in (np.uint8, np.uint16) or not grey_or_colour or image.size == 0:
            raise ValueError(
                f"{self.name} must be (rows, columns) or (rows, columns, 3) of uint8 or uint16; it is {image.shape} of "
                f"{image.dtype}"
            )
        object.__setattr__(self, "pixels", image)

    def __str__(self) -> str:
        """The name, as a path would be told."""
        return self.name


Stored = Path | ImageInMemory  # where an image is


def read_image(path: Stored) -> Image:
    """Read an image as it is stored: grey or BGR, 8 or 16 bits; one in memory as it is.

    An alpha channel is dropped, a palette is applied, one-channel colour becomes grey. ``FileError`` for a file that is
    missing, empty, truncated or no image, and for pixels that are not 8- or 16-bit unsigned.
    """
    import cv2

    if isinstance(path, ImageInMemory):
        return path.pixels
    try:
        size = path.stat().st_size
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if size == 0:
        raise FileError(f"{path}: is empty (0 bytes); take the image again")
    if _truncated(data):  # asked first: decoders print what they miss
        raise FileError(f"{path}: is truncated ({size} bytes, its end is missing); take or copy it again")
    if (chunk := _damaged_chunk(data)) is not None:
        raise FileError(f"{path}: is damaged: its {chunk} chunk fails its checksum; take or copy it again")
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise FileError(f"{path}: is no image that can be decoded ({size} bytes; truncated?); take or copy it again")
    if image.size > 4 * _MOST_PIXELS:
        raise FileError(f"{path}: {image.shape[1]} x {image.shape[0]} px; at most {_MOST_PIXELS} pixels are read")
    if image.dtype not in (np.uint8, np.uint16):
        raise FileError(f"{path}: its pixels are {image.dtype}; 8- or 16-bit unsigned are needed: convert it")
    if image.ndim == 3 and image.shape[2] == 4:
        image = image[:, :, :3]
    if image.ndim == 3 and image.shape[2] not in (1, 3):
        raise FileError(f"{path}: has {image.shape[2]} channels; 1, 3 or 4 are needed: convert it")
    return np.ascontiguousarray(image[:, :, 0] if image.ndim == 3 and image.shape[2] == 1 else image)


ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".webp")


def image_files(place: Path) -> list[Path]:
    """Images of a folder, or files of a glob, in natural order; ``FileError`` where there is none."""
    if place.is_dir():
        found = [path for path in place.iterdir() if path.is_file() and path.suffix.lower() in ENDINGS]
        if not found:
            raise FileError(f"{place}: holds no image; give the folder of the frames")
        return sorted(found, key=lambda path: natural_key(path.name))
    return matching(place.parent, place.name, owner=place, key="files")


def _truncated(data: NDArray[np.uint8]) -> bool:
    """Whether a PNG or JPEG lacks its end: decoders fill the missing rows with grey and say nothing."""
    head, tail = data[:8].tobytes(), data[-64:].tobytes()
    if head == b"\x89PNG\r\n\x1a\n":
        return b"IEND" not in tail
    if head[:3] == b"\xff\xd8\xff":
        return b"\xff\xd9" not in data[-4096:].tobytes()
    return False


def _damaged_chunk(data: NDArray[np.uint8]) -> str | None:
    """Name of the first chunk of a PNG that is not as it was written; None where all are, and for other formats.

    Decoders read some of such files without a word; PNG specification (ISO/IEC 15948), 5.3 and 5.5.
    """
    if data[:8].tobytes() != b"\x89PNG\r\n\x1a\n":
        return None
    view, at = memoryview(data.data), 8
    while at + 12 <= len(view):
        length, name = int.from_bytes(view[at : at + 4], "big"), bytes(view[at + 4 : at + 8])
        end = at + 8 + length
        if end + 4 > len(view) or zlib.crc32(view[at + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            return repr(name.decode("ascii", "replace"))
        if name == b"IEND":
            return None
        at = end + 4
    return "last"


def read_alike(paths: Sequence[Stored], what: str) -> list[Image]:
    """Images that must agree in size, depth and channels; ``FileError`` names the first that does not."""
    images: list[Image] = []
    for path in paths:
        image = read_image(path)
        if images and (image.shape != images[0].shape or image.dtype != images[0].dtype):
            raise FileError(
                f"{path}: {shape_text(image)}, but {paths[0].name} has {shape_text(images[0])}; all images of {what} must "
                "agree: take them with the same settings"
            )
        images.append(image)
    return images


def shape_text(image: Image) -> str:
    """Size, depth and channels in words."""
    colour = "colour" if image.ndim == 3 else "grey"
    return f"{image.shape[1]} x {image.shape[0]} px, {image.dtype.itemsize * 8} bit {colour}"


def gray(image: Image) -> Image:
    """Grey levels (rows, columns) of an image for finding marks: the mean of the colours, weighted as BT.601."""
    import cv2

    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def mean_gray(images: Sequence[Image]) -> Array | Image:
    """Mean grey levels (rows, columns) of repeats; a single image keeps its type."""
    if len(images) == 1:
        return gray(images[0])
    total = np.zeros(images[0].shape[:2], dtype=np.float32)
    for image in images:
        total += gray(image)
    return np.asarray(total / np.float32(len(images)))


def mean_image(images: Sequence[Image]) -> Image:
    """Mean of repeats as they are stored, rounded to twice their depth where that keeps what averaging gained.

    Repeats of 8 bits are scaled to 16 bits, so that the mean is not rounded to a grey level.
    """
    if len(images) == 1:
        return images[0]
    mean = np.mean([image.astype(np.float32) for image in images], axis=0)
    if images[0].dtype == np.uint8:
        return np.asarray(np.rint(mean * 257.0), dtype=np.uint16)
    return np.asarray(np.rint(mean), dtype=np.uint16)


def save_image(path: Path, image: Image) -> None:
    """Write a PNG whole, in a folder that is made where it is not there; ``FileError`` where it cannot be."""
    save_images([(path, image)])


def save_images(images: Sequence[tuple[Path, Image]]) -> None:
    """Write several PNG, which appear when all of them are on the disk; ``FileError``, and nothing new, where one cannot be."""
    import cv2

    with ExitStack() as stack:
        for path, image in images:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise FileError(f"{path.parent}: cannot be made ({error.strerror}); free space") from error
            done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            if not done:
                raise FileError(f"{path}: the image cannot be encoded")
            part = stack.enter_context(beside(path))
            part.write_bytes(data.tobytes())
