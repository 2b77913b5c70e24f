"""Bad input through the command line: exit 1, one line that says what and where, nothing written, no traceback."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.rig import Rig
from cli.main import app

Argv = list[str]
Spoil = Callable[["Folder"], Argv]


class Folder:
    """A copy of the session that may be spoiled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def edit(self, name: str, old: str, new: str, count: int = 1) -> None:
        text = (self / name).read_text(encoding="utf-8")
        assert old in text, f"{old!r} is not in {name}"
        (self / name).write_text(text.replace(old, new, count), encoding="utf-8")

    def image(self, name: str) -> np.ndarray:
        return cv2.imread(str(self / name), cv2.IMREAD_UNCHANGED)

    def write(self, name: str, image: np.ndarray) -> None:
        (self / name).parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(self / name), image)

    def every(self, pattern: str) -> Iterator[str]:
        found = sorted(self.path.glob(pattern))
        assert found, pattern
        return (str(path.relative_to(self.path)) for path in found)

    def only_planes(self, keep: Callable[[int], bool]) -> None:
        """Leave some of the [[plane]] tables in calibration.toml."""
        head, *planes = (self / "calibration.toml").read_text(encoding="utf-8").split("[[plane]]")
        kept = [plane for k, plane in enumerate(planes) if keep(k)]
        (self / "calibration.toml").write_text("[[plane]]".join([head, *kept]), encoding="utf-8")

    def calibrate(self, *more: str) -> Argv:
        return ["calibrate", str(self / "calibration.toml"), "-o", str(self / "new.json"), *more]

    def scan(self, *more: str) -> Argv:
        return ["scan", str(self / "capture.toml"), "--rig", str(self / "rig.json"), "-o", str(self / "new.ply"), *more]


CASES: list[object] = []


def refused(*patterns: str) -> Callable[[Spoil], Spoil]:
    """Register a way to spoil a session; the patterns must all be found in the one line on stderr."""

    def register(spoil: Spoil) -> Spoil:
        CASES.append(pytest.param(spoil, patterns, id=spoil.__name__))
        return spoil

    return register


# --- calibration.toml ---------------------------------------------------------------------------------------------


@refused(r"nothing\.toml", "cannot be read", "check the path")
def no_such_calibration(s: Folder) -> Argv:
    return ["calibrate", str(s / "nothing.toml"), "-o", str(s / "new.json")]


@refused("cannot be read")
def a_folder_for_a_calibration(s: Folder) -> Argv:
    return ["calibrate", str(s.path), "-o", str(s / "new.json")]


@refused("calibration.toml", "TOML syntax", "line 5", "correct that line")
def a_syntax_error(s: Folder) -> Argv:
    s.edit("calibration.toml", "[target]", "[target")
    return s.calibrate()


@refused("calibration.toml", "TOML", "nested")
def arrays_nested_without_end(s: Folder) -> Argv:
    s.edit("calibration.toml", "rows = 11", "rows = " + "[" * 5000 + "]" * 5000)
    return s.calibrate()


@refused("calibration.toml", "UTF-8", "byte 0")
def no_text(s: Folder) -> Argv:
    (s / "calibration.toml").write_bytes(b"\xff\xfe\x00")
    return s.calibrate()


@refused("calibration.toml", r"target\.colums", "unknown key", "found|value")
def an_unknown_key(s: Folder) -> Argv:
    s.edit("calibration.toml", "columns = 15", "colums = 15")
    return s.calibrate()


@refused("calibration.toml", r"laser.*orign", "unknown key")
def an_unknown_key_of_a_laser(s: Folder) -> Argv:
    s.edit("calibration.toml", "origin = [0.0, -150.0, 8.0]", "orign = [0.0, -150.0, 8.0]")
    return s.calibrate()


@refused("calibration.toml", r"target\.rows", "'eleven'", "integer")
def a_word_for_a_number(s: Folder) -> Argv:
    s.edit("calibration.toml", "rows = 11", 'rows = "eleven"')
    return s.calibrate()


@refused("calibration.toml", r"target\.rows", "'11'", "integer")
def a_number_in_quotes(s: Folder) -> Argv:
    s.edit("calibration.toml", "rows = 11", 'rows = "11"')
    return s.calibrate()


@refused("calibration.toml", r"target\.diameter", "True")
def a_truth_value_for_a_length(s: Folder) -> Argv:
    s.edit("calibration.toml", "diameter = 6.0", "diameter = true")
    return s.calibrate()


@refused("calibration.toml", r"target\.pitch", "-16", "greater than 0")
def a_negative_pitch(s: Folder) -> Argv:
    s.edit("calibration.toml", "pitch = 16.0", "pitch = -16.0")
    return s.calibrate()


