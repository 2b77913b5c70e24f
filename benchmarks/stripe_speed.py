"""One 1920 x 1200 frame of 8 bits on one core, warm, over one numpy.copy of it: `python -m benchmarks.stripe_speed`.

Every round times the copy and each extraction in turn, so that a busy machine slows all of them alike; the lower
deciles of the rounds are compared. Both give position, sigma, width, floor, second peak, asymmetry and
reasons; bare has no laser-off image, no comparison with neighbours and no look for speckle; in full has all three.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from ranging.stripe import Along, StripeOptions, extract  # noqa: E402

ROWS, COLUMNS = 1200, 1920
OPTIONS = StripeOptions(gain_e=35.0, read_noise=1.2)
BARE = StripeOptions(gain_e=35.0, read_noise=1.2, speckle="off", neighbours=False)
Frame = NDArray[np.uint8]


def frame(along: Along, sigma: float, seed: int) -> Frame:
    """A curved stripe of 160 grey levels on an offset of 4, with shot and read noise."""
    rng = np.random.default_rng(seed)
    lines, length = (ROWS, COLUMNS) if along == "columns" else (COLUMNS, ROWS)
    i = np.arange(lines)
    place = length / 2 + length / 8 * np.sin(i / lines * 5) + 0.1 * i
    light = 160 * np.exp(-(((np.arange(length) - place[:, None]) / sigma) ** 2) / 2)
    noisy = 4 + light + np.sqrt(light / 35 + 1.2**2) * rng.standard_normal(light.shape)
    image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return image if along == "columns" else np.ascontiguousarray(image.T)


def centre_of_mass(image: Frame, along: Along) -> NDArray[np.float64]:
    """The usual numpy route: brightest pixel, then the centre of mass of 11 pixels about it."""
    lines = image if along == "columns" else image.T
    at = np.clip(lines.argmax(axis=1), 5, lines.shape[1] - 6)
    near = at[:, None] + np.arange(-5, 6)
    value = np.take_along_axis(lines, near, axis=1).astype(np.float64) - 4
    return np.asarray((value * near).sum(axis=1) / value.sum(axis=1))


def ratios(actions: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Time of each action over that of the first: ratio of the lower deciles of rounds that interleave them."""
    for action in actions.values():
        action()
    times = np.empty((rounds, len(actions)))
    for row in times:
        for k, action in enumerate(actions.values()):
            start = time.perf_counter()
            action()
            row[k] = time.perf_counter() - start
    decile = np.percentile(times, 10, axis=0)
    return dict(zip(actions, (decile / decile[0]).tolist(), strict=True))


def start_up() -> None:
    """Time to import the extractor and load its compiled passes from disk for a first frame."""

    def wall(code: str) -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True)
        return time.perf_counter() - start

    base = "import numpy as np, cv2\nim = np.zeros((64, 64), np.uint8); im[:, 30:35] = [20, 80, 120, 70, 15]\n"
    work = "from ranging.stripe.extraction import extract\nextract(im, along='columns')\n"
    wall(base + work)
    with_work, without = (min(wall(code) for _ in range(5)) for code in (base + work, base))
    print(
        f"start-up to the first stripe, kernels on disk: {with_work:.2f} s (numpy and cv2 alone {without:.2f} s); limit 1.5 s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=200)
    rounds = parser.parse_args().rounds
    print("| one 1920 x 1200 frame over numpy.copy | numpy centre of mass | bare (limit 2.5) | in full (limit 4) |")
    print("| --- | --- | --- | --- |")
    for along in ("rows", "columns"):
        for sigma in (1.5, 2.5):
            image = frame(along, sigma, 0)
            off = np.clip(np.rint(np.random.default_rng(1).normal(4.0, 0.5, image.shape)), 0, 255).astype(np.uint8)
            found = ratios(
                {
                    "copy": image.copy,
                    "mass": lambda image=image, along=along: centre_of_mass(image, along),
                    "bare": lambda image=image, along=along: extract(image, along=along, options=BARE),
                    "full": lambda image=image, along=along, off=off: extract(
                        image, along=along, options=OPTIONS, background=off
                    ),
                },
                rounds,
            )
            print(
                f"| along {along}, width {sigma} px | {found['mass']:.1f} | {found['bare']:.2f} | {found['full']:.2f} |"
            )
    start_up()


if __name__ == "__main__":
    main()
