"""What a calibration and a verification tell, on the small simulated session."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from calibration.errors import FileError
from scope.calibrating import calibrate, check_plane, verify
from scope.report import calibration_page, calibration_text


@pytest.fixture(scope="module")
def found(session):
    return calibrate(session.calibration)


def test_residuals_are_split_and_every_plane_is_held_out(found) -> None:
    result = found.result
    parts = result["residual_px"]
    together = math.sqrt(sum(value**2 for value in parts.values()))
    assert parts["random"] > 2 * parts["placement"]  # a simulated jig is exact, its noise is not
    for plane in result["planes"]:
        assert together == pytest.approx(plane["fit_px"], rel=0.5)
        assert np.linalg.norm(plane["heldout_bias_mm"]) < plane["heldout_mm"]
    assert [plane["between"] for plane in result["planes"]] == [False, True, True, False]


def test_the_page_tells_what_the_json_tells(found) -> None:
    page = calibration_page(found)
    for heading in ("Held out", "Intra-plane", "Inter-plane", "Uncertainty of the rays", "numerical findings", "Marks"):
        assert heading in page
    assert "repeats mark for mark" in page
    assert found.result["planes"][0]["name"] in calibration_text(found)


def test_a_moved_camera_is_told_by_verify(copy_of_session) -> None:
    copy = copy_of_session()
    assert verify(copy.rig, copy.calibration)["faults"] == []
    for path in copy.folder.glob("w*/*.png"):
        if path.parent.name[1:].isdigit():
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), np.roll(image, 2, axis=1))
    result = verify(copy.rig, copy.calibration)
    assert not result["passed"]
    assert [(f["plane"], f["kind"]) for f in result["faults"]] == [("all", "moved")]


def test_a_black_image_is_no_good_at_the_jig(copy_of_session) -> None:
    copy = copy_of_session()
    good = check_plane(copy.calibration, "w330")
    assert good["remedy"] == ""
    for path in copy.folder.glob("w330/*.png"):
        cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
    bad = check_plane(copy.calibration, "w330")
    assert "is black" in bad["remedy"]
    assert set(good) == set(bad)


def test_a_plane_is_judged_at_the_jig_before_the_others_and_the_laser_are_taken(copy_of_session) -> None:
    import shutil

    copy = copy_of_session()
    with_all = check_plane(copy.calibration, "w330")
    for folder in copy.folder.glob("w*"):
        if folder.name != "w330":
            shutil.rmtree(folder)
    assert check_plane(copy.calibration, "w330") == with_all
    with pytest.raises(FileError, match="w300"):
        check_plane(copy.calibration, "w300")


def _move_spots(session, plane: str, pixels: np.ndarray, px: int) -> None:
    """Move spots of a plane in all its images to the right."""
    for path in session.folder.glob(f"{plane}/*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        moved = image.copy()
        for u, v in np.round(pixels).astype(int):
            patch = (slice(v - 12, v + 13), slice(u - 12, u + 13))
            moved[patch] = image[v - 12 : v + 13, u - 12 - px : u + 13 - px]
        cv2.imwrite(str(path), moved)


def _inner(found, plane: str, count: int) -> tuple[set[int], np.ndarray]:
    """Marks in the middle of the image, which have room around them: their numbers and pixels."""
    marks = next(m for m in found.two_plane.marks if m.name == plane)
    inside = (np.abs(marks.pixels - [320, 240]) < [250, 170]).all(axis=1)
    inside &= ~np.isin(marks.mark, [82, 84, 37])  # the fiducials
    rows = np.random.default_rng(1).choice(np.flatnonzero(inside), count, replace=False)
    return set(marks.mark[rows].tolist()), marks.pixels[rows]


def test_a_few_bad_marks_are_left_out_and_named(copy_of_session, found) -> None:
    copy = copy_of_session()
    numbers, pixels = _inner(found, "w330", 4)
    _move_spots(copy, "w330", pixels, 2)
    result = calibrate(copy.calibration)
    assert result.passed
    assert "4 bad marks left out" in result.why
    assert {f["mark"] for f in result.faults if f["kind"] == "mark"} == numbers
    for fault in result.faults:
        assert fault["plane"] == "w330"
        assert fault["value"] == pytest.approx(2.0, abs=0.1)
    dropped = [each for each in result.result["dropped"] if each["part"] == "mark"]
    assert [each["name"] for each in dropped] == ["w330"] * 4
    assert all("near pixel (" in each["reason"] and " px" in each["reason"] for each in dropped)
    assert "4 of 660 marks: mark" in calibration_text(result)
    pixels = np.random.default_rng(3).uniform((60, 60), (580, 420), (200, 2))
    here, there = result.rig.camera.rays(pixels), found.rig.camera.rays(pixels)
    assert np.abs(here.at_depth(345.0) - there.at_depth(345.0)).max() < 0.003


def test_too_many_bad_marks_fail_the_session(copy_of_session, found) -> None:
    copy = copy_of_session()
    _, pixels = _inner(found, "w330", 14)
    _move_spots(copy, "w330", pixels, 4)
    result = calibrate(copy.calibration)
    assert not result.passed
    assert "plane w330: 14 of 165 marks are off by" in result.why
    assert "5 %" in check_plane(copy.calibration, "w330")["remedy"]
