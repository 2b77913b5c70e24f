"""Scans in one frame: the right place or none, columns that go with the points, and disagreement that is told."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from calibration.errors import FileError
from calibration.geometry import Pose
from cli.main import app
from scope.cloud import ScanCloud, Sensors
from scope.merge import merge, read_poses

NOISE = 0.02


def part():
    """A block with a smaller one and a pin on it: nothing of it repeats."""
    base, top = trimesh.creation.box((60, 40, 25)), trimesh.creation.box((20, 20, 20))
    pin = trimesh.creation.cylinder(8, 30, sections=64)
    top.apply_translation((10, 5, 20))
    pin.apply_translation((-18, -6, 14))
    return trimesh.util.concatenate([base, top, pin])


def scan(mesh, view, rng, *, cells=110, half=45.0, sensors=True):
    """Points that a camera 300 mm away in direction ``view`` sees, in the frame of the part, by trimesh's own rays."""
    z = np.asarray(view, dtype=float) / np.linalg.norm(view)
    x = np.cross(z, [0.3, 0.5, 0.8])
    x /= np.linalg.norm(x)
    camera = 300.0 * z
    u, v = (a.ravel() for a in np.meshgrid(*[np.linspace(-half, half, cells)] * 2))
    ray = u[:, None] * x + v[:, None] * np.cross(z, x) - camera
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32))
    )
    rays = np.concatenate([np.broadcast_to(camera, ray.shape), ray], axis=1).astype(np.float32)
    away = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy().astype(float)
    seen = np.isfinite(away)
    points = camera + (away[seen] + rng.normal(0, NOISE, int(seen.sum())))[:, None] * ray[seen]
    cloud = replace(
        ScanCloud.from_points(points),
        sigma=np.full(len(points), NOISE, np.float32),
        sigma_cal=np.full(len(points), 0.01, np.float32),
    )
    if not sensors:
        return cloud
    one = Sensors(
        np.zeros(1, np.int32), np.zeros(1, np.uint8), camera[None], np.array([[1.0, 0, 0, 0]]), np.full((1, 3), np.nan)
    )
    return replace(
        cloud,
        sensors=one,
        camera_centre=np.zeros(3),
        rig_sha256="ab",
        pixels=np.column_stack([u, v])[seen].astype(np.float32) + 100,
    )


def moved(cloud, pose):
    sensors = cloud.sensors
    if sensors is not None:
        turn = Rotation.from_matrix(pose.rotation).as_quat(scalar_first=True)[None]
        sensors = replace(sensors, centre=pose.apply(sensors.centre), rotation=turn)
    return replace(cloud, points=pose.apply(cloud.points), sensors=sensors)


VIEWS = [(1, 0.3, 0.9), (-0.2, 1, 0.9), (-1, -0.2, 0.8), (0.1, -1, 0.9)]


@pytest.fixture(scope="module")
def scans():
    rng = np.random.default_rng(3)
    mesh = part()
    return [scan(mesh, view, rng) for view in VIEWS]


def test_unknown_poses_are_found(scans):
    rng = np.random.default_rng(3)
    away = [Pose(Rotation.random(random_state=k).as_matrix(), rng.normal(0, 100, 3)) for k in range(4)]
    found = merge([moved(c, p) for c, p in zip(scans, away, strict=True)], list("abcd"))
    assert found.poses is not None, found.why
    assert found.passed
    corners = np.array([[30.0, 20, 12], [-30, -20, 0], [0, 0, 20]])
    for pose, there in zip(found.poses, away, strict=True):
        back = (pose @ there).apply(corners) - away[0].apply(corners)
        assert np.abs(back).max() < 0.15  # mm, of noise 0.02 and faces that nearly slide
    assert found.disagreement_mm < 3 * NOISE
    assert len(found.cloud) == sum(len(c) for c in scans)


