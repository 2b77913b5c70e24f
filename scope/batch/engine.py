"""Sessions on workers: handed out a few at a time, taken again from workers that die, written down as they come.

Dask (dask.distributed) is the engine: a cluster of processes on this machine, or any scheduler that already runs. Workers speak with it in Python's
own serialisation: connect to schedulers that you trust only.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calibration.errors import FileError
from scope.batch.journal import journal, journal_of, note, read_journal
from scope.batch.session import BAD_DATA, NOT_TO_BE_USED, Job, Outcome, Run, run_session
from scope.batch.steps import Step
from scope.batch.table import Row, read_rows, row_of, write_rows
from scope.errors import MeasurementError, MissingLibraryError

AHEAD = 2  # sessions handed to each worker beyond the one that it does
DEATHS = 20  # of its workers, that a session may see before it is given up
_TOPIC = "scope-batch"
_PATIENCE = 60.0  # s, for a scheduler that restarts
_WATCH = 10.0  # s between looks at whether all workers are there


@dataclass(frozen=True, slots=True)
class DayOptions:
    """How a day is run."""

    jobs: int = 1  # worker processes of this machine, where there is no scheduler
    scheduler: str = ""  # address of a Dask scheduler
    resume: bool = False  # keep rows whose inputs and options have not changed
    clouds: Path | None = None  # folder in which the clouds stay


@dataclass(frozen=True, slots=True, eq=False)
class Day:
    """What became of a day."""

    rows: tuple[Row, ...]  # in the order of the sessions
    seconds: float  # from the first session handed out to the last one back
    own_seconds: float  # sum of the sessions' own times, those of kept rows left out
    kept: int  # rows of an earlier run
    retried: int  # sessions begun again because a worker died
    workers: int

    @property
    def failed(self) -> int:
        """Sessions without an answer."""
        return sum(int(row["status"]) not in {0, NOT_TO_BE_USED} for row in self.rows)

    @property
    def doubtful(self) -> int:
        """Sessions whose answer must not be used."""
        return sum(int(row["status"]) == NOT_TO_BE_USED for row in self.rows)


def run_day(
    sources: Sequence[Path],
    rig: Path | None,
    steps: Sequence[Step],
    table: Path,
    run: Run,
    *,
    options: DayOptions | None = None,
    on_session: Callable[[int, int], None] = lambda _done, _total: None,
) -> Day:
    """Do the steps of every session and write the table.

    Parameters
    ----------
    sources : sequence of path
        Captures, or clouds where the first step is no scan.
    rig : path, optional
        Needed by a scan.
    steps : sequence of Step
        From `parse_steps`.
    table : path
        CSV or Parquet; a journal stands beside it until it is whole.
    run : callable
        Command line to answer, a function that workers can import.
    options : DayOptions, optional
    on_session : callable
        Told (done, total).

    Raises
    ------
    FileError
        The table of an earlier run cannot be read, or the journal not be written.
    MeasurementError
        The scheduler cannot be reached, or is gone; what was done is kept for ``resume``.
    MissingLibraryError
        Dask is not installed.
    """
    chosen = options or DayOptions()
    earlier = _earlier(table) if chosen.resume else {}
    jobs = _jobs(sources, rig, steps, earlier, chosen)
    rows: dict[int, Row] = {}
    own, kept, started = 0.0, 0, 0.0
    with _client(chosen) as (client, workers), journal(table, begin=not chosen.resume) as stream:
        started = time.perf_counter()
        begun: Counter[int] = Counter()
        client.subscribe_topic(_TOPIC, lambda event: begun.update([int(event[1])]))
        for outcome in _outcomes(client, workers, jobs, run):
            if outcome.kept:
                row = earlier[jobs[outcome.number].source]
                kept += 1
            else:
                row = row_of(outcome)
                own += outcome.seconds
            note(stream, row)
            rows[outcome.number] = row
            on_session(len(rows), len(jobs))
        seconds = time.perf_counter() - started
    ordered = tuple(rows[k] for k in range(len(jobs)))
    write_rows(table, ordered)
    journal_of(table).unlink(missing_ok=True)
    retried = sum(count - 1 for count in begun.values())
    return Day(ordered, seconds, own, kept, retried, workers)


def _earlier(table: Path) -> dict[str, Row]:
    """Rows of earlier runs by session, those of sessions that lost their worker left out."""
    rows = [*(read_rows(table) if table.is_file() else []), *read_journal(table)]
    return {str(row["session"]): row for row in rows if row["digest"]}


def _jobs(
    sources: Sequence[Path], rig: Path | None, steps: Sequence[Step], earlier: dict[str, Row], options: DayOptions
) -> list[Job]:
    """Jobs with absolute files but for the names under which sessions are known; clouds get names of their own."""
    jobs = []
    taken: Counter[str] = Counter()
    for number, source in enumerate(sources):
        keep = ""
        if options.clouds is not None:
            name = source.parent.name or source.stem
            taken[name] += 1
            suffix = "" if taken[name] == 1 else f"-{taken[name]}"
            keep = str((options.clouds / f"{name}{suffix}.ply").resolve())
        done = str(earlier.get(str(source), {}).get("digest", ""))
        if keep and not Path(keep).is_file():
            done = ""
        jobs.append(Job(number, str(source), "" if rig is None else str(rig.resolve()), tuple(steps), keep, done))
    return jobs


def _work(job: Job, run: Run, folder: str) -> Outcome:
    """In the worker: tell that the session begins, and do it; its name stands in the answer as it was given."""
    from distributed import get_worker

    get_worker().log_event(_TOPIC, job.number)
    placed = replace(job, source=str(Path(folder, job.source)))
    outcome = run_session(placed, run)
    return replace(outcome, source=job.source, reason=outcome.reason.replace(placed.source, job.source))


def _outcomes(client: Any, workers: int, jobs: Sequence[Job], run: Run) -> Iterator[Outcome]:
    """Outcomes as they come; a few sessions are with the workers at any time, so that memory does not grow with the day."""
    from distributed import as_completed

    waiting, folder = iter(jobs), str(Path.cwd())
    at_work: dict[Any, Job] = {}
    lost: Counter[int] = Counter()

    def hand(job: Job) -> Any:
        _await(client)
        with _there(client):
            future = client.submit(_work, job, run, folder, pure=False, key=f"session-{job.number}-{lost[job.number]}")
        at_work[future] = job
        return future

    line = as_completed(loop=client.loop)
    for _, job in zip(range(workers * (1 + AHEAD)), waiting, strict=False):
        line.add(hand(job))
    while at_work:
        with _there(client):
            future = next(line)
        job = at_work.pop(future)
        outcome = _taken(future, job, lost)
        future.release()
        if outcome is None:
            lost[job.number] += 1
            line.add(hand(job))
            continue
        following = next(waiting, None)
        if following is not None:
            line.add(hand(following))
        yield outcome


def _taken(future: Any, job: Job, lost: Counter[int]) -> Outcome | None:
    """Outcome of a session that is back; None where it must be done again."""
    if future.status == "finished":
        return future.result()  # type: ignore[no-any-return]
    if future.status == "error":
        error = future.exception()
        if type(error).__name__ == "KilledWorker":
            reason = f"its workers died {DEATHS} times; is there memory enough for it?"
        else:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        return Outcome(job.number, job.source, "", BAD_DATA, reason)
    if lost[job.number] >= DEATHS:  # cancelled with its scheduler
        return Outcome(job.number, job.source, "", BAD_DATA, f"its scheduler was lost {DEATHS} times")
    return None


_GONE = "the scheduler is gone; what was done is kept: start it and run the same command with --resume"


def _await(client: Any) -> None:
    """Wait for a scheduler that restarts."""
    began = time.monotonic()
    while client.status != "running":
        if client.status in {"closed", "closing"} or time.monotonic() - began > _PATIENCE:
            raise MeasurementError(_GONE)
        time.sleep(0.2)


@contextmanager
def _there(client: Any) -> Iterator[None]:
    """Tell in a line that the scheduler has gone while it was asked."""
    try:
        yield
    except (OSError, RuntimeError, CancelledError) as error:
        if client.status == "running":
            raise
        raise MeasurementError(_GONE) from error


@contextmanager
def _client(options: DayOptions) -> Iterator[tuple[Any, int]]:
    """A client of the scheduler that was named, or of processes on this machine; and the number of its workers."""
    try:
        import dask
        import distributed
    except ImportError as error:
        raise MissingLibraryError(
            f"scope batch needs the package {error.name}; install it: pip install 'scope-scanner[cluster]'"
        ) from error
    logs = (
        "log-length",
        "low-level-log-length",
        "system-monitor.log-length",
    )  # short: memory does not grow with the day
    settings = {"distributed.scheduler.allowed-failures": DEATHS} | {f"distributed.admin.{name}": 100 for name in logs}
    with dask.config.set(settings), _cluster(distributed, options) as address:
        try:
            client = distributed.Client(address, timeout=20, set_as_default=False)
        except (OSError, ValueError) as error:
            raise FileError(
                f"--scheduler {options.scheduler}: no Dask scheduler answers there ({str(error)[:80]}); start one: dask scheduler"
            ) from error
        with client, _silenced():
            yield client, _ready(client, options)


@contextmanager
def _silenced() -> Iterator[None]:
    """Keep Dask's own talk of lost connections from stderr: what matters of it is told in a line."""
    import logging

    log = logging.getLogger("distributed")
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(before)


