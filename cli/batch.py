"""`scope batch`."""

from __future__ import annotations

import csv
import io
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli.console import (
    EXIT_NOT_TO_BE_USED,
    Jobs,
    Json,
    Quiet,
    Report,
    Scheduler,
    emit,
    progress,
    say,
    user_errors,
    write_page,
)

if TYPE_CHECKING:
    from scope.batch import Answer


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(batch)


def batch(
    captures: Annotated[
        list[str],
        typer.Argument(
            help="capture.toml of each session; patterns in quotes; clouds where --do begins without scan.",
            metavar="CAPTURE...",
        ),
    ],
    do: Annotated[str, typer.Option("--do", help='"scan; pose --model part.stl; check -a sphere:d=34"')] = "scan",
    rig: Annotated[Path | None, typer.Option("--rig", "-r", help="Calibrated rig.")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Table of the day: .csv or .parquet.")] = Path("day.csv"),
    jobs: Jobs = 1,
    scheduler: Scheduler = "",
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep rows of an earlier run whose files and options are the same.")
    ] = False,
    clouds: Annotated[Path | None, typer.Option("--clouds", help="Folder in which the clouds stay.")] = None,
    labels: Annotated[
        Path | None, typer.Option("--labels", help="CSV: session, then labels such as part and operator (gauge study).")
    ] = None,
    limits: Annotated[
        list[str] | None, typer.Option("--limits", help="COLUMN=LOW:HIGH, for the capability; may be repeated.")
    ] = None,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Scan and measure many sessions: one row each; a failing one does not stop the day. Exit 3 where any failed."""
    from dataclasses import replace

    from calibration.atomic import require_folder
    from scope.batch import (
        DayOptions,
        day_page,
        day_result,
        day_text,
        parse_steps,
        require_table,
        run_day,
        sessions_of,
        write_rows,
    )

    with user_errors():
        try:
            steps = parse_steps(do)
            require_table(out)
            bounds = dict(_limits(text) for text in limits or [])
            if steps[0].command == "scan" and rig is None:
                raise ValueError("--rig is missing: a scan needs the calibrated rig")
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error
        require_folder(out, report)
        if clouds is not None:
            require_folder(clouds / "cloud.ply")
        sources = sessions_of(captures)
        told = {} if labels is None else _labels(labels)
        options = DayOptions(jobs=jobs, scheduler=scheduler, resume=resume, clouds=clouds)
        with progress("sessions", quiet=quiet) as tick:
            day = run_day(sources, rig, steps, out, run_words, options=options, on_session=tick)
        if told:
            rows = tuple(
                {k: v for k, v in row.items() if not k.startswith("label.")} | told.get(str(row["session"]), {})
                for row in day.rows
            )
            day = replace(day, rows=rows)
            write_rows(out, rows)
        say(f"wrote {out}", quiet=quiet)
        write_page(report, lambda: day_page(day, f"SCOPE batch {out.stem}", bounds), [out, rig, labels], quiet=quiet)
    emit(day_result(day, bounds), as_json=as_json, text=day_text(day), inputs=[out, rig, labels])
    if day.failed or day.doubtful:
        raise typer.Exit(EXIT_NOT_TO_BE_USED)


def run_words(words: list[str]) -> Answer:
    """Run a command of `scope` in this process and give what it answered; a worker's part of a batch."""
    import json

    from cli.main import app
    from scope.batch import Answer

    out, err = io.StringIO(), io.StringIO()
    usage: Any = typer.BadParameter.__base__
    reason = ""
    with redirect_stdout(out), redirect_stderr(err):
        try:
            status = typer.main.get_command(app).main(args=words, prog_name="scope", standalone_mode=False) or 0
        except typer.Exit as stop:
            status = stop.exit_code
        except usage as error:
            status, reason = 2, str(error.format_message())
    try:
        result = json.loads(out.getvalue())
    except ValueError:
        result = None
    lines = err.getvalue().strip().splitlines()
    reason = reason or (lines[-1].removeprefix("error: ") if lines else _why(result))
    return Answer(int(status), result, "" if status == 0 else reason)


def _why(result: Any) -> str:
    """What a result says against itself, where nothing was said on stderr."""
    if isinstance(result, dict):
        if result.get("why"):
            return str(result["why"])
        if result.get("within") is False:
            return "out of tolerance"
    return "the result is not to be used"


def _limits(text: str) -> tuple[str, tuple[float, float]]:
    """Limits of ``COLUMN=LOW:HIGH``."""
    name, _, rest = text.rpartition("=")
    try:
        low, high = (float(part) for part in rest.split(":"))
    except ValueError as error:
        raise ValueError(f"--limits {text!r}: give COLUMN=LOW:HIGH") from error
    if not name or not low < high:
        raise ValueError(f"--limits {text!r}: give COLUMN=LOW:HIGH with LOW below HIGH")
    return name, (low, high)


def _labels(path: Path) -> dict[str, dict[str, str]]:
    """Labels by session."""
    from calibration.errors import FileError

    try:
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig")), strict=True))
    except (OSError, ValueError, csv.Error) as error:
        raise FileError(
            f"{path}: no table of labels could be read ({str(error)[:60]}); give session,part,operator"
        ) from error
    if not rows or "session" not in rows[0] or len(rows[0]) < 2:
        raise FileError(f"{path}: has no column session and labels beside it; the first line is session,part,operator")
    return {row["session"]: {f"label.{k}": v for k, v in row.items() if k and k != "session" and v} for row in rows}