def test_columns_and_sensors_go_with_the_points(scans, tmp_path):
    turn = Pose(Rotation.from_euler("xyz", [0.2, -0.1, 0.4]).as_matrix(), np.array([5.0, -3, 8]))
    found = merge([scans[0], moved(scans[1], turn.inverse)], ["a", "b"], poses=[Pose.identity(), turn])
    found.cloud.save(tmp_path / "w.ply")
    back = ScanCloud.load(tmp_path / "w.ply")
    n = len(scans[0])
    assert np.abs(back.points[n:] - scans[1].points).max() < 1e-4
    assert set(back.frame[n:]) == {1}
    assert np.allclose(back.sensors.centre[1], scans[1].sensors.centre[0], atol=1e-3)
    assert np.allclose(back.sigma[:n], NOISE)
    assert back.rig_sha256 == "ab"


def test_two_sensors_that_disagree_are_told(scans):
    off = Pose(np.eye(3), np.array([0.0, 0.0, 0.1]))
    still = [Pose.identity()] * 2
    good = merge(scans[:2], ["a", "b"], poses=still)
    assert good.passed
    assert abs(good.pairs[0].offset_mm) < 0.01
    bad = merge([scans[0], moved(scans[1], off)], ["a", "b"], poses=still)
    assert not bad.passed
    assert "one calibration, or a pose, is wrong" in bad.why
    assert -0.1 < bad.pairs[0].offset_mm < -0.02  # of 0.1 mm along z, on faces of which some are upright
    again = merge([scans[0], moved(scans[1], off)], ["a", "b"], poses=still, refine=True)
    assert np.abs(again.poses[1].translation + off.translation).max() < 0.05
    assert merge([scans[0], moved(scans[1], off)], ["a", "b"], poses=still, tolerance=0.2).passed


@pytest.mark.long
def test_what_does_not_hold_is_refused():
    rng = np.random.default_rng(4)
    plate = trimesh.creation.box((80, 80, 1))
    found = merge([scan(plate, v, rng, cells=60) for v in ((0.3, 0, 1), (0, 0.3, 1))], ["a", "b"])
    assert found.poses is None or not found.passed
    ball = trimesh.creation.icosphere(5, 25)
    found = merge([scan(ball, v, rng, cells=50) for v in ((0.5, 0, 1), (0, 0.5, 1))], ["a", "b"])
    assert found.poses is None
    assert not found.passed


def test_the_command(scans, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, cloud in zip("ab", scans[:2], strict=True):
        cloud.save(f"{name}.ply")
    run = CliRunner().invoke
    done = run(
        app,
        [
            "merge",
            "a.ply",
            "b.ply",
            "-o",
            "w.ply",
            "--poses",
            "same",
            "--json",
            "-q",
            "--map",
            "m.ply",
            "--report",
            "r.html",
        ],
    )
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert {"poses", "disagreement_mm", "passed"} <= set(told)
    assert np.allclose(told["poses"], np.eye(4))
    assert trimesh.load("m.ply").vertices.shape[0] == told["points"]
    (tmp_path / "p.json").write_text(done.stdout, encoding="utf-8")
    assert (
        run(app, ["merge", "a.ply", "b.ply", "-o", "w2.ply", "--poses", "p.json", "--tolerance", "0.05"]).exit_code == 0
    )
    assert run(app, ["merge", "a.ply", "-o", "w.ply"]).exit_code == 2
    assert run(app, ["merge", "a.ply", "b.ply", "-o", "w.ply", "--refine"]).exit_code == 2
    assert run(app, ["merge", "a.ply", "b.ply", "-o", "w.ply", "--poses", "none.json"]).exit_code == 1


@pytest.mark.parametrize(
    "text", ["[1", "[]", "[[[1,0,0,0]]]", '{"poses": [[[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]]}']
)
def test_poses_that_are_none_are_refused(tmp_path, text):
    (tmp_path / "p.json").write_text(text, encoding="utf-8")
    with pytest.raises(FileError):
        read_poses(tmp_path / "p.json", 1)
