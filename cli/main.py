"""The command `scope`."""

from __future__ import annotations

import os
from typing import Annotated

import typer

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
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Lengths are mm, angles degrees, pixels (u, v) = (column, row) from the centre of the first pixel."""


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


def main() -> None:
    """Run the command."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # read when OpenCV is first imported; SCOPE says what is wrong
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet, for the same reason
    # Read when numpy is first imported. Its matrices are small here: threads that wait for each other gain nothing on an idle
    # machine, and on a busy one a calibration takes twice as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with libraries_silenced():
        app()
