"""Pictures of images with what was found on them."""

from __future__ import annotations

import cv2
import numpy as np

from calibration.geometry import Array, Bools
from ranging.background import Image
from scope.session import gray
from scope.viewer import Picture, colour_bgr

_GREEN, _RED, _YELLOW, _BLUE = (90, 200, 60), (60, 60, 230), (40, 200, 240), (230, 140, 40)


def backdrop(image: Image | Array, *, width: int = 900, gain: float = 1.0) -> tuple[Picture, float]:
    """8-bit BGR copy of an image, at most ``width`` px wide, and the scale from its pixels to the copy's."""
    grey = gray(image).astype(np.float32)
    top = max(float(np.percentile(grey, 99.8)), 1.0)
    shown = np.clip(grey / top * 255 * gain, 0, 255).astype(np.uint8)
    scale = min(1.0, width / shown.shape[1])
    if scale < 1.0:
        size = (round(shown.shape[1] * scale), round(shown.shape[0] * scale))
        shown = np.asarray(cv2.resize(shown, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return np.asarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR), dtype=np.uint8), scale


def with_marks(image: Image | Array, used: Array, rejected: list[tuple[float, float]], origin: int | None) -> Picture:
    """Image with the used marks in green, the rejected in red, and mark (0, 0) (row ``origin`` of ``used``) in yellow."""
    picture, scale = backdrop(image)
    for u, v in used:
        _cross(picture, (u, v), scale, _GREEN)
    for u, v in rejected:
        cv2.circle(picture, _at((u, v), scale), 7, _RED, 1, cv2.LINE_AA)
    if origin is not None:
        cv2.circle(picture, _at(used[origin], scale), 9, _YELLOW, 2, cv2.LINE_AA)
    return picture


def with_stripe(image: Image | Array, pixels: Array, *, crop: bool = False) -> Picture:
    """Image, brightened, with the stripe's positions as dots; cropped to the stripe on demand."""
    picture, scale = backdrop(image, gain=1.6)
    for u, v in pixels[np.isfinite(pixels).all(axis=1)]:
        cv2.circle(picture, _at((u, v), scale), 1, _GREEN, -1)
    if crop and len(pixels):
        return _cropped(picture, pixels * scale)
    return picture


def with_coverage(image: Image | Array, pixels: Array, covered: Bools) -> Picture:
    """Image, dark where blocks (R, C) are not covered, with the marks of all views and the line around them."""
    picture, scale = backdrop(image)
    light = cv2.resize(covered.astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
    shown = np.where(light[:, :, None], picture // 2 + 110, picture // 4).astype(np.uint8)
    for u, v in pixels:
        cv2.circle(shown, _at((u, v), scale), 1, _GREEN, -1)
    hull = cv2.convexHull(pixels.astype(np.float32))[:, 0]
    outline = np.array([_at((float(u), float(v)), scale) for u, v in hull], dtype=np.int32)
    cv2.polylines(shown, [outline], True, _YELLOW, 2, cv2.LINE_AA)
    return shown


def arrows(size: tuple[int, int], pixels: Array, vectors: Array, *, longest: float = 40.0) -> tuple[Picture, float]:
    """Signed arrows of vectors (n, 2) px at pixels on white, and how many times they are enlarged."""
    scale = min(1.0, 900 / size[0])
    picture = np.full((round(size[1] * scale), round(size[0] * scale), 3), 255, dtype=np.uint8)
    lengths = np.linalg.norm(vectors, axis=1)
    reach = float(np.percentile(lengths, 98)) if len(lengths) else 1.0
    gain = longest / max(reach * scale, 1e-12)
    for start, vector in zip(pixels, vectors, strict=True):
        cv2.arrowedLine(picture, _at(start, scale), _at(start + gain * vector, scale), _BLUE, 1, cv2.LINE_AA, 0, 0.3)
    return picture, gain


def grey_blocks(values: Array, *, high: float | None = None, enlarge: int = 1) -> Picture:
    """Grey image of values as the paper prints them: lighter is larger, NaN is blue-black."""
    top = float(np.nanmax(values)) if high is None and np.isfinite(values).any() else (high or 1.0)
    grey = np.clip(np.nan_to_num(values) / max(top, 1e-30) * 255, 0, 255).astype(np.uint8)
    picture = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    picture[~np.isfinite(values)] = (48, 24, 16)
    return np.kron(picture, np.ones((enlarge, enlarge, 1), dtype=np.uint8))


def heat(values: Array, *, enlarge: int = 1, low: float | None = None, high: float | None = None) -> Picture:
    """Colours of values (rows, columns)."""
    return np.kron(colour_bgr(values, low, high), np.ones((enlarge, enlarge, 1), dtype=np.uint8))


def _at(pixel: Array | tuple[float, float], scale: float) -> tuple[int, int]:
    return round(float(pixel[0]) * scale), round(float(pixel[1]) * scale)


def _cross(picture: Picture, pixel: tuple[float, float], scale: float, colour: tuple[int, int, int]) -> None:
    u, v = _at(pixel, scale)
    cv2.line(picture, (u - 3, v), (u + 3, v), colour, 1)
    cv2.line(picture, (u, v - 3), (u, v + 3), colour, 1)


def _cropped(picture: Picture, pixels: Array, margin: int = 40) -> Picture:
    low = np.maximum(np.nanmin(pixels, axis=0).astype(int) - margin, 0)
    high = np.nanmax(pixels, axis=0).astype(int) + margin
    return picture[low[1] : high[1], low[0] : high[0]]
