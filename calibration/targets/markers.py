"""ArUco and AprilTag markers at known places to the corners of their squares."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.geometry import Array, Ints
from calibration.targets._looks import eight_bit, magnified, refined
from calibration.targets.boards import Corners
from calibration.targets.layout import MarkerBoard

_MISFIT = 0.08  # of a marker's side in the image, rms: more is no error of measurement
_TURN = 12.0  # degrees by which a marker may seem turned otherwise than stated


def find_markers(image: NDArray[np.generic], target: MarkerBoard) -> Corners:
    """Find the corners of a target's markers, of which any may be hidden.

    Parameters
    ----------
    image : (H, W) array
        Grey levels of any depth.
    target : MarkerBoard
        Dictionary, side and places.

    Returns
    -------
    Corners
        Four a marker that is in view, refined by `cornerSubPix`. Markers that are seen twice do not count.

    Raises
    ------
    CalibrationError
        No marker of the target in view, an unknown dictionary, or places that contradict the image: the message says how the
        markers seem to be turned.

    Notes
    -----
    OpenCV's detector (Garrido-Jurado et al., Pattern Recognition 47, 2014), asked at twice the size where it misses some.
    """
    numbers = [place.number for place in target.places]
    grey = eight_bit(image)
    seen = _detect(grey, target.dictionary, numbers)
    if len(seen) < len(numbers):
        seen = _detect(magnified(grey, 2.0), target.dictionary, numbers, 2.0) | seen
    if not seen:
        raise CalibrationError(
            f"none of the {len(numbers)} markers of {target.dictionary} in the image: check dictionary, ids, focus and exposure"
        )
    order = [k for k, number in enumerate(numbers) if number in seen]
    corners = np.concatenate([seen[numbers[k]] for k in order])
    side = float(np.median([np.linalg.norm(np.diff(seen[numbers[k]], axis=0), axis=1).min() for k in order]))
    pixels = refined(grey, corners, side / 3.0)
    mark = np.concatenate([np.arange(4 * k, 4 * k + 4) for k in order])
    if len(order) > 1:
        _check_places(target, pixels, mark, side)
    return Corners(pixels, mark)


def upright(target: MarkerBoard, seen: Corners) -> MarkerBoard:
    """The target as a view of two markers or more shows its frame; unchanged where fewer are seen.

    Whether y was measured down or up, and from which side of the markers their turns were counted, are conventions that
    centres and corners together tell: the one of the eight that fits is taken.
    """
    if len(seen.mark) < 8:
        return target
    ways = [replace(target, upwards=up, quarters=k) for up in (False, True) for k in range(4)]
    return min(ways, key=lambda way: _misfit(way, seen.pixels, seen.mark))


def spread_of(image: NDArray[np.generic], target: MarkerBoard) -> float:
    """By which factor a target's centres are farther apart than stated, if the side of its markers is right.

    A plane that shows four centres where they should be shows the sides of the markers to scale. NaN where fewer are in view.
    """
    seen = _detect(eight_bit(image), target.dictionary, [place.number for place in target.places])
    order = np.array([k for k, place in enumerate(target.places) if place.number in seen], dtype=np.int64)
    if len(order) < 4:
        return float("nan")
    flat = _flattened(target, np.concatenate([seen[target.places[k].number] for k in order]), order)
    if flat is None:
        return float("nan")
    sides = np.linalg.norm(flat - np.roll(flat, -1, axis=1), axis=2)
    return float(target.side / np.median(sides))


def _detect(grey: NDArray[np.uint8], dictionary: str, numbers: list[int], scale: float = 1.0) -> dict[int, Array]:
    """Corners (4, 2) px of the wanted markers that are seen once."""
    import cv2

    code = getattr(cv2.aruco, dictionary, None)
    if not isinstance(code, int) or not dictionary.startswith("DICT_"):
        raise CalibrationError(
            f"target.dictionary is {dictionary!r}; one of OpenCV's is needed, such as DICT_4X4_50 or DICT_APRILTAG_36h11"
        )
    words = cv2.aruco.getPredefinedDictionary(code)
    beyond = [number for number in numbers if number >= len(words.bytesList)]
    if beyond:
        raise CalibrationError(
            f"target.places names marker {beyond[0]}; {dictionary} ends at {len(words.bytesList) - 1}: correct either"
        )
    options: Any = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, found, _ = cv2.aruco.ArucoDetector(words, options).detectMarkers(grey)
    every = [] if found is None else [int(number) for number in np.ravel(found)]
    return {
        number: (np.asarray(quad, dtype=np.float64).reshape(4, 2) + 0.5) / scale - 0.5
        for number, quad in zip(every, corners, strict=True)
        if number in numbers and every.count(number) == 1
    }


def _homography(points: Array, pixels: Array) -> Array | None:
    import cv2

    found = cv2.findHomography(points[:, :2], pixels, 0)[0]
    return None if found is None else np.asarray(found, dtype=np.float64)


def _mapped(matrix: Array, points: Array) -> Array:
    q = np.column_stack([points[:, :2], np.ones(len(points))]) @ matrix.T
    return np.asarray(q[:, :2] / q[:, 2:])


def _misfit(target: MarkerBoard, pixels: Array, mark: Ints) -> float:
    """Rms distance, px, of corners from where a homography of the stated places puts them; infinite where there is none."""
    points = target.marks[mark]
    matrix = _homography(points, pixels)
    if matrix is None:
        return np.inf
    return float(np.sqrt(((_mapped(matrix, points) - pixels) ** 2).sum(axis=1).mean()))


def _check_places(target: MarkerBoard, pixels: Array, mark: Ints, side: float) -> None:
    """Refuse places that no plane can show so; with four markers the message says how each seems to be turned."""
    misfit = _misfit(upright(target, Corners(pixels, mark)), pixels, mark)
    if misfit <= max(_MISFIT * side, 1.0):
        return
    told = "check x, y and turn of each, and `marker`"
    order = np.unique(mark // 4)
    if len(order) >= 4:
        told = _turns(target, pixels, order)
    raise CalibrationError(
        f"{len(order)} markers do not lie as `places` says (a plane fits to {misfit:.0f} px rms, where a side is {side:.0f} px): {told}"
    )


def _turns(target: MarkerBoard, pixels: Array, order: Ints) -> str:
    """How the markers seem to be turned, if their centres are right: for the message."""
    flat = _flattened(target, pixels, order)
    if flat is None:
        return "check x, y and turn of each, and `marker`"
    along = flat[:, 1] - flat[:, 0] + flat[:, 2] - flat[:, 3]
    turns = np.degrees(np.arctan2(along[:, 1], along[:, 0]))
    stated = np.degrees([target.places[k].turn for k in order])
    off = (turns - stated + 180.0) % 360.0 - 180.0
    off = np.abs((off - 90.0 * np.round(off[0] / 90.0) + 180.0) % 360.0 - 180.0)  # a common quarter is a convention
    if off.max() < _TURN:
        sides = float(np.median(np.linalg.norm(flat - np.roll(flat, -1, axis=1), axis=2)))
        return f"their turns agree; by their centres the side `marker` would be {sides:.1f} mm"
    seen = ", ".join(f"{target.places[k].number}: {turn % 360.0:.0f}" for k, turn in zip(order, turns, strict=True))
    return f"if their centres are right, turn is about {seen} degrees"


def _flattened(target: MarkerBoard, pixels: Array, order: Ints) -> Array | None:
    """Corners (k, 4, 2) mm of markers on the plane that their centres, where they were stated, span; None where they span none."""
    quads = pixels.reshape(-1, 4, 2)
    centres = np.array([[target.places[k].x, target.places[k].y] for k in order]) * target.spread
    matrix = _homography(centres, np.stack([_crossing(quad) for quad in quads]))
    if matrix is None:
        return None
    return _mapped(np.asarray(np.linalg.inv(matrix), dtype=np.float64), pixels).reshape(-1, 4, 2)


def _crossing(quad: Array) -> Array:
    """Where the diagonals of a quadrangle (4, 2) cross: the image of a square's centre."""
    across, down = quad[2] - quad[0], quad[3] - quad[1]
    share = np.linalg.solve(np.stack([across, -down], axis=1), quad[1] - quad[0])[0]
    return np.asarray(quad[0] + share * across)
