"""calibration.targets."""

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
from calibration.targets.spots import find_spots

__all__ = [
    "Charuco",
    "Chessboard",
    "CircleGrid",
    "MarkerBoard",
    "MarkerPlace",
    "Polarity",
    "SpotGrid",
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
