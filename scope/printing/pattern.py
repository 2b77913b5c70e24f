"""A target to the shapes that carry its marks, in the target's own frame (mm, x along a row, y down)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array
from calibration.targets import Charuco, Chessboard, CircleGrid, MarkerBoard, SpotGrid, Target
from scope.printing.drawing import Disk, Region, Shape, rectangle

_QUIET = 8.0  # mm at least that stay empty about a pattern


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """Shapes of a target and the rectangle that they and their quiet border fill."""

    shapes: tuple[Shape, ...]
    area: tuple[float, float, float, float]  # x0, y0, x1, y1 mm
    title: str  # kind and sizes, for the sheet


def draw_pattern(target: Target) -> Pattern:
    """Draw the shapes that carry the marks of a target.

    Light spots are white on a black ground; on a drill layout their disks are the holes. The corner squares of a
    chessboard's top left are black. ChArUco squares and markers stand as OpenCV's detectors look for them.

    Raises
    ------
    CalibrationError
        A diameter that a drawing needs and the target does not tell, or a marker that its dictionary does not have.
    """
    match target:
        case SpotGrid():
            return _spots(target)
        case CircleGrid():
            return _circles(target)
        case Chessboard():
            return _chessboard(target)
        case Charuco():
            return _charuco(target)
        case MarkerBoard():
            return _markers(target)


def _around(low: Array, high: Array, border: float) -> tuple[float, float, float, float]:
    return (
        float(low[0]) - border,
        float(low[1]) - border,
        float(high[0]) + border,
        float(high[1]) + border,
    )


def _lengths(pitch: tuple[float, float]) -> str:
    return f"{pitch[0]:g} mm" if pitch[0] == pitch[1] else f"{pitch[0]:g} x {pitch[1]:g} mm"


def _diameter(value: float | None, key: str) -> float:
    if value is None:
        raise CalibrationError(
            f"target.{key} is missing: a drawing needs it, although finding the marks does not; add it"
        )
    return value


def _spots(target: SpotGrid) -> Pattern:
    usual = _diameter(target.diameter, "diameter")
    radii = np.full(target.rows * target.columns, usual / 2)
    if target.fiducials:
        larger = _diameter(target.fiducial_diameter, "fiducial_diameter")
        radii[[row * target.columns + column for row, column in target.fiducials]] = larger / 2
    title = f"spots {target.rows} x {target.columns}, {target.polarity}, pitch {_lengths(target.pitch)}, diameter {usual:g} mm"
    return _round(target.marks, radii, max(target.pitch), target.polarity == "light", title)


def _circles(target: CircleGrid) -> Pattern:
    usual = _diameter(target.diameter, "diameter")
    title = (
        f"circles {target.rows} x {target.columns}, {target.polarity}, pitch {target.pitch:g} mm, diameter {usual:g} mm"
    )
    radii = np.full(len(target.marks), usual / 2)
    return _round(target.marks, radii, target.pitch, target.polarity == "light", title)


def _round(marks: Array, radii: Array, pitch: float, light: bool, title: str) -> Pattern:
    """Disks, on a black ground where they are light."""
    border = max(pitch, float(radii.max()) + _QUIET)
    area = _around(marks.min(axis=0), marks.max(axis=0), border)
    disks = tuple(
        Disk(float(x), float(y), float(r), "white" if light else "black", f"HOLES_{2 * r:g}".replace(".", "-"))
        for (x, y, _), r in zip(marks, radii, strict=True)
    )
    ground = (Region((rectangle(*area),), "black", "OUTLINE"),) if light else ()
    return Pattern((*ground, *disks), area, title)


def _chessboard(target: Chessboard) -> Pattern:
    px, py = target.pitch
    rings = tuple(
        rectangle((c - 1) * px, (r - 1) * py, c * px, r * py)
        for r in range(target.rows + 1)
        for c in range(target.columns + 1)
        if (r + c) % 2 == 0
    )
    low, high = np.array([-px, -py]), np.array([target.columns * px, target.rows * py])
    title = f"chessboard {target.rows} x {target.columns} inner corners, pitch {_lengths(target.pitch)}"
    return Pattern((Region(rings),), _around(low, high, max(_QUIET, 0.4 * max(px, py))), title)


def _charuco(target: Charuco) -> Pattern:
    import cv2

    words = _dictionary(target.dictionary)
    pitch = target.pitch[0]
    board: Any = cv2.aruco.CharucoBoard((target.columns, target.rows), pitch, target.marker, words)
    board.setLegacyPattern(target.legacy)
    origin = np.array([pitch, pitch])  # corner 0, from the corner of the board
    light = set()
    rings: list[Array] = []
    for number, corners in zip(np.ravel(board.getIds()), board.getObjPoints(), strict=True):
        square = np.asarray(corners, dtype=np.float64)[:, :2]
        column, row = np.floor(square.mean(axis=0) / pitch).astype(int)
        light.add((int(row), int(column)))
        # OpenCV's points are single precision: the marker stands in the middle of its square
        middle = (np.array([column, row]) + 0.5) * pitch - origin
        half = target.marker / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        rings += _cells(words, int(number), middle + half, target.dictionary)
    rings += [
        rectangle(c * pitch, r * pitch, (c + 1) * pitch, (r + 1) * pitch) - origin
        for r in range(target.rows)
        for c in range(target.columns)
        if (r, c) not in light
    ]
    size = np.array([target.columns, target.rows]) * pitch
    title = (
        f"charuco {target.rows} x {target.columns} squares, pitch {pitch:g} mm, marker {target.marker:g} mm, "
        f"{target.dictionary}{', legacy' if target.legacy else ''}"
    )
    return Pattern((Region(tuple(rings)),), _around(-origin, size - origin, max(_QUIET, 0.4 * pitch)), title)


def _markers(target: MarkerBoard) -> Pattern:
    words = _dictionary(target.dictionary)
    corners = target.marks.reshape(-1, 4, 3)[:, :, :2]
    rings: list[Array] = []
    for place, square in zip(target.places, corners, strict=True):
        rings += _cells(words, place.number, square, target.dictionary)
    flat = corners.reshape(-1, 2)
    quiet = max(_QUIET, target.side / 4)
    title = f"{len(target.places)} markers of {target.side:g} mm, {target.dictionary}"
    return Pattern((Region(tuple(rings)),), _around(flat.min(axis=0), flat.max(axis=0), quiet), title)


def _dictionary(name: str) -> Any:
    import cv2

    number = getattr(cv2.aruco, name, None)
    if not isinstance(number, int) or not name.startswith("DICT_"):
        raise CalibrationError(f"target.dictionary is {name!r}; one of OpenCV's is needed, such as DICT_5X5_100")
    return cv2.aruco.getPredefinedDictionary(number)


def _cells(words: Any, number: int, corners: Array, name: str) -> list[Array]:
    """Rings of a marker's dark cells, run by run; ``corners`` (4, 2) from its top left, clockwise."""
    import cv2

    if not 0 <= number < len(words.bytesList):
        raise CalibrationError(f"{name} has markers 0 to {len(words.bytesList) - 1}, not {number}; correct `places`")
    side = int(words.markerSize) + 2
    dark = cv2.aruco.generateImageMarker(words, number, side, borderBits=1) < 128
    right, down = (corners[1] - corners[0]) / side, (corners[3] - corners[0]) / side
    rings = []
    for row in range(side):
        ends = np.flatnonzero(np.diff(np.concatenate([[False], dark[row], [False]]).astype(np.int8)))
        for begin, end in zip(ends[::2], ends[1::2], strict=True):
            rings.append(corners[0] + rectangle(begin, row, end, row + 1) @ np.stack([right, down]))
    return rings
