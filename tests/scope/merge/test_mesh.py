"""Meshes: closed where seen all around, open where not, near the points, and with the volume that is known."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from calibration.errors import FileError
from calibration.geometry import Pose
from cli.main import app
from scope.merge import merge, reconstruct, require_mesh_format
from tests.scope.merge.test_merge import NOISE, scan


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(5, 25)
    rng = np.random.default_rng(1)
    views = [v for axis in np.eye(3) for v in (axis + 0.01, -axis + 0.01)]
    scans = [scan(mesh, view, rng, cells=60, half=27.0) for view in views]
    return merge(scans, [f"v{k}" for k in range(6)], poses=[Pose.identity()] * 6).cloud, scans[0]


def test_seen_all_around_it_is_closed(ball):
    found = reconstruct(ball[0], "ball")
    assert found.watertight
    assert found.volume == pytest.approx(4 / 3 * np.pi * 25**3, rel=0.005)
    assert found.rms_mm < 2 * NOISE
    radius = np.linalg.norm(found.vertices, axis=1)
    assert abs(radius.mean() - 25) < 0.02


def test_seen_from_one_side_it_is_open_and_nothing_is_made_up(ball):
    found = reconstruct(ball[1], "half")
    assert not found.watertight
    assert np.isnan(found.volume)
    away = np.array([np.linalg.norm(ball[1].points - v, axis=1).min() for v in found.vertices[::20]])
    assert away.max() < 4.0  # mm; points stand 0.9 mm apart, at the limb more
    assert found.uncovered < 0.01


def test_the_command(ball, tmp_path):
    ball[0].save(tmp_path / "ball.ply")
    done = CliRunner().invoke(
        app, ["mesh", str(tmp_path / "ball.ply"), "-o", str(tmp_path / "ball.stl"), "--json", "-q"]
    )
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["watertight"]
    back = trimesh.load(tmp_path / "ball.stl")
    assert len(back.faces) == told["triangles"]
    assert back.volume > 0  # outwards
    with pytest.raises(FileError, match="stl"):
        require_mesh_format(tmp_path / "ball.step")
