"""`scope target`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.console import Json, Quiet, emit, say, user_errors


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(target)


def target(
    source: Annotated[
        str,
        typer.Argument(
            metavar="FILE|KIND",
            help="calibration.toml, rig-design.toml, or spots, chessboard, charuco, markers, circles",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="target.svg, .pdf or .dxf (drill layout)")] = Path(
        "target.pdf"
    ),
    paper: Annotated[
        str, typer.Option("--paper", help="fit (one page as large as the sheet), a4, a3, letter... or 210x297: tiled.")
    ] = "fit",
    measured: Annotated[
        str | None,
        typer.Option("--measured", metavar="MM[,MM]", help="Crosses of the print, across[, down]: corrects the file."),
    ] = None,
    jig: Annotated[
        Path | None,
        typer.Option("--jig", help="Also draw the jig's base, 1 : 1: stand-offs and seats. .svg, .pdf or .dxf"),
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Draw the target that a calibration file describes, to scale, to be printed or drilled; and the jig that carries it."""
    from scope.printing import print_jig, print_target

    size, lengths = _paper(paper, out), _measured(measured)
    base = None if jig is None else _paper("fit" if jig.suffix.lower() == ".dxf" else paper, jig, option="--jig")
    with user_errors():
        found = print_target(source, out, paper=size, measured=lengths)
        seats = None if jig is None else print_jig(source, jig, paper=base)
    say(f"{found.toml} describes what was drawn", quiet=quiet)
    text = (
        f"{found.title}: {found.marks} marks, {found.width:g} x {found.height:g} mm, {found.pages} page"
        f"{'s' * (found.pages > 1)}; wrote {', '.join(str(path) for path in found.files)}\n"
        f"print at 100 %; the crosses stand {found.crosses[0]:g} mm apart across, {found.crosses[1]:g} mm down"
    )
    if found.scales is not None:
        text += (
            f"\nscale {found.scales[0]:.5f} across, {found.scales[1]:.5f} down: {found.toml} has pitch {found.pitch}"
        )
    if seats is not None:
        text += f"\njig: {len(seats.rows)} seats; wrote {', '.join(str(path) for path in seats.files)}"
    emit(found.result if seats is None else found.result | {"jig": seats.result}, as_json=as_json, text=text)


def _paper(text: str, out: Path, *, option: str = "--out") -> tuple[float, float] | None:
    from scope.printing import PAPERS

    if out.suffix.lower() not in (".svg", ".pdf", ".dxf"):
        raise typer.BadParameter(f"{out}: use .svg, .pdf or .dxf", param_hint=option)
    if text.lower() == "fit":
        return None
    if out.suffix.lower() == ".dxf":
        raise typer.BadParameter("a DXF is one drawing; paper is for .svg and .pdf", param_hint="--paper")
    if text.lower() in PAPERS:
        return PAPERS[text.lower()]
    try:
        width, height = (float(part) for part in text.lower().split("x"))
    except ValueError:
        width = height = 0.0
    if not (60.0 <= width <= 5000.0 and 60.0 <= height <= 5000.0):
        names = ", ".join(["fit", *PAPERS])
        raise typer.BadParameter(f"{text!r}: use {names}, or WIDTHxHEIGHT in mm, 60 to 5000", param_hint="--paper")
    return width, height


def _measured(text: str | None) -> tuple[float, ...]:
    if text is None:
        return ()
    try:
        lengths = tuple(float(part) for part in text.split(","))
    except ValueError:
        lengths = ()
    if not 1 <= len(lengths) <= 2 or not all(0.0 < value < 1e5 for value in lengths):
        raise typer.BadParameter(f"{text!r}: one length in mm, or two as 199.4,199.7", param_hint="--measured")
    return lengths
