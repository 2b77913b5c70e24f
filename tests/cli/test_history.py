"""Commands record what they give, unless told not to; `scope history` prints it."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from scope.history import Journal

ROOT = Path(__file__).resolve().parents[2]


def scope(*words: object, **environment: str) -> tuple[int, str, str]:
    kept = {key: value for key, value in os.environ.items() if key != "SCOPE_HISTORY"}
    done = subprocess.run(
        [sys.executable, "-c", "from cli.main import main; main()", *map(str, words)],
        env={**kept, "PYTHONPATH": str(ROOT), **environment}, capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def test_commands_record_and_history_prints(copy_of_session: Any, tmp_path: Path) -> None:
    session = copy_of_session()
    cloud = session.folder / "cloud.ply"
    assert scope("scan", session.capture, "--rig", session.rig, "-o", cloud, "-q")[0] == 0
    scope("check", cloud, "--artefact", "sphere:d=40", "-q")
    assert scope("verify", session.rig, "-q")[0] == 0
    database = session.folder / "history.db"
    found = Journal(database).records()
    assert [record.kind for record in found] == ["scan", "check", "verify"]
    assert found[0].figures["points"] > 1000
    assert len({record.rig for record in found}) == 1
    status, told, _ = scope("history", "--db", database, "--json", "--csv", tmp_path / "all.csv")
    records = json.loads(told)
    assert status == 0
    assert {"when", "kind", "rig", "passed", "figures"} <= set(records[0])
    with (tmp_path / "all.csv").open(encoding="utf-8") as stream:
        assert [row["kind"] for row in csv.DictReader(stream)] == ["scan", "check", "verify"]


@pytest.mark.parametrize(("words", "environment"), [(["--no-history"], {}), ([], {"SCOPE_HISTORY": "off"})])
def test_told_not_to_they_write_none(copy_of_session: Any, words: list[str], environment: dict[str, str]) -> None:
    session = copy_of_session()
    assert scope("verify", session.rig, *words, "-q", **environment)[0] == 0
    assert not (session.folder / "history.db").exists()


def test_a_history_that_cannot_be_written_spoils_nothing(copy_of_session: Any) -> None:
    session = copy_of_session()
    (session.folder / "history.db").write_bytes(b"something else" * 1000)
    status, told, talk = scope("verify", session.rig, "--json", "-q")
    assert status == 0
    assert json.loads(told)["passed"]
    assert talk.startswith("not recorded: ")
    assert talk.count("\n") == 1


def test_a_history_that_is_not_there_is_told_in_one_line(tmp_path: Path) -> None:
    status, told, talk = scope("history", "--db", tmp_path / "none.db")
    assert (status, told) == (1, "")
    assert talk.startswith("error: ")
    assert talk.count("\n") == 1
