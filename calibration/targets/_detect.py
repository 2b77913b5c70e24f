"""From an image to the mask of what stands out of it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError


def clip_level(image: NDArray[np.generic]) -> float:
    """Grey level at which the image is clipped, or infinity where it is not.

    Cameras of 8, 10, 12, 14 or 16 bits clip at 2**bits - 1, which some shift to the top of a 16-bit word: the
    brightest level of the image counts as clipped where it is one of those.
    """
    brightest = float(image.max())
    bits = [8] if image.dtype == np.uint8 else [8, 10, 12, 14, 16]
    levels = [2**n - 1 for n in bits]
    if image.dtype != np.uint8:
        levels += [(2**n - 1) << (16 - n) for n in (10, 12, 14)]
    return next((level - 0.5 for level in levels if abs(brightest - level) < 0.5), np.inf)


def spot_mask(light: NDArray[np.float32], *, window: int | None = None) -> NDArray[np.uint8]:
    """Mask of the pixels above the grey level at which the edges of the image stand.

    The threshold is the mean grey level weighted by the gradient above its noise, over a window of a sixteenth of the
    image: half way up the edges that are near, whatever the illumination and the share of spots; where no edge is
    near, that of the whole image.

    Raises
    ------
    CalibrationError
        The image has no edge that stands out of its noise.
    """
    height, width = light.shape
    half = cv2.resize(light, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
    gradient = cv2.magnitude(
        cv2.Sobel(half, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(half, cv2.CV_32F, 0, 1, scale=0.125)
    )
    weight = np.maximum(gradient - 4.0 * float(np.median(gradient[::4, ::4])), 0.0)
    total = float(weight.sum())
    if not total > 0.0:
        raise CalibrationError(_nothing(light))
    window = max(31, min(height, width) // 16 | 1) if window is None else window
    # the two means are taken on pixels of 16 x 16, which costs nothing and is fine enough
    small = (max(half.shape[1] // 8, 1), max(half.shape[0] // 8, 1))
    coarse = cv2.resize(weight, small, interpolation=cv2.INTER_AREA)
    raised = cv2.resize(weight * half, small, interpolation=cv2.INTER_AREA)
    span = max(3, round(window / 8) | 1)
    share = 0.05 * float(coarse.mean())
    mean = (cv2.boxFilter(raised, -1, (span, span)) + share * float(raised.sum() / coarse.sum())) / (
        cv2.boxFilter(coarse, -1, (span, span)) + share
    )
    threshold = cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.compare(light, threshold, cv2.CMP_GT), dtype=np.uint8)


def _nothing(light: NDArray[np.float32]) -> str:
    """What is wrong with an image without any edge; levels of dark targets come with a minus."""
    low, high = sorted((abs(float(light.min())), abs(float(light.max()))))
    tops = tuple(float(2**bits - 1) for bits in (8, 10, 12, 14, 16))
    if low == high == 0.0:
        found, advice = "is black: all grey levels are 0", "check lens cap, illumination and exposure"
    elif low in tops and low == high:
        found, advice = f"is saturated: all grey levels are {high:.0f}", "expose shorter or dim the light"
    else:
        found, advice = (
            f"shows nothing: its grey levels lie between {low:.0f} and {high:.0f}",
            "check exposure and illumination",
        )
    return f"the image {found}; spots with contrast are needed: {advice}"
