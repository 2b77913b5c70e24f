"""Videos and cameras as sources of frames: order, what breaks off, dropped frames, the end by the user."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calibration.errors import FileError
from ranging.errors import RangingError
from scope.scanning.statistics import Median
from scope.session import Frame, in_order, open_source, read_capture
from scope.session.frames import Stream

SIZE = (64, 48)


def picture(k: int) -> np.ndarray:
    return np.full((SIZE[1], SIZE[0], 3), 10 + 8 * k, np.uint8)


def video(folder: Path, count: int = 20) -> Path:
    path = folder / "sweep.avi"
    out = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, SIZE)
    for k in range(count):
        out.write(picture(k))
    out.release()
    return path


def capture(folder: Path, text: str) -> Path:
    path = folder / "capture.toml"
    still = "" if "[motion]" in text else '[motion]\nkind = "fixed"\n'
    path.write_text(f"format = 1\n{text}\n{still}")
    return path


def level(frame: Frame) -> tuple[int, int]:
    return frame.number, round((float(frame.image.mean()) - 10) / 8)


class Camera:
    """Stands in for a live camera: gives ``count`` frames, then no more."""

    def __init__(self, count: int, *, opens: bool = True) -> None:
        self.count, self.given, self.opens, self.released = count, 0, opens, False

    def isOpened(self) -> bool:
        return self.opens

    def read(self) -> tuple[bool, Any]:
        if self.given == self.count:
            return False, None
        self.given += 1
        return True, picture(self.given - 1)

    def get(self, _what: int) -> float:
        return 0.0

    def release(self) -> None:
        self.released = True


@pytest.mark.parametrize("first", [0, 7])
def test_a_video_comes_in_order_and_its_sample_comes_again(tmp_path: Path, first: int) -> None:
    video(tmp_path)
    source = open_source(read_capture(capture(tmp_path, 'video = "sweep.avi"')))
    assert [level(frame) for frame in source.first(3)] == [(0, 0), (1, 1), (2, 2)]
    assert list(in_order(source, level, first=first)) == [(k, k) for k in range(first, 20)]
    assert source.count == 20
    assert source.trouble == ""
    assert not source.endless


def test_a_video_tells_when_its_frames_were_taken(tmp_path: Path) -> None:
    video(tmp_path)
    source = open_source(read_capture(capture(tmp_path, 'video = "sweep.avi"')))
    times = list(in_order(source, lambda frame: frame.at))
    assert np.allclose(np.diff(times), 1 / 25, atol=1e-3)


def test_a_video_that_ends_early_is_told(tmp_path: Path) -> None:
    path = video(tmp_path)
    source = open_source(read_capture(capture(tmp_path, 'video = "sweep.avi"')))
    assert isinstance(source, Stream)
    source.count = 25
    assert len(list(in_order(source, level))) == 20
    assert source.trouble == f"{path.name} ended after 20 of 25 frames"


def test_pairs_of_a_video(tmp_path: Path) -> None:
    video(tmp_path)
    source = open_source(read_capture(capture(tmp_path, 'video = "sweep.avi"\nbackground_mode = "alternate"')))
    seen = list(in_order(source, lambda frame: (level(frame), round((float(frame.background.mean()) - 10) / 8))))  # type: ignore[union-attr]
    assert seen == [((k, 2 * k), 2 * k + 1) for k in range(10)]


def test_dropped_frames_matter_only_where_a_step_places_them(tmp_path: Path) -> None:
    class Skipping(Camera):
        def get(self, what: int) -> float:
            late = 120.0 if self.given > 5 else 0.0  # three frames of 40 ms are missing
            return {cv2.CAP_PROP_FPS: 25.0, cv2.CAP_PROP_POS_MSEC: 40.0 * self.given + late}.get(what, 0.0)

    video(tmp_path)
    motion = '[motion]\nkind = "linear"\nmoves = "object"\ndirection = [0, 1, 0]\nstep = 0.5'
    for text, told in ((motion, "3 frames were dropped before frame 5"), ("", "")):
        source = Stream(read_capture(capture(tmp_path, f'video = "sweep.avi"\n{text}')), Skipping(9), "sweep.avi", 9)
        assert len(list(in_order(source, level))) == 9
        assert told in source.trouble
        assert bool(told) == bool(source.trouble)


def test_no_video_at_all(tmp_path: Path) -> None:
    (tmp_path / "sweep.avi").write_bytes(b"no video")
    with pytest.raises(FileError, match="no video that can be decoded"):
        open_source(read_capture(capture(tmp_path, 'video = "sweep.avi"')))


def test_a_camera_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", lambda _index: Camera(0, opens=False))
    with pytest.raises(RangingError, match="camera 3 does not answer"):
        open_source(read_capture(capture(tmp_path, "camera = 3")))


@pytest.mark.parametrize(
    ("asked", "told"), [("frames = 9", "ended after 6 of 9 frames"), ("", "stopped after 6 frames")]
)
def test_a_camera_that_stops_keeps_what_it_gave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: str, told: str
) -> None:
    camera = Camera(6)
    monkeypatch.setattr(cv2, "VideoCapture", lambda _index: camera)
    source = open_source(read_capture(capture(tmp_path, f"camera = 0\n{asked}")))
    assert [level(frame) for frame in source.first(2)] == [(0, 0), (1, 1)]
    assert list(in_order(source, level)) == [(k, k) for k in range(6)]
    assert told in source.trouble
    assert camera.released
    assert source.endless == (asked == "")


def test_a_camera_gives_no_more_than_was_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", lambda _index: Camera(100))
    source = open_source(read_capture(capture(tmp_path, "camera = 0\nframes = 4")))
    source.first(3)
    assert list(in_order(source, level)) == [(k, k) for k in range(4)]
    assert source.trouble == ""


def test_running_median_is_the_median() -> None:
    values = np.random.default_rng(2).lognormal(-4, 1, 5000).astype(np.float32)
    median = Median()
    assert np.isnan(median.value)
    for part in np.array_split(values, 7):
        median.add(np.r_[part, np.float32(np.nan)])
    assert median.value == pytest.approx(float(np.median(values)), rel=1e-3)


def test_fewer_frames_are_held_of_large_images() -> None:
    from scope.session import AHEAD, frames_in_memory
    from scope.session.frames import HELD

    assert frames_in_memory(np.zeros((480, 640), np.uint8), AHEAD) == AHEAD
    assert frames_in_memory(None, AHEAD) == AHEAD
    large = np.broadcast_to(np.uint16(0), (4096, 5120))  # 42 MB, of which none is taken here
    assert frames_in_memory(large, AHEAD) * large.nbytes <= HELD
    assert frames_in_memory(np.broadcast_to(np.uint16(0), (20000, 20000)), AHEAD) == 4
