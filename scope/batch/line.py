"""Work handed out to workers a little at a time, and taken again from workers that die: what a day, draws and repeats share."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from calibration.errors import ScopeError
from scope.batch.cluster import DEATHS, PATIENCE, connected
from scope.errors import MeasurementError

AHEAD = 2  # pieces of work handed to each worker beyond the one that it does
GONE = "the scheduler is gone; what was done is kept: start it and run the same command with --resume"
Given = TypeVar("Given")
Answered = TypeVar("Answered")


@dataclass(frozen=True, slots=True, eq=False)
class Back:
    """What came back of one piece of work."""

    number: int  # of the piece
    value: Any = None  # what the function returned
    error: Exception | None = None  # what it raised
    lost: str = ""  # why there is neither


def each(
    function: Callable[[Given], Answered],
    items: Iterable[Given],
    *,
    jobs: int = 1,
    scheduler: str = "",
    on_done: Callable[[int, int], None] = lambda _done, _total: None,
) -> list[Answered]:
    """Answers of a function to every item, in the order of the items, whatever the number of workers.

    One job without a scheduler is done in this process, and needs no Dask. A worker that dies loses nothing: its item is given to another.

    Parameters
    ----------
    function : callable
        Of one item; its answer depends on that alone. Workers import it by its name (or receive a ``functools.partial`` of such a one).
    items : iterable
        As small as they may be: each travels to a worker.
    jobs : int
        Worker processes of this machine, where there is no scheduler.
    scheduler : str
        Address of a Dask scheduler.
    on_done : callable
        Told (done, total).

    Raises
    ------
    ValueError
        Fewer than one job; or what the function raises, as every error of it.
    MeasurementError
        An item whose workers died again and again, or a scheduler that is gone.
    MissingLibraryError
        Dask is not installed and is needed.
    """
    given = list(items)
    if jobs < 1:
        raise ValueError(f"jobs must be 1 or more, not {jobs}")
    if jobs == 1 and not scheduler:
        answers = []
        for item in given:
            answers.append(function(item))
            on_done(len(answers), len(given))
        return answers
    found: dict[int, Any] = {}
    with connected(min(jobs, max(1, len(given))), scheduler) as (client, workers):
        for back in handed_out(client, workers, given, function):
            if back.error is not None:
                raise back.error
            if back.lost:
                raise MeasurementError(f"item {back.number + 1} of {len(given)}: {back.lost}")
            found[back.number] = back.value
            on_done(len(found), len(given))
    return [found[k] for k in range(len(given))]


def handed_out(client: Any, workers: int, items: Sequence[Given], function: Callable[[Given], Any]) -> Iterator[Back]:
    """What comes back, as it comes; a few pieces are with the workers at any time, so that memory does not grow with their number."""
    from distributed import as_completed

    waiting = iter(enumerate(items))
    at_work: dict[Any, tuple[int, Given]] = {}
    lost: Counter[int] = Counter()

    def hand(number: int, item: Given) -> Any:
        _await(client)
        with _there(client):
            future = client.submit(function, item, pure=False, key=f"scope-{id(lost):x}-{number}-{lost[number]}")
        at_work[future] = number, item
        return future

    line = as_completed(loop=client.loop)
    for _, (number, item) in zip(range(workers * (1 + AHEAD)), waiting, strict=False):
        line.add(hand(number, item))
    while at_work:
        with _there(client):
            future = next(line)
        number, item = at_work.pop(future)
        back = _taken(future, number, lost)
        future.release()
        if back is None:
            lost[number] += 1
            line.add(hand(number, item))
            continue
        following = next(waiting, None)
        if following is not None:
            line.add(hand(*following))
        yield back


def _taken(future: Any, number: int, lost: Counter[int]) -> Back | None:
    """What a finished piece gave; None where it must be done again."""
    if future.status == "finished":
        return Back(number, future.result())
    if future.status == "error":
        error = future.exception()
        if type(error).__name__ == "KilledWorker":
            return Back(number, lost=f"its workers died {DEATHS} times; is there memory enough for it?")
        return Back(number, error=error)
    if lost[number] >= DEATHS:  # cancelled with its scheduler
        return Back(number, lost=f"its scheduler was lost {DEATHS} times")
    return None


def _await(client: Any) -> None:
    """Wait for a scheduler that restarts."""
    began = time.monotonic()
    while client.status != "running":
        if client.status in {"closed", "closing"} or time.monotonic() - began > PATIENCE:
            raise MeasurementError(GONE)
        time.sleep(0.2)


@contextmanager
def _there(client: Any) -> Iterator[None]:
    """Tell in a line that the scheduler has gone while it was asked."""
    try:
        yield
    except ScopeError:
        raise
    except (OSError, RuntimeError, CancelledError) as error:
        if client.status == "running":
            raise
        raise MeasurementError(GONE) from error
