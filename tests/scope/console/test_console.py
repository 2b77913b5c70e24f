"""The console's parts without a browser: jobs, steps, looks, and scans that leave what the commands need."""

from __future__ import annotations

import errno
import shutil
import threading
import time
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.small_session import DESIGN
from calibration.errors import FileError
from calibration.reason import Reason
from scope.cameras import SimulatedCamera
from scope.console.console import Console
from scope.console.folder import SessionFolder, toml_text
from scope.console.jobs import Busy, Jobs
from scope.console.look import look_at, picture
from scope.console.recording import Place, motion_of
from scope.errors import CameraError
from scope.scanning import Scanner, run_scan
from scope.session import CameraSettings, read_image
from scope.simulation import planned_session


@pytest.fixture
def console(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Console]:
    """A console on a virtual rig of eight frames, its session still empty."""
    monkeypatch.delenv("SCOPE_HISTORY")
    design = tmp_path / "design.toml"
    design.write_text(DESIGN.replace("frames = 12", "frames = 8"), encoding="utf-8")
    folder = SessionFolder.open(tmp_path / "session")
    text, motion = planned_session(design)
    folder.calibration.write_text(text, encoding="utf-8")
    made = Console.open(folder, CameraSettings("simulated", str(design)), motion)
    made.steps.repeats = 2
    yield made
    made.close()


def wait_for_camera(console: Console) -> None:
    for _ in range(200):
        if console.station.frames:
            return
        time.sleep(0.05)
    raise AssertionError(console.station.trouble)


@pytest.mark.long
def test_taken_calibrated_scanned_and_what_the_commands_make_of_the_same_folder(console: Console) -> None:
    """The folder is the peer: `scope calibrate` and `scope scan` on what the console left give the same."""
    from scope.calibrating import calibrate

    wait_for_camera(console)
    assert [step.light for step in console.steps.all()] == ["empty"] * 4
    for step in console.steps.all():
        console.steps.take(console.station, step.name)
    assert [step.light for step in console.steps.all()] == ["good"] * 4
    job = console.start_calibration()
    console.jobs.wait(120)
    assert job.state == "done", job.message
    assert job.result["passed"] == calibrate(console.folder.calibration).passed
    job = console.start_scan({}, "first")
    assert console.start_scan({}, "first") is job  # the same id starts no second one
    console.jobs.wait(120)
    assert job.state == "done", job.message
    place = console.folder.scan("first")
    assert len(list((place / "frames").iterdir())) == 8
    again = run_scan(place / "capture.toml", console.folder.rig)
    from scope.cloud import ScanCloud

    kept = ScanCloud.load(place / "cloud.ply")
    np.testing.assert_array_equal(kept.points, again.cloud.points.astype(np.float32).astype(np.float64))
    assert console.growth.points == len(again.cloud)
    assert [record.kind for record in console.history()] == ["scan", "calibrate"]
    with pytest.raises(FileError, match="there is no such file"):
        console.file("scans", "first", "nothing.ply")


def test_a_skipped_stand_off_is_left_out_and_the_file_that_was_used_is_kept(console: Console) -> None:
    wait_for_camera(console)
    names = [step.name for step in console.steps.all()]
    console.steps.skip(names[1], out=True)
    assert [step.light for step in console.steps.all()] == ["empty", "skipped", "empty", "empty"]
    used = tomllib.loads(console.steps._used_file().read_text(encoding="utf-8"))
    assert [plane["name"] for plane in used["plane"]] == [names[0], *names[2:]]
    assert used["target"] == tomllib.loads(console.folder.calibration.read_text(encoding="utf-8"))["target"]


@pytest.mark.long
def test_a_stopped_scan_keeps_the_frames_that_came(console: Console, session) -> None:
    wait_for_camera(console)
    console.folder.rig.write_bytes(session.rig.read_bytes())
    console.station.settings = CameraSettings("simulated", console.station.settings.id, rate=4.0)
    job = console.start_scan({}, "cut")
    while not console.growth.name or not list((console.folder.scan("cut") / "frames").glob("*")):
        time.sleep(0.02)
    console.stop()
    console.jobs.wait(60)
    kept = sorted((console.folder.scan("cut") / "frames").iterdir())
    assert 0 < len(kept) <= 8
    assert job.state == "done", job.message
    assert job.result["frames"] == len(kept)


