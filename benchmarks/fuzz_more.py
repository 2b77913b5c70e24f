"""What else is spoiled by `benchmarks.fuzz`: motions of robot and turntable, hand and eye, targets, freehand views, designs, models, several clouds, a day.

Sessions of an arm, a board and a part are those of the tests (`tests.scope.hand_eye.arm`, `tests.scope.inspection`); everything stands in folders
of its own beside the session's.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

Argv = Callable[[Path], list[str]]
Kind = tuple[str, str, Argv, float, bool]  # name, file, command, weight, whether it is a text of people

_MOTIONS = {
    "turning": 'kind = "turntable"\nmoves = "object"\naxis_point = [0.0, 0.0, 360.0]\naxis_direction = [0.0, 1.0, 0.0]\nstep = 2.0\n',
    "posed": 'kind = "poses"\nposes = "posed.csv"\nconvention = "camera_from_object"\n',
    "placed": 'kind = "linear"\nmoves = "object"\ndirection = [0.0, 1.0, 0.0]\npositions = "placed.csv"\n',
}
_CAMERA = '[camera]\ndriver = "replay"\nid = "frames"\n'
_WILD = """format = 1
units = "mm"
[wild]
colour = "green"
width = 0.8
bayer = false
boards = 2
lasers = 2
missing = 0
blurred = 0
dust = 1
hands = 1
"""


def prepare_more(folder: Path, design: str) -> None:
    """Write the further files into a session's folder that has ``cloud.ply``, ``rig.json`` and ``capture.toml``."""
    from benchmarks.fuzz import run
    from scope.cloud import ScanCloud

    prepare_texts(folder, design)
    _prepare_solids(folder)
    cloud = ScanCloud.load(folder / "cloud.ply")
    cloud.select(np.arange(0, len(cloud), 2)).save(folder / "half.ply")
    (folder / "poses.json").write_text(json.dumps([np.eye(4).tolist(), np.eye(4).tolist()]), encoding="utf-8")
    done = run(
        ["check", str(folder / "cloud.ply"), "-a", "sphere:d=40", "--region", "box:-58,-12,-40,40,330,362", "--json"]
    )
    (folder / "check.json").write_text(done[1], encoding="utf-8")


def prepare_texts(folder: Path, design: str) -> None:
    """Captures with other motions and their CSV, targets and designs."""
    from scope.session import write_template

    text = (folder / "capture.toml").read_text(encoding="utf-8").split("[motion]")[0]
    for name, motion in _MOTIONS.items():
        (folder / f"{name}.toml").write_text(f"{text}[motion]\n{motion}", encoding="utf-8")
    linear = (folder / "capture.toml").read_text(encoding="utf-8")
    images = next(line for line in linear.splitlines() if line.startswith("images"))
    (folder / "watched.toml").write_text(
        linear.replace(f"{images}\n", "").replace("[motion]", f"{_CAMERA}[motion]"), encoding="utf-8"
    )
    head = "frame," + ",".join(f"m{i}{j}" for i in range(4) for j in range(4))
    rows = []
    for k in range(12):
        pose = np.eye(4)
        pose[1, 3] = 2.0 * k - 11.0
        rows.append(f"{k}," + ",".join(f"{x:g}" for x in pose.ravel()))
    (folder / "posed.csv").write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    places = [f"{k},{2.0 * k - 11.0:g}" for k in range(12)]
    (folder / "placed.csv").write_text("\n".join(["frame,position", *places]) + "\n", encoding="utf-8")
    (folder / "targets").mkdir()
    for kind in ("spots", "chessboard", "charuco", "markers", "circles"):
        write_template(folder / "targets" / f"{kind}.toml", kind)
    (folder / "designs").mkdir()
    (folder / "designs" / "rig.toml").write_text(design, encoding="utf-8")
    (folder / "designs" / "wild.toml").write_text(_WILD, encoding="utf-8")


def _prepare_solids(folder: Path) -> None:
    """An arm that looks at a board, a ball in several formats, a part with its features."""
    import trimesh

    from tests.scope.hand_eye.arm import arm, write_session
    from tests.scope.inspection.test_inspection import FEATURES, plate, seen

    rng = np.random.default_rng(3)
    write_session(folder / "arm", arm(rng, 7), rng)
    (folder / "arm" / "calibration.toml").write_text(
        'format = 1\nunits = "mm"\n[target]\nkind = "chessboard"\nrows = 6\ncolumns = 9\npitch = 5.0\n[[views]]\nimages = "views/*.png"\n',
        encoding="utf-8",
    )
    ball = trimesh.load(folder / "ball.stl")
    (folder / "models").mkdir()
    for ending in ("glb", "3mf", "obj", "ply"):
        made = ball.copy()
        made.apply_scale(0.001 if ending == "glb" else 1.0)  # glTF is in metres
        made.export(folder / "models" / f"ball.{ending}")
    (folder / "part").mkdir()
    part = plate()
    part.export(folder / "part" / "plate.stl")
    seen(part, rng)[0].save(folder / "part" / "plate.ply")
    (folder / "part" / "features.toml").write_text(FEATURES, encoding="utf-8")


