"""Where the marks of a calibration target are, in the target's own frame (mm)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array

Polarity = Literal["light", "dark"]
GridIndex: TypeAlias = tuple[int, int]  # (row, column), from 0


def _pair(pitch: object) -> tuple[float, float]:
    """Pitch along x and y of a pair, or of the one number that stands for both; ``ValueError`` for what is neither."""
    both = np.atleast_1d(np.asarray(pitch, dtype=np.float64))
    if both.shape not in ((1,), (2,)) or not (np.isfinite(both).all() and (both > 0).all()):
        raise ValueError(f"pitch is {pitch!r}: give a positive number in mm, or a pair of them along x and y")
    return float(both[0]), float(both[-1])


def _check_counts(rows: object, columns: object) -> None:
    for name, count in (("rows", rows), ("columns", columns)):
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 2:
            raise ValueError(f"{name} is {count!r}: give how many there are, 2 or more")


def _lattice(rows: int, columns: int, pitch: tuple[float, float]) -> Array:
    """Marks (rows * columns, 3) mm, row by row: x along a row, y down the columns, (0, 0) first."""
    row, column = np.mgrid[0:rows, 0:columns]
    return np.stack([column * pitch[0], row * pitch[1], np.zeros_like(row)], axis=-1).reshape(-1, 3).astype(np.float64)


@dataclass(frozen=True, slots=True)
class SpotGrid:
    """A regular grid of round spots, some of which may be larger (fiducials) and tell where (0, 0) is.

    Mark ``row * columns + column`` stands at ``(column * pitch[0], row * pitch[1], 0)``.
    """

    rows: int
    columns: int
    pitch: tuple[float, float]  # mm, along x and y; one number stands for both
    diameter: float | None = None  # mm; None where it is not known
    polarity: Polarity = "light"
    fiducials: tuple[GridIndex, ...] = ()
    fiducial_diameter: float | None = None  # mm

    def __post_init__(self) -> None:
        _check_counts(self.rows, self.columns)
        object.__setattr__(self, "pitch", _pair(self.pitch))

    @property
    def marks(self) -> Array:
        """(rows * columns, 3) mm."""
        return _lattice(self.rows, self.columns, self.pitch)

    def check_fiducials(self) -> None:
        """Refuse fiducials that look like themselves after a turn or a reflection of the grid.

        The pattern is compared as a set of offsets between fiducials, since a partial view shows no border: it must
        differ from itself, up to translation, under the seven other symmetries of the square lattice.
        ``CalibrationError`` names the symmetry.
        """
        if not self.fiducials:
            return
        points = np.array([(column, row) for row, column in self.fiducials])
        own = _shape(points)
        for name, matrix in _SYMMETRIES.items():
            if _shape(points @ np.array(matrix).T) == own:
                raise CalibrationError(
                    f"target.fiducials {[list(f) for f in self.fiducials]} look the same after {name}; the grid could "
                    "not be told from its own image: choose three or more that form an L with unequal arms"
                )


@dataclass(frozen=True, slots=True)
class Chessboard:
    """Inner corners of a chessboard, ``rows`` by ``columns``."""

    rows: int
    columns: int
    pitch: tuple[float, float]  # mm, along x and y; one number stands for both

    def __post_init__(self) -> None:
        _check_counts(self.rows, self.columns)
        object.__setattr__(self, "pitch", _pair(self.pitch))

    @property
    def marks(self) -> Array:
        """(rows * columns, 3) mm."""
        return _lattice(self.rows, self.columns, self.pitch)


@dataclass(frozen=True, slots=True)
class Charuco:
    """Corners of a ChArUco board of ``rows`` by ``columns`` squares; corner 0 is the origin."""

    rows: int
    columns: int
    pitch: tuple[float, float]  # mm, square; one number stands for both
    marker: float  # mm
    dictionary: str
    legacy: bool = False

    def __post_init__(self) -> None:
        _check_counts(self.rows, self.columns)
        object.__setattr__(self, "pitch", _pair(self.pitch))

    @property
    def marks(self) -> Array:
        """((rows - 1) * (columns - 1), 3) mm, in the order of OpenCV's corner numbers."""
        return _lattice(self.rows - 1, self.columns - 1, self.pitch)


@dataclass(frozen=True, slots=True)
class CircleGrid:
    """OpenCV's asymmetric grid of circles: ``rows`` of ``columns`` each, every other row shifted by half a column.

    Mark ``row * columns + column`` stands at ``((2 * column + row % 2) * pitch, row * pitch, 0)``.
    """

    rows: int
    columns: int
    pitch: float  # mm, from neighbour to neighbour along a diagonal, in x and in y
    diameter: float | None = None  # mm; None where it is not known
    polarity: Polarity = "dark"

    @property
    def marks(self) -> Array:
        """(rows * columns, 3) mm."""
        points = _lattice(self.rows, self.columns, (2 * self.pitch, self.pitch))
        points[:, 0] += self.pitch * (np.arange(len(points)) // self.columns % 2)
        return points


@dataclass(frozen=True, slots=True)
class MarkerPlace:
    """Where one square marker is on a target."""

    number: int  # of the dictionary
    x: float  # mm, of its centre
    y: float  # mm
    turn: float = 0.0  # rad, from x to y


@dataclass(frozen=True, slots=True)
class MarkerBoard:
    """ArUco or AprilTag markers at known places of one plane; any of them may be in view.

    Marks ``4 k`` to ``4 k + 3`` are the corners of place k in OpenCV's order: top left, top right, bottom right, bottom left
    of the upright marker. The target's frame has x to the right of a marker that is not turned and, as on the other
    targets, y down; ``upwards`` is for places that were measured with y up, ``quarters`` for turns that count from another
    side of the markers, and ``spread`` for places that were stated too close together.
    """

    dictionary: str
    side: float  # mm, of a marker's black square
    places: tuple[MarkerPlace, ...]
    upwards: bool = False
    quarters: int = 0  # quarter turns that are added to the turn of every place
    spread: float = 1.0  # by which x and y of every place are multiplied

    @property
    def marks(self) -> Array:
        """(4 * places, 3) mm."""
        half = self.side / 2
        square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        if self.upwards:
            square[:, 1] *= -1
        corners = []
        for place in self.places:
            turn = place.turn + self.quarters * np.pi / 2
            c, s = np.cos(turn), np.sin(turn)
            corners.append(square @ np.array([[c, s], [-s, c]]) + self.spread * np.array([place.x, place.y]))
        flat = np.concatenate(corners)
        return np.column_stack([flat, np.zeros(len(flat))])


Target: TypeAlias = SpotGrid | Chessboard | Charuco | CircleGrid | MarkerBoard

_SYMMETRIES: dict[str, tuple[tuple[int, int], tuple[int, int]]] = {
    "a turn by 90 degrees": ((0, -1), (1, 0)),
    "a turn by 180 degrees": ((-1, 0), (0, -1)),
    "a turn by 270 degrees": ((0, 1), (-1, 0)),
    "a reflection left to right": ((-1, 0), (0, 1)),
    "a reflection top to bottom": ((1, 0), (0, -1)),
    "a reflection about a diagonal": ((0, 1), (1, 0)),
    "a reflection about the other diagonal": ((0, -1), (-1, 0)),
}


def _shape(points: np.typing.NDArray[np.int64]) -> frozenset[tuple[int, int]]:
    """Points of a lattice up to translation."""
    shifted = points - points.min(axis=0)
    return frozenset((int(x), int(y)) for x, y in shifted)