@refused("calibration.toml", r"target\.pitch", "finite")
def an_infinite_pitch(s: Folder) -> Argv:
    s.edit("calibration.toml", "pitch = 16.0", "pitch = inf")
    return s.calibrate()


@refused("calibration.toml", "format = 2", "format = 1")
def a_newer_calibration_file(s: Folder) -> Argv:
    s.edit("calibration.toml", "format = 1", "format = 2")
    return s.calibrate()


@refused("calibration.toml", r"plane\.images", r"w300/\*\.jpg", "add the images")
def an_empty_glob(s: Folder) -> Argv:
    s.edit("calibration.toml", "w300/*.png", "w300/*.jpg")
    return s.calibrate()


@refused("calibration.toml", "pitch is missing")
def a_missing_key(s: Folder) -> Argv:
    s.edit("calibration.toml", "\npitch = 16.0", "")
    return s.calibrate()


@refused("calibration.toml", "fiducials", "180 degrees", "choose three or more")
def fiducials_that_look_like_themselves_turned(s: Folder) -> Argv:
    s.edit("calibration.toml", "[[5, 7], [5, 9], [2, 7]]", "[[5, 5], [5, 7], [5, 9]]")
    return s.calibrate()


@refused("calibration.toml", "fiducials", "reflection", "choose three or more")
def fiducials_that_look_like_themselves_mirrored(s: Folder) -> Argv:
    s.edit("calibration.toml", "[[5, 7], [5, 9], [2, 7]]", "[[5, 7], [5, 9], [3, 8]]")
    return s.calibrate()


@refused("calibration.toml", r"fiducial \[11, 7\]", "11 rows")
def a_fiducial_outside_the_grid(s: Folder) -> Argv:
    s.edit("calibration.toml", "[[5, 7],", "[[11, 7],")
    return s.calibrate()


@refused("calibration.toml", "two planes are called 'w300'")
def two_planes_of_one_name(s: Folder) -> Argv:
    s.edit("calibration.toml", 'name = "w330"', 'name = "w300"')
    return s.calibrate()


@refused("calibration.toml", "'blue'", "the lasers are laser")
def a_laser_that_is_not_there(s: Folder) -> Argv:
    s.edit("calibration.toml", 'laser = "w300-laser/*.png"', 'laser = { blue = "w300-laser/*.png" }')
    return s.calibrate()


@refused("calibration.toml", "stage", "2 images and 3 positions")
def a_position_too_many(s: Folder) -> Argv:
    with (s / "calibration.toml").open("a", encoding="utf-8") as file:
        file.write('\n[[stage]]\nkind = "linear"\nimages = "w300/*.png"\npositions = [0.0, 1.0, 2.0]\n')
    return s.calibrate()


@refused("calibration.toml", "stage", r"0\.000\d mm a stated mm")
def a_stage_that_does_not_move(s: Folder) -> Argv:
    with (s / "calibration.toml").open("a", encoding="utf-8") as file:
        file.write('\n[[stage]]\nkind = "linear"\nimages = "w300/*.png"\npositions = [0.0, 10.0]\n')
    return s.calibrate()


@refused(r"stage/0\.png", "stage 1", "320 x 240 px", "640 x 480")
def a_stage_seen_by_another_camera(s: Folder) -> Argv:
    for k, name in enumerate(s.every("w300/*.png")):
        s.write(f"stage/{k}.png", cv2.resize(s.image(name), (320, 240)))
    with (s / "calibration.toml").open("a", encoding="utf-8") as file:
        file.write('\n[[stage]]\nkind = "linear"\nimages = "stage/*.png"\npositions = [0.0, 10.0]\n')
    return s.calibrate()


# --- images of a calibration --------------------------------------------------------------------------------------


@refused(r"w300/0\.png", "0 bytes", "again")
def an_image_of_no_bytes(s: Folder) -> Argv:
    (s / "w300/0.png").write_bytes(b"")
    return s.calibrate()


@refused(r"w300/0\.png", "no image", "again")
def a_text_for_an_image(s: Folder) -> Argv:
    (s / "w300/0.png").write_text("no image at all\n" * 30, encoding="utf-8")
    return s.calibrate()