@pytest.mark.long
def test_a_scan_that_broke_off_is_finished_or_gone_on_with(console: Console, session) -> None:
    """The peer is a scan in one piece: frames 0 to 2 kept, the camera takes the others, one cloud bit for bit."""
    wait_for_camera(console)
    console.folder.rig.write_bytes(session.rig.read_bytes())
    whole = console.start_scan({}, "whole")
    console.jobs.wait(120)
    assert whole.state == "done", whole.message
    for name in ("cut", "cut-too"):
        place = Place(console.folder, console.folder.new_scan(name))
        place.begin(console.station.settings, {"motion": motion_of(console.motion), "frames": None})
        (place.path / "frames").mkdir()
        for k in range(3):
            shutil.copy(console.folder.scan("whole") / "frames" / f"{k:06d}.png", place.path / "frames")
    assert sorted(console.folder.unfinished()) == ["cut", "cut-too"]
    assert console.can_go_on("cut")
    job = console.resume_scan("cut", camera=True)
    console.jobs.wait(120)
    assert job.state == "done", job.message
    clouds = [(console.folder.scan(name) / "cloud.ply").read_bytes() for name in ("whole", "cut")]
    assert clouds[0] == clouds[1]
    job = console.resume_scan("cut-too", camera=False)
    console.jobs.wait(120)
    assert (job.state, job.result["frames"]) == ("done", 3)
    assert console.folder.unfinished() == []
    with pytest.raises(FileError, match="no unfinished scan"):
        console.resume_scan("whole", camera=False)


def test_a_scan_by_a_log_takes_the_log_with_it(console: Console, session) -> None:
    """The virtual stage goes 2 mm a frame at 25 a second; the log ends before the last two frames."""
    wait_for_camera(console)
    console.folder.rig.write_bytes(session.rig.read_bytes())
    rows = "".join(f"{0.1 * k:.1f},{-11.0 + 5.0 * k}\n" for k in range(-3, 3))
    (console.folder.root / "stage.csv").write_text(f"seconds,position\n{rows}", encoding="utf-8")
    motion = {"kind": "linear", "moves": "object", "direction": [0.0, 1.0, 0.0], "log": "stage.csv", "delay": 0.0}
    console.station.settings = replace(console.station.settings, timeout_s=0.2)
    job = console.start_scan({"motion": motion}, "logged")
    console.jobs.wait(120)
    assert job.state == "done", job.message
    assert (job.result["frames"], job.result["complete"]) == (6, False)
    place = console.folder.scan("logged")
    (console.folder.root / "stage.csv").unlink()
    again = run_scan(place / "capture.toml", console.folder.rig)
    # the noise was learnt from all frames that came, of which two have no position
    assert len(again.cloud) == pytest.approx(job.result["points"], rel=0.01)
    assert len(list((place / "frames-without-position").iterdir())) >= 1
    with pytest.raises(ValueError, match="name of a CSV"):
        motion_of({**motion, "log": "../stage.csv"})


def test_stand_offs_of_several_lasers_have_a_shot_for_each(console: Console) -> None:
    wait_for_camera(console)
    text = console.folder.calibration.read_text(encoding="utf-8")
    first = next(step for step in console.steps.all() if step.shots.get("laser"))
    lit = first.shots["laser"][0]
    other = lit.replace("laser", "green")
    console.folder.calibration.write_text(
        text.replace(f'laser = "{lit}"', f'laser = {{ red = "{lit}", green = "{other}" }}'), encoding="utf-8"
    )
    step = console.steps.all()[0]
    assert [kind for kind in step.shots if kind.startswith("laser")] == ["laser red", "laser green"]
    assert console.steps.in_turn(console.station, step) == []
    assert "laser green" in console.steps.take(console.station, step.name, "laser green")
    assert console.steps.all()[0].files["laser green"] == 2
    with pytest.raises(FileError, match="asks for no laser blue"):
        console.steps.take(console.station, step.name, "laser blue")


def test_a_disk_that_is_full_while_images_are_taken_leaves_those_before(console: Console, monkeypatch) -> None:
    wait_for_camera(console)
    step = console.steps.all()[0]
    console.steps.take(console.station, step.name)
    place = console.folder.root / Path(step.shots["target"][0]).parent
    before = {path.name: path.read_bytes() for path in place.iterdir()}
    room, write = [1], Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        room[0] -= 1
        if room[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(FileError, match="No space left on device"):
        console.steps.take(console.station, step.name)
    assert {path.name: path.read_bytes() for path in place.iterdir()} == before


@pytest.mark.parametrize("cause", ["the disk is full", "the camera is gone"])
def test_what_breaks_off_a_scan_keeps_the_frames_that_came(console: Console, session, monkeypatch, cause: str) -> None:
    wait_for_camera(console)
    console.folder.rig.write_bytes(session.rig.read_bytes())
    write, read = Path.write_bytes, SimulatedCamera.read

    def full(path: Path, data: bytes) -> int:
        if path.name.startswith(".000005"):
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, data)

    def gone(camera: SimulatedCamera) -> Any:
        shot = read(camera)
        if shot is not None and shot.number == 5 and camera.view.moving:
            raise CameraError("camera simulated: gave no frame for 5 s")
        return shot

    if cause == "the disk is full":
        monkeypatch.setattr(Path, "write_bytes", full)
    else:
        monkeypatch.setattr(SimulatedCamera, "read", gone)
    job = console.start_scan({}, "broken")
    console.jobs.wait(60)
    assert job.state == "done", job.message
    assert job.result["frames"] == len(list((console.folder.scan("broken") / "frames").iterdir())) == 5
    assert ("No space left" if "disk" in cause else "gave no frame for 5 s; 5 frames are kept") in job.result[
        "why_incomplete"
    ]


