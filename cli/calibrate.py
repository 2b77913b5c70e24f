"""`scope calibrate` and `scope verify`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from cli.console import (
    EXIT_NOT_TO_BE_USED,
    AllowEdited,
    Json,
    NoHistory,
    Quiet,
    Report,
    emit,
    note,
    progress,
    say,
    say_unsealed,
    user_errors,
    write_page,
)

Model = Literal["auto", "two-plane", "joint", "pinhole"]


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(calibrate)
    app.command()(verify)
    app.command()(correct)


def calibrate(
    file: Annotated[Path, typer.Argument(help="calibration.toml")] = Path("calibration.toml"),
    out: Annotated[Path, typer.Option("--out", "-o", help="Where the rig is written.")] = Path("rig.json"),
    model: Annotated[Model, typer.Option("--model", help="Which rays the camera gives.")] = "auto",
    order: Annotated[
        str, typer.Option("--order", help="Terms of the plane maps: auto, linear, paper or a degree.")
    ] = "auto",
    check: Annotated[
        str | None, typer.Option("--check", metavar="PLANE", help="Judge one plane's images at the jig.")
    ] = None,
    retake: Annotated[
        bool, typer.Option("--retake", help="Take all images anew by the file's [camera], not the missing ones only.")
    ] = False,
    init: Annotated[bool, typer.Option("--init", help="Write a commented calibration.toml to fill in.")] = False,
    report: Report = None,
    no_history: NoHistory = False,  # noqa: ARG001  (its callback acts)
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Find the marks, fit every plane, verify, calibrate lasers and stages, and write the rig."""
    with user_errors():
        if init:
            _init(file, quiet=quiet)
        elif check is not None:
            _check(file, check, as_json=as_json)
        else:
            _take(file, again=retake)
            _calibrate(file, out, model, order, report, as_json=as_json, quiet=quiet)


def verify(
    rig: Annotated[Path, typer.Argument(help="rig.json")],
    other: Annotated[
        Path | None, typer.Option("--with", help="calibration.toml with images the rig has not seen.")
    ] = None,
    allow_edited: AllowEdited = False,
    report: Report = None,
    no_history: NoHistory = False,  # noqa: ARG001  (its callback acts)
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Repeat what the rig says of its verification, or test it on images it has not seen."""
    from calibration.atomic import require_folder
    from calibration.rig import sha256_of
    from scope import verify as verify_rig
    from scope.history import verification_figures
    from scope.report import verification_page, verification_text

    with user_errors():
        require_folder(report)
        result = verify_rig(rig, other, allow_edited=allow_edited)
        if not result["sealed"]:
            say_unsealed(rig, quiet=quiet)
        note("verify", rig, verification_figures(result), passed=bool(result["passed"]), rig=sha256_of(rig))
        write_page(report, lambda: verification_page(result), [rig, other], quiet=quiet)
    emit(result, as_json=as_json, text=verification_text(result), inputs=[rig, other])
    if not result["passed"]:
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def _calibrate(
    file: Path, out: Path, model: Model, order: str, report: Path | None, *, as_json: bool, quiet: bool
) -> None:
    from calibration.atomic import require_folder
    from calibration.rig import sha256_of
    from scope import calibrate as calibrate_rig
    from scope.history import calibration_figures
    from scope.report import calibration_page, calibration_text

    require_folder(out, report)
    with progress("finding marks", quiet=quiet) as tick:
        found = calibrate_rig(file, model=model, order=_order(order), on_plane=tick)
    found.rig.save(out)
    figures = calibration_figures(found.result)
    note("calibrate", out, figures, passed=found.passed, rig=sha256_of(out), camera=found.rig.camera_id)
    say(f"wrote {out}", quiet=quiet)
    write_page(report, lambda: calibration_page(found), [file, out], quiet=quiet)
    emit(found.result, as_json=as_json, text=calibration_text(found), inputs=[file, out])
    if not found.rig.verification.passed:
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def _take(file: Path, *, again: bool) -> None:
    """Take the images that are missing, where the file has a [camera]: whoever stands at the jig answers line by line."""
    from calibration.errors import FileError
    from scope.calibrating import take_missing
    from scope.session import planned_camera

    if not file.is_file() or (not again and planned_camera(file) is None):
        return  # what is wrong with the file is told by who reads it
    if again and planned_camera(file) is None:
        raise FileError(
            f"{file}: --retake needs a section [camera]; add it (see scope cameras), or take the images by hand"
        )

    def ask(what: str) -> bool:
        typer.echo(f"{what}; Enter takes it, q ends: ", err=True, nl=False)
        answer = sys.stdin.readline()
        if not answer:
            raise FileError(
                f"{what}: no image yet, and nobody answers; call this in a terminal, one Enter a shot, or use scope console"
            )
        return answer.strip().lower() not in {"q", "quit"}

    if not take_missing(file, ask, lambda text: typer.echo(text, err=True), again=again):
        raise FileError(f"{file}: ended before all images were taken; those that were are kept: call it again to go on")


def _check(file: Path, plane: str, *, as_json: bool) -> None:
    from scope.calibrating import check_plane
    from scope.report import check_text

    result = check_plane(file, plane)
    emit(result, as_json=as_json, text=check_text(result), inputs=[file])
    if result["remedy"]:
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def _init(file: Path, *, quiet: bool) -> None:
    from scope.session import TEMPLATES, write_template

    # `--init chessboard` leaves the kind where the file would be
    kind = str(file) if str(file) in TEMPLATES else "spots"
    path = Path("calibration.toml") if str(file) in TEMPLATES else file
    write_template(path, kind)
    say(f"wrote {path}: fill it in, then run: scope calibrate {path}", quiet=quiet)


def _order(text: str) -> Literal["auto", "linear", "paper"] | int:
    if text in {"auto", "linear", "paper"}:
        return text  # type: ignore[return-value]
    if text.isdigit() and 1 <= int(text) <= 9:
        return int(text)
    raise typer.BadParameter(f"{text!r}: use auto, linear, paper or a degree from 1 to 9", param_hint="--order")


def correct(
    cloud: Annotated[Path, typer.Argument(help="A scan (.ply) with the artefact in it, made with this rig.")],
    artefact: Annotated[Path, typer.Option("--artefact", "-a", help="artefact.toml: its mesh and uncertainty.")],
    rig: Annotated[Path, typer.Option("--rig", "-r", help="The rig that the scan was made with.")] = Path("rig.json"),
    out: Annotated[Path, typer.Option("--out", "-o", help="The corrected rig.")] = Path("rig-corrected.json"),
    allow_edited: AllowEdited = False,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Put a rig's scale and tilt right by one scan of an artefact: what calibration by planes cannot see."""
    from calibration.atomic import require_folder
    from calibration.rig import Rig
    from scope.cloud import ScanCloud
    from scope.watch import correct_rig, correction_page, correction_result, correction_text, read_artefact

    with user_errors():
        require_folder(out, report)
        plan = read_artefact(artefact)
        scan = ScanCloud.load(cloud)
        found = correct_rig(Rig.load(rig, allow_edited=allow_edited), scan, plan, str(cloud))
        found.rig.save(out)
        say(f"wrote {out}", quiet=quiet)
        write_page(report, lambda: correction_page(found, scan.points), [cloud, artefact, rig], quiet=quiet)
    emit(correction_result(found), as_json=as_json, text=correction_text(found), inputs=[cloud, artefact, rig])
    if not found.rig.verification.passed:
        say("the rig was not verified before, and is not now", quiet=quiet)
        raise typer.Exit(EXIT_NOT_TO_BE_USED)