def more_cases() -> list[Kind]:
    """Names, files and commands; a result is compared for none of them."""
    box = "box:-58,-12,-40,40,330,362"

    def scan(name: str) -> Argv:
        return lambda f: ["scan", str(f / name), "--rig", str(f / "rig.json"), "-o", str(f / "out/new.ply"), "--json"]

    def on(kind: str) -> Argv:
        return lambda f: ["target", str(f / f"targets/{kind}.toml"), "-o", str(f / "out/t.svg"), "--json"]

    def model(ending: str) -> Argv:
        return lambda f: [
            "pose",
            str(f / "cloud.ply"),
            "-m",
            str(f / f"models/ball.{ending}"),
            "--region",
            box,
            "--json",
        ]

    def hand_eye(f: Path) -> list[str]:
        return [
            "hand-eye",
            str(f / "arm/hand-eye.toml"),
            "--rig",
            str(f / "arm/rig.json"),
            "-o",
            str(f / "out/he.json"),
            "--json",
        ]

    def inspect(f: Path) -> list[str]:
        return ["inspect", str(f / "part/plate.ply"), "--model", str(f / "part/plate.stl"), "--features", str(f / "part/features.toml"), "--json"]  # fmt: skip

    def merge(f: Path) -> list[str]:
        return [
            "merge",
            str(f / "cloud.ply"),
            str(f / "half.ply"),
            "--poses",
            str(f / "poses.json"),
            "-o",
            str(f / "out/m.ply"),
            "--json",
        ]

    def check(f: Path) -> list[str]:
        return ["check", str(f / "cloud.ply"), str(f / "half.ply"), "-a", "sphere:d=40", "--region", box, "--json", "--report", str(f / "out/c.html")]  # fmt: skip

    def certificate(f: Path) -> list[str]:
        return ["certificate", str(f / "rig.json"), "--with", str(f / "check.json"), "--cloud", str(f / "cloud.ply"), "-o", str(f / "out/c.html"), "--json"]  # fmt: skip

    def batch(f: Path) -> list[str]:
        return ["batch", str(f / "cloud.ply"), str(f / "half.ply"), "--rig", str(f / "rig.json"), "--do", f"check -a sphere:d=40 --region {box}",
                "-o", str(f / "out/day.csv"), "--jobs", "1", "--json"]  # fmt: skip

    def several(f: Path) -> list[str]:
        return ["pose", str(f / "cloud.ply"), str(f / "half.ply"), "-m", str(f / "ball.stl"), "--region", box, "--json"]

    def freehand(f: Path) -> list[str]:
        return ["calibrate", str(f / "arm/calibration.toml"), "-o", str(f / "out/new.json"), "--json"]

    found: list[Kind] = [
        *((f"capture {name}: scan", f"{name}.toml", scan(f"{name}.toml"), 1.0, True) for name in (*_MOTIONS, "watched")),
        ("poses of frames: scan", "posed.csv", scan("posed.toml"), 1.0, True),
        ("positions of frames: scan", "placed.csv", scan("placed.toml"), 1.0, True),
        ("hand-eye: file", "arm/hand-eye.toml", hand_eye, 0.7, True),
        ("hand-eye: log", "arm/poses.csv", hand_eye, 0.7, True),
        ("hand-eye: view", "arm/views/*.png", hand_eye, 0.3, True),
        ("freehand: calibrate", "arm/calibration.toml", freehand, 0.3, True),
        ("freehand view: calibrate", "arm/views/*.png", freehand, 0.2, True),
        *((f"target {kind}", f"targets/{kind}.toml", on(kind), 1.0, True) for kind in ("spots", "chessboard", "charuco", "markers", "circles")),
        ("design: predict", "designs/rig.toml", lambda f: ["design", str(f / "designs/rig.toml"), "--json"], 0.5, True),
        ("design: simulate wild", "designs/wild.toml",
         lambda f: ["simulate", str(f / "designs/wild.toml"), "-o", str(f / "out/wild"), "--json"], 0.7, True),
        *((f"model {ending}: pose", f"models/ball.{ending}", model(ending), 0.5, True) for ending in ("glb", "3mf", "obj", "ply")),
        ("features: inspect", "part/features.toml", inspect, 0.3, True),
        ("part as seen, inspect", "part/plate.ply", inspect, 0.3, True),
        ("poses: merge", "poses.json", merge, 0.5, True),
        ("second of two, merge", "half.ply", merge, 0.5, True),
        ("second of two, check", "half.ply", check, 1.0, True),
        ("evidence: certificate", "check.json", certificate, 1.0, True),
        ("certificate of a cloud", "cloud.ply", certificate, 0.5, True),
        ("batch of two", "half.ply", batch, 0.5, True),
        ("second of two, pose", "half.ply", several, 0.3, True),
    ]  # fmt: skip
    return found
