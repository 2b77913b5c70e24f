"""An image of a target to its marks: pixels with their covariance, each with the mark that it is.

In: an image (H, W) and the target that it shows: a spot grid, a board, circles, markers, or a list of marks.
Out: `Spots` with sub-pixel centres and covariance, and the index of the mark that each of them is; or the
    reason why not.
Read: layout, spots, eccentricity, lattice, grid, listed, boards, circles, markers.
"""

from calibration.targets.boards import find_charuco, find_chessboard
from calibration.targets.circles import find_circles
from calibration.targets.eccentricity import eccentricity_of_map
from calibration.targets.grid import label_grid
from calibration.targets.layout import (
    Charuco,
    Chessboard,
    CircleGrid,
    MarkerBoard,
    MarkerPlace,
    Polarity,
    SpotGrid,
    Target,
)
from calibration.targets.listed import measure_marks
from calibration.targets.markers import find_markers, spread_of, upright
from calibration.targets.spots import Spots, find_spots

__all__ = [
    "Charuco",
    "Chessboard",
    "CircleGrid",
    "MarkerBoard",
    "MarkerPlace",
    "Polarity",
    "SpotGrid",
    "Spots",
    "Target",
    "eccentricity_of_map",
    "find_charuco",
    "find_chessboard",
    "find_circles",
    "find_markers",
    "find_spots",
    "label_grid",
    "measure_marks",
    "spread_of",
    "upright",
]
