"""Cameras: the same frames give the same cloud whatever brings them; what breaks off is told, and what came is kept."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import FileError, ScopeError
from scope.cameras import CameraInfo, CameraSource, Grabber, Shot, SimulatedCamera, View, open_camera
from scope.cameras.genicam_nodes import FrameIds
from scope.cameras.pixels import image_of
from scope.errors import CameraError
from scope.scanning import ScanOptions, run_scan, scan_to_file
from scope.session import CameraSettings, Capture, read_capture, read_image

ROOT = Path(__file__).resolve().parents[3]
FAKE = shutil.which("arv-fake-gv-camera-0.8")
MOTION = '[motion]\nkind = "linear"\nmoves = "object"\ndirection = [0, 1, 0]\nstep = 2.0\nstart = -11.0\n'


def capture(folder: Path, camera: str, name: str = "live.toml", more: str = "") -> Path:
    path = folder / name
    path.write_text(f"format = 1\n{more}\n[camera]\n{camera}\n{MOTION}", encoding="utf-8")
    return path


class Fake:
    """A camera of images in memory, which may lose frames, break off, or be slow."""

    waits = False
    switches_laser = False
    info = CameraInfo("fake", "0", "fake", (8, 6))

    def __init__(self, shots: list[Shot | Exception]) -> None:
        self.shots, self.dropped, self.closed = iter(shots), 0, False

    def start(self) -> None:
        pass

    def read(self) -> Shot | None:
        shot = next(self.shots, None)
        if isinstance(shot, Exception):
            raise shot
        return shot

    def close(self) -> None:
        self.closed = True


def shots(numbers: list[int], *, interval: float = 0.1, shape: tuple[int, int] = (6, 8)) -> list[Shot]:
    return [Shot(np.full(shape, k, np.uint8), k, k * interval) for k in numbers]


def source(
    plan: Capture, given: list[Shot | Exception], *, count: int | None = None, rate: float | None = None
) -> CameraSource:
    grabber = Grabber(Fake(given))
    grabber.start()
    return CameraSource(plan, grabber, count, rate)


@pytest.fixture
def plan(tmp_path: Path) -> Capture:
    (tmp_path / "frames").mkdir()
    return read_capture(capture(tmp_path, 'driver = "replay"\nid = "frames"'))


def numbers_of(found: CameraSource) -> list[int]:
    return [frame.number for load in found.loaders(0) if (frame := load()) is not None]


# --- the same frames, the same cloud --------------------------------------------------------------------------------


def test_a_folder_and_its_replay_give_one_cloud_bit_for_bit(session, tmp_path: Path) -> None:
    """Peer: the folder. With laser-off images, and through the file that is streamed."""
    for name, first in (("folder", f'images = "{session.folder}/frames/*.png"'), ("replay", "")):
        camera = f'[camera]\ndriver = "replay"\nid = "{session.folder}/frames"\n' if not first else ""
        text = f'format = 1\n{first}\nbackground = "{session.folder}/off/*.png"\n{camera}{MOTION}'
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
        found = scan_to_file(tmp_path / f"{name}.toml", session.rig, tmp_path / f"{name}.ply", ScanOptions())
        assert found.why_incomplete == ""
    assert (tmp_path / "folder.ply").read_bytes() == (tmp_path / "replay.ply").read_bytes()


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from benchmarks.small_session import DESIGN

    path = tmp_path_factory.mktemp("design") / "design.toml"
    path.write_text(DESIGN.replace("frames = 12", "frames = 3"), encoding="utf-8")
    return path


def test_the_simulated_camera_gives_the_frames_that_simulate_writes(design: Path, tmp_path: Path) -> None:
    from scope.simulation import simulate

    simulate(design, tmp_path / "out", 0)
    camera = SimulatedCamera(CameraSettings("simulated", str(design)))
    for path in sorted((tmp_path / "out" / "frames").iterdir()):
        shot = camera.read()
        assert shot is not None
        np.testing.assert_array_equal(shot.image, read_image(path))
    assert camera.read() is None


def test_the_simulated_camera_shows_target_object_and_darkness(design: Path) -> None:
    camera = SimulatedCamera(CameraSettings("simulated", str(design)), again=True)
    camera.show(View("w330", laser=False))
    target = camera.read()
    camera.show(View("w330", laser=True))
    stripe = camera.read()
    camera.show(View(laser=False))
    dark = camera.read()
    assert target is not None
    assert stripe is not None
    assert dark is not None
    # a back-lit target lights much, a stripe a few lines, and darkness nothing
    assert (target.image > 100).mean() > 10 * (stripe.image > 100).mean() > 0
    assert not (dark.image > 30).any()
    camera.set("exposure_us", 2000.0)
    camera.show(View("w330", laser=True))
    twice = camera.read()
    assert twice is not None
    assert (twice.image == 255).any()  # three quarters of white, twice
    with pytest.raises(FileError, match="no stand-off w999"):
        camera.show(View("w999"))


# --- what breaks off ------------------------------------------------------------------------------------------------


def test_a_camera_unplugged_keeps_what_it_gave_and_says_so(plan: Capture) -> None:
    found = source(plan, [*shots([0, 1, 2]), CameraError("camera aravis: gave no frame for 5 s; check cable")])
    assert numbers_of(found) == [0, 1, 2]
    assert found.trouble == "camera aravis: gave no frame for 5 s; check cable; 3 frames are kept"
    assert found.grabber.camera.closed


def test_another_size_ends_the_scan_at_the_frames_before(plan: Capture) -> None:
    found = source(plan, [*shots([0, 1]), *shots([2], shape=(6, 9))])
    assert numbers_of(found) == [0, 1]
    assert "gave frame 2 as 9 x 6 px" in found.trouble
    assert "2 frames are kept" in found.trouble


def test_a_camera_slower_than_asked_is_told_where_steps_would_be_wrong(plan: Capture) -> None:
    slow = source(plan, shots(list(range(60)), interval=0.1), rate=30.0)
    assert len(numbers_of(slow)) < 60
    assert "10 frames a second and 30 were asked for" in slow.trouble
    right = source(plan, shots(list(range(60)), interval=0.1), rate=10.0)
    assert len(numbers_of(right)) == 60
    assert right.trouble == ""


def test_lost_frames_leave_the_others_in_their_places(plan: Capture) -> None:
    given = source(plan, shots([0, 1, 4, 5]))
    given.grabber.camera.dropped = 2
    assert numbers_of(given) == [0, 1, 4, 5]
    assert given.trouble.startswith("2 frames were lost (4 came)")


def test_pairs_stay_pairs_where_a_frame_is_lost(plan: Capture) -> None:
    alternate = replace(plan, background_mode="alternate")
    found = source(alternate, shots([0, 1, 2, 4, 5, 7, 8, 9]))
    pairs = [(f.number, int(f.image[0, 0]), int(f.background[0, 0])) for load in found.loaders(0) if (f := load())]
    assert pairs == [(0, 0, 1), (2, 4, 5), (4, 8, 9)]


def test_a_scan_of_a_camera_that_breaks_off_is_written(
    session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = sorted((session.folder / "frames").iterdir())
    given = [Shot(read_image(file), k, 0.1 * k) for k, file in enumerate(files)]
    camera = Fake([*given[:8], CameraError("camera aravis: gave no frame for 5 s; check cable")])
    monkeypatch.setattr("scope.cameras.source.open_camera", lambda _settings: camera)
    path = capture(tmp_path, 'driver = "aravis"', more="frames = 12")
    found = run_scan(path, session.rig)
    assert found.frames == 8
    assert found.points > 500
    assert "8 frames are kept" in found.why_incomplete


# --- [camera] -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('driver = "sony"', "camera.driver: found 'sony'"),
        ('driver = "replay"', "id is missing"),
        ('driver = "simulated"\nid = "d.toml"\nexposure_us = 100.0', "exposure_us has no meaning"),
        ('driver = "aravis"\nexposure = 100.0', "camera.exposure: unknown key"),
        ('driver = "genicam"', "producer"),
        ('driver = "aravis"\nrate = -1.0', "camera.rate"),
        ('driver = "replay"\nid = "nothing"', "no file matches"),
    ],
)
def test_a_wrong_section_is_refused_in_one_line(tmp_path: Path, text: str, told: str) -> None:
    from scope.cameras import open_source

    with pytest.raises(FileError) as error:
        open_source(read_capture(capture(tmp_path, text)))
    assert told in str(error.value)
    assert len(str(error.value)) <= 300
    assert "\n" not in str(error.value)


# --- bytes to images ------------------------------------------------------------------------------------------------


def test_packed_pixels_of_twelve_bits() -> None:
    """Two pixels in three bytes, lower bits first (PFNC 2.1): 0xABC and 0x123 are BC 3A 12."""
    image = image_of(np.array([0xBC, 0x3A, 0x12], np.uint8), 2, 1, "Mono12p", "camera")
    assert image.tolist() == [[0xABC, 0x123]]


@pytest.mark.parametrize(
    ("pattern", "at"), [("BayerRG8", (0, 0)), ("BayerGR8", (0, 1)), ("BayerGB8", (1, 0)), ("BayerBG8", (1, 1))]
)
def test_a_red_light_is_red_through_each_filter_pattern(pattern: str, at: tuple[int, int]) -> None:
    raw = np.zeros((8, 8), np.uint8)
    raw[at[0] :: 2, at[1] :: 2] = 200
    image = image_of(raw.ravel(), 8, 8, pattern, "camera")
    np.testing.assert_array_equal(image[2:6, 2:6], np.broadcast_to([0, 0, 200], (4, 4, 3)))


def test_a_buffer_that_is_too_short_or_unknown_is_refused() -> None:
    with pytest.raises(CameraError, match="63 bytes for 8 x 8"):
        image_of(np.zeros(63, np.uint8), 8, 8, "Mono8", "camera")
    with pytest.raises(CameraError, match="0x02200016"):
        image_of(np.zeros(640, np.uint8), 8, 8, 0x02200016, "camera")


def test_frame_ids_wrap_around_and_count_what_is_missing() -> None:
    ids = FrameIds()
    assert [ids.next(k, 0.0)[0] for k in (65533, 65534, 65535, 1, 2, 5)] == [0, 1, 2, 3, 4, 7]
    assert ids.missing == 2


# --- real protocols -------------------------------------------------------------------------------------------------


@pytest.fixture
def fake_gige() -> Iterator[subprocess.Popen[bytes]]:
    """Aravis's fake GigE Vision camera on loopback."""
    if FAKE is None:
        pytest.skip("no fake GigE camera; run: sudo apt-get install -y aravis-tools (make test does, where it may)")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", 3956))  # GigE Vision's control port
        except OSError:
            pytest.skip("another GigE Vision camera answers on loopback")
    process = subprocess.Popen(
        [FAKE, "-i", "127.0.0.1", "-s", "SCOPE1"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    time.sleep(0.5)
    yield process
    process.kill()
    process.wait()


@pytest.mark.long
def test_a_gige_camera_gives_frames_with_numbers_and_breaks_off_in_one_line(fake_gige: subprocess.Popen[bytes]) -> None:
    settings = CameraSettings("aravis", "Aravis-Fake-SCOPE1", exposure_us=3000.0, rate=50.0, timeout_s=1.0)
    camera = open_camera(settings)
    try:
        assert camera.info.size == (512, 512)
        assert camera.settings["exposure_us"] == pytest.approx(3000.0)
        camera.start()
        taken = [camera.read() for _ in range(40)]
        numbers = [shot.number for shot in taken if shot is not None]
        # each frame came or is counted
        assert numbers[-1] + 1 == len(numbers) + camera.dropped
        assert all(shot is not None and shot.image.shape == (512, 512) for shot in taken)
        times = [shot.at for shot in taken if shot is not None]
        assert all(b > a for a, b in pairwise(times))
        fake_gige.kill()
        with pytest.raises(CameraError, match="gave no frame for 1 s"):
            [camera.read() for _ in range(100)]
    finally:
        camera.close()
        camera.close()


def test_a_camera_that_is_not_there() -> None:
    with pytest.raises(ScopeError) as error:
        open_camera(CameraSettings("aravis", "Nobody-9"))
    assert len(str(error.value)) <= 300


def test_pylons_emulator_is_listed_and_gives_frames() -> None:
    pytest.importorskip(
        "pypylon", reason="no pypylon; run: .venv/bin/python -m pip install -e '.[basler]' (make test does)"
    )
    code = (
        "import json; from scope.cameras import *; from scope.session import CameraSettings;"
        "camera = open_camera(CameraSettings('basler', exposure_us=2000.0, rate=60.0)); camera.start();"
        "shots = [camera.read() for _ in range(20)];"
        "print(json.dumps([list(camera.info.size), shots[-1].number, camera.dropped, list(shots[0].image.shape)])); camera.close()"
    )
    environment = os.environ | {"PYLON_CAMEMU": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    size, number, dropped, shape = json.loads(done.stdout)
    assert (size, shape) == ([1024, 1040], [1040, 1024])
    assert number == 19 + dropped
