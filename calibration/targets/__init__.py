"""calibration.targets."""

from calibration.targets.boards import find_charuco, find_chessboard
from calibration.targets.eccentricity import eccentricity_of_map
from calibration.targets.grid import label_grid
from calibration.targets.layout import Charuco, Chessboard, Polarity, SpotGrid
from calibration.targets.listed import measure_marks
from calibration.targets.spots import find_spots

__all__ = [
    "Charuco",
    "Chessboard",
    "Polarity",
    "SpotGrid",
    "eccentricity_of_map",
    "find_charuco",
    "find_chessboard",
    "find_spots",
    "label_grid",
    "measure_marks",
]
