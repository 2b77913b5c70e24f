"""What a pose costs without a region over with one, and five clouds over one: processor time of whole commands.

    python -m benchmarks.several                              simulated: a bracket between a casting and a plate above a table
    python -m benchmarks.several CLOUD MODEL REGION           a cloud of your own, such as twin-a's

The peer is the same command with a region, and with one cloud. Processor time of the children is taken, since other work on the machine does not
count in it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks import parts
from calibration.geometry import Pose
from scope.cloud import ScanCloud


def scene(seed: int) -> tuple[ScanCloud, str]:
    """A scan of a bracket between two other parts above a table, and the region of the bracket."""
    rng = np.random.default_rng(seed)
    bodies = []
    for body, x in ((parts.bracket(), 0.0), (parts.casting(), -130.0), (parts.plate(), 130.0)):
        rotation = parts.random_rotation(rng)
        middle = 0.5 * (body.vertices.min(axis=0) + body.vertices.max(axis=0))
        bodies.append((body, Pose(rotation, np.array([x, 0.0, 390.0]) - rotation @ middle)))
    table = parts.box_part(np.array([-190.0, -90.0, 470.0]), np.array([190.0, 90.0, 480.0]))
    made = parts.Scanner(points=40_000)
    cloud = parts.scan(table, Pose.identity(), rng, scanner=made, clutter=tuple(bodies))
    part, pose = bodies[0]
    at = pose.apply(part.vertices)
    low, high = at.min(axis=0) - 3.0, at.max(axis=0) + 3.0
    return cloud, f"box:{low[0]:.1f},{high[0]:.1f},{low[1]:.1f},{high[1]:.1f},{low[2]:.1f},{high[2]:.1f}"


def seconds(clouds: list[Path], model: Path, region: str = "") -> tuple[float, int]:
    """Processor time, s, of one command, and its exit status."""
    words = [
        sys.executable,
        "-c",
        "from cli.main import main; main()",
        "pose",
        *map(str, clouds),
        "-m",
        str(model),
        "--json",
        "-q",
    ]
    began = os.times()
    done = subprocess.run([*words, *(["--region", region] if region else [])], stdout=subprocess.DEVNULL, check=False)
    ended = os.times()
    return ended.children_user + ended.children_system - began.children_user - began.children_system, done.returncode


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("given", nargs="*")
    told = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if told.given:
            scenes = [(Path(told.given[0]), told.given[2])] * 5
            model = Path(told.given[1])
        else:
            model, scenes = Path(folder) / "part.stl", []
            parts.bracket().mesh().export(model)
            for seed in range(5):
                cloud, region = scene(seed)
                cloud.save(Path(folder) / f"{seed}.ply")
                scenes.append((Path(folder) / f"{seed}.ply", region))
        seconds([scenes[0][0]], model, scenes[0][1])  # the model is prepared and kept
        within = [seconds([path], model, region) for path, region in scenes[: 1 if told.given else 3]]
        without = [seconds([path], model) for path, _ in scenes[: 1 if told.given else 3]]
        five = seconds([path for path, _ in scenes], model)
    one, whole = float(np.mean([t for t, _ in within])), float(np.mean([t for t, _ in without]))
    print("| figure | with region, s | without, s | ratio | exit | reach |\n| --- | --- | --- | --- | --- | --- |")
    print(f"| one cloud | {one:.1f} | {whole:.1f} | {whole / one:.2f} | {[s for _, s in (*within, *without)]} | <= 3 |")
    print(f"| five clouds without a region over one | | {five[0]:.1f} | {five[0] / whole:.2f} | {five[1]} | <= 3.5 |")
    if told.given:
        many = seconds([path for path, _ in scenes], model, scenes[0][1])
        print(f"| five clouds with a region over one | {many[0]:.1f} | | {many[0] / one:.2f} | {many[1]} | <= 3.5 |")


if __name__ == "__main__":
    main()
