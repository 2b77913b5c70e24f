"""An image as detectors like it: eight bits, other scales, other contrasts; and corners refined in it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array

_LARGE = 2600  # px, of the longer side: such images are not enlarged


def eight_bit(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Stretch an image to the 8 bits that the detectors take; the darkest and brightest thousandth may clip."""
    grey = np.asarray(image)
    if grey.ndim != 2 or not grey.size:
        raise ValueError(f"an image is (H, W), one channel; found shape {grey.shape}")
    if grey.dtype == np.uint8:
        return np.ascontiguousarray(grey)
    low, high = np.percentile(grey[:: max(1, grey.shape[0] // 512), :: max(1, grey.shape[1] // 512)], [0.1, 99.9])
    scaled = (grey.astype(np.float64) - low) * (255.0 / max(high - low, 1e-9))
    return np.asarray(np.clip(np.round(scaled), 0, 255), dtype=np.uint8)


def magnified(grey: NDArray[np.uint8], scale: float) -> NDArray[np.uint8]:
    """Image at another scale: pixel (u, v) of it shows ((u, v) + 0.5) / scale - 0.5 of the original."""
    import cv2

    way = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=way), dtype=np.uint8)


def looks(grey: NDArray[np.uint8]) -> Iterator[tuple[NDArray[np.uint8], float]]:
    """The image, then other looks of it with their scale: blurred, twice as large, half as large, evened out, dark parts lifted."""
    import cv2

    yield grey, 1.0
    yield np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.2), dtype=np.uint8), 1.0
    if max(grey.shape) <= _LARGE:
        yield magnified(grey, 2.0), 2.0
    if min(grey.shape) >= 240:
        yield magnified(grey, 0.5), 0.5
    yield np.asarray(cv2.createCLAHE(3.0, (8, 8)).apply(grey), dtype=np.uint8), 1.0
    yield np.asarray(np.rint(255.0 * np.sqrt(grey / 255.0)), dtype=np.uint8), 1.0


def refined(grey: NDArray[np.uint8], corners: Array, spacing: float) -> Array:
    """Corners moved to where the gradients of their surroundings, a third of a square, point."""
    import cv2

    half = int(np.clip(spacing / 3.0, 2, 12))
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    moved = cv2.cornerSubPix(grey, corners.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), until)
    moved = np.asarray(moved, dtype=np.float64).reshape(-1, 2)
    # where the surroundings mislead, by glare or an edge of the board, the detector's own answer stands
    return np.where(np.linalg.norm(moved - corners, axis=1, keepdims=True) < 1.0, moved, corners)
