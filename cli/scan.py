"""`scope scan`, `scope simulate` and `scope demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
    write_init,
    write_page,
)

if TYPE_CHECKING:
    from calibration.rig import Rig
    from scope.scanning import Scan
    from scope.watch import WatchPlan

Method = Literal["auto", "centroid", "gaussian", "ridge"]
Which = Literal["strongest", "first", "last", "continuous"]


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(scan)
    app.command()(simulate)
    app.command()(demo)


def scan(
    capture: Annotated[Path, typer.Argument(help="capture.toml")] = Path("capture.toml"),
    rig: Annotated[Path, typer.Option("--rig", "-r", help="Calibrated rig.")] = Path("rig.json"),
    out: Annotated[Path, typer.Option("--out", "-o", help="Point cloud, mm.")] = Path("cloud.ply"),
    method: Annotated[Method, typer.Option("--method", help="How the stripe is measured.")] = "auto",
    which: Annotated[
        Which,
        typer.Option("--which", help="Of several peaks on a line, along u or v; continuous: with the lines about it."),
    ] = "strongest",
    normals: Annotated[bool, typer.Option("--normals", help="Add surface normals from the scan lattice.")] = False,
    max_sigma: Annotated[
        float | None, typer.Option("--max-sigma", min=0.0, help="Reject points less certain than this, mm.")
    ] = None,
    extrapolate: Annotated[
        float, typer.Option("--extrapolate", min=0.0, help="Range this far outside the calibrated volume, mm.")
    ] = 0.0,
    isolated: Annotated[
        int | None,
        typer.Option("--isolated", min=1, max=8, help="Remove points with fewer neighbours than this on the scan."),
    ] = None,
    max_incidence: Annotated[
        float | None,
        typer.Option("--max-incidence", min=1.0, max=90.0, help="Remove surface seen at a steeper angle, degrees."),
    ] = None,
    voxel: Annotated[
        float | None,
        typer.Option("--voxel", min=1e-3, help="Keep the most certain point of each cube of this edge, mm."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from an interrupted scan's cloud.ply.part.")] = False,
    allow_unverified: Annotated[
        bool, typer.Option("--allow-unverified", help="Exit 0 although the rig is not verified.")
    ] = False,
    allow_edited: AllowEdited = False,
    watch: Annotated[
        Path | None,
        typer.Option("--watch", help="artefact.toml: an object of known shape in the scan; checks it and tells drift."),
    ] = None,
    no_history: NoHistory = False,  # noqa: ARG001  (its callback acts)
    init: Annotated[bool, typer.Option("--init", help="Write a commented capture.toml to fill in.")] = False,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Range every stripe image of a capture and write one point cloud."""
    if init:
        write_init(capture, "capture.toml", f"scope scan {capture} --rig rig.json", quiet=quiet)
        return
    from calibration.atomic import require_folder
    from calibration.rig import Rig
    from ranging.stripe import StripeOptions
    from scope.cloud import FilterOptions
    from scope.history import scan_figures
    from scope.report import scan_page, scan_result, scan_text
    from scope.scanning import ScanOptions, scan_to_file

    with user_errors():
        require_folder(report)
        artefact = None if watch is None else _artefact(watch)
        calibrated = Rig.load(rig, allow_edited=allow_edited)
        if not calibrated.sealed:
            say_unsealed(rig, quiet=quiet)
        with progress("scanning", quiet=quiet) as tick:
            options = ScanOptions(
                StripeOptions(method=method, which=which), extrapolate=extrapolate, max_sigma=max_sigma, normals=normals,
                filters=FilterOptions(isolated=isolated, max_incidence=max_incidence, voxel=voxel),
            )  # fmt: skip
            found = scan_to_file(
                capture, calibrated, out, options, resume=resume, origin=_origin(capture, rig), on_frame=tick
            )
        good = found.verified and not found.why_incomplete and not found.troubles
        note(
            "scan",
            out,
            scan_figures(scan_result(found)),
            passed=good,
            rig=calibrated.sha256,
            camera=calibrated.camera_id,
        )
        say(f"wrote {out}", quiet=quiet)
        seen = None if artefact is None else _watched(artefact, found, calibrated, out, quiet=quiet)
        rows = seen.rows if seen else ()
        write_page(report, lambda: scan_page(found, capture, artefact=rows), [capture, rig], quiet=quiet)
    told, text = scan_result(found), scan_text(found)
    if seen is not None:
        told, text = {**told, "watch": seen.result}, f"{text}\n{seen.text}"
    emit(told, as_json=as_json, text=text, inputs=[capture, rig])
    if found.why_incomplete:
        say(f"incomplete: {found.why_incomplete}; go on with --resume", quiet=quiet)
    if found.troubles:
        say("the scan contradicts its [motion]: do not use this cloud before that is put right", quiet=quiet)
        raise typer.Exit(EXIT_NOT_TO_BE_USED)
    if seen is not None and not seen.good:
        say("the artefact beside the part does not bear this scan out: do not use this cloud", quiet=quiet)
        raise typer.Exit(EXIT_NOT_TO_BE_USED)
    if not found.verified and not allow_unverified:
        say(
            "the rig is not verified: do not use this cloud (scope verify says why; --allow-unverified accepts it)",
            quiet=quiet,
        )
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def _origin(capture: Path, rig: Path) -> tuple[str, ...]:
    """What the cloud says of itself."""
    from scope.origin import origin_of
    from scope.session import read_capture

    plan = read_capture(capture)
    frames = [*plan.images, *([plan.video] if plan.video is not None else []), *plan.background]
    return origin_of([capture, rig], frames=frames).lines


