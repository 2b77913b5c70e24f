"""One bad image never ends a calibration: it is left out with its reason, counted, and the rest goes on."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.errors import FileError
from cli.main import app
from scope.session import read_calibration


def test_views_and_laser_images_that_cannot_be_used_are_left_out(session, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    shutil.copytree(session.folder, tmp_path / "s", ignore=shutil.ignore_patterns("truth"))
    folder = tmp_path / "s"
    shutil.copy(folder / "off/0.png", folder / "w300-laser/0.png")
    (folder / "more").mkdir()
    cv2.imwrite(str(folder / "more/dark.png"), np.zeros((480, 640), np.uint8))
    (folder / "more/damaged.png").write_bytes(b"no image")
    cv2.imwrite(str(folder / "more/small.png"), np.zeros((240, 320), np.uint8))
    file = folder / "calibration.toml"
    file.write_text(file.read_text(encoding="utf-8") + '\n[[views]]\nimages = "more/*.png"\n', encoding="utf-8")
    done = CliRunner().invoke(
        app, ["calibrate", str(file), "-o", str(folder / "new.json"), "--report", str(folder / "r.html"), "--json"]
    )
    assert done.exit_code == 0, done.stderr
    result = json.loads(done.stdout)
    dropped = {(each["part"], each["name"]): each["reason"] for each in result["dropped"]}
    assert set(dropped) == {("view", f"more/{name}") for name in ("dark", "damaged", "small")} | {("laser", "w300")}
    assert "is the laser on in 0.png" in dropped["laser", "w300"]
    assert all(each["count"] == 1 for each in result["dropped"])
    (laser,) = result["lasers"].values()
    assert laser["views"] == len(laser["planes"]) == 3
    page = (folder / "r.html").read_text(encoding="utf-8")
    assert "Left out" in page
    assert "1 of 4 laser images" in page


def files(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"x")


HEAD = 'format = 1\n[target]\nkind = "chessboard"\nrows = 6\ncolumns = 8\npitch = 4\n'


def plan(folder: Path, text: str):  # type: ignore[no-untyped-def]
    (folder / "c.toml").write_text(HEAD + text, encoding="utf-8")
    return read_calibration(folder / "c.toml")


def test_a_glob_brings_many_views_named_by_their_folder(tmp_path: Path) -> None:
    files(tmp_path, "a/im10.png", "a/im2.png", "b/im2.png", "b/im10.png", "b[1]/im2.png")
    read = plan(
        tmp_path,
        '[[views]]\nimages = "a/*.png"\n[[views]]\nimages = "b/*.png"\nlaser = "same"\nbackground = "a/*.png"\n',
    )
    assert [plane.name for plane in read.planes] == ["a/im2", "a/im10", "b/im2", "b/im10"]
    assert read.planes[0].lasers == {}
    assert [path.name for path in read.planes[3].lasers["laser"]] == ["im10.png"]
    assert read.planes[3].backgrounds["laser"][0].parent.name == "a"
    assert [p.name for p in plan(tmp_path, '[[views]]\nimages = "b[[]1]/*.png"\n').planes] == ["b[1]/im2"]
    with pytest.raises(FileError, match="2 files match .* for 1 views"):
        plan(tmp_path, '[[views]]\nimages = "a/im2.png"\nlaser = "b/*.png"\n')
    with pytest.raises(FileError, match="two planes are called 'a/im2'"):
        plan(tmp_path, '[[views]]\nimages = "a/im2.png"\n[[views]]\nimages = "a/im2.png"\n')
    with pytest.raises(FileError, match=r"no \[\[plane\]\]"):
        plan(tmp_path, "")


def test_planes_of_equal_stems_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    files(tmp_path, "a/im2.png", "b/im2.png", "b/im3.png")
    read = plan(tmp_path, "".join(f'[[plane]]\nimages = "{name}.png"\n' for name in ("a/im2", "b/im2", "b/im3")))
    assert [plane.name for plane in read.planes] == ["a/im2", "b/im2", "im3"]


def test_targets_of_other_makers_are_read(tmp_path: Path) -> None:
    files(tmp_path, "a/im2.png")
    tail = '[[plane]]\nimages = "a/im2.png"\n'

    def target(text: str):  # type: ignore[no-untyped-def]
        (tmp_path / "c.toml").write_text(f'format = 1\nunits = "cm"\n[target]\n{text}\n{tail}', encoding="utf-8")
        return read_calibration(tmp_path / "c.toml")

    read = target(
        'kind = "markers"\ndictionary = "DICT_4X4_50"\nmarker = 3.0\nplaces = [{ id = 5, x = -9.0, y = 0, turn = 90 }]'
    )
    assert read.target.marks == pytest.approx(
        np.array([[-75, -15, 0], [-75, 15, 0], [-105, 15, 0], [-105, -15, 0]]), abs=1e-9
    )
    read = target('kind = "circles"\nrows = 3\ncolumns = 2\npitch = 2\nplate = [-1, 9, -1, 5]')
    assert read.target.marks[:, :2].tolist() == [[0, 0], [40, 0], [20, 20], [60, 20], [0, 40], [40, 40]]
    assert read.plate == (-10.0, 90.0, -10.0, 50.0)
    assert target('kind = "spots"\nrows = 3\ncolumns = 4\npitch = 2').target.diameter is None
    with pytest.raises(FileError, match="no rectangle"):
        target('kind = "spots"\nrows = 3\ncolumns = 4\npitch = 2\nplate = [9, -1, -1, 5]')
    with pytest.raises(FileError, match="marker 5 twice"):
        target('kind = "markers"\nmarker = 3\nplaces = [{ id = 5, x = 0, y = 0 }, { id = 5, x = 9, y = 0 }]')