def truncated(ending: str) -> Spoil:
    def spoil(s: Folder) -> Argv:
        for name in list(s.every("w300/*.png")):
            s.write(name.replace(".png", f".{ending}"), s.image(name))
            if ending != "png":
                (s / name).unlink()
        s.edit("calibration.toml", "w300/*.png", f"w300/*.{ending}")
        whole = (s / f"w300/0.{ending}").read_bytes()
        (s / f"w300/0.{ending}").write_bytes(whole[: len(whole) // 2])
        return s.calibrate()

    return spoil


for _ending in ("png", "jpg", "bmp", "tif"):
    CASES.append(
        pytest.param(truncated(_ending), (rf"w300/0\.{_ending}", "truncated", "again"), id=f"truncated_{_ending}")
    )


@refused(r"w300/1\.png", "320 x 240", "640 x 480", "same settings")
def repeats_of_different_size(s: Folder) -> Argv:
    s.write("w300/1.png", cv2.resize(s.image("w300/1.png"), (320, 240)))
    return s.calibrate()


@refused(r"w300/1\.png", "16 bit", "8 bit", "same settings")
def repeats_of_different_depth(s: Folder) -> Argv:
    s.write("w300/1.png", s.image("w300/1.png").astype(np.uint16) * 257)
    return s.calibrate()


@refused("calibration.toml", "w330", "512 x 384", "640 x 480", "one camera setting")
def planes_of_different_size(s: Folder) -> Argv:
    for name in list(s.every("w330/*.png")):
        s.write(name, cv2.resize(s.image(name), (512, 384), interpolation=cv2.INTER_AREA))
    return s.calibrate()


@refused(r"w300/0\.tif", "float32", "8- or 16-bit", "convert")
def a_float_image(s: Folder) -> Argv:
    for name in list(s.every("w300/*.png")):
        s.write(name.replace(".png", ".tif"), s.image(name).astype(np.float32))
    s.edit("calibration.toml", "w300/*.png", "w300/*.tif")
    return s.calibrate()


@refused("calibration.toml", "w300", "spot")
def black_images(s: Folder) -> Argv:
    for name in list(s.every("w300/*.png")):
        s.write(name, np.zeros((480, 640), np.uint8))
    return s.calibrate()


@refused("calibration.toml", "w300", "spot|saturated")
def white_images(s: Folder) -> Argv:
    for name in list(s.every("w300/*.png")):
        s.write(name, np.full((480, 640), 255, np.uint8))
    return s.calibrate()


@refused("calibration.toml", "w300", "fiducials|whole grid")
def a_grid_that_cannot_be_told_apart(s: Folder) -> Argv:
    s.edit("calibration.toml", "fiducials = [[5, 7], [5, 9], [2, 7]]\nfiducial_diameter = 9.0\n", "")
    for name in list(s.every("w300/*.png")):
        image = s.image(name)
        image[:, 560:] = image.min()
        s.write(name, image)
    return s.calibrate()


@refused("calibration.toml", "w300", "rows", "columns", "swapped|exchange|turned")
def rows_and_columns_swapped(s: Folder) -> Argv:
    s.edit("calibration.toml", "fiducials = [[5, 7], [5, 9], [2, 7]]\nfiducial_diameter = 9.0\n", "")
    s.edit("calibration.toml", "rows = 11\ncolumns = 15", "rows = 15\ncolumns = 11")
    return s.calibrate()


# --- what cannot be calibrated ------------------------------------------------------------------------------------


@refused("calibration.toml", "one plane", "two or more", "add")
def one_plane_only(s: Folder) -> Argv:
    s.only_planes(lambda k: k == 0)
    return s.calibrate()


@refused("calibration.toml", "w300", "w330", "stand-off", "300")
def two_planes_at_one_stand_off(s: Folder) -> Argv:
    s.edit("calibration.toml", "-78.5, 330.0", "-78.5, 300.0")
    return s.calibrate()


@refused("calibration.toml", "w300", "w330", "stand-off", "300")
def nothing_but_two_planes_at_one_stand_off(s: Folder) -> Argv:
    s.edit("calibration.toml", "-78.5, 330.0", "-78.5, 300.0")
    s.only_planes(lambda k: k < 2)
    return s.calibrate()


@refused("calibration.toml", "tilt", "focal length", "distance")
def freehand_views_all_parallel(s: Folder) -> Argv:
    text = (s / "calibration.toml").read_text(encoding="utf-8")
    text = re.sub(r"origin = \[-113.*\nrotation.*\n", "", text)
    (s / "calibration.toml").write_text(text, encoding="utf-8")
    return s.calibrate()


@refused("calibration.toml", "origin", "pinhole")
def a_joint_model_without_stand_offs(s: Folder) -> Argv:
    return [*freehand_views_all_parallel(s), "--model", "joint"]


@refused("calibration.toml", "pinhole", "remove the origins")
def a_pinhole_on_a_jig(s: Folder) -> Argv:
    return s.calibrate("--model", "pinhole")


def listed(
    s: Folder, rows: list[tuple[float, float, float, float, float]], *, plane: str = "w300", refine: bool = False
) -> None:
    """Marks of one plane by a list."""
    text = "x,y,z,u,v\n" + "".join(",".join(f"{value:.6f}" for value in row) + "\n" for row in rows)
    (s / f"{plane}.csv").write_text(text, encoding="utf-8")
    s.edit(
        "calibration.toml",
        f'name = "{plane}"',
        f'name = "{plane}"\npoints = "{plane}.csv"\nrefine = {str(refine).lower()}',
    )


def grid_rows(n: int, m: int) -> list[tuple[float, float, float, float, float]]:
    """Marks of a plane about as the camera of the session sees them at 300 mm."""
    return [(16.0 * j, 16.0 * i, 0.0, 58.0 + 37.3 * j, 53.0 + 37.3 * i) for i in range(n) for j in range(m)]


@refused("calibration.toml", "plane w300", "6 marks", "11 terms", "lower --order")
def too_few_marks_for_the_order(s: Folder) -> Argv:
    listed(s, grid_rows(2, 3))
    return s.calibrate("--order", "paper")


@refused("calibration.toml", "plane w300", "one line")
def collinear_marks(s: Folder) -> Argv:
    listed(s, grid_rows(1, 12))
    return s.calibrate()


@refused("calibration.toml", "plane w300", "one line")
def collinear_marks_that_rise(s: Folder) -> Argv:
    listed(s, [(x, y, 0.1 * x, u, v) for x, y, _, u, v in grid_rows(1, 12)])
    return s.calibrate()


@refused(r"w300\.csv", "0 marks|no mark|header alone|is empty")
def a_list_without_marks(s: Folder) -> Argv:
    listed(s, [])
    return s.calibrate()


@refused(r"w300\.csv", "row 3", "v", "'nan'", "finite number")
def a_list_with_nan(s: Folder) -> Argv:
    listed(s, [*grid_rows(1, 1), (16.0, 0.0, 0.0, 95.0, float("nan"))])
    return s.calibrate()


@refused(r"w300\.csv", "x, y, z, u", "needed too: v")
def a_list_without_a_column(s: Folder) -> Argv:
    listed(s, [])
    (s / "w300.csv").write_text("x,y,z,u\n1,2,3,4\n", encoding="utf-8")
    return s.calibrate()


@refused(r"w300\.csv", "cannot be read")
def a_list_that_is_not_there(s: Folder) -> Argv:
    listed(s, [])
    (s / "w300.csv").unlink()
    return s.calibrate()


@refused("calibration.toml", "w300", "off one plane", r"\[\[plane\]\] of its own")
def listed_marks_off_one_plane(s: Folder) -> Argv:
    listed(s, [(x, y, 0.01 * (x - 80) ** 2, u, v) for x, y, _, u, v in grid_rows(9, 12)])
    return s.calibrate()


@refused("calibration.toml", "w300", "grey levels", "exposure")
def listed_marks_where_there_are_none(s: Folder) -> Argv:
    for name in list(s.every("w300/*.png")):
        s.write(name, np.zeros((480, 640), np.uint8))
    listed(s, grid_rows(3, 4), refine=True)
    return s.calibrate()


@refused("calibration.toml", "w300", "0 of 4 views", "no stripe", r"is the laser on in 0\.png")
def laser_images_without_laser(s: Folder) -> Argv:
    for name in list(s.every("*-laser/0.png")):
        shutil.copy(s / "off/0.png", s / name)
    return s.calibrate()


@refused(r"w300-laser/0\.png", "plane w300", "320 x 240", "640 x 480")
def a_laser_image_of_another_size(s: Folder) -> Argv:
    s.write("w300-laser/0.png", cv2.resize(s.image("w300-laser/0.png"), (320, 240)))
    return s.calibrate()


@refused(r"off/0\.png|w300", "16 bit", "8 bit", "same settings")
def a_background_of_another_depth(s: Folder) -> Argv:
    for name in list(s.every("off/*.png")):
        s.write(name, s.image(name).astype(np.uint16) * 257)
    s.edit("calibration.toml", 'laser = "w300-laser/*.png"', 'laser = "w300-laser/*.png"\nbackground = "off/*.png"')
    return s.calibrate()


@refused("calibration.toml", "1 plane|one line", "two or more|free to turn")
def a_laser_on_one_plane_only(s: Folder) -> Argv:
    for plane in ("w330", "w360", "w390"):
        s.edit("calibration.toml", f'laser = "{plane}-laser/*.png"\n', "")
    return s.calibrate()


# --- outputs ------------------------------------------------------------------------------------------------------


@refused(r"absent/new\.json", "does not exist", "create it")
def a_rig_into_a_folder_that_is_not_there(s: Folder) -> Argv:
    return ["calibrate", str(s / "calibration.toml"), "-o", str(s / "absent/new.json")]


@refused("is a folder", "name a file")
def a_rig_named_like_a_folder(s: Folder) -> Argv:
    return ["calibrate", str(s / "calibration.toml"), "-o", str(s / "off")]


@refused(r"absent/page\.html", "does not exist")
def a_report_into_a_folder_that_is_not_there(s: Folder) -> Argv:
    return s.calibrate("--report", str(s / "absent/page.html"))


@refused(r"absent/cloud\.ply", "does not exist")
def a_cloud_into_a_folder_that_is_not_there(s: Folder) -> Argv:
    return [*s.scan()[:-1], str(s / "absent/cloud.ply")]


@refused(r"locked", "cannot be written|Permission denied")
def a_cloud_into_a_folder_that_is_locked(s: Folder) -> Argv:
    if os.geteuid() == 0:
        pytest.skip("the superuser may write anywhere")
    (s / "locked").mkdir(mode=0o555)
    return [*s.scan()[:-1], str(s / "locked/cloud.ply")]


@refused(r"new\.xyzzy", r"\.ply", "ending")
def a_cloud_of_an_unknown_format(s: Folder) -> Argv:
    return [*s.scan()[:-1], str(s / "new.xyzzy")]


@refused(r"calibration\.toml", "already there")
def a_template_over_a_calibration(s: Folder) -> Argv:
    return ["calibrate", str(s / "calibration.toml"), "--init"]


@refused("no plane is called 'w999'", "w300, w330")
def a_check_of_no_plane(s: Folder) -> Argv:
    return s.calibrate("--check", "w999")


# --- rigs ---------------------------------------------------------------------------------------------------------


@refused(r"nothing\.json", "cannot be read", "scope calibrate")
def no_such_rig(s: Folder) -> Argv:
    return ["scan", str(s / "capture.toml"), "--rig", str(s / "nothing.json"), "-o", str(s / "new.ply")]


@refused(r"rig\.json", "is no JSON", "calibrate again")
def a_truncated_rig(s: Folder) -> Argv:
    whole = (s / "rig.json").read_bytes()
    (s / "rig.json").write_bytes(whole[: len(whole) // 2])
    return s.scan()


@refused(r"rig\.json", "format 2", "format 1", "update")
def a_rig_of_a_newer_format(s: Folder) -> Argv:
    s.edit("rig.json", '"format": 1', '"format": 2')
    return s.scan()


@refused(r"rig\.json", "is no rig")
def a_rig_that_is_none(s: Folder) -> Argv:
    (s / "rig.json").write_text("[1, 2]", encoding="utf-8")
    return ["verify", str(s / "rig.json")]


def with_rig(change: Callable[[dict], None]) -> Callable[[Folder], Argv]:
    def spoil(s: Folder) -> Argv:
        content = json.loads((s / "rig.json").read_text(encoding="utf-8"))
        change(content)
        (s / "rig.json").write_text(json.dumps(content), encoding="utf-8")
        return s.scan()

    return spoil


for _name, _change in {
    "without_camera": lambda rig: rig.pop("camera"),
    "with_a_word_for_coefficients": lambda rig: rig["camera"]["field"].update(coefficients="none"),
    "with_coefficients_cut_off": lambda rig: rig["camera"]["field"]["coefficients"].pop(),
    "with_a_coefficient_that_is_null": lambda rig: rig["camera"]["field"]["coefficients"].__setitem__(0, [None, 1.0]),
    "with_a_size_of_zero": lambda rig: rig["camera"].update(size=[0, 480]),
    "with_an_infinite_size": lambda rig: rig["camera"].update(size=[float("inf"), 480]),
    "with_an_order_of_a_million": lambda rig: rig["camera"]["field"].update(slope_order=1000000),
    "with_a_normal_that_is_zero": lambda rig: rig["lasers"]["laser"]["sheet"].update(normal=[0.0, 0.0, 0.0]),
    "with_a_laser_along_nothing": lambda rig: rig["lasers"]["laser"].update(along="diagonals"),
    "with_a_pose_that_is_no_rotation": lambda rig: rig["camera"]["maps"][0]["c_from_plane"].update(
        rotation=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]
    ),
    "with_a_list_for_a_laser": lambda rig: rig.update(lasers=[1]),
    "with_null_for_an_offset": lambda rig: rig["lasers"]["laser"]["sheet"].update(offset=None),
    "with_one_map": lambda rig: rig["camera"].update(maps=rig["camera"]["maps"][:1]),
    "with_a_word_for_a_verdict": lambda rig: rig["verification"].update(planes=["w300"]),
}.items():
    CASES.append(
        pytest.param(with_rig(_change), (r"rig\.json", "damaged or edited", "calibrate again"), id=f"rig_{_name}")
    )


@refused(r"calibration\.toml", "w300", "320 x 240", "640 x 480")
def verified_with_another_camera(s: Folder) -> Argv:
    for name in list(s.every("w300/*.png")):
        s.write(name, cv2.resize(s.image(name), (320, 240), interpolation=cv2.INTER_AREA))
    return ["verify", str(s / "rig.json"), "--with", str(s / "calibration.toml")]


# --- capture.toml -------------------------------------------------------------------------------------------------


@refused(r"nothing\.toml", "cannot be read")
def no_such_capture(s: Folder) -> Argv:
    return ["scan", str(s / "nothing.toml"), "--rig", str(s / "rig.json"), "-o", str(s / "new.ply")]


@refused(r"capture\.toml", "images", "no file matches")
def a_capture_without_frames(s: Folder) -> Argv:
    s.edit("capture.toml", "frames/*.png", "frames/*.tif")
    return s.scan()


@refused(r"capture\.toml", "images and video", "exactly one")
def images_and_a_video(s: Folder) -> Argv:
    s.edit("capture.toml", "units", 'video = "a.avi"\nunits')
    return s.scan()


@refused(r"capture\.toml", "direction", r"\[0\.0, 0\.0, 0\.0\]", "length zero")
def a_direction_of_zero(s: Folder) -> Argv:
    s.edit("capture.toml", "[0.0, 1.0, 0.0]", "[0.0, 0.0, 0.0]")
    return s.scan()


@refused(r"capture\.toml", "step is 0")
def a_step_of_zero(s: Folder) -> Argv:
    s.edit("capture.toml", "step = 2.0", "step = 0.0")
    return s.scan()


@refused(r"capture\.toml", "rig", "stage", "none")
def a_stage_that_the_rig_does_not_have(s: Folder) -> Argv:
    s.edit("capture.toml", "direction = [0.0, 1.0, 0.0]", 'direction = "rig"')
    return s.scan()


@refused(r"capture\.toml", "moves is missing", 'moves = "object"', 'moves = "sensor"')
def a_motion_of_nobody(s: Folder) -> Argv:
    s.edit("capture.toml", 'moves = "object"\n', "")
    return s.scan()


@refused(r"capture\.toml", r"12 frames and no \[motion\]", "direction, step, moves", "turntable")
def frames_without_motion(s: Folder) -> Argv:
    text = (s / "capture.toml").read_text(encoding="utf-8").split("[motion]")[0]
    (s / "capture.toml").write_text(text, encoding="utf-8")
    return s.scan()


@refused(r"capture\.toml", "a camera and no", "add")
def a_camera_without_motion(s: Folder) -> Argv:
    text = (
        (s / "capture.toml")
        .read_text(encoding="utf-8")
        .split("[motion]")[0]
        .replace('images = "frames/*.png"', "camera = 63")
    )
    (s / "capture.toml").write_text(text, encoding="utf-8")
    return s.scan()


@refused(r"capture\.toml", "'cell-9'", "'cell-8'", "rig of this camera")
def a_capture_of_another_camera(s: Folder) -> Argv:
    s.edit("capture.toml", "units", 'camera_id = "cell-9"\nunits')
    replace(Rig.load(s / "rig.json"), camera_id="cell-8").save(s / "rig.json")
    return s.scan()


@refused(r"rig\.json", "altered since it was calibrated: camera_id", "--allow-edited")
def a_rig_with_another_name(s: Folder) -> Argv:
    s.edit("rig.json", '"camera_id": ""', '"camera_id": "cell-8"')
    return s.scan()


@refused(r"rig\.json", "damaged or edited", "volume", "calibrate again")
def a_rig_whose_volume_lost_an_offset(s: Folder) -> Argv:
    content = json.loads((s / "rig.json").read_text(encoding="utf-8"))
    content["camera"]["volume"]["offsets"].pop()
    (s / "rig.json").write_text(json.dumps(content), encoding="utf-8")
    return s.scan("--allow-edited")


@refused(r"capture\.toml", "'red'", "the rig has laser")
def a_laser_that_the_rig_does_not_have(s: Folder) -> Argv:
    s.edit("capture.toml", "units", 'lasers = ["red"]\nunits')
    return s.scan()


@refused(r"capture\.toml", "lasers", "twice|empty|name")
def no_laser_at_all(s: Folder) -> Argv:
    s.edit("capture.toml", "units", "lasers = []\nunits")
    return s.scan()


@refused(r"capture\.toml", "320 x 240", "640 x 480", "rig of this camera")
def frames_of_another_size_than_the_rig(s: Folder) -> Argv:
    for name in list(s.every("frames/*.png")):
        s.write(name, cv2.resize(s.image(name), (320, 240)))
    return s.scan()


@refused(r"capture\.toml", r"05\.png", "320 x 240", "640 x 480")
def a_folder_that_mixes_sizes(s: Folder) -> Argv:
    s.write("frames/05.png", cv2.resize(s.image("frames/05.png"), (320, 240)))
    return s.scan()


@refused(r"05\.png", "16 bit|uint16", "8 bit|uint8")
def a_folder_that_mixes_depths(s: Folder) -> Argv:
    s.write("frames/05.png", s.image("frames/05.png").astype(np.uint16) * 257)
    return s.scan()


@refused(r"05\.png", "float32", "convert")
def a_float_frame(s: Folder) -> Argv:
    for name in list(s.every("frames/*.png")):
        s.write(name.replace(".png", ".tif"), s.image(name))
    s.write("frames/05.tif", s.image("frames/05.png").astype(np.float32))
    (s / "frames/05.tif").rename(s / "frames/05.png.tif")
    s.edit("capture.toml", "frames/*.png", "frames/*.tif")
    return s.scan()


@refused(r"capture\.toml", "gap", r"04\.png", r"06\.png", "filename")
def a_gap_in_the_frame_numbers(s: Folder) -> Argv:
    (s / "frames/05.png").unlink()
    return s.scan()


@refused(r"capture\.toml", "filename", "number")
def frame_numbers_beyond_reason(s: Folder) -> Argv:
    s.edit("capture.toml", "step = 2.0", 'step = 2.0\nindex = "filename"')
    (s / "frames/11.png").rename(s / "frames/20261122030819.png")
    return s.scan()


@refused(r"capture\.toml", "no point in any of 12 frames", "laser is on", "channel")
def frames_without_any_stripe(s: Folder) -> Argv:
    for name in list(s.every("frames/*.png")):
        shutil.copy(s / "off/0.png", s / name)
    return s.scan()


@refused(r"off/1\.png", "320 x 240", "640 x 480")
def backgrounds_that_differ(s: Folder) -> Argv:
    s.write("off/1.png", cv2.resize(s.image("off/1.png"), (320, 240)))
    return s.scan()


@refused("16 bit|uint16", "8 bit|uint8")
def a_scan_background_of_another_depth(s: Folder) -> Argv:
    for name in list(s.every("off/*.png")):
        s.write(name, s.image(name).astype(np.uint16) * 257)
    return s.scan()


@refused(r"capture\.toml", "2 backgrounds for 12 images", "one for each")
def too_few_paired_backgrounds(s: Folder) -> Argv:
    s.edit("capture.toml", 'background = "off/*.png"', 'background = "off/*.png"\nbackground_mode = "paired"')
    return s.scan()


@refused(r"capture\.toml", "11 images", "pairs")
def an_odd_number_of_alternate_images(s: Folder) -> Argv:
    (s / "frames/11.png").unlink()
    s.edit("capture.toml", 'background = "off/*.png"', 'background_mode = "alternate"')
    return s.scan()


def poses(s: Folder, rows: list[list[float]], *, more: str = 'convention = "object_from_camera"\n') -> Argv:
    header = "frame," + ",".join(f"m{i}{j}" for i in range(4) for j in range(4))
    lines = [header, *(",".join([str(k), *map(str, row)]) for k, row in enumerate(rows))]
    (s / "poses.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    text = (s / "capture.toml").read_text(encoding="utf-8").split("[motion]")[0]
    (s / "capture.toml").write_text(f'{text}[motion]\nkind = "poses"\nposes = "poses.csv"\n{more}', encoding="utf-8")
    return s.scan()


def still(n: int) -> list[list[float]]:
    return [np.eye(4).ravel().tolist() for _ in range(n)]


@refused(r"poses\.csv", "11 rows for 12 frames", "frame 11")
def a_pose_too_few(s: Folder) -> Argv:
    return poses(s, still(11))


@refused(r"poses\.csv", "row 5", "m03", "'nan'", "finite")
def a_pose_with_nan(s: Folder) -> Argv:
    rows = still(12)
    rows[3][3] = float("nan")
    return poses(s, rows)


@refused(r"capture\.toml", "convention is missing", "camera_from_object")
def poses_without_convention(s: Folder) -> Argv:
    return poses(s, still(12), more="")


@refused(r"poses\.csv", "row 4", "no rotation")
def a_pose_that_shears(s: Folder) -> Argv:
    rows = still(12)
    rows[2][1] = 0.1
    return poses(s, rows)


@refused(r"poses\.csv", "row 4", "no rotation")
def a_pose_that_mirrors(s: Folder) -> Argv:
    rows = still(12)
    rows[2][0] = -1.0
    return poses(s, rows)


@refused(r"poses\.csv", "row 4", "last row")
def a_pose_that_is_transposed(s: Folder) -> Argv:
    rows = still(12)
    rows[2][12] = 30.0
    return poses(s, rows)


@refused(r"stage\.csv", "frame 11|11 rows")
def a_position_too_few(s: Folder) -> Argv:
    s.edit("capture.toml", "step = 2.0\nstart = -11.0", 'positions = "stage.csv"')
    (s / "stage.csv").write_text("frame,position\n" + "".join(f"{k},{k}\n" for k in range(11)), encoding="utf-8")
    return s.scan()


@refused(r"new\.ply\.part", "another capture", "without --resume")
def a_part_of_something_else(s: Folder) -> Argv:
    (s / "new.ply.part").write_text('{"capture": "other"}\n', encoding="utf-8")
    return s.scan("--resume")


@refused(r"new\.ply\.part", "another capture", "without --resume")
def a_part_that_is_none(s: Folder) -> Argv:
    (s / "new.ply.part").write_bytes(bytes(range(256)) * 10)
    return s.scan("--resume")


@refused(r"frames/03\.png|frames/3\.png", "damaged", "IDAT", "checksum")
def a_frame_with_a_damaged_chunk(s: Folder) -> Argv:
    path = sorted((s / "frames").glob("*.png"))[3]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(bytes(data))
    return s.scan()


@refused(r"sweep\.avi", "not there")
def a_video_that_is_not_there(s: Folder) -> Argv:
    s.edit("capture.toml", 'images = "frames/*.png"', 'video = "sweep.avi"')
    return s.scan()


@refused(r"sweep\.avi", "no video", "record it again")
def a_video_that_is_none(s: Folder) -> Argv:
    (s / "sweep.avi").write_bytes(b"RIFF" + bytes(500))
    s.edit("capture.toml", 'images = "frames/*.png"', 'video = "sweep.avi"')
    return s.scan()


@refused("camera 63 does not answer", "cable")
def a_camera_that_is_not_there(s: Folder) -> Argv:
    s.edit("capture.toml", 'images = "frames/*.png"', "camera = 63\nframes = 5")
    return s.scan()


# --- clouds and designs -------------------------------------------------------------------------------------------


@refused(r"nothing\.ply", "cannot be read")
def no_such_cloud(s: Folder) -> Argv:
    return ["export", str(s / "nothing.ply"), str(s / "new.xyz")]


@refused(r"rig\.json", "not a PLY")
def a_rig_for_a_cloud(s: Folder) -> Argv:
    return ["export", str(s / "rig.json"), str(s / "new.xyz")]


@refused(r"cloud\.ply", "1 of 2 points are NaN")
def a_cloud_with_nan(s: Folder) -> Argv:
    text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (s / "cloud.ply").write_text(text + "1 2 3\n1 nan 3\n", encoding="utf-8")
    return ["export", str(s / "cloud.ply"), str(s / "new.xyz")]


@refused(r"cloud\.ply", "truncated")
def a_truncated_cloud(s: Folder) -> Argv:
    text = "ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (s / "cloud.ply").write_text(text, encoding="utf-8")
    return ["export", str(s / "cloud.ply"), str(s / "new.xyz")]


@refused(r"design\.toml", "no such file|cannot be read")
def no_such_design(s: Folder) -> Argv:
    return ["simulate", str(s / "design.toml"), "-o", str(s / "out")]


# --- the law ------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(session, tmp_path: Path) -> Folder:  # type: ignore[no-untyped-def]
    shutil.copytree(session.folder, tmp_path / "s", ignore=shutil.ignore_patterns("truth"))
    return Folder(tmp_path / "s")


def contents(folder: Folder) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("spoil", "patterns"), CASES)
def test_bad_input_is_refused_in_one_line(
    spoil: Spoil, patterns: tuple[str, ...], folder: Folder, capfd: pytest.CaptureFixture[str]
) -> None:
    argv = spoil(folder)
    before = contents(folder)
    capfd.readouterr()
    done = CliRunner().invoke(app, argv)
    printed = capfd.readouterr()  # what libraries print past Python
    assert done.exception is None or isinstance(done.exception, SystemExit), repr(done.exception)
    assert done.exit_code == 1
    assert done.stdout == ""
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    assert len(lines[0]) - len(str(folder.path)) * lines[0].count(str(folder.path)) <= 300  # paths of this test aside
    assert [p for p in patterns if not re.search(p, lines[0])] == [], lines[0]
    past = [
        line for line in printed.err.splitlines() if line.strip() and "global " not in line
    ]  # OpenCV's log: see below
    assert (printed.out, past) == ("", [])
    assert contents(folder) == before


@pytest.mark.parametrize(
    "spoil", [truncated("tif"), a_camera_that_is_not_there, a_frame_with_a_damaged_chunk], ids=["tif", "camera", "png"]
)
def test_libraries_add_nothing_to_the_one_line(spoil: Spoil, folder: Folder) -> None:
    code = "import sys; from cli.main import main; main()"
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code, *spoil(folder)], cwd=root, capture_output=True, text=True, check=False, timeout=120
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stderr.startswith("error: ")
