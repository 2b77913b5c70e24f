"""`scope certificate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.console import EXIT_NOT_TO_BE_USED, AllowEdited, Json, Quiet, emit, say, user_errors


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(certificate)


def certificate(
    rig: Annotated[Path, typer.Argument(help="rig.json")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The page.")] = Path("certificate.html"),
    results: Annotated[
        list[Path] | None,
        typer.Option("--with", help="JSON of scope check or scope verify; may be given several times."),
    ] = None,
    clouds: Annotated[
        list[Path] | None, typer.Option("--cloud", help="A scan by this rig, for the noise of the stripe.")
    ] = None,
    lengths: Annotated[
        float | None,
        typer.Option("--lengths", help="Standard uncertainty of the target's pitch and the stand-offs, percent."),
    ] = None,
    operator: Annotated[str, typer.Option("--operator", help="Who answers for it.")] = "",
    allow_edited: AllowEdited = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Join calibration, verifications and checks of a rig on one page with its uncertainty budget."""
    from calibration.atomic import require_folder, write_text
    from calibration.rig import Rig
    from scope.check import certify
    from scope.cloud import ScanCloud
    from scope.report import certificate_page

    if lengths is not None and not 0 < lengths < 100:
        raise typer.BadParameter(f"--lengths {lengths:g} must lie between 0 and 100, percent")
    with user_errors():
        require_folder(out)
        found = certify(
            Rig.load(rig, allow_edited=allow_edited),
            clouds=[ScanCloud.load(path) for path in clouds or ()],
            results=results or (),
            lengths_percent=lengths,
            operator=operator,
        )
        write_text(out, certificate_page(found))
    lines = [f"{'may be used' if found.passed else 'MUST NOT BE USED'}: {found.why}"]
    for budget in found.budgets:
        left = f"; without {', '.join(budget.missing)}" if budget.missing else ""
        lines.append(f"laser {budget.laser}: {budget.expanded:.4f} mm along the ray (k = 2){left}")
    emit(found.as_json(), as_json=as_json, text="\n".join(lines))
    say(f"wrote {out}", quiet=quiet)
    if not found.passed:
        raise typer.Exit(EXIT_NOT_TO_BE_USED)
