"""Sessions on workers: handed out a few at a time, taken again from workers that die, written down as they come."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from scope.batch.cluster import connected
from scope.batch.journal import journal, journal_of, note, read_journal
from scope.batch.line import Back, handed_out
from scope.batch.session import BAD_DATA, NOT_TO_BE_USED, Job, Outcome, Run, run_session
from scope.batch.steps import Step
from scope.batch.table import Row, read_rows, row_of, write_rows

_TOPIC = "scope-batch"


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
    with (
        connected(chosen.jobs, chosen.scheduler) as (client, workers),
        journal(table, begin=not chosen.resume) as stream,
    ):
        started = time.perf_counter()
        begun: Counter[int] = Counter()
        client.subscribe_topic(_TOPIC, lambda event: begun.update([int(event[1])]))
        for back in handed_out(client, workers, jobs, partial(_work, run=run, folder=str(Path.cwd()))):
            outcome = _outcome(jobs[back.number], back)
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


def _outcome(job: Job, back: Back) -> Outcome:
    """Outcome of a session, also of one that was lost."""
    if back.error is None and not back.lost:
        return back.value  # type: ignore[no-any-return]
    reason = back.lost or f"{type(back.error).__name__}: {' '.join(str(back.error).split())[:200]}"
    return Outcome(job.number, job.source, "", BAD_DATA, reason)
