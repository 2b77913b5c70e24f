"""Damaged files through the commands: python -m benchmarks.fuzz --inputs 2000.

Each input is a file of a simulated session, or made from it, with one mutation: bytes flipped, set, cut out, doubled, inserted or cut
off; a number replaced by an impossible one; a value of a JSON file altered, removed or emptied. It must end in success or in one
line of error. Counted are

- tracebacks: any exception but an orderly exit;
- silent wrong: exit 0, and the result is not that of the sound files (a TOML file that says something else, validly, is no damage);
- half-written: exit 1 or 2, and a file was made or changed;
- lines: exit 1 or 2, and not one line ``error: ...`` of at most 300 characters (paths not counted) on stderr, C libraries included;
- crashes and hangs would end the run.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from typer.testing import CliRunner

from benchmarks.fuzz_more import more_cases, prepare_more
from benchmarks.small_session import design_text, small_session
from cli.console import libraries_silenced
from cli.main import app

KINDS = ("tracebacks", "silent wrong", "half-written", "lines")
_IMPOSSIBLE = (
    "1e999",
    "-1",
    "nan",
    "99999999999999999999",
    "0",
    "null",
    '"x"',
    "[]",
    "-0.0",
    "1e300",
    "4294967295",
    "2147483647",
)
_TOML_NUMBERS = ("0", "-1", "1e9", "-1e9", "1e300", "nan", "inf", "2147483648", "0.001", "1.5", "99999999999999999999")
_TOML_VALUES = (
    '""',
    '"x"',
    "[]",
    "{}",
    "true",
    "[[]]",
    '["x"]',
    "2026-01-01",
    '"../../x/*.png"',
    '"/"',
    '"*"',
    '"\\u0000"',
    *_TOML_NUMBERS,
)
_LINE = re.compile(r"error: .+")

Run = tuple[int, str, list[str], BaseException | None]


@dataclass(frozen=True, slots=True)
class Case:
    """A file to spoil, what to run on it, and what its result must be if that succeeds."""

    name: str
    file: str  # within the session
    argv: Callable[[Path], list[str]]
    weight: float
    result: Callable[[Path, str], Any] = field(default=lambda _folder, _stdout: None)
    same: Callable[[Any, Any], bool] = field(default=lambda _a, _b: True)
    free: bool = False  # a text of people: another content that is valid may give another result


def prepare(folder: Path) -> None:
    """Add to a session with rig.json (and its capture) the cloud and what is made of it."""
    for argv in (
        ["scan", str(folder / "capture.toml"), "--rig", str(folder / "rig.json"), "-o", str(folder / "cloud.ply")],
        *(["export", str(folder / "cloud.ply"), str(folder / f"made.{ending}")] for ending in ("pcd", "xyz")),
    ):
        done = run(argv)
        if done[0] not in (0, 3):
            raise SystemExit(f"{argv[0]} failed: {done[2]}")
    for ending, package in (("las", "laspy"), ("e57", "pye57")):
        if _there(package):
            run(["export", str(folder / "cloud.ply"), str(folder / f"made.{ending}")])
    import trimesh

    trimesh.creation.icosphere(subdivisions=3, radius=20.0).export(folder / "ball.stl")
    end = {"robot_from_camera": [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0], "units": "m", "convention": "quaternion-xyzw"}
    (folder / "robot.json").write_text(json.dumps(end), encoding="utf-8")
    np.save(folder / "made.npy", np.random.default_rng(0).normal(scale=0.01, size=(60, 80)))


def _there(package: str) -> bool:
    import importlib.util

    return importlib.util.find_spec(package) is not None


def _points(name: str) -> Callable[[Path, str], Any]:
    def read(folder: Path, _stdout: str) -> Any:
        from scope.cloud import ScanCloud

        cloud = ScanCloud.load(folder / "out" / name)
        return cloud.frame, cloud.pixels, cloud.points

    return read


def _same_points(a: Any, b: Any) -> bool:
    """Whether the points of all frames and lines are there, and where they were to 0.01 mm, but for one in 200."""
    keys = [frame.astype(np.int64) * 100_000 + np.rint(pixels[:, 0]).astype(np.int64) for frame, pixels, _ in (a, b)]
    _, i, j = np.intersect1d(keys[0], keys[1], return_indices=True)
    off = np.linalg.norm(a[2][i] - b[2][j], axis=1) > 0.01
    return bool(len(i) >= 0.995 * max(len(keys[0]), len(keys[1])) and off.mean() <= 0.005)


def _told(*keys: str) -> Callable[[Path, str], Any]:
    def read(_folder: Path, stdout: str) -> Any:
        value = json.loads(stdout)
        for key in keys:
            value = value[int(key)] if isinstance(value, list) else value[key]
        return value

    return read


def _near(limit: float) -> Callable[[Any, Any], bool]:
    return lambda a, b: (a is None) == (b is None) and (a is None or abs(a - b) <= limit)


def cases(folder: Path) -> list[Case]:
    """What is spoiled, with its commands."""
    rig, cloud, capture = (lambda f, n=n: str(f / n) for n in ("rig.json", "cloud.ply", "capture.toml"))
    box = "box:-58,-12,-40,40,330,362"

    def scanned(f: Path) -> list[str]:
        return ["scan", capture(f), "--rig", rig(f), "-o", str(f / "out/new.ply"), "--json"]

    def calibrated(f: Path) -> list[str]:
        return ["calibrate", str(f / "calibration.toml"), "-o", str(f / "out/new.json"), "--json"]

    found = [
        Case("rig: scan", "rig.json", scanned, 3, _points("new.ply"), _same_points),
        Case("rig: verify", "rig.json", lambda f: ["verify", rig(f), "--json"], 2, _told("passed"), lambda a, b: bool(a == b)),
        Case("rig: view", "rig.json", lambda f: ["view", rig(f), "--no-show", "-o", str(f / "out/v.html")], 0.5),
        Case("capture: scan", "capture.toml", scanned, 2, _points("new.ply"), _same_points, free=True),
        Case("frame: scan", "frames/*.png", scanned, 2, _points("new.ply"), _same_points),
        Case("cloud: roughness", "cloud.ply", lambda f: ["roughness", cloud(f), "--region", "box:0,140,-60,60,366,378", "--json"], 2,
             _told("patches", "0", "areal", "Sq", "value"), _near(0.01)),
        Case("cloud: check", "cloud.ply", lambda f: ["check", cloud(f), "-a", "sphere:d=40", "--region", box, "--json"], 2,
             _told("sizes", "0", "measured"), _near(0.2)),
        Case("cloud: pose", "cloud.ply",
             lambda f: ["pose", cloud(f), "-m", str(f / "ball.stl"), "--region", box, "--json"], 0.3, _told("found")),
        Case("robot end: pose", "robot.json",
             lambda f: ["pose", cloud(f), "-m", str(f / "ball.stl"), "--region", box, "--json", "--robot-from-camera",
                        str(f / "robot.json")], 0.3),
        Case("cloud: view", "cloud.ply", lambda f: ["view", cloud(f), "--no-show", "-o", str(f / "out/v.html")], 1),
        Case("cloud: export stl", "cloud.ply", lambda f: ["export", cloud(f), str(f / "out/new.stl")], 1),
        Case("plane at the jig: check", "w330/*.png",
             lambda f: ["calibrate", str(f / "calibration.toml"), "--check", "w330", "--json"], 1),
        Case("calibration: calibrate", "calibration.toml", calibrated, 0.15, _told("passed"), lambda a, b: bool(a == b), free=True),
        Case("mark image: calibrate", "w3*/*.png", calibrated, 0.15, _told("passed"), lambda a, b: bool(a == b)),
        Case("calibration: check", "calibration.toml",
             lambda f: ["calibrate", str(f / "calibration.toml"), "--check", "w330", "--json"], 2),
        Case("heights: roughness", "made.npy", lambda f: ["roughness", str(f / "made.npy"), "--pitch", "0.1", "--json"], 1),
    ]  # fmt: skip
    found += [
        Case(name, file, argv, weight, free=free)
        for name, file, argv, weight, free in more_cases()
        if any(folder.glob(file)) and ((folder / "arm").exists() or file.endswith((".toml", ".csv")))
    ]
    for ending in ("pcd", "xyz", "las", "e57"):
        if (folder / f"made.{ending}").exists():
            argv = _export(ending)
            found.append(Case(f"{ending}: export", f"made.{ending}", argv, 1))
    return found


def _export(ending: str) -> Callable[[Path], list[str]]:
    return lambda f: ["export", str(f / f"made.{ending}"), str(f / "out/new.ply")]


def run(argv: list[str]) -> Run:
    """Exit status, stdout, lines of stderr (with what C libraries print past it), and an exception that was not caught."""
    with tempfile.TemporaryFile() as past:
        sys.stderr.flush()
        kept = os.dup(1), os.dup(2)
        for fd in (1, 2):
            os.dup2(past.fileno(), fd)
        try:
            with libraries_silenced():  # as `cli.main.main` does
                done = CliRunner().invoke(app, argv)
        finally:
            for fd, own in zip((1, 2), kept, strict=True):
                os.dup2(own, fd)
                os.close(own)
        past.seek(0)
        text = done.stderr + past.read().decode("utf-8", "replace")
    exception = done.exception if not isinstance(done.exception, SystemExit) else None
    return done.exit_code, done.stdout, [line for line in text.splitlines() if line.strip()], exception


def mutated(data: bytes, rng: np.random.Generator, *, name: str) -> bytes:
    """Content with one mutation."""
    if name.endswith(".json") and rng.random() < 0.7:
        return _mutated_json(data, rng)
    if name.endswith(".toml") and rng.random() < 0.6 and (other := _mutated_values(data, rng)):
        return other
    if name.endswith(".csv") and rng.random() < 0.6:
        return _mutated_cells(data, rng)
    if name.endswith(".ply") and rng.random() < 0.5:
        return _mutated_points(data, rng)
    n = len(data)
    text = name.endswith((".toml", ".json", ".xyz")) or rng.random() < 0.3
    at = int(rng.integers(0, min(n, 2000) if text and rng.random() < 0.5 else n))
    size = int(rng.integers(1, 200))
    match int(rng.integers(0, 8)):
        case 0:
            return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(0, 8)))]) + data[at + 1 :]
        case 1:
            return data[:at] + rng.bytes(min(size, 8)) + data[at + min(size, 8) :]
        case 2:
            return data[:at] + data[at + size :]
        case 3:
            return data[:at] + data[at : at + size] + data[at:]
        case 4:
            return data[:at] + rng.bytes(size) + data[at:]
        case 5:
            return data[:at]
        case 6:
            return data[:at] + bytes(size) + data[at + size :]
        case _:
            spots = list(re.finditer(rb"-?\d+\.?\d*(?:e-?\d+)?", data[: 1 << 14]))
            if not spots:
                return data[:at]
            spot = spots[int(rng.integers(0, len(spots)))]
            wrong = _IMPOSSIBLE[int(rng.integers(0, len(_IMPOSSIBLE)))].encode()
            return data[: spot.start()] + wrong + data[spot.end() :]


def _mutated_values(data: bytes, rng: np.random.Generator) -> bytes:
    """A TOML whose one value is another, valid TOML mostly; or without a key, or with a table twice."""
    lines = data.split(b"\n")
    keyed = [k for k, line in enumerate(lines) if b" = " in line and not line.lstrip().startswith(b"#")]
    tables = [k for k, line in enumerate(lines) if line.startswith(b"[")]
    if not keyed:
        return b""
    k = keyed[int(rng.integers(0, len(keyed)))]
    key, value = lines[k].split(b" = ", 1)
    others = (*(lines[j].split(b" = ", 1)[1] for j in keyed), *(text.encode() for text in _TOML_VALUES))
    match int(rng.integers(0, 6)):
        case 0:
            del lines[k]
        case 1 if tables:
            lines.append(lines[tables[int(rng.integers(0, len(tables)))]])
        case 2 if spots := list(re.finditer(rb"-?\d+\.?\d*", value)):
            spot = spots[int(rng.integers(0, len(spots)))]
            wrong = _TOML_NUMBERS[int(rng.integers(0, len(_TOML_NUMBERS)))].encode()
            lines[k] = key + b" = " + value[: spot.start()] + wrong + value[spot.end() :]
        case _:
            lines[k] = key + b" = " + others[int(rng.integers(0, len(others)))]
    return b"\n".join(lines)


def _mutated_cells(data: bytes, rng: np.random.Generator) -> bytes:
    """A CSV with one cell that is another, or a row that is missing, doubled or moved."""
    rows = [line.split(b",") for line in data.rstrip(b"\n").split(b"\n")]
    row = int(rng.integers(0, len(rows)))
    match int(rng.integers(0, 6)):
        case 0:
            del rows[row]
        case 1:
            rows.insert(row, rows[int(rng.integers(0, len(rows)))])
        case 2:
            rows[row] = rows[row][:-1]
        case _:
            wrong = (*_TOML_NUMBERS, "", "x", "nan", "1e999", '"', "im99.png")
            rows[row][int(rng.integers(0, len(rows[row])))] = wrong[int(rng.integers(0, len(wrong)))].encode()
    return b"\n".join(b",".join(line) for line in rows) + b"\n"


def _mutated_points(data: bytes, rng: np.random.Generator) -> bytes:
    """A PLY of SCOPE with one value, of one point or of many, that no scan has."""
    from scope.cloud import VERTEX

    start = data.index(b"end_header\n") + 11
    count = int(re.findall(rb"element vertex (\d+)", data)[0])
    rows = np.frombuffer(data, dtype=VERTEX, count=count, offset=start).copy()
    column = (VERTEX.names or ())[int(rng.integers(0, len(VERTEX)))]
    some = rng.integers(0, count, 1 if rng.random() < 0.7 else count // 3)
    with np.errstate(all="ignore"):
        if VERTEX[column].kind == "f":
            rows[column][some] = (np.nan, np.inf, -1.0, 1e30, -1e-3, 0.0, 1e-40, 1e9)[int(rng.integers(0, 8))]
        else:
            most = np.iinfo(VERTEX[column])
            rows[column][some] = (most.max, most.min, 1, most.max // 2, 255)[int(rng.integers(0, 5))]
    return data[:start] + rows.tobytes() + data[start + rows.nbytes :]


def _mutated_json(data: bytes, rng: np.random.Generator) -> bytes:
    content = json.loads(data)
    place: Any = content
    key: Any = None
    while isinstance(place, dict | list) and place:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = keys[int(rng.integers(0, len(keys)))]
        if not isinstance(place[key], dict | list) or not place[key] or rng.random() < 0.15:
            break
        place = place[key]
    old = place[key]
    match int(rng.integers(0, 4)):
        case 0:
            del place[key]
        case 1:
            place[key] = (None, "x", -1, [], {}, 1e300, True)[int(rng.integers(0, 7))]
        case 2 if isinstance(old, int | float) and not isinstance(old, bool):
            place[key] = old * (1 + 10.0 ** -rng.uniform(1, 9)) if rng.random() < 0.7 else -old
        case _:
            place[key] = [old, old]
    return json.dumps(content).encode()


def _contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in (folder / "out").rglob("*") if path.is_file()}


def judged(case: Case, folder: Path, done: Run, expected: Any, *, free: bool) -> list[tuple[str, str]]:
    """Kinds of failure of one run, each with what was seen."""
    code, stdout, lines, exception = done
    if exception is not None:
        return [("tracebacks", f"{type(exception).__name__}: {exception}"[:160])]
    made, found = _contents(folder), []
    if code in (1, 2):
        if any(not name.endswith(".part") for name in made):
            found.append(("half-written", ", ".join(made)))
        plain = re.sub(rf"{re.escape(str(folder))}\S*", "", lines[0]) if lines else ""
        if len(lines) != 1 or not _LINE.match(lines[0]) or len(plain) > 300:
            found.append(("lines", " | ".join(lines)[:200]))
    elif code == 0 and not free:
        try:
            same = case.same(expected, case.result(folder, stdout))
        except (ValueError, KeyError, IndexError, TypeError, OSError) as error:
            same = False
            lines = [f"{type(error).__name__}: {error}"]
        if not same:
            found.append(("silent wrong", " | ".join(lines)[:160]))
    return found


def campaign(folder: Path, inputs: int, *, seed: int, only: str = "") -> tuple[Counter[str], list[str], Counter[str]]:
    """Spoil ``inputs`` files of a prepared session; failures by kind, a line about each, and exit statuses."""
    chosen = [case for case in cases(folder) if only in case.name]
    (folder / "out").mkdir(exist_ok=True)
    expected = {}
    for case in chosen:
        done = run(case.argv(folder))
        if done[0] not in (0, 3):
            raise SystemExit(f"{case.name}: the sound files give exit {done[0]}: {done[2]} {done[3]!r}")
        expected[case.name] = case.result(folder, done[1])
        shutil.rmtree(folder / "out")
        (folder / "out").mkdir()
    rng = np.random.default_rng(seed)
    weights = np.array([case.weight for case in chosen])
    failures: Counter[str] = Counter()
    exits: Counter[str] = Counter()
    told = []
    for k in range(inputs):
        case = chosen[int(rng.choice(len(chosen), p=weights / weights.sum()))]
        files = sorted(folder.glob(case.file))
        path = files[int(rng.integers(0, len(files)))]
        whole = path.read_bytes()
        spoiled = mutated(whole, rng, name=path.name)
        path.write_bytes(spoiled)
        try:
            done = run(case.argv(folder))
            for kind, seen in judged(
                case, folder, done, expected[case.name], free=case.free and _says_else(whole, spoiled)
            ):
                failures[kind] += 1
                told.append(f"{kind}: input {k}, {case.name}: {seen}")
            exits[f"exit {done[0]}"] += 1
        finally:
            path.write_bytes(whole)
            shutil.rmtree(folder / "out")
            (folder / "out").mkdir()
    return failures, told, exits


def _says_else(whole: bytes, spoiled: bytes) -> bool:
    """Whether a TOML file is still one, and says something else."""
    try:
        return tomllib.loads(spoiled.decode()) != tomllib.loads(whole.decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError):
        return False


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--inputs", type=int, default=2000)
    asked.add_argument("--seed", type=int, default=0)
    asked.add_argument("--only", default="", help="cases whose name holds this")
    options = asked.parse_args()
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        folder = small_session(Path(name))
        prepare(folder)
        prepare_more(folder, design_text())
        failures, told, exits = campaign(folder, options.inputs, seed=options.seed, only=options.only)
    print("\n".join(told))
    print(
        f"{options.inputs} mutated inputs, seed {options.seed}: {dict(sorted(exits.items()))}, {time.perf_counter() - started:.0f} s"
    )
    print("| figure | count | goal |\n| --- | --- | --- |")
    for kind in KINDS:
        print(f"| {kind} | {failures[kind]} | 0 |")


if __name__ == "__main__":
    main()
