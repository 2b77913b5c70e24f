"""Images in memory: the same points as from files, and what is no image is refused."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

import scope
from calibration.errors import FileError
from calibration.reason import Reason

FIELDS = ("points", "sigma", "sigma_cal", "intensity", "pixels", "frame", "laser")


@pytest.fixture(scope="module")
def frames(session) -> list[np.ndarray]:
    return [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in sorted((session.folder / "frames").glob("*.png"))]


@pytest.fixture(scope="module")
def dark(session) -> list[np.ndarray]:
    return [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in sorted((session.folder / "off").glob("*.png"))]


def motion_of(session) -> scope.Linear:
    told = tomllib.loads(session.capture.read_text(encoding="utf-8"))["motion"]
    sign = -1.0 if told["moves"] == "sensor" else 1.0
    return scope.Linear(told["direction"], told["step"], start=told.get("start", 0.0), sign=sign)


def test_a_scan_of_arrays_is_the_scan_of_the_files(session, frames, dark) -> None:
    whole = scope.scan(session.capture, session.rig)
    motion = motion_of(session)
    found = scope.Scanner(session.rig).scan(iter(frames), motion, background=dark)
    for name in FIELDS:
        assert np.array_equal(getattr(found, name), getattr(whole, name), equal_nan=True), name
    assert np.array_equal(found.sensors.rotation, whole.sensors.rotation)
    assert found.rig_sha256 == whole.rig_sha256


def test_a_video_and_arrays_of_the_same_frames_give_the_same_points(session, frames, tmp_path: Path) -> None:
    grey = [np.ascontiguousarray(frame) for frame in frames]
    height, width = grey[0].shape[:2]
    writer = cv2.VideoWriter(
        str(tmp_path / "sweep.avi"), cv2.VideoWriter_fourcc(*"FFV1"), 10, (width, height), isColor=True
    )
    for frame in grey:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR) if frame.ndim == 2 else frame)
    writer.release()
    opened = cv2.VideoCapture(str(tmp_path / "sweep.avi"))
    decoded = [opened.read()[1] for _ in grey]
    text = session.capture.read_text(encoding="utf-8").replace('background = "off/*.png"\n', "")
    text = text.replace('images = "frames/*.png"', 'video = "sweep.avi"')
    (tmp_path / "capture.toml").write_text(text, encoding="utf-8")
    for k, frame in enumerate(decoded):
        cv2.imwrite(str(tmp_path / f"{k:02d}.png"), frame)
    (tmp_path / "folder.toml").write_text(text.replace('video = "sweep.avi"', 'images = "*.png"'), encoding="utf-8")
    video = scope.scan(tmp_path / "capture.toml", session.rig)
    folder = scope.scan(tmp_path / "folder.toml", session.rig)
    arrays = scope.Scanner(session.rig).scan(decoded, motion_of(session))
    for name in FIELDS:
        assert np.array_equal(getattr(video, name), getattr(folder, name)), name
        assert np.array_equal(getattr(video, name), getattr(arrays, name)), name


def test_the_points_of_a_profile_lie_on_the_plate(session, frames, dark) -> None:
    scanner = scope.Scanner(session.rig)
    profile = scanner.profile(frames[0], dark[0])
    ranged = profile.reason == Reason.RANGED
    assert ranged.sum() > 300
    assert profile.ranged + sum(profile.rejected.values()) == len(profile) == 640
    assert np.isnan(profile.points[~ranged]).all()
    on_plate = ranged & (np.abs(profile.points[:, 0]) > 70)
    off = profile.points[on_plate, 2] - 372.0
    assert np.abs(np.median(off)) < 0.02
    assert 0.5 < np.std(off) / np.median(profile.sigma[on_plate]) < 1.5


def test_the_noise_is_learnt_from_the_first_images_and_kept(session, frames, dark) -> None:
    scanner = scope.Scanner(session.rig)
    for frame in frames[:3]:
        scanner.profile(frame, dark[0])
    once = scanner.profile(frames[5], dark[0])
    for frame in frames[6:9]:
        scanner.profile(frame, dark[0])
    again = scanner.profile(frames[5], dark[0])
    assert np.array_equal(once.points, again.points, equal_nan=True)
    assert np.array_equal(once.sigma, again.sigma, equal_nan=True)


def test_points_come_while_frames_come(session, frames, dark) -> None:
    taken = 0

    def camera() -> Iterator[np.ndarray]:
        nonlocal taken
        for frame in frames * 4:
            taken += 1
            yield frame

    scanner, motion = scope.Scanner(session.rig), motion_of(session)
    parts = scanner.stream(camera(), motion, background=dark)
    first = next(parts)
    assert len(first) > 0
    assert taken < 48
    assert len(first) + sum(len(part) for part in parts) == len(scanner.scan(frames * 4, motion, background=dark))


def test_what_is_no_image_is_refused(session, frames) -> None:
    scanner, motion = scope.Scanner(session.rig), motion_of(session)
    with pytest.raises(ValueError, match=r"uint8 or uint16; it is \(480, 640\) of float64"):
        scanner.profile(np.zeros((480, 640)))
    with pytest.raises(ValueError, match=r"frame 0 must be"):
        scanner.scan([np.zeros((480, 640, 2), np.uint8)], motion)
    with pytest.raises(ValueError, match="tuple of 3"):
        scanner.scan([(frames[0], frames[0], frames[0])], motion)
    with pytest.raises(FileError, match="320 x 240 px.*calibrated at 640 x 480"):
        scanner.profile(np.zeros((240, 320), np.uint8))
    with pytest.raises(scope.RangingError, match="no frame came"):
        scanner.scan([], motion)
    with pytest.raises(FileError, match="violet"):
        scope.Scanner(session.rig, laser="violet")
    scanner.profile(frames[0])
    with pytest.raises(FileError, match="16 bit"):
        scanner.profile(frames[0].astype(np.uint16) * 257)


def test_profiles_keep_nothing_that_grows(session, frames, dark):
    import gc
    import tracemalloc

    scanner = scope.Scanner(session.rig)

    def held(count: int) -> int:
        for k in range(count):
            scanner.profile(frames[k % len(frames)], dark[0])
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    held(8)  # the first frames tell the noise, and are kept for that
    tracemalloc.start()
    try:
        held(100)  # caches of the interpreter fill
        few, many = held(100), held(200)
    finally:
        tracemalloc.stop()
    assert many - few < 8192  # bytes; a hundredth of a profile a call would be 66,000
