"""`scope pose`, and what commands share that look for something in a cloud."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibration.errors import ScopeError
from cli.console import (
    EXIT_NOT_TO_BE_USED,
    Json,
    Quiet,
    Report,
    emit,
    progress,
    say,
    user_errors,
    write_page,
)

if TYPE_CHECKING:
    from scope.cloud import Region
    from scope.pose import Sighted

Where = Annotated[
    str | None, typer.Option("--region", help="box:x0,x1,y0,y1[,z0,z1], polygon:file or mesh:file; mm, cloud frame.")
]


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(pose)


def pose(
    clouds: Annotated[
        list[Path],
        typer.Argument(
            help="Point cloud: PLY, PCD, XYZ, LAS or E57; of several, each is answered.", metavar="CLOUD..."
        ),
    ],
    model: Annotated[Path, typer.Option("--model", "-m", help="Mesh of the part: STL, OBJ, PLY, GLB, 3MF or STEP.")],
    region: Where = None,
    at: Annotated[
        str,
        typer.Option("--at", help="last, first or a frame: where the object is to be told of in the camera's frame."),
    ] = "last",
    init: Annotated[
        Path | None, typer.Option("--init", help="JSON with a 4x4 cloud_from_model to be tried too.")
    ] = None,
    robot_from_camera: Annotated[
        Path | None,
        typer.Option(
            "--robot-from-camera",
            help="JSON with robot_from_camera, units and convention: the pose is given for the robot too.",
        ),
    ] = None,
    part_tolerance: Annotated[
        float,
        typer.Option(
            "--part-tolerance", help="How far the right part's surfaces may lie from the mesh, mm; more: exit 3."
        ),
    ] = 0.1,
    deviation: Annotated[
        Path | None,
        typer.Option(
            "--deviation",
            help="The part's points with their distance from the model (.ply .pcd .xyz .vtp); {cloud} in it is the name of each cloud.",
        ),
    ] = None,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Find a known part in a scan: position, orientation and how sure they are; exit 3 where the answer is not sure."""
    from calibration.atomic import require_folder
    from scope.export import require_scalars
    from scope.pose import BAD_DATA, PoseOptions, Told, poses_of, read_robot_from_camera, read_transform

    with user_errors():
        with usage():
            outputs = outputs_of(clouds, deviation, report)
            require_scalars(deviation)
            within = region_of(region)
            if at not in {"last", "first"} and not at.isdecimal():
                raise ValueError(f"--at {at!r} is neither last nor first nor the number of a frame")
            if not 0 < part_tolerance < float("inf"):
                raise ValueError(f"--part-tolerance {part_tolerance:g} must be positive, mm")
        options = PoseOptions(part_tolerance=part_tolerance)
        require_folder(*(path for pair in outputs for path in pair))
        started = None if init is None else read_transform(init)
        robot = None if robot_from_camera is None else read_robot_from_camera(robot_from_camera)
        if robot is not None and robot.warning:
            say(f"warning: {robot.warning}", quiet=quiet)
        with progress("placing", quiet=quiet or len(clouds) == 1) as tick:
            found = []
            answers = poses_of(
                clouds, model, region=within, initial=started, told_in=Told(at, robot), options=options, on_cloud=tick
            )
            for each, files in zip(answers, outputs, strict=True):
                if len(clouds) == 1 and each.error:
                    raise ScopeError(each.error)
                _write(each, model, *files, alone=len(clouds) == 1, quiet=quiet)
                found.append(replace(each, cloud=None))
    _emit_poses(found, model, as_json=as_json)
    statuses = {each.status for each in found}
    if statuses != {0}:
        raise typer.Exit(BAD_DATA if BAD_DATA in statuses else EXIT_NOT_TO_BE_USED)


def outputs_of(clouds: list[Path], *names: Path | None) -> list[tuple[Path | None, ...]]:
    """Files to be written for each cloud; of several clouds, ``{cloud}`` in a name tells them apart."""
    stems = [path.stem for path in clouds]
    for name in names:
        if name is not None and len(clouds) > 1:
            if "{cloud}" not in name.name:
                raise ValueError(
                    f"{name}: there are {len(clouds)} clouds; give a name with {{cloud}} in it, such as {{cloud}}-{name.name}"
                )
            if len(set(stems)) < len(stems):
                twice = next(stem for stem in stems if stems.count(stem) > 1)
                raise ValueError(f"{name}: two clouds are called {twice}; rename one, or give them in two commands")
    return [tuple(None if n is None else n.with_name(n.name.replace("{cloud}", stem)) for n in names) for stem in stems]


def _write(
    each: Sighted, model: Path, deviation: Path | None, report: Path | None, *, alone: bool, quiet: bool
) -> None:
    """Deviation and page of one cloud, and what it does not tell."""
    from scope.pose import write_deviation
    from scope.report import pose_html

    if each.cloud is None or each.placed is None:
        return
    cloud, placed = each.cloud, each.placed
    if deviation is not None and not each.placed.result.candidates and not alone:
        say(f"{deviation}: not written, since {each.path.name} has no pose to compare with", quiet=quiet)
    elif deviation is not None:
        write_deviation(deviation, each.cloud, each.placed.result)
        say(f"wrote {deviation}", quiet=quiet)
    write_page(report, lambda: pose_html(cloud, placed), [each.path, model], quiet=quiet)
    if each.unread:
        say(each.unread, quiet=quiet)


def _emit_poses(found: list[Sighted], model: Path, *, as_json: bool) -> None:
    """One answer, or of several clouds a list and a table."""
    from scope.pose import pose_result, pose_text, poses_table, sighted_result

    if len(found) == 1 and found[0].placed is not None:
        emit(
            pose_result(found[0].placed),
            as_json=as_json,
            text=pose_text(found[0].placed),
            inputs=[found[0].path, model],
        )
    else:
        emit([sighted_result(each) for each in found], as_json=as_json, text=poses_table(found))


@contextmanager
def usage() -> Iterator[None]:
    """A wrong word on the command line is a matter of usage: exit 2 with one line."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error


def region_of(text: str | None) -> Region | None:
    """Region that ``--region`` names; ``ValueError`` where it names none."""
    from scope.cloud import parse_region

    return None if text is None else parse_region(text)[1]
