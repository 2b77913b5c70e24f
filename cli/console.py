"""What every command shares: talk on stderr, data on stdout, errors to exit codes."""

from __future__ import annotations

import json
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from calibration.errors import ScopeError

EXIT_BAD_DATA = 1
EXIT_NOT_TO_BE_USED = 3


def _no_history(off: bool) -> bool:
    if off:
        os.environ["SCOPE_HISTORY"] = "off"  # of this process
    return off


Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no talk on stderr.")]
AllowEdited = Annotated[
    bool, typer.Option("--allow-edited", help="Take a rig that was altered since its calibration, as unverified.")
]
NoHistory = Annotated[
    bool,
    typer.Option("--no-history", help="Keep no record in the history.db beside the result.", callback=_no_history),
]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Worker processes on this machine.")]
Scheduler = Annotated[
    str,
    typer.Option("--scheduler", help="Address of a Dask scheduler, such as tcp://head:8786, in place of --jobs."),
]
Report = Annotated[Path | None, typer.Option("--report", help="Write a self-contained HTML page.")]


@contextmanager
def libraries_silenced() -> Iterator[None]:
    """Keep stdout and stderr for this program: what C libraries print past Python (LAPACK, libpng, E57) goes nowhere.

    SCOPE says itself what is wrong with a file, and stdout is data. Where there are no such descriptors, nothing is done.
    """
    kept = (sys.stdout, sys.stderr)
    try:
        if (sys.stdout.fileno(), sys.stderr.fileno()) != (1, 2):
            raise OSError  # somebody else listens: a notebook, a test
        own = (os.dup(1), os.dup(2))
        nowhere = os.open(os.devnull, os.O_WRONLY)
    except (OSError, AttributeError, ValueError):
        yield
        return
    for stream in kept:
        stream.flush()
    sys.stdout, sys.stderr = (
        open(fd, "w", encoding=stream.encoding, errors=stream.errors, buffering=1, closefd=False)  # noqa: SIM115
        for fd, stream in zip(own, kept, strict=True)
    )
    for fd in (1, 2):
        os.dup2(nowhere, fd)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):  # a pipe whose reader has gone
                stream.flush()
        for fd, back in zip(own, (1, 2), strict=True):
            os.dup2(fd, back)
        sys.stdout, sys.stderr = kept
        for fd in (*own, nowhere):
            os.close(fd)


def note(kind: str, result: Path, figures: dict[str, float], *, passed: bool, rig: str = "", camera: str = "") -> None:
    """Record a result in the history beside it, unless that is switched off; a result is never spoiled by its record."""
    from scope.history import Record, journal_beside

    journal = journal_beside(result)
    if journal is None:
        return
    try:
        journal.add(Record(kind, passed, figures, rig=rig, camera=camera, file=result.name))
    except ScopeError as error:
        typer.echo(f"not recorded: {' '.join(str(error).split())}", err=True)


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn bad data into one line on stderr and exit status 1; a caller's bug still shows its traceback."""
    with warnings.catch_warnings():
        if not sys.warnoptions:
            warnings.simplefilter("ignore")  # what libraries say of damaged numbers is no message to a user
        yield from _one_line()


def _one_line() -> Iterator[None]:
    try:
        yield
    except ScopeError as error:
        typer.echo(f"error: {' '.join(str(error).split())}", err=True)
        raise typer.Exit(EXIT_BAD_DATA) from error


def say(text: str, *, quiet: bool) -> None:
    """Talk on stderr."""
    if not quiet:
        typer.echo(text, err=True)


def say_unsealed(path: Path, *, quiet: bool) -> None:
    """Tell once that a rig is of a version without seals."""
    say(
        f"{path} has no seal (it was written by an earlier version), so that an alteration would not be seen; calibrate "
        "again to seal it",
        quiet=quiet,
    )


def write_page(path: Path | None, page: Callable[[], str], inputs: Iterable[Path | None] = (), *, quiet: bool) -> None:
    """Write a page, where one is wanted, with its origin in the footer."""
    if path is None:
        return
    from calibration.atomic import write_text
    from scope.origin import origin_of
    from scope.report import signed

    write_text(path, signed(page(), origin_of(inputs)))
    say(f"wrote {path}", quiet=quiet)


def emit(
    result: dict[str, Any] | list[dict[str, Any]], *, as_json: bool, text: str, inputs: Iterable[Path | None] = ()
) -> None:
    """Print the result: JSON with its origin, or the text that a person reads."""
    if as_json and isinstance(result, dict):
        from scope.origin import origin_of

        result = {**result, "origin": origin_of(inputs).as_json()}
    typer.echo(json.dumps(plain(result), indent=1, allow_nan=False) if as_json else text)


def plain(value: Any) -> Any:
    """Value made of what JSON has: arrays become lists, NaN and infinities become null."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


@contextmanager
def progress(label: str, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Yield ``tick(done, total)``, a bar on stderr with count, rate and time left; silent when quiet or no terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda _done, _total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=None, rate="")

        def tick(done: int, total: int) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, completed=done, total=total or None, rate=f"{speed:.1f}/s" if speed else "")

        yield tick


def write_init(path: Path, name: str, then: str, *, quiet: bool) -> None:
    """Write a commented file to fill in, for ``--init``."""
    from scope.session import write_commented

    with user_errors():
        write_commented(path, name)
    say(f"wrote {path}: fill it in, then run: {then}", quiet=quiet)
