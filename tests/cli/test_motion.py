"""A capture in which nothing moved, said so: scanned, and measured by nobody."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cli.main import app


@pytest.fixture(scope="module")
def still(session, tmp_path_factory: pytest.TempPathFactory) -> Path:  # type: ignore[no-untyped-def]
    folder = tmp_path_factory.mktemp("still") / "s"
    shutil.copytree(session.folder, folder, ignore=shutil.ignore_patterns("truth"))
    text = (folder / "capture.toml").read_text(encoding="utf-8").split("[motion]")[0]
    (folder / "capture.toml").write_text(f'{text}[motion]\nkind = "fixed"\n', encoding="utf-8")
    asked = ["scan", str(folder / "capture.toml"), "--rig", str(folder / "rig.json"), "-o", str(folder / "c.ply")]
    assert CliRunner().invoke(app, asked).exit_code == 0
    import trimesh

    trimesh.creation.icosphere(radius=20.0).export(folder / "ball.stl")
    return folder


@pytest.mark.parametrize(
    "asked", [["check", "-a", "plane", "--tolerance", "0.01"], ["roughness"], ["pose", "-m", "ball.stl"]]
)
def test_a_cloud_in_one_sheet_is_measured_by_nobody(
    still: Path, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(still)
    done = CliRunner().invoke(app, [asked[0], "c.ply", *asked[1:], "--json"])
    assert (done.exit_code, done.stdout) == (1, "")
    assert "sheet of light" in done.stderr
    assert len(done.stderr.splitlines()) == 1
