"""`scope design`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.console import EXIT_NOT_TO_BE_USED, Json, Quiet, emit, say, user_errors


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(design)


def design(
    file: Annotated[Path, typer.Argument(help="rig-design.toml")] = Path("rig-design.toml"),
    at: Annotated[
        str | None, typer.Option("--at", metavar="X,Y,Z", help="A place, mm in C, to tell more about.")
    ] = None,
    albedo: Annotated[
        float, typer.Option("--albedo", min=1e-3, max=10.0, help="Light that the surface gives back, of one.")
    ] = 1.0,
    tilt: Annotated[
        str, typer.Option("--tilt", metavar="X,Y", help="Degrees about x and y by which the surface is tilted.")
    ] = "0,0",
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Predict how well a rig will range, calibrate and measure, before it is built; no image is rendered."""
    from math import radians

    from scope.design import Surface, design_rig, design_text

    place = None if at is None else _numbers(at, 3, "--at")
    about = _numbers(tilt, 2, "--tilt")
    if max(abs(angle) for angle in about) > 80.0:
        raise typer.BadParameter(f"{tilt!r}: 80 degrees at most", param_hint="--tilt")
    with user_errors():
        surface = Surface(albedo, (radians(about[0]), radians(about[1])))
        found = design_rig(file, at=None if place is None else (place[0], place[1], place[2]), surface=surface)
        result = found.result
    emit(result, as_json=as_json, text=design_text(result))
    if found.troubles:
        say(f"{len(found.troubles)} thing(s) to change before this rig is built", quiet=quiet)
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def _numbers(text: str, count: int, option: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(abs(value) < 1e6 for value in values):
        raise typer.BadParameter(f"{text!r}: {count} numbers, with commas between them", param_hint=option)
    return values
