"""`scope export` and `scope view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.console import AllowEdited, Json, Quiet, emit, say, user_errors


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(export)
    app.command()(view)


def export(
    cloud: Annotated[Path, typer.Argument(help="Cloud: .ply, .pcd, .xyz, .txt, .las, .laz or .e57")],
    out: Annotated[Path, typer.Argument(help="out.ply, .pcd, .xyz, .las, .laz, .e57, .vtp, .mcap or .stl")],
    program: Annotated[
        str | None,
        typer.Option(
            "--for", help="cloudcompare, meshlab, open3d, pcl, pyvista or ros2: under the names that it reads."
        ),
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write a cloud in another format, mesh included, or as another program reads it whole."""
    from scope.cloud import ScanCloud, not_carried, unknown
    from scope.export import export_for, program_for, require_program

    reader = program or program_for(out)
    if reader:
        try:
            require_program(out, reader)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error
    with user_errors():
        found = ScanCloud.load(cloud)
        if reader:
            lost = export_for(found, out, reader)
        else:
            found.save(out)
            lost = not_carried(found, out)
    for line in (unknown(found, cloud.name), lost):
        if line:
            say(line, quiet=quiet)
    told = {"points": len(found), "for": reader or None, "not_carried": lost or None}
    emit(told, as_json=as_json, text=f"wrote {len(found)} points to {out}", inputs=[cloud])


def view(
    path: Annotated[Path, typer.Argument(help="A cloud (.ply, .pcd, .xyz, .las, .e57) or rig.json")],
    rig: Annotated[
        Path | None, typer.Option("--rig", "-r", help="Show this rig with the cloud: camera, rays, sheets, axes.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Keep the page here; otherwise it is a temporary file.")
    ] = None,
    show: Annotated[bool, typer.Option("--show/--no-show", help="Open the page in the browser.")] = True,
    allow_edited: AllowEdited = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Look at a cloud or a rig in the browser."""
    import tempfile
    import webbrowser

    from calibration.atomic import require_folder, write_text
    from scope.origin import origin_of
    from scope.report import signed, view_page

    with user_errors():
        require_folder(out)
        html = view_page(path, rig=rig, allow_edited=allow_edited)
        page = out or Path(tempfile.mkdtemp(prefix="scope-")) / f"{path.stem}.html"
        write_text(page, signed(html, origin_of([path])))
    shown = show and webbrowser.open(page.resolve().as_uri())
    if show and not shown:
        say("no browser was found: open the page yourself", quiet=quiet)
    emit({"page": str(page), "shown": shown}, as_json=as_json, text=f"{page}", inputs=[path])
