"""`scope cameras`, `scope console` and `scope history`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli.console import Json, Quiet, emit, say, user_errors

if TYPE_CHECKING:
    from scope.cameras import CameraInfo
    from scope.session import CameraSettings


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(cameras)
    app.command()(console)
    app.command()(history)


def cameras(
    producer: Annotated[
        Path | None, typer.Option("--producer", help="GenTL producer (.cti) whose cameras are listed too.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """List the cameras that are connected: what [camera] calls driver and id, with model and size."""
    from scope.cameras import list_cameras

    with user_errors():
        found, silent = list_cameras(None if producer is None else str(producer))
    for line in silent:
        say(line, quiet=quiet)
    emit([camera.result for camera in found], as_json=as_json, text=_table(found))


def _table(found: list[CameraInfo]) -> str:
    if not found:
        return 'no camera found; driver = "simulated" and driver = "replay" need none'
    rows = [("driver", "id", "model", "size")]
    rows += [(c.driver, c.id, c.model, "" if c.size is None else f"{c.size[0]} x {c.size[1]}") for c in found]
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    return "\n".join(
        "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def console(
    session: Annotated[Path, typer.Option("--session", help="Folder of everything that is read and made.")] = Path(
        "session"
    ),
    rig: Annotated[Path | None, typer.Option("--rig", "-r", help="Calibrated rig, copied into the session.")] = None,
    camera: Annotated[
        str | None, typer.Option("--camera", help="DRIVER or DRIVER:ID as `scope cameras` lists them, such as v4l2:0.")
    ] = None,
    replay: Annotated[
        Path | None, typer.Option("--replay", help="Folder of images or video instead of a camera.")
    ] = None,
    simulate: Annotated[Path | None, typer.Option("--simulate", help="rig-design.toml: no hardware at all.")] = None,
    port: Annotated[int, typer.Option("--port", min=1, max=65535)] = 8765,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; any but this machine's own asks for a token.")
    ] = "127.0.0.1",
    token: Annotated[
        str | None, typer.Option("--token", help="16 characters or more; one is made where others may call.")
    ] = None,
    show: Annotated[bool, typer.Option("--show/--no-show", help="Open a browser.")] = True,
    no_history: Annotated[bool, typer.Option("--no-history", help="Keep no records.")] = False,
    quiet: Quiet = False,
) -> None:
    """Watch the camera, calibrate, scan and measure in a browser; docs/security.md tells who may call."""
    from scope.console import Address, Console, SessionFolder, serve

    with user_errors():
        try:
            address = Address.of(host, port, token)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error
        folder = SessionFolder.open(session)
        settings, motion = _camera(folder.calibration, camera, replay, simulate)
        if rig is not None:
            _take_rig(rig, folder.rig)
        made = Console.open(folder, settings, motion, history=not no_history)
        try:
            serve(made, address, on_ready=lambda link: _tell(link, quiet=quiet), show=show)
        finally:
            made.close()


def history(
    database: Annotated[Path, typer.Option("--db", help="The file beside the results.")] = Path("history.db"),
    kind: Annotated[str | None, typer.Option("--kind", help="calibrate, verify, scan, check only.")] = None,
    table: Annotated[Path | None, typer.Option("--csv", help="Write all records and figures as CSV.")] = None,
    chart: Annotated[
        str | None, typer.Option("--chart", help="Limits and trend of this figure, such as heldout_mm.")
    ] = None,
    limit: Annotated[
        float | None, typer.Option("--limit", help="What the figure may reach: tells when it will.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Print what was calibrated, verified, scanned and checked, and what drifts."""
    from calibration.atomic import require_folder, write_text
    from calibration.errors import FileError
    from scope.history import Journal, chart_of, records_csv

    with user_errors():
        require_folder(table)
        if not database.is_file():
            raise FileError(f"{database}: is not there; name the history.db beside the results with --db")
        records = Journal(database).records(kind=kind)
        if table is not None:
            write_text(table, records_csv(records))
            say(f"wrote {table}", quiet=quiet)
    lines = [
        f"{r.when}  {'passed    ' if r.passed else 'NOT PASSED'}  {r.kind:9}  {_figures(r.figures)}  {r.file}".rstrip()
        for r in records
    ]
    if chart is None:
        emit([record.content for record in records], as_json=as_json, text="\n".join(lines) or "no records")
        return
    found = chart_of(chart, records, limit=limit)
    told: dict[str, Any] = {"name": chart, "values": list(found.values), "when": list(found.when), "centre": found.centre, "low": found.low,
                            "high": found.high, "outside": list(found.outside), "slope": found.slope, "recalibrate_by": found.recalibrate_by}  # fmt: skip
    text = f"{chart}: {len(found.values)} values, mean {found.centre:.5g}, limits {found.low:.5g} to {found.high:.5g}, {len(found.outside)} outside"
    emit(
        told,
        as_json=as_json,
        text=text + (f"; calibrate again by {found.recalibrate_by}" if found.recalibrate_by else ""),
    )


def _figures(figures: Any) -> str:
    return ", ".join(f"{name} {value:.5g}" for name, value in figures.items() if "normal" not in name)


def _tell(link: str, *, quiet: bool) -> None:
    typer.echo(link)
    say("press Ctrl-C to end", quiet=quiet)


def _camera(
    calibration: Path, camera: str | None, replay: Path | None, simulate: Path | None
) -> tuple[CameraSettings, dict[str, Any]]:
    """Camera of the console, and the motion it offers; writes the calibration.toml of a virtual rig where there is none."""
    from calibration.atomic import write_text
    from calibration.errors import FileError
    from scope.session import DRIVERS, CameraSettings, planned_camera
    from scope.simulation import planned_session

    if sum(given is not None for given in (camera, replay, simulate)) > 1:
        raise typer.BadParameter("give one of --camera, --replay and --simulate")
    motion: dict[str, Any] = {
        "kind": "linear",
        "moves": "object",
        "direction": [1.0, 0.0, 0.0],
        "step": 0.5,
        "start": 0.0,
    }
    if simulate is not None:
        text, motion = planned_session(simulate)
        if not calibration.is_file():
            write_text(calibration, text)
        return CameraSettings("simulated", str(simulate.resolve())), motion
    if replay is not None:
        return CameraSettings("replay", str(replay.resolve())), motion
    said = planned_camera(calibration) if calibration.is_file() else None
    if camera is None:
        if said is None:
            raise FileError(
                "no camera is named; give --camera (see scope cameras), --replay or --simulate, or a [camera] in the session's calibration.toml"
            )
        return said, motion
    driver, _, identity = camera.partition(":")
    if driver not in DRIVERS or driver in {"replay", "simulated", "genicam"}:
        raise typer.BadParameter(
            f"--camera {camera!r}: use aravis, basler or v4l2, with :ID; others by [camera] in calibration.toml"
        )
    if said is not None and said.driver == driver and identity in ("", said.id):
        return said, motion
    return CameraSettings(driver, identity), motion


def _take_rig(rig: Path, place: Path) -> None:
    """Copy a rig into the session, after it was read."""
    from calibration.atomic import written_whole
    from calibration.rig import Rig

    Rig.load(rig)
    if rig.resolve() != place.resolve():
        with written_whole(place) as stream:
            stream.write(rig.read_bytes())
