"""Every page and file says who made it, when, with what and of what."""

from __future__ import annotations

import hashlib
import html
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cli.main import app, threads_first
from scope.cloud import ScanCloud
from scope.origin import origin_of
from scope.report import signed
from scope.version import __version__
from tests.conftest import Session


def test_a_scan_and_its_page_say_where_they_come_from(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCOPE_OPERATOR", "")
    cloud, page = tmp_path / "cloud.ply", tmp_path / "scan.html"
    words = ["--operator", "A. <Smith>", "scan", str(session.capture), "--rig", str(session.rig), "-o", str(cloud)]
    done = CliRunner().invoke(app, [*words, "--report", str(page), "--json", "-q"])
    assert done.exit_code == 0, done.output
    digest = hashlib.sha256(session.rig.read_bytes()).hexdigest()
    told = json.loads(done.stdout)["origin"]
    assert (told["operator"], told["software"]) == ("A. <Smith>", f"SCOPE {__version__}")
    assert {"name": "rig.json", "sha256": digest} in told["inputs"]
    lines = dict(line.split(": ", 1) for line in ScanCloud.load(cloud).origin)
    assert lines["operator"] == "A. <Smith>"
    assert lines["limits asked"] == "none"
    assert lines["rig verified"].startswith("20")
    text = html.unescape(page.read_text(encoding="utf-8"))
    for words in ("A. <Smith>", f"rig.json, sha256 {digest[:16]}", "14 frames, sha256", lines["rig verified"]):
        assert words in text
    # it stays with the cloud: in every format that holds what is known of a cloud, and in the page of whoever measures it
    copy = tmp_path / "copy.pcd"
    assert CliRunner().invoke(app, ["export", str(cloud), str(copy)]).exit_code == 0
    assert ScanCloud.load(copy).origin == ScanCloud.load(cloud).origin


def test_nobody_need_be_named_and_what_is_no_file_is_no_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SCOPE_OPERATOR", raising=False)
    (tmp_path / "a").write_bytes(b"a")
    found = origin_of([tmp_path / "a", tmp_path / "none", None, tmp_path], frames=[tmp_path / "a"])
    assert found.operator == ""
    assert [name for name, _ in found.inputs] == ["a", "1 frames"]
    assert "operator" not in dict(found.told)
    assert signed("<p>no footer</p>", found) == "<p>no footer</p>"
    assert all(line.isascii() and "\n" not in line for line in found.lines)


def test_the_operator_may_be_named_after_the_command() -> None:
    line = ["scope", "check", "a.ply", "--operator", "B", "--threads=2", "-a", "plane"]
    assert threads_first(line) == ["scope", "--threads=2", "--operator", "B", "check", "a.ply", "-a", "plane"]
