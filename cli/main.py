"""The command `scope`."""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from calibration.threads import MOST, claim_threads
from cli import (
    batch,
    calibrate,
    certificate,
    design,
    inspection,
    live,
    locate,
    measure,
    merge,
    robot,
    scan,
    target,
    view,
)
from cli.console import libraries_silenced
from scope.version import __version__

app = typer.Typer(
    name="scope",
    help="A laser-stripe 3-D scanner that is calibrated in place and proves its own calibration.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"scope {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[  # noqa: ARG001 (its callback answers)
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    operator: Annotated[
        str,
        typer.Option("--operator", metavar="NAME", help="Who does this, for pages and files; also after the command."),
    ] = "",
    threads: Annotated[
        int | None,
        typer.Option(
            "--threads", min=1, max=1024, help="Of OpenBLAS, OpenCV, numba and SCOPE itself; also after the command."
        ),
    ] = None,
) -> None:
    """Lengths are mm, angles degrees, pixels (u, v) = (column, row) from the centre of the first pixel."""
    if threads is not None:
        claim_threads(threads, os.environ)
    if operator:
        os.environ["SCOPE_OPERATOR"] = operator  # of this process and its workers


for _commands in (
    calibrate,
    scan,
    measure,
    locate,
    robot,
    merge,
    inspection,
    view,
    target,
    design,
    batch,
    certificate,
    live,
):
    _commands.register(app)


_FIRST = ("--threads", "--operator")  # of every command, said before it or after it


def main() -> None:
    """Run the command."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # read when OpenCV is first imported; SCOPE says what is wrong
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet, for the same reason
    # Before any of the libraries is loaded. Matrices are small here: threads that wait for each other gain nothing on an idle
    # machine, and on a busy one a calibration takes twice as long.
    sys.argv = threads_first(sys.argv)
    claim_threads(_asked(sys.argv), os.environ)
    with libraries_silenced():
        app()


def threads_first(argv: list[str]) -> list[str]:
    """Words of a command line with ``--threads N`` and ``--operator NAME`` in front, wherever they stood; the last of each counts."""
    words, found = argv[:1], dict[str, list[str]]()
    rest = iter(argv[1:])
    for word in rest:
        name = word.partition("=")[0]
        if word == "--":
            words += [word, *rest]
        elif word in _FIRST:
            found[name] = [word, *([value] if (value := next(rest, None)) is not None else [])]
        elif name in _FIRST:
            found[name] = [word]
        else:
            words.append(word)
    return [*words[:1], *(part for name in _FIRST for part in found.get(name, [])), *words[1:]]


def _asked(argv: list[str]) -> int | None:
    """Threads of a command line whose first words are ``--threads N`` or ``--threads=N``; what is no count is refused later."""
    words = argv[1].split("=") + argv[2:3] if len(argv) > 1 else []
    if len(words) < 2 or words[0] != "--threads" or not words[1].isdecimal():
        return None
    return int(words[1]) if 1 <= int(words[1]) <= MOST else None
