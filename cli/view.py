"""`scope export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.console import Json, emit, user_errors


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(export)


def export(
    cloud: Annotated[Path, typer.Argument(help="cloud.ply")],
    out: Annotated[Path, typer.Argument(help="out.ply, .pcd, .xyz, .las, .e57 or .stl")],
    as_json: Json = False,
) -> None:
    """Write a cloud in another format, mesh included."""
    from scope.cloud import ScanCloud

    with user_errors():
        found = ScanCloud.load(cloud)
        found.save(out)
    emit({"points": len(found)}, as_json=as_json, text=f"wrote {len(found)} points to {out}")
