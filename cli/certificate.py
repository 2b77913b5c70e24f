"""`scope check` and `scope certificate`: how far a scanner can be relied upon."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from cli.console import (
    EXIT_NOT_TO_BE_USED,
    AllowEdited,
    Jobs,
    Json,
    NoHistory,
    Quiet,
    Report,
    Scheduler,
    emit,
    note,
    progress,
    say,
    user_errors,
    write_init,
    write_page,
)
from cli.locate import Where, outputs_of, region_of, usage


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(check)
    app.command()(certificate)


def check(
    clouds: Annotated[
        list[Path] | None, typer.Argument(help="One scan, or several of the same artefact for repeatability.")
    ] = None,
    artefact: Annotated[
        str | None,
        typer.Option("--artefact", "-a", help="sphere:d=40, plane, cylinder:d=20, steps:5,10,20 or mesh:file."),
    ] = None,
    acceptance: Annotated[
        Path | None,
        typer.Option("--acceptance", help="acceptance.toml: a test by standard, with its scans; no clouds then."),
    ] = None,
    tolerance: Annotated[float | None, typer.Option("--tolerance", help="Largest error allowed, mm.")] = None,
    region: Where = None,
    deviation: Annotated[
        Path | None,
        typer.Option(
            "--deviation",
            help="The points with their distance from the artefact (.ply .pcd .xyz .vtp); {cloud} in it is the name of each cloud.",
        ),
    ] = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = "",
    init: Annotated[
        bool, typer.Option("--init", help="Write the file of --acceptance with comments, to fill in.")
    ] = False,
    no_history: NoHistory = False,  # noqa: ARG001  (its callback acts)
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare scans of something known with what is known of it; exit 3 where it is out of tolerance."""
    with usage():
        if init or acceptance is not None:
            if clouds or artefact or region or deviation or tolerance is not None or acceptance is None:
                raise ValueError(
                    "--acceptance FILE names its scans, artefacts and limits itself: give no clouds, --artefact, --tolerance or --region "
                    "beside it, and --init only with it"
                )
        elif not clouds or artefact is None:
            raise ValueError("give scans and --artefact, such as scan.ply --artefact sphere:d=40; or --acceptance FILE")
    if init and acceptance is not None:
        write_init(acceptance, "acceptance.toml", f"scope check --acceptance {acceptance}", quiet=quiet)
    elif acceptance is not None:
        _acceptance(acceptance, report, as_json=as_json, quiet=quiet)
    else:
        _artefact(
            clouds or [],
            artefact or "",
            tolerance,
            region,
            (deviation, report),
            spread=(jobs, scheduler),
            as_json=as_json,
            quiet=quiet,
        )


def _acceptance(file: Path, report: Path | None, *, as_json: bool, quiet: bool) -> None:
    from calibration.atomic import require_folder
    from scope.acceptance import (
        accept,
        acceptance_figures,
        acceptance_page,
        acceptance_result,
        acceptance_text,
        read_acceptance,
    )

    with user_errors():
        require_folder(report)
        plan = read_acceptance(file)
        with progress("measuring", quiet=quiet) as tick:
            found = accept(plan, on_scan=tick)
        write_page(report, lambda: acceptance_page(found), [file], quiet=quiet)
    rig = found.rigs[0] if found.rigs else ""
    note("check", file, acceptance_figures(found), passed=found.decision in {"pass", None}, rig=rig)
    emit(acceptance_result(found), as_json=as_json, text=acceptance_text(found), inputs=[file])
    if found.decision not in {"pass", None}:
        say("the scanner has not been shown to keep its limits", quiet=quiet)
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def _artefact(
    clouds: list[Path],
    artefact: str,
    tolerance: float | None,
    region: str | None,
    files: tuple[Path | None, Path | None],
    *,
    spread: tuple[int, str],
    as_json: bool,
    quiet: bool,
) -> None:
    from calibration.atomic import require_folder
    from scope.batch import each
    from scope.check import (
        Artefact,
        ArtefactCheck,
        check_artefact,
        check_repeats,
        check_result,
        check_text,
        out_of_tolerance,
        repeat_result,
        write_residuals,
    )
    from scope.cloud import ScanCloud, unknown
    from scope.export import require_scalars
    from scope.history import check_figures
    from scope.report import check_page

    deviation, report = files
    with user_errors():
        with usage():
            known = Artefact.parse(artefact)
            within = region_of(region)
            if tolerance is not None and not tolerance > 0:
                raise ValueError(f"--tolerance {tolerance:g} must be positive, mm")
            require_scalars(deviation)
            maps = [file for (file,) in outputs_of(clouds, deviation)]
        require_folder(report, *maps)
        repeatability = None
        scans = [ScanCloud.load(path) for path in clouds]
        if len(scans) == 1:
            checks: tuple[ArtefactCheck, ...] = (check_artefact(scans[0], known, tolerance=tolerance, region=within),)
            told, text = check_result(checks[0]), check_text(checks[0])
        else:
            repeat = check_repeats(
                scans,
                known,
                tolerance=tolerance,
                region=within,
                each=partial(each, jobs=spread[0], scheduler=spread[1]),
            )
            checks = repeat.checks
            told, repeatability = repeat_result(repeat), repeat.worst_mm
            text = "\n".join([*(check_text(c) for c in checks), f"repeatability {repeat.worst_mm:.4f} mm (one sigma)"])
        for judged, scan, map_file in zip(checks, scans, maps, strict=True):
            if map_file is not None:
                write_residuals(map_file, judged, scan)
                say(f"wrote {map_file}", quiet=quiet)
        named = [(path.name, scan) for path, scan in zip(clouds, scans, strict=True)]
        write_page(
            report,
            lambda: check_page(checks, named, tolerance=tolerance, repeatability=repeatability),
            clouds,
            quiet=quiet,
        )
    for path, scan in zip(clouds, scans, strict=True):
        if unread := unknown(scan, path.name):
            say(unread, quiet=quiet)
    note("check", clouds[0], check_figures(told), passed=not out_of_tolerance(checks), rig=scans[0].rig_sha256)
    emit(told, as_json=as_json, text=text, inputs=clouds)
    if out_of_tolerance(checks):
        say("do not rely on this scanner before it is calibrated again", quiet=quiet)
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


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
    operator: Annotated[str, typer.Option("--operator", envvar="SCOPE_OPERATOR", help="Who answers for it.")] = "",
    allow_edited: AllowEdited = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Join calibration, verifications and checks of a rig on one page with its uncertainty budget."""
    from calibration.atomic import require_folder
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
        write_page(out, lambda: certificate_page(found), [*(results or []), *(clouds or [])], quiet=quiet)
    lines = [f"{'may be used' if found.passed else 'MUST NOT BE USED'}: {found.why}"]
    for budget in found.budgets:
        left = f"; without {', '.join(budget.missing)}" if budget.missing else ""
        lines.append(f"laser {budget.laser}: {budget.expanded:.4f} mm along the ray (k = 2){left}")
    emit(found.as_json(), as_json=as_json, text="\n".join(lines), inputs=[rig, *(results or []), *(clouds or [])])
    if not found.passed:
        raise typer.Exit(EXIT_NOT_TO_BE_USED)
