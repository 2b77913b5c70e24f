"""`scope merge` and `scope mesh`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.console import EXIT_NOT_TO_BE_USED, Json, Quiet, Report, emit, say, user_errors, write_page


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(merge)
    app.command()(mesh)


def merge(
    clouds: Annotated[list[Path], typer.Argument(help="Two scans or more of one object.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The whole, in the frame of the first (or of the poses).")],
    poses: Annotated[
        str | None,
        typer.Option(
            "--poses", help='"same": all are in one frame already; or a JSON file with a 4x4 whole_from_cloud for each.'
        ),
    ] = None,
    refine: Annotated[bool, typer.Option("--refine", help="Adjust known poses to the overlaps.")] = False,
    tolerance: Annotated[
        float | None, typer.Option("--tolerance", help="How far apart overlaps may be, mm (median of a pair).")
    ] = None,
    deviation: Annotated[
        Path | None,
        typer.Option("--map", help="All points with their distance from the other scans (.ply .pcd .xyz .vtp)."),
    ] = None,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Join scans in one frame, by known poses or by their shapes, and tell how far they disagree where they overlap."""
    from calibration.atomic import require_folder
    from calibration.geometry import Pose
    from scope.cloud import ScanCloud, require_format
    from scope.export import require_scalars
    from scope.merge import merge as join
    from scope.merge import merge_result, merge_text, read_poses, write_map
    from scope.report import merge_page

    if tolerance is not None and not tolerance > 0:
        raise typer.BadParameter(f"--tolerance {tolerance:g} must be positive, mm")
    if len(clouds) < 2:
        raise typer.BadParameter("one cloud is whole already; name two or more")
    if refine and poses is None:
        raise typer.BadParameter("--refine adjusts known poses; give --poses")
    try:
        require_scalars(deviation)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--map") from error
    with user_errors():
        require_folder(out, report, deviation)
        require_format(out)
        known = None
        if poses is not None:
            known = [Pose.identity()] * len(clouds) if poses == "same" else read_poses(Path(poses), len(clouds))
        scans = [ScanCloud.load(path) for path in clouds]
        names = [path.stem for path in clouds]
        if len(set(names)) < len(names):
            names = [f"{path.parent.name}/{path.stem}" if names.count(path.stem) > 1 else path.stem for path in clouds]
        found = join(scans, names, poses=known, refine=refine, tolerance=tolerance)
        if found.cloud is not None:
            found.cloud.save(out)
            say(f"wrote {out}", quiet=quiet)
            if deviation is not None:
                write_map(deviation, found)
                say(f"wrote {deviation}", quiet=quiet)
        write_page(report, lambda: merge_page(found), clouds, quiet=quiet)
    emit(merge_result(found), as_json=as_json, text=merge_text(found), inputs=clouds)
    if not found.passed:
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def mesh(
    cloud: Annotated[Path, typer.Argument(help="Point cloud: PLY, PCD, XYZ, LAS or E57.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Mesh: .stl, .ply or .obj, mm.")] = Path("part.stl"),
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Make a mesh of a cloud: closed where it was seen all around, open where not; how far it lies from the points is told."""
    from calibration.atomic import require_folder
    from scope.cloud import ScanCloud
    from scope.merge import mesh_result, mesh_text, reconstruct, require_mesh_format, save_mesh

    with user_errors():
        require_folder(out)
        require_mesh_format(out)
        found = reconstruct(ScanCloud.load(cloud), cloud.name)
        save_mesh(out, found)
        say(f"wrote {out}", quiet=quiet)
    emit(mesh_result(found), as_json=as_json, text=mesh_text(found), inputs=[cloud])