def test_a_calibration_file_that_leads_out_of_the_folder_is_refused(console: Console) -> None:
    text = console.folder.calibration.read_text(encoding="utf-8")
    for bad in ("../out/*.png", "/elsewhere/*.png"):
        console.folder.calibration.write_text(text.replace("w300/*.png", bad), encoding="utf-8")
        with pytest.raises(FileError, match="leads out of the session folder"):
            console.steps.all()


# --- parts ----------------------------------------------------------------------------------------------------------


def test_one_job_at_a_time_and_an_id_means_one_thing() -> None:
    jobs, gate = Jobs(), threading.Event()
    first = jobs.start("scan", {"frames": 3}, lambda _: {"done": gate.wait(10)}, "a")
    with pytest.raises(Busy, match="job a"):
        jobs.start("scan", {}, lambda _: {}, "b")
    assert jobs.start("scan", {"frames": 3}, lambda _: {}, "a") is first
    with pytest.raises(ValueError, match="something else"):
        jobs.start("scan", {"frames": 4}, lambda _: {}, "a")
    gate.set()
    jobs.wait(10)
    assert (first.state, first.result) == ("done", {"done": True})
    for bad in ("../x", "", "a b", "x" * 65, "<b>"):
        if bad:
            with pytest.raises(ValueError, match="letters, digits"):
                jobs.start("scan", {}, lambda _: {}, bad)


def test_a_job_that_fails_says_so_in_one_line() -> None:
    def fails(_: object) -> dict[str, object]:
        raise FileError("rig.json: is\nnot there")

    jobs = Jobs()
    job = jobs.start("scan", {}, fails)
    jobs.wait(10)
    assert (job.state, job.message) == ("failed", "rig.json: is not there")
    job = jobs.start("scan", {}, lambda _: 1 / 0)  # type: ignore[arg-type,return-value]
    jobs.wait(10)
    assert job.state == "failed"
    assert "ZeroDivisionError" in job.message


def test_a_look_says_what_was_found_at_a_line(session) -> None:
    scanner = Scanner(session.rig)
    image = read_image(sorted((session.folder / "frames").iterdir())[5])
    look = look_at(image, "stripe", scanner)
    profile = Scanner(session.rig).profile(image)
    np.testing.assert_array_equal(look.reason, profile.reason)
    ranged, dark = (int(np.flatnonzero((profile.reason == 0) == want)[0]) for want in (True, False))
    along = scanner.rig.lasers["laser"].along
    told = look.at(ranged, ranged) if along == "rows" else look.at(0, ranged)
    assert f"{profile.points[ranged, 2]:.3f}) mm" in told
    assert Reason(int(profile.reason[dark])).key.replace("_", " ") in look.at(dark, dark)
    assert picture(image, look)[:2] == b"\xff\xd8"


def test_the_exposure_helper_says_which_way(session) -> None:
    image = read_image(sorted((session.folder / "frames").iterdir())[5])
    assert look_at(image, "stripe").advice == ""
    assert "halve the exposure" in look_at(np.clip(image.astype(float) * 3, 0, 255).astype(np.uint8), "stripe").advice
    assert "times as long" in look_at((image // 5).astype(np.uint8), "stripe").advice
    target = read_image(session.folder / "w300" / "0.png")
    found = look_at(target, "target")
    assert len(found.spots) == 11 * 15
    assert "spot at" in found.at(*found.spots[0])


@pytest.mark.parametrize(
    "asked",
    [
        {"kind": "spiral"},
        {"kind": "linear", "step": "0.5", "direction": [1, 0, 0]},
        {"kind": "linear", "step": float("nan"), "direction": [1, 0, 0]},
        {"kind": "linear", "step": True, "direction": [1, 0, 0]},
        {"kind": "linear", "step": 0.5, "direction": [1, 0]},
        {"kind": "linear", "step": 0.5, "direction": [1, 0, 0], "moves": "both"},
        {"kind": "turntable", "step": 0.5, "axis_point": [0, 0, 0]},
    ],
)
def test_a_motion_asked_wrongly_is_refused(asked: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="must be"):
        motion_of(asked)


def test_toml_that_is_written_reads_back() -> None:
    content = tomllib.loads(planned_text())
    assert tomllib.loads(toml_text(content)) == content
    odd = {
        "a": 'quote " and \\ and \n',
        "list": [1, 2.5, "x"],
        "t": {"k e y": [1], "sub": {"x": True}},
        "many": [{"n": 1}, {"n": 2}],
    }
    assert tomllib.loads(toml_text(odd)) == odd


def planned_text() -> str:
    return (
        'format = 1\n[target]\nkind = "markers"\nplaces = [{ id = 5, x = -90.0, y = 0.0 }]\n[laser.red]\nalong = "auto"\n'
        '[[plane]]\nname = "a"\nimages = ["a/0.png"]\norigin = [0.0, 1.0, 2.0]\nlaser = { red = "b/*.png" }\n'
    )
