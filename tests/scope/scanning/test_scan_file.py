"""Scans to files: what is interrupted goes on to the very same cloud; videos and cameras that break off."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.errors import FileError, ScopeError
from calibration.rig import Rig
from cli.main import app
from scope.cloud import ScanCloud
from scope.scanning import ScanOptions, scan_to_file
from scope.scanning import run as scanning
from scope.session import read_capture


@pytest.fixture(scope="module")
def long_capture(session, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The twelve frames of the session four times over: three chunks."""
    folder = tmp_path_factory.mktemp("long")
    for k in range(48):
        shutil.copy(session.folder / f"frames/{k % 12:02d}.png", folder / f"{k:03d}.png")
    text = session.capture.read_text(encoding="utf-8").replace("frames/*.png", "*.png")
    (folder / "capture.toml").write_text(text.replace('background = "off/*.png"\n', ""), encoding="utf-8")
    return folder / "capture.toml"


@pytest.mark.parametrize("normals", [False, True])
def test_a_scan_that_failed_goes_on_to_the_same_cloud(
    session, long_capture: Path, tmp_path: Path, normals: bool
) -> None:
    options = ScanOptions(normals=normals)
    scan_to_file(long_capture, session.rig, tmp_path / "whole.ply", options)
    spoiled = long_capture.parent / "040.png"
    kept = spoiled.read_bytes()
    try:
        spoiled.unlink()
        spoiled.write_bytes(b"")  # vanishes while scanning
        with pytest.raises(FileError, match=r"040\.png.*0 bytes.*26 frames are kept.*--resume"):
            scan_to_file(long_capture, session.rig, tmp_path / "cloud.ply", options)
    finally:
        spoiled.write_bytes(kept)
    assert not (tmp_path / "cloud.ply").exists()
    assert (tmp_path / "cloud.ply.part").stat().st_size > 10_000
    found = scan_to_file(long_capture, session.rig, tmp_path / "cloud.ply", options, resume=True)
    assert found.frames == 48
    assert (tmp_path / "cloud.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert not (tmp_path / "cloud.ply.part").exists()


def test_a_part_that_is_cut_anywhere_goes_on(session, long_capture: Path, tmp_path: Path) -> None:
    whole = tmp_path / "whole.ply"
    scan_to_file(long_capture, session.rig, whole, ScanOptions())
    spoiled = long_capture.parent / "047.png"
    kept = spoiled.read_bytes()
    try:
        spoiled.write_bytes(b"")
        with pytest.raises(FileError):
            scan_to_file(long_capture, session.rig, tmp_path / "cloud.ply", ScanOptions())
    finally:
        spoiled.write_bytes(kept)
    part = (tmp_path / "cloud.ply.part").read_bytes()
    for share in (0.3, 0.9):
        (tmp_path / "cloud.ply.part").write_bytes(part[: int(share * len(part))])
        scan_to_file(long_capture, session.rig, tmp_path / "cloud.ply", ScanOptions(), resume=True)
        assert (tmp_path / "cloud.ply").read_bytes() == whole.read_bytes()


def test_nothing_to_resume_is_a_scan_from_the_beginning(session, tmp_path: Path) -> None:
    scan_to_file(session.capture, session.rig, tmp_path / "whole.ply", ScanOptions())
    scan_to_file(session.capture, session.rig, tmp_path / "cloud.ply", ScanOptions(), resume=True)
    assert (tmp_path / "cloud.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert not (tmp_path / "cloud.ply.part").exists()


@pytest.mark.parametrize("stop", [2, 30])
def test_a_scan_that_the_user_ended_goes_on_to_the_same_cloud(
    session, long_capture: Path, tmp_path: Path, stop: int
) -> None:
    scan_to_file(long_capture, session.rig, tmp_path / "whole.ply", ScanOptions())

    def tick(done: int, _total: int) -> None:
        if done == stop:
            raise KeyboardInterrupt

    found = scan_to_file(long_capture, session.rig, tmp_path / "cloud.ply", ScanOptions(), on_frame=tick)
    assert found.frames == stop
    assert f"after {stop} frames" in found.why_incomplete
    assert not ScanCloud.load(tmp_path / "cloud.ply").complete
    assert scan_to_file(long_capture, session.rig, tmp_path / "cloud.ply", ScanOptions(), resume=True).frames == 48
    assert (tmp_path / "cloud.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


def test_a_typing_error_does_not_cost_the_part(session, tmp_path: Path) -> None:
    (tmp_path / "cloud.ply.part").write_bytes(b"what an hour of scanning gave")
    with pytest.raises(ScopeError):
        scan_to_file(tmp_path / "nothing.toml", session.rig, tmp_path / "cloud.ply", ScanOptions())
    assert (tmp_path / "cloud.ply.part").read_bytes() == b"what an hour of scanning gave"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_told(session, tmp_path: Path) -> None:
    (tmp_path / "cloud.ply.part").symlink_to("/dev/full")
    with pytest.raises(FileError, match=r"cloud\.ply\.part.*[Nn]o space"):
        scan_to_file(session.capture, session.rig, tmp_path / "cloud.ply", ScanOptions())


def test_frames_without_stripe_are_counted(session, copy_of_session, tmp_path: Path) -> None:
    copy = copy_of_session()
    shutil.copy(copy.folder / "off/0.png", copy.folder / "frames/04.png")
    done = CliRunner().invoke(
        app, ["scan", str(copy.capture), "-r", str(copy.rig), "-o", str(tmp_path / "c.ply"), "--json"]
    )
    assert done.exit_code == 0
    result = json.loads(done.stdout)
    assert (result["frames"], result["empty_frames"], result["complete"]) == (12, 1, True)
    assert set(np.unique(ScanCloud.load(tmp_path / "c.ply").frame)) == set(range(12)) - {4}


def agree(found: ScanCloud, plain: ScanCloud) -> bool:
    """The same points on the same lines, but for what frames that are missing would have told of their neighbours."""
    line = 0 if float(np.abs(plain.pixels[:, 0] % 1).max()) < 1e-3 else 1
    place = {(f, round(float(p[line]))): x for f, p, x in zip(plain.frame, plain.pixels, plain.points, strict=True)}
    shared = [(x, place[key]) for f, p, x in zip(found.frame, found.pixels, found.points, strict=True)
              if (key := (f, round(float(p[line])))) in place]  # fmt: skip
    gap = np.array([np.linalg.norm(a - b) for a, b in shared])
    return len(shared) > 0.95 * max(len(found), len(plain)) and float(np.percentile(gap, 95)) < 0.02


class Recorded:
    """A video that stands in for a camera: its frames, and then nothing."""

    def __init__(self, frames: list[np.ndarray]) -> None:
        self.frames = list(frames)

    def isOpened(self) -> bool:
        return True

    def read(self) -> tuple[bool, np.ndarray | None]:
        return (True, self.frames.pop(0)) if self.frames else (False, None)

    def get(self, _: int) -> float:
        return 0.0

    def release(self) -> None:
        self.frames = []


@pytest.mark.parametrize(("asked", "given", "complete"), [(8, 12, True), (12, 7, False)])
def test_a_camera(
    session, copy_of_session, monkeypatch: pytest.MonkeyPatch, asked: int, given: int, complete: bool
) -> None:
    copy = copy_of_session()
    text = copy.capture.read_text(encoding="utf-8")
    copy.capture.write_text(text.replace('images = "frames/*.png"', f"camera = 0\nframes = {asked}"), encoding="utf-8")
    frames = [cv2.imread(str(copy.folder / f"frames/{k:02d}.png"), cv2.IMREAD_UNCHANGED) for k in range(given)]
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: Recorded(frames))
    found = scanning.run_scan(copy.capture, Rig.load(copy.rig))
    plain = scanning.run_scan(session.capture, Rig.load(session.rig)).cloud
    n = min(asked, given)
    assert (found.frames, found.cloud.complete) == (n, complete)
    assert agree(found.cloud, plain.select(plain.frame < n))
    assert ("7 of 12" in found.why_incomplete) != complete


def test_frames_in_colour_are_read_in_the_colour_of_the_line_though_the_rig_knows_none(
    session, copy_of_session
) -> None:
    copy = copy_of_session()
    shade = np.repeat(np.repeat(np.random.default_rng(0).integers(20, 120, (12, 16, 1)), 40, axis=0), 40, axis=1)
    for path in copy.folder.glob("frames/*.png"):
        lit = np.repeat(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[:, :, None], 3, axis=2) * np.array([0.05, 0.1, 1.0])
        cv2.imwrite(str(path), np.clip(lit + shade, 0, 255).astype(np.uint8))  # grey things in white light
    text = copy.capture.read_text(encoding="utf-8").replace('background = "off/*.png"\n', "")
    copy.capture.write_text(text, encoding="utf-8")
    rig = Rig.load(copy.rig)
    assert rig.lasers["laser"].channel == "gray"
    plain = scanning.run_scan(session.capture, rig).cloud
    found = scanning.run_scan(copy.capture, rig).cloud
    assert len(found) > 0.9 * len(plain)


def test_the_report_of_a_video_shows_its_hard_frames(session, copy_of_session, tmp_path: Path) -> None:
    copy = copy_of_session()
    out = cv2.VideoWriter(str(copy.folder / "sweep.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (640, 480))
    for k in range(12):
        out.write(cv2.imread(str(session.folder / f"frames/{k:02d}.png")))
    out.release()
    text = copy.capture.read_text(encoding="utf-8").replace('images = "frames/*.png"', 'video = "sweep.avi"')
    copy.capture.write_text(text.replace('background = "off/*.png"\n', ""), encoding="utf-8")
    page = tmp_path / "scan.html"
    done = CliRunner().invoke(
        app, ["scan", str(copy.capture), "-r", str(copy.rig), "-o", str(tmp_path / "c.ply"), "--report", str(page)]
    )
    assert done.exit_code == 0
    assert page.read_text(encoding="utf-8").count("sweep.avi frame ") >= 3


def test_frames_of_another_depth_are_refused(session, copy_of_session) -> None:
    copy = copy_of_session()
    path = copy.folder / "frames/07.png"
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint16) * 257)
    with pytest.raises(FileError, match=r"07\.png.*16 bit grey.*8 bit grey"):
        scanning.run_scan(copy.capture, Rig.load(copy.rig))


def test_numbers_from_file_names_leave_gaps(session, copy_of_session) -> None:
    copy = copy_of_session()
    (copy.folder / "frames/05.png").unlink()
    text = copy.capture.read_text(encoding="utf-8").replace("step = 2.0", 'step = 2.0\nindex = "filename"')
    copy.capture.write_text(text, encoding="utf-8")
    plain = scanning.run_scan(session.capture, Rig.load(session.rig)).cloud
    found = scanning.run_scan(copy.capture, Rig.load(copy.rig)).cloud
    assert agree(found, plain.select(plain.frame != 5))
    listed = text.replace('step = 2.0\nindex = "filename"\nstart = -11.0', 'positions = "p.csv"\nindex = "filename"')
    rows = "".join(f"{k:02d}.png,{-11 + 2 * k}\n" for k in range(12))
    (copy.folder / "p.csv").write_text("image,position\n" + rows, encoding="utf-8")
    copy.capture.write_text(listed, encoding="utf-8")
    assert read_capture(copy.capture).numbers == (0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11)
    assert np.allclose(scanning.run_scan(copy.capture, Rig.load(copy.rig)).cloud.points, found.points, atol=1e-9)
