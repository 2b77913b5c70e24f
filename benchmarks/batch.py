"""A day on workers: the same table whatever their number, nothing lost when they die, and what the engine costs.

    python -m benchmarks.batch [--sessions 64] [--jobs 1 2 4] [--kill 10] [--small]
    python -m benchmarks.batch memory [--sessions 2000]
    python -m benchmarks.batch resume [--sessions 64]
    python -m benchmarks.batch gauge

Sessions are simulated scans of a sphere and a plate, each with its own noise; the peer is their own time, as each session measures it in
its worker. ``--kill`` ends one worker every so many seconds. ``memory`` runs a day of stand-ins for scans and prints the client's memory; ``resume`` ends
the scheduler of a cluster in the middle of such a day, starts another and goes on; ``gauge`` sets the variance components of simulated days, and their
scatter, beside the closed form (expected mean squares of a crossed design, E. Searle, Linear Models, 1971, ch. 9).
"""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.small_session import DESIGN, design_text, small_session
from calibration.errors import ScopeError
from cli.batch import run_words
from scope.batch import Answer, Day, DayOptions, gauge_study, parse_steps, run_day

KILLED: list[float] = []  # when a worker was
DO = "scan; check -a sphere:d=40 --region box:-60,-10,-30,30"


def pretend(words: list[str]) -> Answer:
    """Stand in for a command: figures from the name of the session, counted in a file beside it, obeying words in it.

    ``die``: the worker ends at the first attempt. ``fail``: bad data. ``doubt``: exit 3.
    """
    source = Path(words[1])
    order = source.read_text(encoding="utf-8").split()
    with source.with_suffix(".count").open("a", encoding="utf-8") as stream:
        stream.write("x")
    if "die" in order and source.with_suffix(".count").stat().st_size == 1:
        os._exit(1)
    if "fail" in order:
        return Answer(1, None, f"{source}: is bad")
    number = int(hashlib.sha256(source.name.encode()).hexdigest()[:6], 16)
    result = {"value_mm": {"value": number * 1e-3, "uncertainty": 0.1}, "seconds": time.time(), "big": [0.0] * 5000}
    return Answer(3 if "doubt" in order else 0, result, "is doubtful" if "doubt" in order else "")


def sessions(folder: Path, count: int, *, small: bool = False) -> tuple[list[Path], Path]:
    """Captures with noise of their own, and the rig that is calibrated for them."""
    import cv2

    shutil.copy(
        small_session(folder, design_text(size=(320, 240), frames=8, step=3.0) if small else DESIGN, name="first")
        / "rig.json",
        folder,
    )
    captures = []
    for k in range(count):
        rng, home = np.random.default_rng(k), folder / f"s{k:03d}"
        for part in ("frames", "off"):
            shutil.copytree(folder / "first" / part, home / part)
        for path in (home / "frames").glob("*.png"):
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            noisy = np.rint(image + rng.normal(0, 1.0, image.shape)).clip(0, 255).astype(np.uint8)
            cv2.imwrite(str(path), noisy)
        captures.append(Path(shutil.copy(folder / "first" / "capture.toml", home)))
    return captures, folder / "rig.json"


def without_times(table: Path) -> str:
    """A table but for its times."""
    lines = [line.split(",") for line in table.read_text(encoding="utf-8").splitlines()]
    at = lines[0].index("seconds")
    return "\n".join(",".join(line[:at] + line[at + 1 :]) for line in lines)


def killing(every: float, stop: threading.Event) -> None:
    """End one of this process's workers every so many seconds."""
    from distributed.nanny import Nanny

    rng = np.random.default_rng(0)
    while not stop.wait(every):
        alive = [nanny.pid for nanny in list(Nanny._instances) if nanny.pid]
        if alive:
            os.kill(int(rng.choice(alive)), signal.SIGKILL)
            KILLED.append(time.monotonic())


def run(captures: list[Path], rig: Path, table: Path, jobs: int, *, kill: float = 0.0) -> Day:
    stop = threading.Event()
    killer = threading.Thread(target=killing, args=(kill, stop), daemon=True)

    def tick(done: int, _total: int) -> None:
        if kill and done == 1:  # the workers are up
            killer.start()

    try:
        return run_day(captures, rig, parse_steps(DO), table, run_words, options=DayOptions(jobs=jobs), on_session=tick)
    finally:
        stop.set()


