"""Flat patches that are there are found, with their borders; curved surfaces and edges are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cli.main import app
from scope.cloud import ScanCloud, parse_region
from scope.heightmap import flat_patches

RNG = np.random.default_rng(8)


def patch(
    x: tuple[float, float], y: tuple[float, float], z: float, *, tilt: float = 0.0, rough: float = 0.0
) -> np.ndarray:
    """Points 0.3 mm apart, with noise of 0.01 mm and perhaps texture of a correlation length of about 1 mm."""
    u, v = (a.ravel() for a in np.meshgrid(np.arange(*x, 0.3), np.arange(*y, 0.3)))
    texture = rough * np.sqrt(2.0) * np.sin(u / 0.6 + RNG.uniform(0, 6)) * np.sin(v / 0.7) * np.sqrt(2.0)
    return np.column_stack([u, v, z + tilt * (u - x[0]) + texture + 0.01 * RNG.standard_normal(len(u))])


def test_three_faces_are_three_patches() -> None:
    faces = [
        ((0, 40), (0, 30), 300.0, 0.0, 0.0),
        ((45, 75), (0, 30), 290.0, 0.3, 0.0),
        ((0, 25), (35, 55), 295.0, 0.0, 0.05),
    ]
    cloud = np.concatenate([patch(x, y, z, tilt=tilt, rough=rough) for x, y, z, tilt, rough in faces])
    found = flat_patches(RNG.permutation(cloud))
    assert len(found) == 3
    areas = [p.size[0] * p.size[1] for p in found]
    assert areas == sorted(areas, reverse=True)
    for each in found:
        region = parse_region(each.region)[1]
        assert region is not None
        inside = cloud[region.contains(cloud)]
        home = [
            k
            for k, (x, y, *_) in enumerate(faces)
            if ((inside[:, 0] >= x[0]) & (inside[:, 0] < x[1]) & (inside[:, 1] >= y[0]) & (inside[:, 1] < y[1])).all()
        ]
        assert len(home) == 1, each.region  # of one face alone
        x, y, *_ = faces[home[0]]
        assert each.size[0] * each.size[1] > 0.6 * (x[1] - x[0]) * (y[1] - y[0])
        assert len(inside) >= 0.99 * each.points


def test_a_ball_is_no_flat_patch_and_few_points_are_none() -> None:
    u, v = (a.ravel() for a in np.meshgrid(np.arange(-20, 20, 0.3), np.arange(-20, 20, 0.3)))
    inside = np.hypot(u, v) < 18
    ball = np.column_stack([u, v, 300.0 - np.sqrt(np.maximum(400.0 - u**2 - v**2, 0.0))])[inside]
    assert flat_patches(ball) == ()
    assert flat_patches(ball[:500]) == ()
    assert flat_patches(np.tile([[1.0, 2.0, 3.0]], (2000, 1))) == ()


def test_the_command_says_what_it_took_and_names_what_it_saw(tmp_path: Path) -> None:
    """A step is refused, with the patches to either side; one of them, named, is measured and says nothing."""
    both = np.concatenate([patch((0, 20), (0, 20), 300.0), patch((20, 40), (0, 20), 305.0)])
    ScanCloud.from_points(both).save(tmp_path / "c.ply")
    done = CliRunner().invoke(app, ["roughness", str(tmp_path / "c.ply")])
    assert done.exit_code == 1
    regions = [word.strip(",") for word in done.output.split() if word.startswith("box:")]
    assert len(done.output) < 300
    assert len(regions) == 2
    named = CliRunner().invoke(app, ["roughness", str(tmp_path / "c.ply"), "--region", regions[0]])
    assert named.exit_code in {0, 3}, named.output
    assert "no --region" not in named.output
    alone = tmp_path / "one.ply"
    ScanCloud.from_points(both[: len(both) // 2]).save(alone)
    page = tmp_path / "r.html"
    whole = CliRunner().invoke(app, ["roughness", str(alone), "--report", str(page)])
    assert "the whole cloud is taken for one surface; flat patches in it: box:" in whole.output
    assert "No --region was given" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_do_not_matter(scale: float) -> None:
    cloud = patch((0, 40), (0, 30), 300.0) * scale
    assert len(flat_patches(cloud)) == 1
