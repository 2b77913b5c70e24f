"""Scale that planes cannot see: stand-offs stated 0.1 % too far apart, undone by one scan of a stepped block.

    python -m benchmarks.scale [--draws 3]

A rendered rig (the tests' camera of 640 x 480 px) whose calibration.toml states stand-offs 0.1 % larger about zero than they are; a
block with three levels and sloped ends is scanned by a linear stage, the rig corrected by it (`scope correct`), and another scan, of
four steps that stand elsewhere, made with both rigs. Peer: the same heights with the rig as it was calibrated.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from pathlib import Path

import numpy as np
import trimesh

from benchmarks.small_session import DESIGN
from calibration.rig import Rig
from scope import simulation
from scope.calibrating import calibrate
from scope.check import check_artefact
from scope.scanning import scan
from scope.watch import correct_rig, read_artefact

ERROR = 0.001
FINER = (
    DESIGN.replace("[640, 480]", "[1280, 960]")
    .replace("700.0", "1400.0")
    .replace("[322.0, 236.0]", "[644.0, 472.0]")
    .replace("width = 0.5", "width = 0.25")
)
STEPS = """[[object]]
solid = "steps"
heights = [8.0, 16.0, 24.0]
tread = [14.0, 36.0]
gap = 4.0
origin = [-25.0, 18.0, 372.0]
rotation = [180.0, 0.0, 0.0]
[[object]]
solid = "plane"
origin = [0.0, 0.0, 372.0]
"""


def block() -> trimesh.Trimesh:
    """Five levels, 8 mm apart, of different lengths: upright walls, as milled."""
    x = [-36.0, -26, -14, -4, 12, 22, 30, 36]
    height = [8.0, 16, 24, 32, 24, 16, 8]
    points, faces = [], []
    for k, high in enumerate(height):
        left = {0.0, high} | ({height[k - 1]} if k and height[k - 1] < high else set())
        right = {0.0, high} | ({height[k + 1]} if k + 1 < len(height) and height[k + 1] < high else set())
        ring = [(x[k], z) for z in sorted(left)] + [(x[k + 1], z) for z in sorted(right, reverse=True)]
        first = len(points)
        points += [*ring, ((x[k] + x[k + 1]) / 2, high / 2)]
        faces += [[first + i, first + (i + 1) % len(ring), first + len(ring)] for i in range(len(ring))]
    flat, where = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    mesh = trimesh.creation.extrude_triangulation(flat, where.ravel()[np.array(faces)], 36.0)
    mesh.fix_normals()
    # x along the steps, z up
    turn = np.array([[1.0, 0, 0, 0], [0, 0, -1, 18.0], [0, 1, 0, 0], [0, 0, 0, 1]])
    mesh.apply_transform(turn)
    return mesh


def session(folder: Path, objects: str, seed: int, *, step: float = 0.5, frames: int = 100) -> Path:
    head = FINER.split("[[object]]")[0]
    motion = f'[motion]\nkind = "linear"\ndirection = [0.0, 1.0, 0.0]\nstart = {-step * frames / 2}\nstep = {step}\nframes = {frames}\noff_images = 2\n'
    (folder / "design.toml").write_text(head + objects + motion)
    simulation.simulate(simulation.read_design(folder / "design.toml"), folder / "r", np.random.default_rng(seed))
    return folder / "r"


def stretch(file: Path) -> None:
    """State every stand-off 0.1 % further from C than it is."""
    text = re.sub(
        r"(origin = \[[^,\]]+,[^,\]]+,\s*)([\d.]+)\]", lambda m: f"{m.group(1)}{float(m.group(2)) * (1 + ERROR):.6f}]", file.read_text()
    )  # fmt: skip
    file.write_text(text)


def draw(seed: int) -> tuple[list[float], list[float], dict[str, float]]:
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        block().export(home / "block.stl")
        (home / "a").mkdir(), (home / "b").mkdir()
        turn = 3.0 * np.sin(seed)
        one = session(
            home / "a", f'[[object]]\nmesh = "{home / "block.stl"}"\norigin = [0.0, 0.0, 365.0]\nrotation = [{180 + turn}, 0.0, 0.0]\n', seed
        )  # fmt: skip
        stretch(one / "calibration.toml")
        rig = calibrate(one / "calibration.toml").rig
        rig.save(home / "rig.json")
        rig = Rig.load(home / "rig.json")
        (home / "artefact.toml").write_text('format = 1\nmesh = "block.stl"\nuncertainty = 0.001\n')
        cloud = scan(one / "capture.toml", rig)
        cloud.save(home / "block.ply")
        found = correct_rig(rig, cloud, read_artefact(home / "artefact.toml"), str(home / "block.ply"))
        found.rig.save(home / "corrected.json")
        two = session(home / "b", STEPS, seed + 50)
        off = []
        for which in ("rig.json", "corrected.json"):
            seen = check_artefact(scan(two / "capture.toml", Rig.load(home / which)), "steps:8,16,24")
            off.append([100 * s.error / s.nominal for s in seen.sizes])
        s = found.watched.strain
        told = {
            a: (100 * float(s.scale[k]), 100 * float(found.watched.scale_uncertainty[k]))
            for k, a in enumerate("xyz")
            if s.told[k, k]
        }
        return off[0], off[1], told


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=3)
    asked = parser.parse_args()
    for seed in range(asked.draws):
        before, after, told = draw(seed)
        print(f"seed {seed}: block says " + ", ".join(f"{a} {v:+.4f} % (U {u:.4f})" for a, (v, u) in told.items()))
        print("  steps of 8, 16, 24 mm off by " + ", ".join(f"{v:+.4f}" for v in before) + " % as calibrated, " + ", ".join(f"{v:+.4f}" for v in after) + " % corrected", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