@contextmanager
def _cluster(distributed: Any, options: DayOptions) -> Iterator[Any]:
    """Address of the scheduler that was named, or processes on this machine, which are started anew where they stay away."""
    import logging

    if options.scheduler:
        yield options.scheduler
        return
    try:
        cluster = distributed.LocalCluster(
            n_workers=options.jobs, threads_per_worker=1, processes=True, memory_limit=0, dashboard_address=":0",
            silence_logs=logging.CRITICAL,
        )  # fmt: skip
    except (OSError, RuntimeError) as error:
        raise MeasurementError(f"{options.jobs} workers did not start ({str(error)[:80]}); try fewer --jobs") from error
    stop = threading.Event()

    def keep_up() -> None:
        while not stop.wait(_WATCH):
            cluster.scale(options.jobs)

    threading.Thread(target=keep_up, daemon=True).start()
    try:
        yield cluster
    finally:
        stop.set()
        cluster.close()


def _ready(client: Any, options: DayOptions) -> int:
    """Threads of all workers, once there is one."""
    from distributed import TimeoutError as Late

    try:
        client.wait_for_workers(options.jobs if not options.scheduler else 1, timeout=_PATIENCE)
    except Late as error:
        raise MeasurementError(
            f"no worker came within {_PATIENCE:.0f} s; start some: dask worker {options.scheduler} --nthreads 1"
        ) from error
    return max(1, sum(int(count) for count in client.nthreads().values()))
