"""Acceptance tests on simulated artefacts: what is stated against the true errors.

    python -m benchmarks.acceptance [--sessions 12]

A scanner whose sheet of light is off by its own stated calibration error (offset 0.01 mm, tilts 0.01 mm over 50 mm, drawn anew each session) and
whose points have 0.01 mm of noise; spheres of 20 mm at ten places, a ball bar of 80 mm in seven, a plane of 100 x 50 mm in six. The artefacts are exact, so
that an error of indication is the scanner's own: is it within what the scanner claims for it (k = 2)? Beside it: the claims with noise alone.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from calibration.geometry import Pose
from scope.acceptance import accept, read_acceptance
from scope.cloud import ScanCloud, Sensors
from tests.scope.acceptance.test_acceptance import FILE, PLACES, cap

NOISE, SHEET = 0.01, 0.01
CENTRE, NORMAL = np.array([0.0, 0.0, 390.0]), np.array([0.0, 0.93, 0.37]) / np.hypot(0.93, 0.37)
AWAY = np.array([0.0, 1.0, 0.0])
AXES = np.linalg.svd(NORMAL[None])[2][1:]


def seen(points: np.ndarray, error: np.ndarray, rng: np.random.Generator) -> ScanCloud:
    """Points (N, 3) of an object at position 0, each lit when the stage has brought it into the sheet; the scanner takes the sheet to lie elsewhere."""
    moved = ((CENTRE - points) @ NORMAL) / (AWAY @ NORMAL)
    lit = points + moved[:, None] * AWAY
    ray = lit / np.linalg.norm(lit, axis=1, keepdims=True)
    place = np.column_stack([np.ones(len(lit)), (lit - CENTRE) @ AXES.T / 50.0])
    cosine = ray @ NORMAL
    wrong = (place @ error) / cosine
    sigma_cal = SHEET * np.linalg.norm(place, axis=1) / np.abs(cosine)
    found = lit + (wrong + NOISE * rng.normal(size=len(lit)))[:, None] * ray
    n = len(lit)
    bare = ScanCloud.from_points(found - moved[:, None] * AWAY)
    frames = np.arange(n, dtype=np.int32)
    sensors = Sensors(
        frames, np.zeros(n, np.uint8), -moved[:, None] * AWAY, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), np.nan)
    )
    return ScanCloud(
        points=bare.points, intensity=bare.intensity, sigma=np.full(n, NOISE, np.float32), sigma_cal=sigma_cal.astype(np.float32),
        pixels=bare.pixels, frame=frames, laser=bare.laser, camera_centre=np.zeros(3), verified=True, sensors=sensors,
    )  # fmt: skip


def facing(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return points[(normals * -points).sum(axis=1) / np.linalg.norm(points, axis=1) > 0.3]


def session(folder: Path, rng: np.random.Generator) -> None:
    error = rng.normal(0, SHEET, 3)
    for k, place in enumerate(PLACES):
        seen(cap(10.0, np.array([*place, 380.0 + 4 * k]), 1500, rng), error, rng).save(folder / f"sphere{k}.ply")
    turns = [[0, 0, 0], [0, 0, 1.5], [0, 0, 0.7], [0, 0.4, 0], [0, -0.4, 0.2], [0, 0.3, 1.2], [0, -0.3, -0.6]]
    for k, turn in enumerate(turns):
        ends = Pose.from_rotation_vector(turn, [*PLACES[k % 3], 400.0]).apply(np.array([[-40.0, 0, 0], [40.0, 0, 0]]))
        seen(np.concatenate([cap(10.0, end, 1200, rng) for end in ends]), error, rng).save(folder / f"bar{k}.ply")
    for k in range(6):
        flat = np.column_stack([rng.uniform(-1, 1, (3000, 2)) * [50, 25], np.zeros(3000)])
        pose = Pose.from_rotation_vector([0.2 * (k % 3), 0.1 * k - 0.2, 0], [*PLACES[k], 400.0])
        seen(pose.apply(flat), error, rng).save(folder / f"plane{k}.ply")
    (folder / "acceptance.toml").write_text(FILE.format(standard="vdi-2634-2"))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--sessions", type=int, default=12)
    asked = parser.parse_args()
    inside: dict[str, list[bool]] = defaultdict(list)
    ratio: dict[str, list[float]] = defaultdict(list)
    for seed in range(asked.sessions):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            session(folder, np.random.default_rng(seed))
            for test in accept(read_acceptance(folder / "acceptance.toml")).tests:
                for r in test.readings:
                    inside[test.symbol].append(abs(r.value) <= (r.claimed or 0.0))
                    ratio[test.symbol].append(abs(r.value) / (r.claimed or np.nan))
    for symbol, values in inside.items():
        print(
            f"{symbol}: {sum(values)} of {len(values)} errors within what is claimed ({100 * np.mean(values):.1f} %); error over claim: "
            f"median {np.median(ratio[symbol]):.2f}, worst {max(ratio[symbol]):.2f}"
        )
    everything = [v for values in inside.values() for v in values]
    print(f"all: {sum(everything)} of {len(everything)} ({100 * np.mean(everything):.1f} %), reach 95 %")


if __name__ == "__main__":
    main()
