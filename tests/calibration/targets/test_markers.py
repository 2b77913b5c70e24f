"""Markers and asymmetric circles drawn under a known homography: their marks must come back where it puts them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.targets import CircleGrid, MarkerBoard, MarkerPlace, find_circles, find_markers, spread_of, upright

SIZE = (800, 600)
FINE = 4  # the drawing is finer than the image by this, and averaged down
HOMOGRAPHY = np.array([[3.0, 0.35, 390.0], [-0.25, 2.6, 300.0], [0.0004, 0.0009, 1.0]])  # mm to px
PLACES = ((5, -90.0, 0.0, 180.0), (27, 0.0, -90.0, 0.0), (42, 90.0, 0.0, 30.0), (18, 0.0, 90.0, -90.0))


def projected(points, homography=HOMOGRAPHY):
    q = np.column_stack([points[:, :2], np.ones(len(points))]) @ homography.T
    return q[:, :2] / q[:, 2:]


def seen(drawing, corner, mm):
    """Image of a drawing whose px are ``mm`` wide and whose first corner stands at ``corner`` mm, by averaging a fine one."""
    fine = np.array([[FINE, 0, FINE / 2 - 0.5], [0, FINE, FINE / 2 - 0.5], [0, 0, 1.0]]) @ HOMOGRAPHY
    to_mm = np.array([[mm, 0, corner[0] + mm / 2], [0, mm, corner[1] + mm / 2], [0, 0, 1.0]])
    large = cv2.warpPerspective(drawing, fine @ to_mm, (SIZE[0] * FINE, SIZE[1] * FINE), borderValue=200)
    return cv2.GaussianBlur(cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA), (0, 0), 0.7)


def drawn(places=PLACES, side=30.0, mm=0.5, up=False):
    """Drawing of a table of 240 mm with markers; with ``up``, y of the places and their turns run against the image's."""
    canvas = np.full((480, 480), 220, np.uint8)
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, x, y, turn in places:
        y, turn = (-y, -turn) if up else (y, turn)
        marker = cv2.aruco.generateImageMarker(words, number, 240)
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        scale = side / 240 / mm
        middle = np.array([(x + 120) / mm - 0.5, (y + 120) / mm - 0.5])
        turned = scale * np.array([[c, -s], [s, c]])
        matrix = np.column_stack([turned, middle - turned @ [119.5, 119.5]])
        warped = cv2.warpAffine(marker, matrix, (480, 480), flags=cv2.INTER_AREA, borderValue=255)
        inside = cv2.warpAffine(np.full_like(marker, 255), matrix, (480, 480)) > 127
        canvas[inside] = np.minimum(warped[inside], 220)
    return seen(canvas, (-120.0, -120.0), mm)


def board(places=PLACES, side=30.0):
    return MarkerBoard("DICT_4X4_50", side, tuple(MarkerPlace(n, x, y, np.radians(t)) for n, x, y, t in places))


@pytest.mark.parametrize("up", [False, True])
def test_marker_corners_are_where_they_were_drawn_whichever_way_y_runs(up):
    found = find_markers(drawn(up=up), board())
    target = upright(board(), found)
    assert (target.upwards, target.quarters) == (up, 0)
    truth = target.marks[found.mark] * [1.0, -1.0 if up else 1.0, 1.0]
    assert len(found.mark) == 16
    assert np.sqrt(np.mean((found.pixels - projected(truth)) ** 2)) < 0.15


def test_turns_that_count_from_another_side_are_put_right():
    stated = board([(n, x, y, t + 90.0) for n, x, y, t in PLACES])
    found = find_markers(drawn(), stated)
    marks = upright(stated, found).marks[found.mark]
    assert np.sqrt(np.mean((found.pixels - projected(marks)) ** 2)) < 0.15


def test_a_hidden_marker_is_missing_and_the_others_keep_their_names():
    image = drawn()
    hidden = projected(board().marks[4:8]).astype(int)
    image[hidden[:, 1].min() : hidden[:, 1].max(), hidden[:, 0].min() : hidden[:, 0].max()] = 200
    assert find_markers(image, board()).mark.tolist() == [*range(4), *range(8, 16)]


def test_markers_at_other_places_than_stated_are_refused_with_how_they_seem_turned():
    wrong = [(n, x, y, 75.0 if n == 42 else t) for n, x, y, t in PLACES]
    with pytest.raises(CalibrationError, match=r"turn is about .*42: 30"):
        find_markers(drawn(), board(wrong))
    with pytest.raises(CalibrationError, match="none of the 4 markers"):
        find_markers(np.full((480, 640), 128, np.uint8), board())
    with pytest.raises(CalibrationError, match="DICT_9X9"):
        find_markers(drawn(), MarkerBoard("DICT_9X9", 30.0, board().places))


def test_sides_tell_how_far_apart_markers_really_are():
    stated = board([(n, 1.2 * x, 1.2 * y, t) for n, x, y, t in PLACES])
    assert spread_of(drawn(), stated) == pytest.approx(1 / 1.2, rel=0.01)


def circles(target, radius=3.0, mm=0.25):
    marks = target.marks
    width, height = (marks[:, :2].max(axis=0) + 40.0) / mm
    canvas = np.full((int(height), int(width)), 220, np.uint8)
    for x, y, _ in marks:
        centre = (np.array([x + 20, y + 20]) / mm - 0.5) * 16
        cv2.circle(canvas, tuple(np.rint(centre).astype(int)), round(radius / mm * 16), 30, -1, cv2.LINE_AA, 4)
    corner = np.array([-20.0, -20.0]) - marks[:, :2].mean(axis=0)
    return canvas, corner, mm


@pytest.mark.parametrize("polarity", ["dark", "light"])
def test_asymmetric_circles_are_named_as_opencv_counts_them(polarity):
    target = CircleGrid(7, 4, 12.0, polarity=polarity)
    canvas, corner, mm = circles(target)
    image = seen(canvas, corner, mm)
    found = find_circles(255 - image if polarity == "light" else image, target)
    truth = projected(target.marks[:, :2] - target.marks[:, :2].mean(axis=0))
    error = np.linalg.norm(found.pixels - truth[found.mark], axis=1)
    assert error.max() < 1.0
    assert len(found.mark) == 28


def test_circles_out_of_view_are_refused():
    with pytest.raises(CalibrationError, match="7 rows of 4 dark circles"):
        find_circles(np.full((480, 640), 128, np.uint8), CircleGrid(7, 4, 12.0))
