"""Laws of a day: the same table whatever the workers, no session lost, nothing done twice that has not changed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.batch import pretend, without_times
from calibration.errors import FileError
from cli.main import app
from scope.batch import (
    DayOptions,
    Job,
    day_page,
    day_result,
    parse_steps,
    read_rows,
    run_day,
    run_session,
    sessions_of,
    write_rows,
)
from scope.batch.figures import figures_of
from scope.batch.journal import journal_of
from scope.batch.session import digest_of
from tests.conftest import Session

STEPS = parse_steps("check -a plane")
ORDERS = ("", "fail", "", "die", "doubt", "")


def sources(folder: Path) -> list[Path]:
    paths = [folder / f"cloud{k}.ply" for k in range(len(ORDERS))]
    for path, order in zip(paths, ORDERS, strict=True):
        path.write_text(order, encoding="utf-8")
    return paths


def attempts(paths: list[Path]) -> list[int]:
    return [
        len(p.with_suffix(".count").read_text(encoding="utf-8")) if p.with_suffix(".count").exists() else 0
        for p in paths
    ]


@pytest.mark.long
def test_a_day_on_workers(tmp_path: Path) -> None:
    """One fails, one is doubtful, one ends its worker: all have their rows, in order, whatever the number of workers."""
    pytest.importorskip("distributed")
    paths, table = sources(tmp_path), tmp_path / "day.csv"
    day = run_day(paths, None, STEPS, table, pretend, options=DayOptions(jobs=2))
    rows = read_rows(table)
    assert [row["session"] for row in rows] == list(map(str, paths))
    assert [row["status"] for row in rows] == ["0", "1", "0", "0", "3", "0"]
    assert (day.failed, day.doubtful, day.kept) == (1, 1, 0)
    tried = attempts(paths)
    assert tried[3] == 2
    assert set(tried) <= {1, 2}  # an answer that was still with the worker that died is worked out again
    assert day.retried >= 1
    assert "is bad" in str(rows[1]["reason"])
    assert not journal_of(table).exists()
    told = day_result(day)
    assert (told["sessions"], told["failed"], told["not_to_be_used"]) == (6, 1, 1)
    assert told["figures"]["check.value_mm"]["n"] == 5
    assert "check.seconds" not in told["figures"]
    assert "2 not" not in (page := day_page(day, "Day"))
    assert "<svg" in page

    # one worker, begun anew: the same table; resumed: nothing is done again but what has changed
    first = without_times(table)
    run_day(paths, None, STEPS, table, pretend, options=DayOptions(jobs=1))
    assert without_times(table) == first
    tried = attempts(paths)
    paths[2].write_text("doubt", encoding="utf-8")
    again = run_day(paths, None, STEPS, table, pretend, options=DayOptions(jobs=1, resume=True))
    assert [after - before for before, after in zip(tried, attempts(paths), strict=True)] == [0, 0, 1, 0, 0, 0]
    assert (again.kept, again.doubtful) == (5, 2)
    paths[2].write_text("", encoding="utf-8")
    run_day(paths, None, STEPS, table, pretend, options=DayOptions(jobs=1, resume=True))
    assert without_times(table) == first

    # a run that was stopped: its journal holds what was done, the last line cut
    text = [json.dumps(row) for row in read_rows(table)[:4]]
    journal_of(table).write_text("\n".join(text) + '\n{"session": "clo', encoding="utf-8")
    table.unlink()
    resumed = run_day(paths, None, STEPS, table, pretend, options=DayOptions(jobs=1, resume=True))
    assert resumed.kept == 4
    assert without_times(table) == first


def test_a_scheduler_that_does_not_answer_is_told_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("scope.batch.cluster.GREETING", 2.0)
    with pytest.raises(FileError, match="no Dask scheduler answers"):
        run_day(
            sources(tmp_path),
            None,
            STEPS,
            tmp_path / "day.csv",
            pretend,
            options=DayOptions(scheduler="tcp://127.0.0.1:9"),
        )


@pytest.mark.long
def test_a_scheduler_that_runs_already_gives_the_same(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    paths, tables = sources(tmp_path), [tmp_path / "there.csv", tmp_path / "here.csv"]
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0", silence_logs=50)
    try:
        run_day(paths, None, STEPS, tables[0], pretend, options=DayOptions(scheduler=cluster.scheduler_address))
    finally:
        cluster.close()
    run_day(paths, None, STEPS, tables[1], pretend)
    assert without_times(tables[0]) == without_times(tables[1])


def test_the_digest_sees_every_input(copy_of_session: Callable[[], Session], tmp_path: Path) -> None:
    session = copy_of_session()
    model = tmp_path / "part.stl"
    model.write_bytes(b"a")
    job = Job(0, str(session.capture), str(session.rig), parse_steps(f"scan; pose --model {model}"))
    seen = {digest_of(job)}
    frame = sorted((session.folder / "frames").glob("*.png"))[3]
    changes: tuple[Callable[[], object], ...] = (
        lambda: model.write_bytes(b"b"),
        lambda: frame.write_bytes(frame.read_bytes() + b"\0"),
        lambda: frame.with_name("99.png").write_bytes(frame.read_bytes()),
        lambda: session.rig.write_text(session.rig.read_text() + " "),
        lambda: session.capture.write_text(session.capture.read_text() + "\n"),
    )
    for k, change in enumerate(changes):
        change()
        seen.add(digest_of(job))
        assert len(seen) == k + 2
    assert digest_of(job) in seen
    assert digest_of(replace(job, steps=parse_steps("scan --normals"))) not in seen
    assert digest_of(replace(job, number=5, keep="/x", done="y")) in seen


def test_the_command_on_a_simulated_session(session: Session, tmp_path: Path) -> None:
    """Exit 3 and a row each: one good, one whose capture names no images; the good one's figures are the commands' own."""
    pytest.importorskip("distributed")
    bad = tmp_path / "bad" / "capture.toml"
    bad.parent.mkdir()
    bad.write_text(session.capture.read_text(), encoding="utf-8")
    do = "scan; check -a sphere:d=40 --region box:-60,-10,-30,30"
    words = [
        "batch",
        str(session.capture),
        str(bad),
        "--rig",
        str(session.rig),
        "--do",
        do,
        "-o",
        str(tmp_path / "day.csv"),
        "--json",
        "-q",
    ]
    done = CliRunner().invoke(app, [*words, "--report", str(tmp_path / "day.html"), "--clouds", str(tmp_path)])
    assert done.exit_code == 3, done.output
    told = json.loads(done.stdout)
    assert (told["sessions"], told["failed"]) == (2, 1)
    good, failed = read_rows(tmp_path / "day.csv")
    assert (good["status"], failed["status"]) == ("0", "1")
    assert "bad/capture.toml" in str(failed["reason"])
    check = CliRunner().invoke(
        app, ["check", str(tmp_path / "rendered.ply"), "-a", "sphere:d=40", "--region", "box:-60,-10,-30,30", "--json"]
    )
    assert float(str(good["check.error_mm"])) == json.loads(check.stdout)["error_mm"]
    assert (tmp_path / "day.html").read_text(encoding="utf-8").startswith("<!")


@pytest.mark.parametrize(
    ("text", "said"),
    [("", "no step"), ("calibrate", "the steps are"), ("check -a plane; scan", "first"), ("scan -o x.ply", "-o"),
     ("scan; pose --report=x.html", "--report"), ("scan; pose 'x", "quotation")],
)  # fmt: skip
def test_steps_that_are_none(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        parse_steps(text)


def test_files_in_steps_are_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "part.stl").write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    here = str((tmp_path / "part.stl").resolve())
    scan, pose, rough, check, more = parse_steps(
        "scan; pose --model part.stl; roughness --region top=mesh:part.stl; check -a mesh:part.stl; pose --model=part.stl"
    )
    assert pose.options == ("--model", here)
    assert rough.options == ("--region", f"top=mesh:{here}")
    assert check.options == ("-a", f"mesh:{here}")
    assert more.options == (f"--model={here}",)
    assert [step.label for step in (scan, pose, rough, check, more)] == ["scan", "pose", "roughness", "check", "pose2"]
    assert rough.files == (here,)


def test_figures_have_their_uncertainty_beside_them() -> None:
    patch = {"name": "top", "areal": {"Sq": {"value": 1.5, "uncertainty": 0.1, "unit": "um"}}, "pitch_mm": [0.1, 0.2]}
    told = figures_of("roughness", "roughness", {"patches": [patch], "seconds": 3.0, "notes": ["a", "b"]})
    assert told == {
        "roughness.patches.top.areal.Sq": 1.5, "roughness.patches.top.areal.Sq.u": 0.1,
        "roughness.patches.top.pitch_mm.0": 0.1, "roughness.patches.top.pitch_mm.1": 0.2, "roughness.notes": "a; b",
    }  # fmt: skip
    pose = figures_of("pose", "pose", {"found": False, "why": "no", "notations": {}, "covariance": None})
    assert pose["pose.x_mm"] is None
    assert pose["pose.why"] == "no"


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_tables_come_back(tmp_path: Path, ending: str) -> None:
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    head = {"session": 'a,"b"\nc', "status": 0, "reason": "", "seconds": 1.5, "digest": "d"}
    rows = [head | {"x": 0.1 + 0.2, "ok": True}, head | {"session": "z", "word": "für", "x": float("nan")}]
    write_rows(tmp_path / f"t.{ending}", rows)
    back = read_rows(tmp_path / f"t.{ending}")
    assert [row["session"] for row in back] == ['a,"b"\nc', "z"]
    assert float(back[0]["x"]) == 0.1 + 0.2
    assert "x" not in back[1]
    assert back[1]["word"] == "für"
    write_rows(tmp_path / f"u.{ending}", back)
    if ending == "csv":
        assert (tmp_path / "u.csv").read_bytes() == (tmp_path / "t.csv").read_bytes()
    (tmp_path / f"n.{ending}").write_bytes(b"no,table\n1\n")
    with pytest.raises(FileError, match=rf"n\.{ending}"):
        read_rows(tmp_path / f"n.{ending}")


def test_sessions_of_patterns(tmp_path: Path) -> None:
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "capture.toml").write_text("")
    a, b = (tmp_path / name / "capture.toml" for name in "ab")
    assert sessions_of([str(tmp_path / "*" / "capture.toml"), str(b)]) == [a, b]
    assert sessions_of([str(b), str(tmp_path / "*" / "capture.toml")]) == [b, a]
    with pytest.raises(FileError, match="no such file"):
        sessions_of([str(tmp_path / "c*")])


def test_a_session_whose_files_are_gone_has_a_row() -> None:
    outcome = run_session(Job(0, "gone.ply", "", STEPS), pretend)
    assert outcome.status == 1
    assert "gone.ply" in outcome.reason


@pytest.mark.parametrize(
    "words", [["--do", "scan"], ["--do", "pose -m x", "-o", "day.txt"], ["--do", "pose", "--limits", "x=2:1"]]
)
def test_a_wrong_command_line_is_a_matter_of_usage(words: list[str]) -> None:
    assert CliRunner().invoke(app, ["batch", "none.toml", *words]).exit_code == 2
