"""Boards drawn under a known homography: the corners must come back where it puts them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.targets import Charuco, Chessboard, boards, find_charuco, find_chessboard

SIZE = (800, 600)
SCALE = 8  # the drawing is finer than the image by this, and averaged down


def picture(board, mm, homography):
    """Image of a drawing (px of ``mm`` each) of the plane under a plane-to-pixel homography, by averaging a fine one."""
    # pixel centres of the fine image, the drawing and the image: (i + 0.5) steps from their corners
    fine = np.diag([SCALE / 2, SCALE / 2, 1.0]) @ np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]]) @ homography
    fine = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]]) @ fine
    drawing = np.diag([mm, mm, 1.0]) @ np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    size = (SIZE[0] * SCALE // 2, SIZE[1] * SCALE // 2)
    large = cv2.warpPerspective(board, fine @ drawing, size, flags=cv2.INTER_LINEAR, borderValue=200)
    small = cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), 0.7)


def pixels(homography, points):
    q = np.column_stack([points[:, :2], np.ones(len(points))]) @ homography.T
    return q[:, :2] / q[:, 2:]


HOMOGRAPHY = np.array([[4.2, 0.35, 120.0], [-0.25, 4.0, 110.0], [0.0004, 0.0006, 1.0]])


def chessboard(rows, columns, square, mm):
    side = int(square / mm)
    v, u = np.mgrid[0 : (rows + 3) * side, 0 : (columns + 3) * side]
    dark = ((u // side + v // side) % 2 == 0) & (u >= side) & (v >= side)
    dark &= (u < (columns + 2) * side) & (v < (rows + 2) * side)
    # a white rim of one square about rows + 1 by columns + 1 squares
    return np.where(dark, 30, 220).astype(np.uint8)


@pytest.mark.parametrize("depth", [np.uint8, np.uint16, np.float32])
def test_chessboard_corners_are_where_they_were_drawn(depth):
    target = Chessboard(6, 9, (10.0, 10.0))
    image = picture(chessboard(6, 9, 10.0, 0.25), 0.25, HOMOGRAPHY)
    truth = pixels(HOMOGRAPHY, target.marks + np.array([20.0, 20.0, 0.0]))
    found = find_chessboard(image.astype(depth) * (257 if depth is np.uint16 else 1), target)
    error = found.pixels - truth
    turned = found.pixels[::-1] - truth
    error = error if np.abs(error).max() < np.abs(turned).max() else turned
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert found.mark.tolist() == list(range(54))


def test_a_chessboard_out_of_view_is_refused():
    image = picture(chessboard(6, 9, 10.0, 0.25), 0.25, HOMOGRAPHY)
    with pytest.raises(CalibrationError, match="inner corners"):
        find_chessboard(image[:, 260:], Chessboard(6, 9, (10.0, 10.0)))


CHARUCO = Charuco(7, 9, (10.0, 10.0), 7.0, "DICT_5X5_100")


def charuco_image(homography=HOMOGRAPHY):
    board = cv2.aruco.CharucoBoard((9, 7), 10.0, 7.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    return picture(board.generateImage((9 * 40, 7 * 40)), 0.25, homography)


def test_charuco_corners_are_where_they_were_drawn():
    found = find_charuco(charuco_image(), CHARUCO)
    truth = pixels(HOMOGRAPHY, CHARUCO.marks + np.array([10.0, 10.0, 0.0]))
    assert len(found.mark) == len(truth)
    assert np.sqrt(np.mean((found.pixels - truth[found.mark]) ** 2)) < 0.1


def test_part_of_a_charuco_board_keeps_its_numbers():
    found = find_charuco(np.ascontiguousarray(charuco_image()[:, 300:]), CHARUCO)
    truth = pixels(HOMOGRAPHY, CHARUCO.marks + np.array([10.0, 10.0, 0.0])) - [300, 0]
    assert 8 <= len(found.mark) < 48
    assert np.sqrt(np.mean((found.pixels - truth[found.mark]) ** 2)) < 0.1


def test_a_picture_without_a_board_is_refused():
    blank = np.full((480, 640), 128, np.uint8)
    with pytest.raises(CalibrationError, match="found 0 corners"):
        find_charuco(blank, CHARUCO)
    with pytest.raises(CalibrationError, match="dictionary"):
        find_charuco(blank, Charuco(7, 9, (10.0, 10.0), 7.0, "DICT_NONE"))


def test_a_corner_that_the_detector_misplaces_is_found_again(monkeypatch):
    """OpenCV's detector has put single corners of clean views seven px away."""
    image = picture(chessboard(6, 9, 10.0, 0.25), 0.25, HOMOGRAPHY)
    target, detect = Chessboard(6, 9, (10.0, 10.0)), boards._detect
    right = find_chessboard(image, target)

    def misplaced(grey, rows, columns):
        found = detect(grey, rows, columns)
        found[17] += [5.0, -4.0]
        return found

    monkeypatch.setattr(boards, "_detect", misplaced)
    again = find_chessboard(image, target)
    assert again.mark.tolist() == right.mark.tolist()
    assert np.abs(again.pixels - right.pixels).max() < 0.02


@pytest.mark.parametrize(("rows", "columns"), [(6, 8), (5, 9)])
def test_a_board_told_too_small_is_refused_where_its_pattern_goes_on(rows, columns):
    image = picture(chessboard(6, 9, 10.0, 0.25), 0.25, HOMOGRAPHY)
    with pytest.raises(CalibrationError, match="its pattern goes on: 6 x 9 inner corners are seen"):
        find_chessboard(image, Chessboard(rows, columns, (10.0, 10.0)))


def test_a_pattern_that_goes_on_is_told_from_a_margin():
    """The law under the refusal: all four sides of a whole board end; of a part of it the cut side goes on."""
    image = picture(chessboard(6, 9, 10.0, 0.25), 0.25, HOMOGRAPHY)
    truth = pixels(HOMOGRAPHY, Chessboard(6, 9, (10.0, 10.0)).marks + np.array([20.0, 20.0, 0.0])).reshape(6, 9, 2)
    boards._check_whole(image, truth)
    for part in (truth[:, 1:], truth[:, :-1], truth[1:], truth[:-1]):
        with pytest.raises(CalibrationError, match="its pattern goes on"):
            boards._check_whole(image, part)


def test_a_blurred_dim_board_is_found_in_another_look():
    image = picture(chessboard(6, 9, 10.0, 0.25), 0.25, HOMOGRAPHY)
    small = cv2.resize(image, None, fx=0.28, fy=0.28, interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(3).normal(0, 3, small.shape)
    dim = np.clip(small * 0.25 + 10 + noise, 0, 255).astype(np.uint8)
    found = find_chessboard(dim, Chessboard(6, 9, (10.0, 10.0)))
    truth = (pixels(HOMOGRAPHY, Chessboard(6, 9, (10.0, 10.0)).marks + np.array([20.0, 20.0, 0.0])) + 0.5) * 0.28 - 0.5
    error = min(np.abs(found.pixels - truth[found.mark]).max(), np.abs(found.pixels - truth[::-1][found.mark]).max())
    assert error < 1.0