def day(count: int, jobs: list[int], kill: float, *, small: bool = False) -> None:
    print("| workers | killed every | killed | sessions | failed | begun again | overhead over own times | table |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        captures, rig = sessions(Path(name), count, small=small)
        first = ""
        for workers, every in [*((j, 0.0) for j in jobs), *([(jobs[-1], kill)] if kill else [])]:
            table = Path(name) / "day.csv"
            done = run(captures, rig, table, workers, kill=every)
            text = without_times(table)
            first = first or text
            overhead = 100.0 * (done.seconds * done.workers / done.own_seconds - 1.0)
            same = "the same" if text == first else "ANOTHER"
            print(
                f"| {workers} | {every:g} s | {len(KILLED)} | {len(done.rows)} | {done.failed} | {done.retried} | {overhead:.1f} % | {same} |",
                flush=True,
            )


def memory(count: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        sources = [Path(name) / f"c{k}.ply" for k in range(count)]
        for path in sources:
            path.write_text("", encoding="utf-8")
        seen: list[tuple[int, float]] = []

        def tick(done: int, total: int) -> None:
            if done in {total // 10, total // 2, total}:
                seen.append((done, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))

        run_day(
            sources,
            None,
            parse_steps("check -a plane"),
            Path(name) / "day.csv",
            pretend,
            options=DayOptions(jobs=2),
            on_session=tick,
        )
    print("; ".join(f"after {done}: {megabytes:.0f} MB" for done, megabytes in seen))


def cluster(port: int, workers: int) -> list[subprocess.Popen[bytes]]:
    """A scheduler and its workers, as processes of their own."""
    start = [
        sys.executable,
        "-m",
        "distributed.cli.dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
        "--no-dashboard",
    ]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    made = [subprocess.Popen(start, **quiet)]
    time.sleep(3.0)
    for _ in range(workers):
        words = [
            sys.executable,
            "-m",
            "distributed.cli.dask_worker",
            f"tcp://127.0.0.1:{port}",
            "--nthreads",
            "1",
            "--no-dashboard",
        ]
        made.append(subprocess.Popen(words, **quiet))
    return made


def resume(count: int) -> None:
    """A day whose scheduler ends in the middle, and goes on with another."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as name:
        sources = [Path(name) / f"c{k}.ply" for k in range(count)]
        for path in sources:
            path.write_text("", encoding="utf-8")
        whole, table = Path(name) / "whole.csv", Path(name) / "day.csv"
        run_day(sources, None, parse_steps("check -a plane"), whole, pretend)
        running = cluster(port, 2)

        def tick(done: int, _total: int) -> None:
            if done == count // 3:
                running[0].kill()

        options = DayOptions(scheduler=f"tcp://127.0.0.1:{port}")
        told = "it went on by itself"
        try:
            run_day(sources, None, parse_steps("check -a plane"), table, pretend, options=options, on_session=tick)
        except ScopeError as error:
            told = str(error)
        for process in running:
            process.kill()
        again = cluster(port, 2)
        try:
            done = run_day(
                sources, None, parse_steps("check -a plane"), table, pretend, options=replace(options, resume=True)
            )
        finally:
            for process in again:
                process.kill()
        same = without_times(table) == without_times(whole)
    print(f"scheduler ended after {count // 3} of {count} sessions: {told}")
    print(
        f"with --resume: {done.kept} kept, {len(done.rows)} rows, {done.failed} failed, table {'the same' if same else 'ANOTHER'}"
    )


def gauge(studies: int = 400, shape: tuple[int, int, int] = (10, 8, 4)) -> None:
    """Components of variance of simulated days beside truth, and their scatter beside the closed form."""
    rng, (p, o, n) = np.random.default_rng(0), shape
    truth = {"repeatability": 1.0, "operators": 1.5**2, "interaction": 0.8**2, "parts": 4.0**2}
    within, operators, crossed, parts = (truth[k] for k in ("repeatability", "operators", "interaction", "parts"))
    found = []
    for _ in range(studies):
        values = (
            rng.normal(0, parts**0.5, (p, 1, 1)) + rng.normal(0, operators**0.5, (1, o, 1)) + rng.normal(0, crossed**0.5, (p, o, 1))
            + rng.normal(0, within**0.5, (p, o, n))
        )  # fmt: skip
        study = gauge_study(values)
        found.append([getattr(study, key) for key in truth])
    squares = {"e": within, "po": within + n * crossed}
    squares |= {"o": squares["po"] + p * n * operators, "p": squares["po"] + o * n * parts}
    free = {"e": p * o * (n - 1), "po": (p - 1) * (o - 1), "o": o - 1, "p": p - 1}
    var = {key: 2.0 * squares[key] ** 2 / free[key] for key in squares}
    closed = {
        "repeatability": var["e"], "operators": (var["o"] + var["po"]) / (p * n) ** 2, "interaction": (var["po"] + var["e"]) / n**2,
        "parts": (var["p"] + var["po"]) / (o * n) ** 2,
    }  # fmt: skip
    mean, spread = np.mean(found, axis=0), np.std(found, axis=0, ddof=1)
    print(f"{studies} studies of {p} parts, {o} operators, {n} repeats")
    print(
        "| variance | true | mean of the studies | its standard error | scatter of a study | closed form |\n|"
        + " --- |" * 6
    )
    for k, key in enumerate(truth):
        print(
            f"| {key} | {truth[key]:.3g} | {mean[k]:.4g} | {spread[k] / studies**0.5:.2g} | {spread[k]:.3g} | {closed[key] ** 0.5:.3g} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", nargs="?", default="day", choices=["day", "memory", "resume", "gauge"])
    parser.add_argument("--sessions", type=int)
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--kill", type=float, default=10.0)
    parser.add_argument("--small", action="store_true", help="sessions of 8 frames of 320 x 240 px")
    told = parser.parse_args()
    if told.work == "memory":
        memory(told.sessions or 2000)
    elif told.work == "resume":
        resume(told.sessions or 64)
    elif told.work == "gauge":
        gauge()
    else:
        day(told.sessions or 64, told.jobs, told.kill, small=told.small)


if __name__ == "__main__":
    main()
