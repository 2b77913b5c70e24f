"""Points with figures of their own, in the readers of others: every number comes back, and the colours say its sign."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.exports import READERS, installed
from cli.main import app
from scope.cloud import ScanCloud
from scope.export import require_scalars, write_scalars
from scope.export.scalars import ENDINGS, colours

RNG = np.random.default_rng(5)
POINTS = RNG.uniform(-50, 50, (40, 3)).astype(np.float32).astype(np.float64)
OFF = np.concatenate([[np.nan], RNG.normal(0, 0.1, 39)]).astype(np.float32)
UNKNOWN = {("pymeshlab", ".ply"): 0.0}  # MeshLab has no NaN for a quality


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_reader_gives_the_numbers_back(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"d{ending}"
    write_scalars(path, POINTS, {"deviation": OFF, "sigma": np.abs(OFF)}, ("deviation from part.stl, mm",))
    for reader, (_, endings, read) in READERS.items():
        if ending not in endings or not installed(reader) or reader == "SCOPE":
            continue
        found = read(path)
        assert np.abs(np.stack([found[axis] for axis in "xyz"], axis=1) - POINTS).max() < 1e-4, reader
        names = {"quality", "deviation", "scalar_deviation"} & set(found)
        if (reader, ending) == ("pyvista", ".ply"):
            continue  # VTK's reader takes no scalars from a PLY
        assert names, reader
        for name in names:
            known = np.isfinite(OFF)
            assert np.asarray(found[name])[known] == pytest.approx(OFF[known], rel=1e-6), (reader, name)
    assert len(ScanCloud.load(path)) == 40 if ending != ".vtp" else True


def test_colours_are_grey_unknown_blue_below_red_above() -> None:
    red, green, blue = colours([np.nan, -1.0, 0.0, 1.0, 9.0]).T.astype(int)
    assert red[0] == green[0] == blue[0]
    assert blue[1] > red[1]
    assert min(red[2], green[2], blue[2]) > 240
    assert red[4] > blue[4]
    assert (colours([np.nan, np.nan]) == colours([np.nan])[0]).all()


def test_what_cannot_be_written_is_an_argument(tmp_path: Path) -> None:
    require_scalars(None)
    with pytest.raises(ValueError, match=r"\.ply, \.pcd"):
        require_scalars(Path("d.stl"))
    with pytest.raises(ValueError, match="one for each of 40"):
        write_scalars(tmp_path / "d.ply", POINTS, {"deviation": OFF[:3]})
    assert list(tmp_path.iterdir()) == []


def test_check_and_roughness_write_theirs(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(0, 12, 0.2), np.arange(0, 12, 0.2))
    z = 300.0 + RNG.normal(0, 0.01, x.shape)
    ScanCloud.from_points(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)).save(tmp_path / "a.ply")
    np.save(tmp_path / "h.npy", z - 300.0)
    run = CliRunner()
    done = run.invoke(
        app,
        [
            "check",
            str(tmp_path / "a.ply"),
            "-a",
            "plane",
            "--deviation",
            str(tmp_path / "{cloud}-d.ply"),
            "--json",
            "-q",
        ],
    )
    assert done.exit_code == 0, done.output
    off = READERS["plyfile"][2](tmp_path / "a-d.ply")["deviation"]
    assert np.sqrt(np.mean(off.astype(float) ** 2)) == pytest.approx(json.loads(done.stdout)["rms_mm"], rel=1e-4)
    done = run.invoke(
        app, ["roughness", str(tmp_path / "h.npy"), "--pitch", "0.2", "--map", str(tmp_path / "m.vtp"), "--json", "-q"]
    )
    assert (tmp_path / "m.vtp").is_file(), done.output
    for words in (["check", "a.ply", "-a", "plane", "--deviation", "x.stl"], ["roughness", "h.npy", "--map", "x.las"],
                  ["check", "a.ply", "b.ply", "-a", "plane", "--deviation", "x.ply"]):  # fmt: skip
        assert run.invoke(app, words).exit_code == 2