@dataclass(frozen=True)
class _Seen:
    """What an artefact says of a scan, as it is told."""

    result: dict[str, Any]
    text: str
    rows: list[list[str]]
    good: bool


def _artefact(path: Path) -> WatchPlan:
    from scope.watch import read_artefact

    return read_artefact(path)


def _watched(plan: WatchPlan, found: Scan, rig: Rig, out: Path, *, quiet: bool) -> _Seen:
    """Check a scan by its artefact, beside the earlier ones of the same rig and artefact."""
    from calibration.errors import ScopeError
    from scope.history import journal_beside
    from scope.watch import drift_of, watch, watch_figures, watch_result, watch_rows, watch_text

    try:
        seen = watch(plan, found.cloud, pinhole=rig.camera.model == "pinhole")
    except ScopeError as error:
        note("watch", out, {}, passed=False, rig=rig.sha256, camera=plan.name)
        why = " ".join(str(error).split())
        return _Seen({"artefact": plan.name, "decision": None, "why": why}, f"artefact: NOT CHECKED: {why}", [["not checked", why, "-"]], False)  # fmt: skip
    journal = journal_beside(out)
    records = [] if journal is None else journal.records(kind="watch")
    earlier = [r for r in records if r.rig == rig.sha256 and r.camera == plan.name and r.figures]
    figures = watch_figures(seen)
    drift = drift_of(figures, earlier)
    good = seen.decision in {"pass", None}
    note("watch", out, figures, passed=good, rig=rig.sha256, camera=plan.name)
    if drift:
        say(f"drift: {drift[0].text}", quiet=quiet)
    return _Seen(watch_result(seen, drift), watch_text(seen, drift), watch_rows(seen, drift), good)


def simulate(
    design: Annotated[Path, typer.Argument(help="rig-design.toml")] = Path("rig-design.toml"),
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder of the session.")] = None,
    init: Annotated[bool, typer.Option("--init", help="Write a commented rig-design.toml to fill in.")] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of noise and dirt.")] = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Render a virtual rig: calibration.toml, capture.toml, images, and the truth."""
    from scope import simulate as simulate_rig

    if init:
        write_init(design, "rig-design.toml", f"scope simulate {design} -o DIR", quiet=quiet)
        return
    if out is None:
        raise typer.BadParameter("name a folder for the session", param_hint="--out")
    with user_errors(), progress("rendering", quiet=quiet) as tick:
        result = simulate_rig(design, out, seed, on_image=tick).result
    sigma = result["expected_sigma_mm"]
    told = "" if sigma is None else f"; expected sigma {sigma} mm"
    emit(result, as_json=as_json, text=f"wrote {result['images']} images to {out}{told}")


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for everything that is made.")] = Path("demo"),
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Simulate, calibrate, verify, scan, measure and report, and show the deviation of each from the truth."""
    from scope.demo import demo_text, run_demo

    with user_errors(), progress("demo", quiet=quiet) as tick:
        result = run_demo(out, on_step=tick, say=lambda text: say(text, quiet=quiet))
    emit(result, as_json=as_json, text=demo_text(result))
