"""`scope inspect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.console import EXIT_NOT_TO_BE_USED, Json, Quiet, Report, emit, say, user_errors, write_page


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command("inspect")(inspect)


def inspect(
    cloud: Annotated[Path, typer.Argument(help="Point cloud: PLY, PCD, XYZ, LAS or E57.")],
    model: Annotated[Path, typer.Option("--model", "-m", help="Mesh of the part as it should be, mm.")],
    tolerance: Annotated[
        float | None,
        typer.Option("--tolerance", help="mm, of every length without one of its own, and of the surface."),
    ] = None,
    features: Annotated[Path | None, typer.Option("--features", help="features.toml: what is to be measured.")] = None,
    region: Annotated[
        str | None,
        typer.Option("--region", help="box:x0,x1,y0,y1[,z0,z1], polygon:file or mesh:file; mm, cloud frame."),
    ] = None,
    deviation: Annotated[
        Path | None,
        typer.Option("--deviation", help="The part's points with their distance from the model (.ply .pcd .xyz .vtp)."),
    ] = None,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare a scanned part with its model: pass, fail or undecided; exit 3 unless it passes (or nothing was to be judged)."""
    from calibration.atomic import require_folder
    from scope.cloud import ScanCloud, parse_region, unknown
    from scope.export import require_scalars
    from scope.inspection import inspect_part, inspection_result, inspection_text, read_features
    from scope.pose import write_deviation
    from scope.report import inspection_page

    if tolerance is not None and not tolerance > 0:
        raise typer.BadParameter(f"--tolerance {tolerance:g} must be positive, mm")
    try:
        require_scalars(deviation)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--deviation") from error
    with user_errors():
        require_folder(deviation, report)
        wanted = () if features is None else read_features(features)
        scan = ScanCloud.load(cloud)
        try:
            within = None if region is None else parse_region(region)[1]
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error
        found = inspect_part(scan, model, features=wanted, tolerance=tolerance, region=within)
        if deviation is not None:
            write_deviation(deviation, scan, found.pose)
            say(f"wrote {deviation}", quiet=quiet)
        write_page(report, lambda: inspection_page(found), [cloud, model, features], quiet=quiet)
    if unread := unknown(scan, cloud.name):
        say(unread, quiet=quiet)
    emit(inspection_result(found), as_json=as_json, text=inspection_text(found), inputs=[cloud, model, features])
    judged = any(v.decision is not None for v in (*found.features, *((found.surface,) if found.surface else ())))
    if found.pose.cloud_from_model is None or (judged and found.decision != "pass"):
        raise typer.Exit(EXIT_NOT_TO_BE_USED)
