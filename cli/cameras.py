"""`scope cameras`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.console import Json, Quiet, emit, say, user_errors

if TYPE_CHECKING:
    from scope.cameras import CameraInfo


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(cameras)


def cameras(
    producer: Annotated[
        Path | None, typer.Option("--producer", help="GenTL producer (.cti) whose cameras are listed too.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """List the cameras that are connected: what [camera] calls driver and id, with model and size."""
    from scope.cameras import list_cameras

    with user_errors():
        found, silent = list_cameras(None if producer is None else str(producer))
    for line in silent:
        say(line, quiet=quiet)
    emit([camera.result for camera in found], as_json=as_json, text=_table(found))


def _table(found: list[CameraInfo]) -> str:
    if not found:
        return 'no camera found; driver = "simulated" and driver = "replay" need none'
    rows = [("driver", "id", "model", "size")]
    rows += [(c.driver, c.id, c.model, "" if c.size is None else f"{c.size[0]} x {c.size[1]}") for c in found]
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    return "\n".join(
        "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )
