"""Run every command line of README.md and docs/ as it stands there, on small simulated input.

``python scripts/docs_commands.py [PAGE...] [--keep FOLDER]``, where the pages that they make stay in the folder.

Fenced blocks of kind ``sh`` and ``console`` are run in order, each page in a scratch folder of its own. A comment of HTML above a block says
what is different about it:

``<!-- run: with session -->``          files of a simulated session are put into the folder first (``measured``: its rig and cloud, too)
``<!-- run: in robot -->``              it is run in that folder
``<!-- not run: REASON -->``            it needs hardware or the network
``<!-- not run "scope x": REASON -->``  likewise, of the lines that begin so

A command fails where it exits with anything but 0 or 3 (3: done, but not to be used, is an answer, too).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"((?:<!--[^\n]*-->\n)*)```(sh|console)\n(.*?)```", re.DOTALL)
NOT_RUN = re.compile(r'<!-- not run(?: "([^"]+)")?: (.+?) -->')
RUN = re.compile(r"<!-- run: (with|in) (\w+) -->")
ANSWERS = {0, 3}
SLOWEST = 600  # s of one command

DESIGN = """
format = 1
[camera]
size = [1024, 768]
focal_px = 1150.0
centre_px = [505.0, 392.0]
distortion = [-0.22, 0.06, -0.0003, 0.0005, 0.0]
[laser]
origin = [0.0, -190.0, 10.0]
through = [0.0, 0.0, 420.0]
roll = 1.5
width = 0.3
[jig]
stand_offs = [320, 360, 400, 440]
rows = 15
columns = 21
pitch = 14.0
diameter = 5.0
fiducials = [[7, 10], [7, 12], [4, 10]]
fiducial_diameter = 7.5
[[object]]
solid = "plane"
origin = [0.0, 0.0, 440.0]
[[object]]
solid = "sphere"
radius = 20.0
origin = [-60.0, 0.0, 415.0]
[[object]]
solid = "rough"
size = [34.0, 34.0]
Sq = 0.1
correlation = 1.5
seed = 7
origin = [-2.0, 32.0, 436.0]
rotation = [180.0, 0.0, 0.0]
[motion]
kind = "linear"
direction = [0, 1, 0]
step = 0.7
start = -22.0
frames = 80
"""
FEATURES = """
format = 1
[[feature]]
name = "top"
kind = "plane"
point = [{x:.3f}, {y:.3f}, {z:.3f}]
tolerance = 0.2
"""
ACCEPTANCE = """
format = 1
standard = "vdi-2634-2"
[limits]
probing_form = 0.1
[sphere]
scans = "sphere/*.ply"
diameter = 25.0
uncertainty = 0.0005
"""
ARTEFACT = """
format = 1
name = "ball"
mesh = "ball.stl"
uncertainty = 0.01
region = "box:-85,-35,-25,25,390,432"
"""


@dataclass(frozen=True)
class Line:
    """One command line."""

    page: Path
    number: int  # of its line in the page
    text: str
    place: str = ""  # folder in which it is run
    files: str = ""  # that are put there before
    reason: str = ""  # why it is not run


def lines_of(page: Path) -> Iterator[Line]:
    """Command lines of a page, those that are not run with their reason."""
    text = page.read_text(encoding="utf-8")
    for block in BLOCK.finditer(text):
        marks, kind, body = block.groups()
        skipped = [(prefix, reason) for prefix, reason in NOT_RUN.findall(marks)]
        asked = dict(RUN.findall(marks))
        first = text[: block.start(3)].count("\n") + 1
        for k, line in enumerate(body.splitlines()):
            words = line.removeprefix("$ ") if kind == "console" else line
            if not words.strip() or words.lstrip().startswith("#") or (kind == "console" and not line.startswith("$ ")):
                continue
            reason = next((why for prefix, why in skipped if words.startswith(prefix)), "")
            yield Line(page, first + k, words, asked.get("in", ""), asked.get("with", "") if k == 0 else "", reason)


def prepare(folder: Path) -> None:
    """Simulated input: ``session`` (a jig, a scan, artefacts), ``robot`` (an arm, three scans of a part and its mesh)."""
    import numpy as np
    import trimesh

    from benchmarks import parts
    from scope import simulation
    from scope.cloud import ScanCloud
    from tests.scope.hand_eye.arm import arm, write_session
    from tests.scope.merge.test_merge import VIEWS
    from tests.scope.merge.test_merge import scan as seen_from

    session, robot, rng = folder / "session", folder / "robot", np.random.default_rng(3)
    (folder / "design.toml").write_text(DESIGN, encoding="utf-8")
    simulation.simulate(simulation.read_design(folder / "design.toml"), session, np.random.default_rng(1))
    shutil.copy(session / "calibration.toml", session / "new-images.toml")
    part = parts.casting().mesh()
    part.apply_translation(-part.bounds.mean(axis=0))
    part.export(session / "part.stl")
    (session / "sphere").mkdir()
    for k in range(10):
        out = rng.normal(size=(4000, 3))
        out = out[out[:, 2] < 0] / np.linalg.norm(out[out[:, 2] < 0], axis=1, keepdims=True)
        ball = (
            np.array([20.0 * k - 90.0, 10.0 * (k % 3), 380.0 + 5.0 * k])
            + (12.5 + rng.normal(0, 0.01, (len(out), 1))) * out
        )
        ScanCloud.from_points(ball).save(session / "sphere" / f"p{k}.ply")
    (session / "acceptance.toml").write_text(ACCEPTANCE, encoding="utf-8")
    trimesh.creation.icosphere(subdivisions=4, radius=20.0).export(session / "ball.stl")
    (session / "artefact.toml").write_text(ARTEFACT, encoding="utf-8")
    robot.mkdir()
    write_session(robot, arm(rng, 9), rng)
    shutil.copy(session / "part.stl", robot)
    level = part.triangles_center[part.face_normals[:, 2] > 0.99]
    x, y, z = level[np.argmax(level[:, 2])]
    (robot / "features.toml").write_text(FEATURES.format(x=x, y=y, z=z), encoding="utf-8")
    for name, view in zip("abc", VIEWS, strict=False):
        seen_from(part, view, rng, half=0.7 * float(np.ptp(part.bounds, axis=0).max())).save(robot / f"{name}.ply")


def measure(prepared: Path, environment: dict[str, str]) -> None:
    """``measured``: the session, calibrated and scanned."""
    copied(prepared / "session", prepared / "measured")
    for words in ("calibrate calibration.toml -o rig.json", "scan capture.toml --rig rig.json -o cloud.ply"):
        subprocess.run(
            f"scope {words} -q", shell=True, cwd=prepared / "measured", env=environment, check=True, capture_output=True
        )


def copied(source: Path, target: Path) -> None:
    """Put the files of a folder into another."""
    shutil.copytree(source, target, dirs_exist_ok=True)


def run_page(page: Path, folder: Path, prepared: Path, environment: dict[str, str]) -> list[str]:
    """Run the lines of a page; what failed."""
    failed = []
    for line in lines_of(page):
        where = f"{page.relative_to(ROOT)}:{line.number}"
        if line.reason:
            print(f"{where}: not run, {line.reason}: {line.text}", flush=True)
            continue
        if line.files == "measured" and not (prepared / "measured").exists():
            measure(prepared, environment)
        if line.files:
            copied(prepared / line.files, folder)
        if line.place:
            copied(prepared / line.place, folder / line.place)
        began = time.perf_counter()
        done = subprocess.run(
            line.text, shell=True, cwd=folder / line.place, env=environment, capture_output=True, text=True,
            timeout=SLOWEST, check=False,
        )  # fmt: skip
        print(f"{where}: exit {done.returncode}, {time.perf_counter() - began:.1f} s: {line.text}", flush=True)
        if done.returncode not in ANSWERS:
            failed.append(f"{where}: exit {done.returncode}: {line.text}\n{done.stderr[-600:]}")
    return failed


def main() -> int:
    """Run the pages that were named, or all."""
    words = sys.argv[1:]
    keep = Path(words[words.index("--keep") + 1]).resolve() if "--keep" in words else None
    words = words[: words.index("--keep")] if keep else words
    pages = [Path(name).resolve() for name in words] or [
        ROOT / "README.md",
        *sorted((ROOT / "docs").glob("*.md")),
    ]
    sys.path.insert(0, str(ROOT))
    binaries = Path(sys.executable).parent
    environment = os.environ | {
        "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}", "BROWSER": "true", "SCOPE_HISTORY": "off", "PYTHONPATH": str(ROOT),
    }  # fmt: skip
    failed: list[str] = []
    with tempfile.TemporaryDirectory(prefix="scope-docs-") as name:
        prepared = Path(name) / "prepared"
        prepared.mkdir()
        prepare(prepared)
        for page in pages:
            folder = Path(name) / page.stem
            folder.mkdir()
            copied(ROOT / "examples", folder / "examples")
            failed += run_page(page, folder, prepared, environment)
            if keep is not None:
                for made in folder.rglob("*.html"):
                    keep.mkdir(exist_ok=True, parents=True)
                    shutil.copy(made, keep / f"{page.stem}-{made.name}")
    print("\n".join(failed) or "every command line ran", file=sys.stderr if failed else sys.stdout)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
