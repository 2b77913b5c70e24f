"""`scope pose` and `scope check`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.console import EXIT_NOT_TO_BE_USED, Json, Quiet, Report, emit, say, user_errors

if TYPE_CHECKING:
    from scope.cloud import Region

Where = Annotated[
    str | None, typer.Option("--region", help="box:x0,x1,y0,y1[,z0,z1], polygon:file or mesh:file; mm, cloud frame.")
]


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(pose)
    app.command()(check)


def pose(
    cloud: Annotated[Path, typer.Argument(help="Point cloud: PLY, PCD, XYZ, LAS or E57.")],
    model: Annotated[Path, typer.Option("--model", "-m", help="Mesh of the part: STL, OBJ or PLY, mm.")],
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
    deviation: Annotated[
        Path | None, typer.Option("--deviation", help="PLY of the part's points with their distance from the model.")
    ] = None,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Find a known part in a scan: position, orientation and how sure they are; exit 3 where the answer is not sure."""
    from calibration.atomic import require_folder, write_text
    from scope.cloud import ScanCloud, unknown
    from scope.pose import (
        estimate_pose,
        frame_of,
        place,
        pose_result,
        pose_text,
        read_robot_from_camera,
        read_transform,
        write_deviation,
    )
    from scope.report import pose_html

    with user_errors():
        require_folder(deviation, report)
        started = None if init is None else read_transform(init)
        robot = None if robot_from_camera is None else read_robot_from_camera(robot_from_camera)
        if robot is not None and robot.warning:
            say(f"warning: {robot.warning}", quiet=quiet)
        scan = ScanCloud.load(cloud)
        with _usage():
            within = _region(region)
            frame_of(scan, at)
        result = estimate_pose(scan, model, region=within, initial=started)
        placed = place(scan, result, at, robot)
        if deviation is not None:
            write_deviation(deviation, scan, result)
            say(f"wrote {deviation}", quiet=quiet)
        if report is not None:
            write_text(report, pose_html(scan, placed))
            say(f"wrote {report}", quiet=quiet)
    if unread := unknown(scan, cloud.name):
        say(unread, quiet=quiet)
    emit(pose_result(placed), as_json=as_json, text=pose_text(placed))
    if not result.found:
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def check(
    clouds: Annotated[list[Path], typer.Argument(help="One scan, or several of the same artefact for repeatability.")],
    artefact: Annotated[
        str, typer.Option("--artefact", "-a", help="sphere:d=40, plane, cylinder:d=20, steps:5,10,20 or mesh:file.")
    ],
    tolerance: Annotated[float | None, typer.Option("--tolerance", help="Largest error allowed, mm.")] = None,
    region: Where = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare scans of something known with what is known of it; exit 3 where it is out of tolerance."""
    from scope.check import (
        Artefact,
        ArtefactCheck,
        check_artefact,
        check_repeats,
        check_result,
        check_text,
        out_of_tolerance,
        repeat_result,
    )
    from scope.cloud import ScanCloud, unknown

    with user_errors():
        with _usage():
            known = Artefact.parse(artefact)
            within = _region(region)
            if tolerance is not None and not tolerance > 0:
                raise ValueError(f"--tolerance {tolerance:g} must be positive, mm")
        scans = [ScanCloud.load(path) for path in clouds]
        if len(scans) == 1:
            checks: tuple[ArtefactCheck, ...] = (check_artefact(scans[0], known, tolerance=tolerance, region=within),)
            told, text = check_result(checks[0]), check_text(checks[0])
        else:
            repeat = check_repeats(scans, known, tolerance=tolerance, region=within)
            checks = repeat.checks
            told = repeat_result(repeat)
            text = "\n".join([*(check_text(c) for c in checks), f"repeatability {repeat.worst_mm:.4f} mm (one sigma)"])
    for path, scan in zip(clouds, scans, strict=True):
        if unread := unknown(scan, path.name):
            say(unread, quiet=quiet)
    emit(told, as_json=as_json, text=text)
    if out_of_tolerance(checks):
        say("do not rely on this scanner before it is calibrated again", quiet=quiet)
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


@contextmanager
def _usage() -> Iterator[None]:
    """A wrong word on the command line is a matter of usage: exit 2 with one line."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error


def _region(text: str | None) -> Region | None:
    from scope.cloud import parse_region

    return None if text is None else parse_region(text)[1]
