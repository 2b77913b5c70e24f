"""`scope roughness`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.console import EXIT_NOT_TO_BE_USED, Json, Quiet, Report, emit, say, user_errors, write_page


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(roughness)


def roughness(
    cloud: Annotated[
        Path, typer.Argument(help="Cloud (.ply .pcd .las .e57), or height map (.npy .asc .txt .xyz .sdf .x3p), mm.")
    ],
    region: Annotated[
        list[str] | None,
        typer.Option(
            "--region", help="[NAME=]box:x0,x1,y0,y1[,z0,z1] | polygon:file.csv | mesh:file.stl; mm; may be repeated."
        ),
    ] = None,
    form: Annotated[
        str,
        typer.Option("--form", help="auto, plane, robust-plane, cylinder, sphere, poly2 to poly10, none, model:file."),
    ] = "auto",
    s_filter: Annotated[
        float | None, typer.Option("--s-filter", min=0.0, help="Nesting index of the areal S-filter, mm.")
    ] = None,
    l_filter: Annotated[
        float | None, typer.Option("--l-filter", min=0.0, help="Areal L-filter and cut-off of the profiles, mm.")
    ] = None,
    noise: Annotated[
        Path | None,
        typer.Option("--noise", help="A repeat of the scan, best displaced by more than the stripe's width (.ply)."),
    ] = None,
    stripe_width: Annotated[
        float | None,
        typer.Option(
            "--stripe-width", min=0.0, help="One sigma of the stripe on the surface, mm, in place of the cloud's own."
        ),
    ] = None,
    pose: Annotated[
        Path | None,
        typer.Option(
            "--pose", help="Of mesh: and model: files: cloud_from_model as JSON, such as scope pose --json gives."
        ),
    ] = None,
    pitch: Annotated[
        str | None, typer.Option("--pitch", help="Of a height map that tells none: mm, or DOWN,ALONG in mm.")
    ] = None,
    heights: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="The heights of a patch as points, form and filters applied (.ply .pcd .xyz .vtp); {patch} in it is the name of each.",
        ),
    ] = None,
    table: Annotated[Path | None, typer.Option("--csv", help="Write the parameters as CSV.")] = None,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Roughness of patches after ISO 25178-2 and ISO 21920-2, with the scanner's noise taken out.

    Lengths are mm. Exit 3: a patch's Sq is withheld or mostly uncertain.
    """
    from calibration.atomic import require_folder, write_text
    from scope.cloud import parse_region, require_names
    from scope.pose import read_transform
    from scope.report import roughness_csv, roughness_page, roughness_text
    from scope.roughness import options_from_text, run_roughness, write_heights

    with user_errors():
        require_folder(table, report, heights)
        placed = None if pose is None else read_transform(pose)
        try:
            regions = [parse_region(text, cloud_from_model=placed) for text in region or []]
            require_names([name for name, _ in regions])
            options = options_from_text(
                form, s_filter=s_filter, l_filter=l_filter, stripe_width=stripe_width, cloud_from_model=placed
            )
            steps = None if pitch is None else _steps(pitch)
            maps = _maps(heights, [name for name, _ in regions])
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error
        patches = run_roughness(cloud, regions, options, noise=noise, pitch=steps)
        for patch, file in zip(patches, maps * (len(patches) if len(maps) == 1 else 1), strict=True):
            if file is not None:
                write_heights(file, patch)
                say(f"wrote {file}", quiet=quiet)
        if table is not None:
            write_text(table, roughness_csv(patches))
            say(f"wrote {table}", quiet=quiet)
        write_page(report, lambda: roughness_page(patches, cloud.name), [cloud, noise], quiet=quiet)
    emit(
        {"patches": [patch.to_dict() for patch in patches]},
        as_json=as_json,
        text=roughness_text(patches),
        inputs=[cloud, noise],
    )
    bad = [patch.name for patch in patches if not patch.valid]
    if bad:
        say(f"not to be used: Sq of {', '.join(bad)} is withheld or uncertain by half of itself", quiet=quiet)
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def _maps(name: Path | None, patches: list[str]) -> list[Path | None]:
    """File for the heights of each patch; of several, ``{patch}`` in the name tells them apart."""
    from scope.export import require_scalars

    require_scalars(name)
    if name is None:
        return [None] * max(1, len(patches))
    if len(patches) > 1 and "{patch}" not in name.name:
        raise ValueError(f"--map {name}: there are {len(patches)} patches; give a name with {{patch}} in it")
    return [name.with_name(name.name.replace("{patch}", patch)) for patch in patches or ["patch"]]


def _steps(text: str) -> tuple[float, float]:
    """Pitch down and along, mm, of ``0.1`` or ``0.2,0.1``."""
    steps = [float(part) for part in text.split(",")]
    if len(steps) not in {1, 2} or not all(0.0 < step < float("inf") for step in steps):
        raise ValueError(f"pitch {text!r} is not a length in mm or two of them")
    return steps[0], steps[-1]
