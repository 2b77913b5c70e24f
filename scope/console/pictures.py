"""Pictures of clouds: from two sides while a scan grows, and to be turned when it is there."""

from __future__ import annotations

import cv2
import numpy as np

from calibration.geometry import Array
from scope.report import cloud_from


def jpeg_of(points: Array, side: str) -> bytes:
    """JPEG of points (N, 3) mm seen along z ("top") or along y ("side"), coloured by z."""
    x, y, z = np.eye(3)
    picture = cloud_from(points, points[:, 2], x, y if side == "top" else z, width=560)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes())
