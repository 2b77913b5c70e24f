"""`scope hand-eye`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.console import (
    EXIT_NOT_TO_BE_USED,
    AllowEdited,
    Json,
    Quiet,
    Report,
    emit,
    progress,
    say,
    say_unsealed,
    user_errors,
    write_page,
)


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command("hand-eye")(hand_eye)


def hand_eye(
    file: Annotated[Path, typer.Argument(help="hand-eye.toml: views of a target and the robot's poses.")],
    rig: Annotated[Path, typer.Option("--rig", "-r", help="Calibrated rig: rig.json.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Where the answer is written.")] = Path("hand-eye.json"),
    allow_edited: AllowEdited = False,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Find where the camera is on a robot's arm, or beside it; exit 3 where the answer is not to be used."""
    from calibration.atomic import require_folder
    from calibration.rig import Rig
    from scope.hand_eye import hand_eye as find
    from scope.hand_eye import hand_eye_text
    from scope.report import hand_eye_page

    with user_errors():
        require_folder(out, report)
        known = Rig.load(rig, allow_edited=allow_edited)
        if not known.sealed:
            say_unsealed(rig, quiet=quiet)
        with progress("finding the target", quiet=quiet) as tick:
            found = find(file, known, on_view=tick)
        if found.answer is not None:
            found.answer.save(out)
            say(f"wrote {out}", quiet=quiet)
        write_page(report, lambda: hand_eye_page(found), [file, rig], quiet=quiet)
    emit(found.result, as_json=as_json, text=hand_eye_text(found), inputs=[file, rig])
    if not found.passed:
        say(f"error: {file}: {found.why}", quiet=not as_json)
        raise typer.Exit(EXIT_NOT_TO_BE_USED)
