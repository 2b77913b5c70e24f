"""Stepped plates, two or three levels in one image, through the commands: what no level can test is withheld, what holds is bounded."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.errors import FileError
from calibration.rig import Rig
from cli.main import app
from scope.design import design_rig
from scope.simulation import RigDesign, exact_rays, read_design, simulate
from scope.simulation.virtual_rig import VirtualRig

DESIGN = """
format = 1
[camera]
size = [480, 360]
focal_px = 600.0
centre_px = [242.0, 177.0]
distortion = [-0.12, 0.03, 0.0004, -0.0003, 0.0]
[laser]
origin = [0.0, -150.0, 8.0]
through = [0.0, 0.0, 390.0]
width = 0.5
roll = 3.0
[jig]
stand_offs = [400.0]
levels = LEVELS
rows = 10
columns = 18
pitch = 14.0
diameter = 6.0
images = 1
laser_images = 1
"""


def designed(folder: Path, levels: list[float]) -> Path:
    path = folder / "rig-design.toml"
    path.write_text(DESIGN.replace("LEVELS", str(levels)), encoding="utf-8")
    return path


@pytest.mark.parametrize("levels", [[0.0, 24.0], [0.0, 20.0, 40.0]])
def test_a_stepped_plate_passes_with_bounded_rays_and_no_figure_without_support(
    tmp_path: Path, levels: list[float]
) -> None:
    file = designed(tmp_path, levels)
    simulate(file, tmp_path / "s", 5)
    done = CliRunner().invoke(
        app, ["calibrate", str(tmp_path / "s/calibration.toml"), "-o", str(tmp_path / "rig.json"), "--json"]
    )
    result = json.loads(done.stdout)
    assert done.exit_code == 0, result["why"]
    assert [p["name"] for p in result["planes"]] == [f"w400-level{k}" for k in range(len(levels))]
    assert all(p["found"] == p["used"] >= 40 for p in result["planes"])  # marks listed to a pixel are all found
    assert all(p["heldout_mm"] is None for p in result["planes"])
    assert result["interplane_px"] is None
    assert all(p["heldout_why"] or len(levels) == 2 for p in result["planes"])
    assert result["lasers"]["laser"]["views"] == len(levels)
    rig, truth = Rig.load(tmp_path / "rig.json"), VirtualRig.of(read_design(file))
    u, v = np.meshgrid(np.arange(20.0, 460.0, 20.0), np.arange(20.0, 340.0, 20.0))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    for share in (0.2, 0.5, 0.8):  # what the levels together determine, where their pixels are not those of the depth
        depth = 400.0 - share * max(levels)
        true = exact_rays(truth.camera, pixels).at_depth(depth)
        off = rig.camera.rays(pixels).distance_to(true)[rig.camera.volume.contains(true)]
        assert len(off) > 50
        assert off.max() < 4.0 * result["ray_sigma_mm"]


@pytest.mark.parametrize(
    ("levels", "said"),
    [
        ([5.0], "two or more"),
        ([0.0, 0.0], "all different"),
        ([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0], "three columns a level"),
    ],
)
def test_levels_that_are_none_are_refused(tmp_path: Path, levels: list[float], said: str) -> None:
    with pytest.raises(FileError, match=said):
        read_design(designed(tmp_path, levels))


def test_a_stepped_plate_is_not_predicted(tmp_path: Path) -> None:
    design: RigDesign = read_design(designed(tmp_path, [0.0, 24.0]))
    with pytest.raises(FileError, match=r"jig\.levels.*simulate"):
        design_rig(design)
