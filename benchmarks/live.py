"""The live path: `Scanner.profile` of one 1280 x 960 frame over decoding the same frame from PNG: ``python -m benchmarks.live``.

All on one core, warm, in turn, and the lower deciles of the rounds are compared. Profile gives points with both sigmas, edges as far as one
frame shows them (lines beside each other, half-seen and two-surface lines); its channel and noise are learnt from the first three frames.
Peers: the usual numpy route to pixels (brightest pixel, centre of mass of 11 px about it), and OpenCV's (blur, highest row of every column, first
moments of the rows about it); neither triangulates, gives an uncertainty or a reason. Last, slopes and edges from frame to frame: `Scanner.stream`
of a run of frames over decoding them.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import tracemalloc
from itertools import cycle, islice
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from benchmarks.scanning import STEP, rig_and_frames  # noqa: E402
from benchmarks.stripe_speed import centre_of_mass, ratios  # noqa: E402
from ranging.motion import Linear  # noqa: E402
from scope.scanning import Scanner  # noqa: E402

Frame = NDArray[np.uint8]


def by_opencv(image: Frame) -> NDArray[np.float32]:
    """Blur across the stripe, the brightest row of every column, and the centre of mass of 11 rows about it."""
    blurred = cv2.GaussianBlur(image, (1, 5), 1.0)
    at = np.clip(np.argmax(blurred, axis=0), 5, image.shape[0] - 6)
    columns = np.arange(image.shape[1], dtype=np.float32)
    rows = at.astype(np.float32) + np.arange(-5, 6, dtype=np.float32)[:, None]
    near = cv2.remap(image, np.broadcast_to(columns, rows.shape).copy(), rows, cv2.INTER_NEAREST).astype(np.float32)
    return np.asarray((near * rows).sum(axis=0) / near.sum(axis=0))


def kept(scanner: Scanner, images: list[Frame], count: int) -> int:
    """Bytes that are still held after ``count`` more profiles."""
    tracemalloc.start()
    for image in islice(cycle(images), 10):
        scanner.profile(image)
    before = tracemalloc.get_traced_memory()[0]
    for image in islice(cycle(images), count):
        scanner.profile(image)
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return after - before


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=100)
    rounds = parser.parse_args().rounds
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        rig = rig_and_frames(Path(name))
        files = sorted((Path(name) / "session" / "frames").glob("*.png"))
        coded = [np.frombuffer(path.read_bytes(), np.uint8) for path in files]
        images = [np.asarray(cv2.imdecode(code, cv2.IMREAD_UNCHANGED)) for code in coded]
        scanner = Scanner(rig)
        for image in images[:4]:
            scanner.profile(image)
        middle = len(images) // 2
        image = images[middle]
        found = ratios(
            {
                "decode": lambda: cv2.imdecode(coded[middle], cv2.IMREAD_UNCHANGED),
                "profile": lambda: scanner.profile(image),
                "numpy": lambda: centre_of_mass(image, "rows"),
                "opencv": lambda: by_opencv(image),
            },
            rounds,
        )
        motion = Linear(np.array([0.0, 1.0, 0.0]), step=STEP)
        run = ratios(
            {
                "decode": lambda: [cv2.imdecode(code, cv2.IMREAD_UNCHANGED) for code in coded],
                "stream": lambda: sum(len(cloud.points) for cloud in scanner.stream(images, motion)),
            },
            max(3, rounds // 20),
        )
        print("| one 1280 x 960 frame, one core, over decoding it | peer | reached | reach |")
        print("| --- | --- | --- | --- |")
        print(
            f"| Scanner.profile | numpy centre of mass {found['numpy']:.3f}, OpenCV {found['opencv']:.3f} | {found['profile']:.3f} | <= 0.15 |"
        )
        print(
            f"| slopes and edges from frame to frame, a run of {len(images)} with its set-up | - | {run['stream']:.3f} | - |"
        )
        print(f"| bytes still held after 500 more profiles | - | {kept(scanner, images, 500)} | 0, to a few objects |")


if __name__ == "__main__":
    main()
