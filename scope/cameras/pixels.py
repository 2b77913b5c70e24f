"""Bytes of a camera's buffer to an image: the pixel formats of GenICam that a scanner meets.

Source: EMVA, GenICam Pixel Format Naming Convention 2.1 (names and 32-bit values).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ranging.background import Image
from scope.errors import CameraError

# value: (name, bits of a pixel in memory, pattern of colour filters or "")
FORMATS = {
    0x01080001: ("Mono8", 8, ""),
    0x01100003: ("Mono10", 16, ""),
    0x01100005: ("Mono12", 16, ""),
    0x01100025: ("Mono14", 16, ""),
    0x01100007: ("Mono16", 16, ""),
    0x010C0047: ("Mono12p", 12, ""),
    0x01080008: ("BayerGR8", 8, "GR"),
    0x01080009: ("BayerRG8", 8, "RG"),
    0x0108000A: ("BayerGB8", 8, "GB"),
    0x0108000B: ("BayerBG8", 8, "BG"),
    0x01100010: ("BayerGR12", 16, "GR"),
    0x01100011: ("BayerRG12", 16, "RG"),
    0x01100012: ("BayerGB12", 16, "GB"),
    0x01100013: ("BayerBG12", 16, "BG"),
    0x02180014: ("RGB8", 24, "RGB"),
    0x02180015: ("BGR8", 24, "BGR"),
}
_VALUES = {name: value for value, (name, _, _) in FORMATS.items()}


def image_of(data: NDArray[np.uint8], width: int, height: int, pixel_format: int | str, whose: str) -> Image:
    """Image (height, width) or (height, width, 3) BGR of a buffer (n,) of bytes; a copy.

    Raises
    ------
    CameraError
        A format that is not known here, or fewer bytes than the image has.
    """
    value = _VALUES.get(pixel_format, 0) if isinstance(pixel_format, str) else pixel_format
    if value not in FORMATS:
        told = pixel_format if isinstance(pixel_format, str) else f"0x{pixel_format:08X}"
        raise CameraError(
            f"{whose}: gives pixels in the format {told}, which is not read; set pixel_format to one of "
            f"{', '.join(name for name, _, _ in FORMATS.values())}"
        )
    _, bits, pattern = FORMATS[value]
    needed = -(-width * height * bits // 8)
    if width < 1 or height < 1 or len(data) < needed:
        raise CameraError(
            f"{whose}: a buffer of {len(data)} bytes for {width} x {height} px of {bits} bit; take it again"
        )
    data = data[:needed]
    if bits == 24:
        colour = data.reshape(height, width, 3)
        return np.ascontiguousarray(colour if pattern == "BGR" else colour[:, :, ::-1])
    if bits == 12:
        return _unpacked(data, width * height).reshape(height, width)
    image = data.view("<u2" if bits == 16 else np.uint8).reshape(height, width)
    return image.copy() if not pattern else _demosaiced(image, pattern)


def _unpacked(data: NDArray[np.uint8], count: int) -> NDArray[np.uint16]:
    """Mono12p: two pixels in three bytes, the lower bits first."""
    padded = np.zeros(-(-count // 2) * 3, dtype=np.uint16)
    padded[: len(data)] = data
    a, b, c = padded.reshape(-1, 3).T
    return np.stack([a | (b & 0x0F) << 8, b >> 4 | c << 4], axis=1).astype(np.uint16).ravel()[:count]


def _demosaiced(image: Image, pattern: str) -> Image:
    """Colours (rows, columns, 3) BGR by bilinear interpolation of the filters, which ``pattern`` names from the corner."""
    import cv2

    # OpenCV names a pattern by its second row and column
    code = {
        "RG": cv2.COLOR_BayerBG2BGR,
        "GR": cv2.COLOR_BayerGB2BGR,
        "BG": cv2.COLOR_BayerRG2BGR,
        "GB": cv2.COLOR_BayerGR2BGR,
    }
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), code[pattern]))
