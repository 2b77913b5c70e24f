"""Scanning: time over decoding alone, memory, first point: ``python -m benchmarks.scanning [time] [memory] [first] [compiled]``.

A simulated rig of 1280 x 960 px gives a few frames, which stand for a capture of hundreds: the stage goes to and fro over
them, and the files are links, so that rendering does not take hours. Time is that of `run_scan`, in process and warm, over decoding the same files with
OpenCV on the same number of threads, alternating, least of several rounds. Memory is the peak resident size of a process
that scans into a file. The first point is timed from the start of the command to the first points on disk.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from scope.calibrating import calibrate
from scope.scanning import run_scan
from scope.session import frames
from scope.simulation.hardware_design import CameraDesign, JigDesign, LaserDesign
from scope.simulation.object_design import MotionDesign, PlaneDesign, SphereDesign
from scope.simulation.rig_design import RigDesign
from scope.simulation.session import simulate

RENDERED = 32
STEP = 0.4  # mm
DESIGN = RigDesign(
    CameraDesign((1280, 960), 1400.0, (655.0, 470.0), distortion=(-0.18, 0.05, 0.0004, -0.0003, 0.0)),
    LaserDesign((0.0, -190.0, 10.0), (0.0, 0.0, 400.0), roll=1.5, width=0.35),
    JigDesign(
        (340.0, 400.0, 460.0), 15, 21, 18.0, 6.0, fiducials=((7, 10), (7, 12), (4, 10)), fiducial_diameter=9.0, images=1,
        laser_images=1,
    ),
    objects=(PlaneDesign(origin=(0.0, 0.0, 430.0)), SphereDesign(radius=30.0, origin=(0.0, 0.0, 420.0))),
    motion=MotionDesign("linear", frames=RENDERED, direction=(0.0, 1.0, 0.0), step=STEP, start=-6.0),
)  # fmt: skip

_PEAK = """
import resource, sys
from pathlib import Path
from scope.scanning import ScanOptions, scan_to_file
found = scan_to_file(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), ScanOptions())
print(found.points, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def rig_and_frames(folder: Path) -> Path:
    """Simulate and calibrate; returns the rig's file."""
    simulate(DESIGN, folder / "session", np.random.default_rng(1))
    calibrate(folder / "session" / "calibration.toml").rig.save(folder / "rig.json")
    return folder / "rig.json"


def capture_of(folder: Path, count: int) -> Path:
    """Capture of ``count`` frames."""
    made = sorted((folder / "session" / "frames").glob("*.png"))
    place = folder / f"capture-{count}"
    (place / "frames").mkdir(parents=True)
    lap = [*range(len(made)), *range(len(made) - 2, 0, -1)]  # to and fro
    shown = [lap[k % len(lap)] for k in range(count)]
    for k, frame in enumerate(shown):
        os.link(made[frame], place / "frames" / f"{k:05d}.png")
    rows = "".join(f"{k},{STEP * frame}\n" for k, frame in enumerate(shown))
    (place / "stage.csv").write_text("frame,position\n" + rows)
    (place / "capture.toml").write_text(
        'format = 1\nimages = "frames/*.png"\n[motion]\nkind = "linear"\nmoves = "object"\ndirection = [0, 1, 0]\npositions = "stage.csv"\n'
    )
    return place / "capture.toml"


def time_ratio(folder: Path, rig: Path, *, count: int = 500, rounds: int = 3) -> float:
    """Least time of scanning over least time of decoding."""
    capture = capture_of(folder, count)
    files = sorted((capture.parent / "frames").glob("*.png"))
    cv2.setNumThreads(1)
    run_scan(capture_of(folder, 20), rig)  # warm
    scanning, decoding = [], []
    for _ in range(rounds):
        start = time.perf_counter()
        with ThreadPoolExecutor(frames.THREADS) as pool:
            for _ in pool.map(lambda path: cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape, files):
                pass
        decoding.append(time.perf_counter() - start)
        start = time.perf_counter()
        run_scan(capture, rig)
        scanning.append(time.perf_counter() - start)
    return min(scanning) / min(decoding)


def peak(capture: Path, rig: Path) -> tuple[int, float]:
    """Points, and peak resident size (MiB) of a process that scans into a file."""
    command = [sys.executable, "-c", _PEAK, str(capture), str(rig), str(capture.parent / "cloud.ply")]
    points, kib = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return int(points), int(kib) / 1024


def first_point(capture: Path, rig: Path, *, rounds: int = 5) -> float:
    """Least time, s, from the command to points on disk, with compiled code cached."""
    code = "import sys; from cli.main import main; sys.argv[0] = 'scope'; main()"
    found = []
    for k in range(rounds + 1):
        out = capture.parent / f"first-{k}.ply"
        command = [sys.executable, "-c", code, "scan", str(capture), "--rig", str(rig), "-o", str(out), "--quiet"]
        part = out.with_name(out.name + ".part")
        start = time.perf_counter()
        running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while not (part.is_file() and part.stat().st_size) and running.poll() is None:
            time.sleep(0.002)
        found.append(time.perf_counter() - start)
        running.kill()
        running.wait()
    return min(found[1:])


def first_over_second(folder: Path, bits: int) -> float:
    """Time of the first scan over that of the second, each a process of its own, after what set-up compiles and nothing else.

    The machine code goes to an empty folder of its own, so that no earlier run helps.
    """
    design = replace(DESIGN, camera=replace(DESIGN.camera, bits=bits))
    simulate(design, folder / f"deep-{bits}", np.random.default_rng(1))
    rig = folder / f"rig-{bits}.json"
    calibrate(folder / f"deep-{bits}" / "calibration.toml").rig.save(rig)
    around = os.environ | {"NUMBA_CACHE_DIR": str(folder / f"machine-code-{bits}")}
    code = "import sys; from cli.main import main; sys.argv[0] = 'scope'; main()"
    scan = [sys.executable, "-c", code, "scan", str(folder / f"deep-{bits}" / "capture.toml"), "--rig", str(rig)]
    subprocess.run([sys.executable, "-m", "scope.demo.precompile"], check=True, env=around)
    times = []
    for k in range(5):
        start = time.perf_counter()
        subprocess.run([*scan, "-o", str(folder / f"deep-{bits}-{k}.ply"), "--quiet"], check=True, env=around)
        times.append(time.perf_counter() - start)
    return times[0] / min(times[1:])


def main(wanted: set[str]) -> None:
    print("| figure | peer or limit | reached | reach |")
    print("| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig = rig_and_frames(folder)
        if "time" in wanted:
            print(
                f"| scanning 500 frames over decoding them | 1 | {time_ratio(folder, rig):.2f} | <= 1.15 |", flush=True
            )
        if "memory" in wanted:
            (few, small), (many, large) = (peak(capture_of(folder, count), rig) for count in (200, 2000))
            print(f"| peak memory, {many} points over {few} | 1 | {large / small:.3f} | <= 1.05 |", flush=True)
        if "first" in wanted:
            share = first_point(capture_of(folder, 300), rig) / 1.5
            print(f"| first point, over the limit of 1.5 s | 1 | {share:.2f} | <= 1 |", flush=True)
        for bits in (8, 16):
            if "compiled" in wanted:
                share = first_over_second(folder, bits)
                print(
                    f"| first scan of {bits} bits over the best of the next four | 1 | {share:.2f} | <= 1.5 |",
                    flush=True,
                )


if __name__ == "__main__":
    main(set(sys.argv[1:]) or {"time", "memory", "first", "compiled"})
