"""Dask's workers: a cluster of processes on this machine, or any scheduler that already runs.

Workers speak with it in Python's own serialisation: connect to schedulers that you trust only.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from calibration.errors import FileError
from scope.errors import MeasurementError, MissingLibraryError

DEATHS = 20  # of its workers, that a piece of work may see before it is given up
PATIENCE = 60.0  # s, for a scheduler that restarts
GREETING = 20.0  # s, for the first answer of a scheduler
_WATCH = 10.0  # s between looks at whether all workers are there


@contextmanager
def connected(jobs: int, scheduler: str) -> Iterator[tuple[Any, int]]:
    """A client of the scheduler that was named, or of processes on this machine; and the number of its workers.

    Raises
    ------
    FileError
        No scheduler answers at the address.
    MeasurementError
        Workers do not start, or none comes.
    MissingLibraryError
        Dask is not installed.
    """
    try:
        import dask
        import distributed
    except ImportError as error:
        raise MissingLibraryError(
            f"work on several processes (--jobs, --scheduler, scope batch) needs the package {error.name}; install it: pip install 'scope-scanner[cluster]'"
        ) from error
    logs = (
        "log-length",
        "low-level-log-length",
        "system-monitor.log-length",
    )  # short: memory does not grow with the day
    settings = {"distributed.scheduler.allowed-failures": DEATHS} | {f"distributed.admin.{name}": 100 for name in logs}
    with dask.config.set(settings), _cluster(distributed, jobs, scheduler) as address:
        try:
            client = distributed.Client(address, timeout=GREETING, set_as_default=False)
        except (OSError, ValueError) as error:
            raise FileError(
                f"--scheduler {scheduler}: no Dask scheduler answers there ({str(error)[:80]}); start one: dask scheduler"
            ) from error
        with _silenced(), client:
            yield client, _ready(client, jobs, scheduler)


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
def _cluster(distributed: Any, jobs: int, scheduler: str) -> Iterator[Any]:
    """Address of the scheduler that was named, or processes on this machine, which are started anew where they stay away."""
    import logging

    if scheduler:
        yield scheduler
        return
    try:
        cluster = distributed.LocalCluster(
            n_workers=jobs, threads_per_worker=1, processes=True, memory_limit=0, dashboard_address=":0",
            silence_logs=logging.CRITICAL,
        )  # fmt: skip
    except (OSError, RuntimeError) as error:
        raise MeasurementError(f"{jobs} workers did not start ({str(error)[:80]}); try fewer --jobs") from error
    stop = threading.Event()

    def keep_up() -> None:
        while not stop.wait(_WATCH):
            cluster.scale(jobs)

    threading.Thread(target=keep_up, daemon=True).start()
    try:
        yield cluster
    finally:
        stop.set()
        cluster.close()


def _ready(client: Any, jobs: int, scheduler: str) -> int:
    """Threads of all workers, once there is one."""
    from distributed import TimeoutError as Late

    try:
        client.wait_for_workers(jobs if not scheduler else 1, timeout=PATIENCE)
    except Late as error:
        raise MeasurementError(
            f"no worker came within {PATIENCE:.0f} s; start some: dask worker {scheduler} --nthreads 1"
        ) from error
    return max(1, sum(int(count) for count in client.nthreads().values()))
