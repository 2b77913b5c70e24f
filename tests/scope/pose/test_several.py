"""Several clouds in one command are answered as each alone, and one that is bad stops nothing."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import parts
from calibration.geometry import Pose
from cli.main import app
from scope.cloud import ScanCloud
from scope.model import load_model
from scope.pose import estimate_pose, poses_of

pytest.importorskip("open3d")


@cache
def part() -> parts.Part:
    return parts.bracket()


@pytest.fixture
def day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, list[Path], list[Pose]]:
    """The bracket's mesh, three clouds of it (the second is no cloud), and where it was in the others."""
    monkeypatch.setenv("SCOPE_CACHE", str(tmp_path / "cache"))
    part().mesh().export(tmp_path / "part.stl")
    clouds, truth = [tmp_path / f"{name}.ply" for name in ("a", "b", "c")], []
    for seed, path in ((11, clouds[0]), (12, clouds[2])):
        rng = np.random.default_rng(seed)
        truth.append(parts.random_pose(part(), rng))
        parts.scan(part(), truth[-1], rng, scanner=parts.Scanner(points=6000)).save(path)
    clouds[1].write_bytes(b"no cloud\n")
    return tmp_path / "part.stl", clouds, truth


@pytest.mark.long
def test_each_of_several_is_answered_as_alone(day: tuple[Path, list[Path], list[Pose]], tmp_path: Path) -> None:
    mesh, clouds, truth = day
    words = ["pose", *map(str, clouds), "-m", str(mesh), "--json", "--deviation", str(tmp_path / "{cloud}-d.ply"), "-q"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 1, done.output
    told = json.loads(done.stdout)
    assert [row["status"] for row in told] == [0, 1, 0]
    assert [row["cloud"] for row in told] == list(map(str, clouds))
    assert "does not start with 'ply'" in told[1]["error"]
    known = load_model(mesh)
    for row, path, true in zip((told[0], told[2]), (clouds[0], clouds[2]), truth, strict=True):
        alone = estimate_pose(ScanCloud.load(path), known)
        assert alone.cloud_from_model is not None
        assert np.array_equal(row["cloud_from_model"], alone.cloud_from_model.matrix)
        assert np.abs(alone.cloud_from_model.apply(part().vertices) - true.apply(part().vertices)).max() < 0.2
        assert len(ScanCloud.load(tmp_path / f"{path.stem}-d.ply")) == row["points"]
    assert not (tmp_path / "b-d.ply").exists()


def test_the_model_is_prepared_once(day: tuple[Path, list[Path], list[Pose]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where nothing of it may be kept on disk."""
    from scope.pose import several

    calls = []
    monkeypatch.setattr(several, "load_model", lambda path: calls.append(path) or load_model(path))
    mesh, clouds, _ = day
    found = list(poses_of([clouds[1]] * 3, mesh))
    assert [each.status for each in found] == [1, 1, 1]
    assert len(calls) == 1


@pytest.mark.parametrize(
    ("names", "output", "said"),
    [(("a.ply", "c.ply"), "d.ply", "{cloud}"), (("a.ply", "x/a.ply"), "{cloud}.ply", "two clouds are called a")],
)
def test_outputs_that_would_overwrite_each_other_are_a_matter_of_usage(
    tmp_path: Path, names: tuple[str, ...], output: str, said: str
) -> None:
    words = ["pose", *names, "-m", "part.stl", "--deviation", str(tmp_path / output)]
    done = CliRunner().invoke(app, words, env={"COLUMNS": "400"})
    assert done.exit_code == 2
    assert said in done.output
