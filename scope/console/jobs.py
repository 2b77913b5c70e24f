"""Work that takes its time: one job at a time, found again by its id."""

from __future__ import annotations

import re
import threading
import time
import uuid
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from calibration.errors import ScopeError

State = Literal["running", "done", "failed"]
_KEPT = 200
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


class Busy(ScopeError):
    """Another job runs."""


@dataclass(slots=True, eq=False)
class Job:
    """One piece of work."""

    id: str
    kind: str
    asked: dict[str, Any]
    state: State = "running"
    done: int = 0
    total: int = 0
    message: str = ""
    result: dict[str, Any] = field(default_factory=dict)
    began: float = field(default_factory=time.time)
    stop: threading.Event = field(default_factory=threading.Event)

    def tick(self, done: int, total: int) -> None:
        """Tell how far it is."""
        self.done, self.total = done, total

    @property
    def content(self) -> dict[str, Any]:
        """What the API tells."""
        return {
            "job": self.id, "kind": self.kind, "state": self.state, "done": self.done, "total": self.total,
            "message": self.message, "result": self.result,
        }  # fmt: skip


class Jobs:
    """All jobs of this process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._jobs: OrderedDict[str, Job] = OrderedDict()
        self._thread: threading.Thread | None = None

    @property
    def running(self) -> Job | None:
        """The job that runs now."""
        last = next(reversed(self._jobs.values()), None)
        return last if last is not None and last.state == "running" else None

    @property
    def last(self) -> Job | None:
        """The job that was started last."""
        return next(reversed(self._jobs.values()), None)

    def get(self, identity: str) -> Job | None:
        """A job by its id."""
        return self._jobs.get(identity)

    def start(self, kind: str, asked: dict[str, Any], work: Callable[[Job], dict[str, Any]], identity: str = "") -> Job:
        """Start a job; the one of the same id, where there is one, is given back and nothing starts.

        Raises
        ------
        Busy
            Another job runs.
        ValueError
            An id of other characters, or of a job that was asked for something else.
        """
        identity = identity or f"{kind}-{time.strftime('%Y%m%d-%H%M%S')}-{uuid.uuid4().hex[:4]}"
        if not _NAME.fullmatch(identity):
            raise ValueError("a job's id has up to 64 letters, digits, dots, dashes and underscores")
        with self._lock:
            known = self._jobs.get(identity)
            if known is not None:
                if (known.kind, known.asked) != (kind, asked):
                    raise ValueError(f"job {identity} was asked for something else; give the new one an id of its own")
                return known
            if (other := self.running) is not None:
                raise Busy(f"job {other.id} ({other.kind}) is running; wait for its end or stop it")
            job = Job(identity, kind, asked)
            self._jobs[identity] = job
            while len(self._jobs) > _KEPT:
                self._jobs.popitem(last=False)
            self._thread = threading.Thread(target=_run, args=(job, work), name=identity, daemon=True)
            self._thread.start()
        return job

    def wait(self, timeout: float | None = None) -> None:
        """Wait for the job that runs."""
        if self._thread is not None:
            self._thread.join(timeout)


def _run(job: Job, work: Callable[[Job], dict[str, Any]]) -> None:
    try:
        job.result = work(job)
        job.state = "done"
    except ScopeError as error:
        job.message, job.state = " ".join(str(error).split()), "failed"
    except OSError as error:
        job.message, job.state = f"could not be written or read ({error.strerror}); free space and try again", "failed"
    except Exception as error:  # noqa: BLE001  (the process must live, and the page must say that it failed)
        job.message, job.state = (
            f"failed by a defect of this program ({type(error).__name__}); please report it",
            "failed",
        )
