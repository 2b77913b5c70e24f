"""One session: the digest of all that its figures depend on, and the steps done with it. This runs in the workers."""

from __future__ import annotations

import glob
import hashlib
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from calibration.errors import FileError
from scope.batch.figures import figures_of
from scope.batch.steps import Step
from scope.version import __version__

BAD_DATA, NOT_TO_BE_USED = 1, 3
_IMAGES = {
    ".png",
    ".jpg",
    ".jpeg",
    ".tif",
    ".tiff",
    ".bmp",
    ".mp4",
    ".avi",
    ".mkv",
    ".csv",
    ".npy",
    ".json",
    ".toml",
    ".raw",
}
_BLOCK = 1 << 22


@dataclass(frozen=True, slots=True)
class Answer:
    """What a command answered."""

    status: int  # its exit status
    result: Any  # of --json; None where there is none
    reason: str  # the last line of its talk; empty where it was done


Run = Callable[[list[str]], Answer]  # words after ``scope`` to the answer; importable by its name in every worker


@dataclass(frozen=True, slots=True)
class Job:
    """One session to be run, as it travels to a worker."""

    number: int
    source: str  # capture.toml, or a cloud
    rig: str  # empty without a scan
    steps: tuple[Step, ...]
    keep: str = ""  # file at which the cloud stays; empty: it is removed
    done: str = ""  # digest of an earlier run, whose row is kept where it is the same


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one session."""

    number: int
    source: str
    digest: str  # of all inputs and options
    status: int = 0  # 0 done, 1 bad data, 3 done but not to be used
    reason: str = ""
    seconds: float = 0.0  # its own time
    figures: dict[str, Any] = field(default_factory=dict)  # by name of column
    kept: bool = False  # the row of an earlier run holds


def sessions_of(patterns: Sequence[str]) -> list[Path]:
    """Files of patterns (globs), each once, in the order given and by name within a pattern.

    Raises
    ------
    FileError
        A pattern without a file.
    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        names = sorted(glob.glob(pattern, recursive=True)) if glob.has_magic(pattern) else [pattern]  # noqa: PTH207 (patterns may be absolute)
        files = [Path(name) for name in names if Path(name).is_file()]
        if not files:
            raise FileError(f"{pattern}: no such file; name captures, such as 'line3/*/capture.toml'")
        found |= dict.fromkeys(files)
    return list(found)


def run_session(job: Job, run: Run) -> Outcome:
    """Do the steps of a session, unless nothing has changed since an earlier run.

    A step that exits with 1 or 2 ends the session, one that exits with 3 marks it. Nothing is raised for bad data.
    """
    started = time.perf_counter()
    try:
        digest = digest_of(job)
    except OSError as error:
        reason = f"{error.filename}: cannot be read ({error.strerror})"
        return Outcome(job.number, job.source, "", BAD_DATA, reason, time.perf_counter() - started)
    if job.done and digest == job.done:
        return Outcome(job.number, job.source, digest, kept=True)
    status, reason, figures = 0, "", dict[str, Any]()
    with tempfile.TemporaryDirectory(prefix="scope-batch-") as folder:
        scanned = job.steps[0].command == "scan"
        cloud = Path(folder) / "cloud.ply" if scanned else Path(job.source)
        for step in job.steps:
            answer = run(step.words(Path(job.source), Path(job.rig), cloud))
            figures |= figures_of(step.label, step.command, answer.result)
            if answer.status and status == 0:
                status, reason = answer.status, answer.reason.replace(str(cloud), f"{job.source}'s cloud")
            if answer.status not in {0, NOT_TO_BE_USED}:
                status = BAD_DATA
                break
        if job.keep and scanned and cloud.is_file():
            shutil.copyfile(cloud, f"{job.keep}.part")
            Path(f"{job.keep}.part").replace(job.keep)
    return Outcome(job.number, job.source, digest, status, reason, time.perf_counter() - started, figures)


def digest_of(job: Job) -> str:
    """SHA-256 of the session's files, the rig, the files that the steps name, their options and the version of SCOPE.

    Of a capture, the images and tables in its folder and below count, by name and content: a frame that is added, left out or
    altered is seen. Images that lie elsewhere count by their folder's names and sizes alone.
    """
    digest = hashlib.sha256(f"scope {__version__}\n".encode())
    for step in job.steps:
        digest.update("\0".join([step.command, *step.options, ""]).encode())
    files = [Path(name) for name in (job.rig, *(name for step in job.steps for name in step.files)) if name]
    source = Path(job.source)
    if job.steps[0].command == "scan":
        files += _session_files(source)
    else:
        files.append(source)
    for path in files:
        size = path.stat().st_size
        digest.update(f"{path.name}\0{size}\0".encode())
        with path.open("rb") as stream:
            while block := stream.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _session_files(capture: Path) -> list[Path]:
    """The capture, and the images and tables that stand beside and below it."""
    below = sorted(p for p in capture.parent.rglob("*") if p.suffix.lower() in _IMAGES and p != capture and p.is_file())
    return [capture, *below]
