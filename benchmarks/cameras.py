"""Cameras on real protocols: frames that came, frames lost, memory; and the same frames by every way.

python -m benchmarks.cameras gige --frames 2000      Aravis's fake GigE Vision camera on loopback
python -m benchmarks.cameras pylon --frames 2000     pylon's emulator
python -m benchmarks.cameras live --rate 30          a real-time camera of rendered frames while every frame is ranged, no console
python -m benchmarks.cameras same                    the same frames by camera, replay and folder: the same cloud, bit for bit
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import socket
import subprocess
import tempfile
import time
from pathlib import Path

from benchmarks.small_session import design_text, small_session

ROOT = Path(__file__).resolve().parents[1]
SLOW = {"frames": 48, "start": -12.0, "step": 0.5, "width": 0.4}  # a scan long enough to be killed in


def memory() -> float:
    """MiB resident now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def read(driver: str, frames: int, **settings: object) -> None:
    """Read frames and print what came, what was lost, and memory."""
    from scope.cameras import Grabber, open_camera
    from scope.session import CameraSettings

    camera = open_camera(CameraSettings(driver, **settings))  # type: ignore[arg-type]
    grabber = Grabber(camera)
    grabber.start()
    began, after = time.perf_counter(), 0.0
    number = -1
    for k in range(frames):
        shot = grabber.next()
        if shot is None:
            break
        number = shot.number
        if k == frames // 10:
            after = memory()
    seconds = time.perf_counter() - began
    lost = grabber.camera.dropped + grabber.lost
    print(f"{driver}: {k + 1} frames of {camera.info.size} came in {seconds:.0f} s ({(k + 1) / seconds:.0f}/s), last number {number}, "
          f"{lost} lost and counted, {number + 1 - (k + 1) - lost} lost and not counted; memory {after:.0f} MiB after a tenth, {memory():.0f} at the end")  # fmt: skip
    grabber.stop()


def gige(frames: int) -> None:
    server = subprocess.Popen(
        [str(shutil.which("arv-fake-gv-camera-0.8")), "-i", "127.0.0.1", "-s", "BENCH"], stdout=subprocess.DEVNULL
    )
    try:
        time.sleep(1.0)
        read("aravis", frames, id="Aravis-Fake-BENCH", rate=100.0, exposure_us=2000.0, timeout_s=20.0)
    finally:
        server.kill()


def pylon(frames: int) -> None:
    os.environ["PYLON_CAMEMU"] = "1"
    read("basler", frames, rate=100.0, exposure_us=1000.0, timeout_s=20.0)


class RealTime:
    """A camera that exposes at its rate whether or not anybody reads, with a few buffers, as hardware has."""

    waits = False
    switches_laser = False
    settings: dict[str, float] = {}  # noqa: RUF012

    def __init__(self, images: list, rate: float, frames: int, buffers: int = 24) -> None:
        from scope.cameras import CameraInfo

        self.info = CameraInfo("real-time", "0", "rendered before", (images[0].shape[1], images[0].shape[0]))
        self.images, self.rate, self.frames, self.buffers = images, rate, frames, buffers
        self.dropped, self.next, self.began = 0, 0, 0.0

    def start(self) -> None:
        """Begin to expose."""
        self.began = time.monotonic()

    def read(self):
        """Next frame that is still in a buffer."""
        from scope.cameras import Shot

        oldest = int((time.monotonic() - self.began) * self.rate) - self.buffers
        if oldest > self.next:
            self.dropped += oldest - self.next
            self.next = oldest
        if self.next >= self.frames:
            return None
        time.sleep(max(0.0, self.began + self.next / self.rate - time.monotonic()))
        k, self.next = self.next, self.next + 1
        turn = k % (2 * len(self.images) - 2)
        return Shot(self.images[min(turn, 2 * len(self.images) - 2 - turn)], k, k / self.rate)

    def close(self) -> None:
        """Nothing is held open."""


def live(rate: float, frames: int, size: tuple[int, int]) -> None:
    from calibration.rig import Rig
    from scope.cameras import CameraSource, Grabber
    from scope.scanning import gathered, open_scan
    from scope.session import image_files, read_capture, read_image

    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        began = time.perf_counter()
        small_session(home, design_text(size=size, **SLOW), name="s")
        rendered = time.perf_counter() - began
        rig = Rig.load(home / "s" / "rig.json")
        images = [read_image(path) for path in image_files(home / "s" / "frames")]
        motion = '[motion]\nkind = "linear"\nmoves = "object"\ndirection = [0, 1, 0]\nstep = 0.5\n'
        (home / "live.toml").write_text(
            f'format = 1\nframes = {frames}\n[camera]\ndriver = "aravis"\nrate = {rate}\n{motion}', encoding="utf-8"
        )
        plan = read_capture(home / "live.toml")
        for warm in (True, False):
            grabber = Grabber(RealTime(images, rate, 40 if warm else frames))
            grabber.start()
            source = CameraSource(plan, grabber, None, None)
            setup, _ = open_scan(home / "live.toml", rig, source=source)
            began = time.perf_counter()
            found = gathered(setup, source)
            seconds = time.perf_counter() - began
        lost = grabber.camera.dropped + grabber.lost
        print(f"live {size[0]} x {size[1]} at {rate:g}/s: {found.frames} of {frames} frames ranged in {seconds:.1f} s, {lost} lost; the machine renders "
              f"{48 / rendered:.1f}/s (with the jig); load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")  # fmt: skip


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def same() -> None:
    """SHA-256 of the clouds of one design by the simulated camera, by a replay and by a folder of its frames."""
    from scope.scanning import ScanOptions, scan_to_file

    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        small_session(home, design_text(**SLOW), seed=0, name="s")
        motion = '[motion]\nkind = "linear"\nmoves = "object"\ndirection = [0, 1, 0]\nstep = 0.5\nstart = -12.0\n'
        found = {}
        for way, source in (
            ("simulated camera", '[camera]\ndriver = "simulated"\nid = "design.toml"\n'),
            ("replay", '[camera]\ndriver = "replay"\nid = "s/frames"\n'),
            ("folder", 'images = "s/frames/*.png"\n'),
        ):
            (home / "c.toml").write_text(f"format = 1\n{source}{motion}", encoding="utf-8")
            scan = scan_to_file(home / "c.toml", home / "s" / "rig.json", home / "c.ply", ScanOptions())
            found[way] = (hashlib.sha256((home / "c.ply").read_bytes()).hexdigest()[:16], scan.frames, scan.points)
        print(f"the same frames: {len({each[0] for each in found.values()})} different cloud ({found})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["gige", "pylon", "live", "same"])
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 960))
    given = parser.parse_args()
    match given.what:
        case "gige":
            gige(given.frames)
        case "pylon":
            pylon(given.frames)
        case "live":
            live(given.rate, given.frames, tuple(given.size))
        case "same":
            same()


if __name__ == "__main__":
    main()
