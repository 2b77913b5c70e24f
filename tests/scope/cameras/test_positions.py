"""Where each frame stands while a camera runs: a CSV that grows, and a stage's log over time, against positions known beforehand."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import FileError
from ranging.errors import RangingError
from ranging.motion import ToldPositions
from scope.cameras import open_source
from scope.scanning import run_scan
from scope.session import Follow, Follower, read_capture

LINEAR = '[motion]\nkind = "linear"\nmoves = "object"\ndirection = [0, 1, 0]\n'
POSITIONS = -11.0 + 2.0 * np.arange(12)


def written(path: Path, head: str, rows: list[tuple[float, ...]]) -> Path:
    path.write_text(
        "\n".join([head, *(",".join(repr(float(x)) for x in row) for row in rows)]) + "\n", encoding="utf-8"
    )
    return path


def capture(folder: Path, name: str, source: str, motion: str) -> Path:
    path = folder / name
    path.write_text(f"format = 1\n{source}\n{LINEAR}{motion}\n", encoding="utf-8")
    return path


def camera(session) -> str:
    return f'[camera]\ndriver = "replay"\nid = "{session.folder}/frames"\ntimeout_s = 0.4\n'


@pytest.fixture(scope="module")
def by_step(session):
    """The truth: the stage went evenly."""
    return run_scan(session.capture, session.rig).cloud


def stage(seconds: np.ndarray) -> np.ndarray:
    """Where the stage of these frames, 25 a second, stood: even, and logged by a clock of its own."""
    return -11.0 + 2.0 * 25.0 * seconds


def test_a_csv_that_grows_places_frames_as_the_same_csv_does_when_it_is_complete(session, by_step, tmp_path) -> None:
    source = f'images = "{session.folder}/frames/*.png"\nbackground = "{session.folder}/off/*.png"'
    written(tmp_path / "whole.csv", "frame,position", list(enumerate(POSITIONS.tolist())))
    complete = run_scan(capture(tmp_path, "whole.toml", source, 'positions = "whole.csv"'), session.rig).cloud
    np.testing.assert_allclose(complete.points, by_step.points, atol=1e-12)
    growing = tmp_path / "growing.csv"

    def grow() -> None:
        with growing.open("w") as stream:
            for text in ("frame,position\n", *(f"{k},{s!r}\n" for k, s in enumerate(POSITIONS.tolist()))):
                for half in (text[:3], text[3:]):  # a row that is half written is not read
                    stream.write(half)
                    stream.flush()
                    time.sleep(0.01)

    thread = threading.Thread(target=grow)
    thread.start()
    source = f'background = "{session.folder}/off/*.png"\n{camera(session)}'
    found = run_scan(capture(tmp_path, "live.toml", source, 'positions = "growing.csv"'), session.rig)
    thread.join()
    assert found.why_incomplete == ""
    np.testing.assert_array_equal(found.cloud.points, complete.points)


@pytest.mark.parametrize("live", [True, False])
def test_time_stamps_and_a_log_give_the_position_of_each_frame(session, by_step, tmp_path, live) -> None:
    """The log has irregular times and a clock that is 3.2 s ahead; interpolation between its rows is exact for an even motion."""
    seconds = np.sort(np.random.default_rng(4).uniform(-0.1, 0.6, 60))
    written(
        tmp_path / "stage.csv",
        "seconds,position",
        list(zip((seconds + 3.2).tolist(), stage(seconds).tolist(), strict=True)),
    )
    more = 'log = "stage.csv"\ndelay = 3.2'
    if live:
        source = f'background = "{session.folder}/off/*.png"\n{camera(session)}'
    else:
        source = f'images = "{session.folder}/frames/*.png"\nbackground = "{session.folder}/off/*.png"'
        names = sorted(path.name for path in (session.folder / "frames").iterdir())
        rows = "".join(f"{name},{k / 25.0!r}\n" for k, name in enumerate(names))
        (tmp_path / "times.csv").write_text(f"image,seconds\n{rows}", encoding="utf-8")
        more += '\ntimes = "times.csv"'
    found = run_scan(capture(tmp_path, "scan.toml", source, more), session.rig)
    assert found.why_incomplete == ""
    np.testing.assert_allclose(found.cloud.points, by_step.points, atol=1e-9)


def test_a_log_that_ends_too_early_keeps_the_frames_so_far_and_says_so(session, tmp_path) -> None:
    written(
        tmp_path / "stage.csv", "seconds,position", [(-1.0, stage(np.float64(-1.0))), (0.27, stage(np.float64(0.27)))]
    )
    source = f'background = "{session.folder}/off/*.png"\n{camera(session)}'
    found = run_scan(capture(tmp_path, "scan.toml", source, 'log = "stage.csv"\ndelay = 0\ngap = 2.0'), session.rig)
    assert found.frames == 7  # at 0, 0.04, ... 0.24 s
    assert "0.28 s and the log ends at 0.27 s; 7 frames are kept" in found.why_incomplete
    assert len(found.why_incomplete) < 300


def followed(path: Path, by: str = "seconds", **more: float) -> Follower:
    return Follower(Follow(path, by, 1.0, {}, **more))  # type: ignore[arg-type]


def test_a_frame_of_which_nobody_told_has_no_position() -> None:
    positions = ToldPositions(0.0, 0.0, known={3: 1.5})
    assert positions.at(3) == 1.5
    with pytest.raises(RangingError, match="no position was told of frame 2"):
        positions.at(2)


@pytest.mark.parametrize(
    ("text", "at", "why"),
    [
        ("seconds,position\n0,0\n5,1\n", 2.5, "no row for 5 s about 2.5 s, more than gap = 1"),
        ("seconds,position\n1,0\n1.5,1\n", 0.5, "taken at 0.5 s and the log begins at 1 s"),
        ("seconds,position\n1,0\n1,1\n", 1.0, "do not come after those before"),
        ("seconds,position\n0,0\n0.5,nan\n", 0.2, "needed: finite numbers"),
        ("seconds,position\n0,0\n0.5\n", 0.2, "row 3 has 1 values; the header names 2"),
        ("time,position\n0,0\n", 0.0, "the header has time, position; needed: seconds,position"),
        ("seconds,position\n0,0\n1,1", 0.5, "the log ends at 0 s"),  # the last row has no end yet
        ("", 0.5, "the log is empty"),
    ],
)
def test_a_log_that_cannot_be_used_is_told_in_a_line(tmp_path: Path, text: str, at: float, why: str) -> None:
    path = tmp_path / "stage.csv"
    path.write_text(text, encoding="utf-8")
    told = followed(path).place(0, at)
    assert why in told
    assert "\n" not in told


def test_a_frame_between_two_rows_stands_between_their_positions(tmp_path: Path) -> None:
    follower = followed(
        written(tmp_path / "stage.csv", "seconds,position", [(0.0, 1.0), (0.5, 2.0), (0.6, 4.0)]), delay=-0.1
    )
    for number, (at, position) in enumerate([(0.1, 1.0), (0.35, 1.5), (0.6, 2.0), (0.65, 3.0), (0.7, 4.0)]):
        assert follower.place(number, at) == ""
        assert follower.follow.known[number] == pytest.approx(position, abs=1e-12)


def test_frames_that_a_camera_lost_leave_the_rows_of_the_others_alone(tmp_path: Path) -> None:
    follower = followed(written(tmp_path / "p.csv", "frame,position", [(2, 5.0), (0, 1.0), (7, 9.0)]), "frame")
    assert [follower.place(k, None) for k in (0, 2, 7)] == ["", "", ""]
    assert follower.follow.known == {0: 1.0, 2: 5.0, 7: 9.0}
    assert "no row for frame 3" in follower.place(3, None)


def test_by_the_number_in_its_name_an_image_has_the_row_of_that_frame(session, tmp_path: Path) -> None:
    """As a console leaves a scan of which the camera lost frames 1 and 2."""
    images = sorted((session.folder / "frames").iterdir())
    (tmp_path / "frames").mkdir()
    for k in (0, 3, 4):
        (tmp_path / "frames" / f"{k:06d}.png").write_bytes(images[k].read_bytes())
    written(tmp_path / "p.csv", "frame,position", list(enumerate(POSITIONS.tolist())))
    plan = read_capture(
        capture(tmp_path, "c.toml", 'images = "frames/*.png"', 'positions = "p.csv"\nindex = "filename"')
    )
    assert plan.numbers == (0, 3, 4)
    assert [plan.motion.positions.at(k) for k in plan.numbers] == POSITIONS[[0, 3, 4]].tolist()


@pytest.mark.parametrize(
    ("motion", "why"),
    [
        ('log = "s.csv"', "delay is missing"),
        ('log = "s.csv"\nstep = 1.0\ndelay = 0', "found step and log of step, positions, log"),
        ("step = 1.0\ndelay = 0.1", "delay has a meaning with log only"),
        ('log = "s.csv"\ndelay = 0\ntimes = "t.csv"', "times is for images"),
    ],
)
def test_keys_that_do_not_fit_are_refused(session, tmp_path: Path, motion: str, why: str) -> None:
    with pytest.raises(FileError, match=why):
        read_capture(capture(tmp_path, "c.toml", camera(session), motion))


def test_a_log_in_the_time_of_this_machine_is_met_by_the_moment_the_first_frame_came(session, tmp_path: Path) -> None:
    now = time.time()
    written(tmp_path / "s.csv", "seconds,position", [(now - 60.0, 0.0), (now + 60.0, 120.0)])
    plan = read_capture(
        capture(tmp_path, "c.toml", camera(session), 'log = "s.csv"\ndelay = 0\nclock = "system"\ngap = 200')
    )
    frames = [frame for load in open_source(plan).loaders(0) if (frame := load()) is not None]
    told = [plan.motion.positions.at(frame.number) for frame in frames]
    assert np.diff(told) == pytest.approx(np.full(11, 0.04), abs=1e-5)
    assert 60.0 <= told[0] < 80.0
