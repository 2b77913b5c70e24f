"""`scope design`."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.console import (
    EXIT_NOT_TO_BE_USED,
    Jobs,
    Json,
    Quiet,
    Report,
    Scheduler,
    emit,
    progress,
    say,
    user_errors,
    write_init,
    write_page,
)

if TYPE_CHECKING:
    from scope.design import Surface, Wanted


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
    want: Annotated[
        str | None,
        typer.Option("--want", metavar="sigma=MM,volume=XxYxZ", help="Search lens, stand-off, baseline and angle."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write the rig that --want proposes: a rig-design.toml.")
    ] = None,
    draws: Annotated[
        int, typer.Option("--draws", min=0, max=100_000, help="Rigs to draw with the file's [tolerance].")
    ] = 0,
    jobs: Jobs = 1,
    scheduler: Scheduler = "",
    init: Annotated[bool, typer.Option("--init", help="Write a commented rig-design.toml to fill in.")] = False,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Predict how well a rig will range, calibrate and measure, before it is built; no image is rendered."""
    from math import radians

    from scope.design import Surface, parse_want

    if init:
        write_init(file, "rig-design.toml", f"scope design {file}", quiet=quiet)
        return
    try:
        brief = None if want is None else parse_want(want)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--want") from error
    if out is not None and brief is None:
        raise typer.BadParameter("writes what --want proposes; give a brief", param_hint="--out")
    place = None if at is None else _numbers(at, 3, "--at")
    about = _numbers(tilt, 2, "--tilt")
    if max(abs(angle) for angle in about) > 80.0:
        raise typer.BadParameter(f"{tilt!r}: 80 degrees at most", param_hint="--tilt")
    surface = Surface(albedo, (radians(about[0]), radians(about[1])))
    with user_errors():
        met, troubled = _predict(
            file, place, surface, brief, (out, report, (draws, jobs, scheduler)), as_json=as_json, quiet=quiet
        )
    if not met:
        say("the brief cannot be met: the nearest rig is shown", quiet=quiet)
    elif troubled:
        say(f"{troubled} thing(s) to change before this rig is built", quiet=quiet)
    if not met or troubled:
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def _predict(
    file: Path, place: tuple[float, ...] | None, surface: Surface, brief: Wanted | None,
    asked: tuple[Path | None, Path | None, tuple[int, int, str]], *, as_json: bool, quiet: bool,
) -> tuple[bool, int]:  # fmt: skip
    """Predict, print and write; whether a brief was met, and how many troubles there are."""
    from calibration.atomic import require_folder
    from calibration.errors import FileError
    from scope.batch import each
    from scope.design import design_rig, design_text, draw_figures, draws_text, proposal_text, propose, write_design
    from scope.simulation import read_design

    out, report, (draws, jobs, scheduler) = asked
    require_folder(report, out)
    design = read_design(file)
    if draws and design.tolerance is None:
        raise FileError(f"{file}: [tolerance] is missing; --draws varies what it lists, such as laser_angle = 0.2")
    proposal = None if brief is None else propose(design, brief, surface=surface)
    if proposal is not None:
        design = replace(proposal.chosen.design, tolerance=design.tolerance)
        if out is not None:
            write_design(design, out)
            say(f"wrote {out}", quiet=quiet)
    found = design_rig(design, at=None if place is None else (place[0], place[1], place[2]), surface=surface)
    with progress("drawing rigs", quiet=quiet) as tick:
        run = partial(each, jobs=jobs, scheduler=scheduler, on_done=tick)
        drawn = draw_figures(design, draws, surface=surface, each=run) if draws else None
    result, text = found.result, design_text(found.result)
    if proposal is not None:
        result["wanted"] = proposal.result
        text = proposal_text(proposal.result) + "\n" + text
    if drawn is not None:
        result["draws"] = drawn.result
        text += "\n" + draws_text(drawn.result)
    if report is not None:
        from scope.design_report import design_page

        write_page(report, lambda: design_page(found, file.name, proposal=proposal, drawn=drawn), [file], quiet=quiet)
    emit(result, as_json=as_json, text=text, inputs=[file])
    return proposal is None or proposal.met, len(found.troubles)


def _numbers(text: str, count: int, option: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(abs(value) < 1e6 for value in values):
        raise typer.BadParameter(f"{text!r}: {count} numbers, with commas between them", param_hint=option)
    return values
