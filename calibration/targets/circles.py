"""OpenCV's asymmetric grid of circles to rough centres, named."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.targets._looks import eight_bit, looks
from calibration.targets.boards import Corners
from calibration.targets.layout import CircleGrid


def find_circles(image: NDArray[np.generic], target: CircleGrid) -> Corners:
    """Find the centres of an asymmetric grid of circles, all of which must be in view.

    Parameters
    ----------
    image : (H, W) array
        Grey levels of any depth.
    target : CircleGrid
        Its rows and columns.

    Returns
    -------
    Corners
        All centres, to about half a pixel: they are measured afterwards. A grid of an even number of rows looks the same
        after half a turn and may be counted from either end.

    Raises
    ------
    CalibrationError
        The grid is not in view as a whole.

    Notes
    -----
    OpenCV's grid finder, asked at several scales and contrasts, by nearest neighbours and then by clustering.
    """
    import cv2

    options = cv2.SimpleBlobDetector.Params()
    options.minArea, options.maxArea = 12.0, 0.02 * image.shape[0] * image.shape[1]
    options.minDistBetweenBlobs = 3.0
    blobs = cv2.SimpleBlobDetector.create(options)
    ways = (cv2.CALIB_CB_ASYMMETRIC_GRID, cv2.CALIB_CB_ASYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING)
    grey = eight_bit(image)
    for look, scale in looks(grey if target.polarity == "dark" else 255 - grey):
        for flags in ways:
            found, centres = cv2.findCirclesGrid(look, (target.columns, target.rows), flags=flags, blobDetector=blobs)
            if found:
                pixels = (np.asarray(centres, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
                return Corners(pixels, np.arange(len(pixels)))
    raise CalibrationError(
        f"no asymmetric grid of {target.rows} rows of {target.columns} {target.polarity} circles in the image; all of it must be "
        "in view: check rows, columns (circles a row), polarity, focus and exposure"
    )
