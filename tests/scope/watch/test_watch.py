"""An artefact in a scan, seen by a scanner that stretches by a known matrix; a rig stretched by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from benchmarks.scale import block
from calibration.errors import FileError
from calibration.geometry import Pose
from calibration.rig import Rig
from cli.main import app
from scope.cloud import ScanCloud, Sensors
from scope.errors import MeasurementError
from scope.history import Record
from scope.watch import drift_of, read_artefact, stretched, watch

NOISE = 0.01
SHEET = np.array([0.0, 0.0, 340.0]), np.array([-0.06, -0.91, 0.41])  # a point and the normal of the sheet, C
AWAY = np.array([0.0, 1.0, 0.0])  # the object moves so, a mm a mm
FILE = 'format = 1\nname = "the block"\nmesh = "block.stl"\nuncertainty = 0.001\n[accept]\nerror = 0.06\nscale_percent = 0.2\n'


def scanned(stretch: np.ndarray, rng: np.random.Generator, *, pyramid: bool = False) -> ScanCloud:
    """Points of the block's faces that face the camera at the origin of C, by a scanner that sees x of C at stretch @ x."""
    mesh = tops() if pyramid else block()
    pose = Pose.from_rotation_vector([np.pi - 0.05, 0.03, 0.0], [1.0, 2.0, 365.0])
    points, face = trimesh.sample.sample_surface(mesh, 30_000, seed=int(rng.integers(1 << 30)))
    normal = mesh.face_normals[face] @ pose.rotation.T
    points = pose.apply(points)
    n = SHEET[1] / np.linalg.norm(SHEET[1])
    moved = ((SHEET[0] - points) @ n) / (AWAY @ n)  # by how much it has moved when the sheet lights it
    lit = points + moved[:, None] * AWAY
    facing = (normal * -lit).sum(axis=1) / np.linalg.norm(lit, axis=1) > 0.2
    lit, moved = lit[facing], moved[facing]
    count = len(lit)
    ray = lit / np.linalg.norm(lit, axis=1, keepdims=True)
    seen = (lit + NOISE * rng.normal(size=(count, 1)) * ray) @ stretch.T
    bare = ScanCloud.from_points(seen - moved[:, None] * AWAY)
    return replace(
        bare, sigma=np.full(count, NOISE, np.float32), frame=np.arange(count, dtype=np.int32), stripe_width=(0.2,), camera_centre=np.zeros(3),
        sensors=Sensors(np.arange(count, dtype=np.int32), np.zeros(count, np.uint8), -moved[:, None] * AWAY, np.tile([1.0, 0, 0, 0], (count, 1)),
                        np.full((count, 3), np.nan)),
    )  # fmt: skip


def tops() -> trimesh.Trimesh:
    """A blunt pyramid of 60 x 50 mm, 20 mm high."""
    low, high = np.array([[-30, -25], [30, -25], [30, 25], [-30, 25.0]]), 0.55
    return trimesh.convex.convex_hull(np.concatenate([np.c_[low, np.zeros(4)], np.c_[high * low, np.full(4, 20.0)]]))


@pytest.fixture
def plan(tmp_path: Path):  # type: ignore[no-untyped-def]
    block().export(tmp_path / "block.stl")
    (tmp_path / "artefact.toml").write_text(FILE)
    return read_artefact(tmp_path / "artefact.toml")


@pytest.mark.parametrize("error", [0.0, -0.003])
def test_scale_of_depth_is_found_from_levels(plan, error: float) -> None:  # type: ignore[no-untyped-def]
    """A stepped block tells depth, within its uncertainty, and says that it tells nothing else."""
    found = watch(plan, scanned(np.diag([1.0, 1.0, 1.0 + error]), np.random.default_rng(3)))
    assert found.strain.told[2, 2]
    assert not found.strain.told[0, 0]
    assert abs(found.strain.scale[2] - error) < found.scale_uncertainty[2] < 3e-4
    assert found.decision == ("fail" if abs(error) > 0.002 else "pass")
    assert abs(found.strain.error_mm) > 0.009 if error else abs(found.strain.error_mm) < 0.008


def test_slopes_tell_scales_aside(tmp_path: Path) -> None:
    tops().export(tmp_path / "block.stl")
    (tmp_path / "a.toml").write_text(FILE.split("[accept]", maxsplit=1)[0])
    made = np.diag([1.002, 1.0, 1.001])
    found = watch(read_artefact(tmp_path / "a.toml"), scanned(made, np.random.default_rng(4), pyramid=True))
    assert found.decision is None
    assert found.strain.told[0, 0]
    assert found.strain.told[2, 2]
    for k, error in ((0, 0.002), (2, 0.001)):
        assert abs(found.strain.scale[k] - error) < found.scale_uncertainty[k] < 1e-3


def test_what_is_no_artefact_is_refused(plan) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(5)
    flat = np.column_stack([rng.uniform(-40, 40, (8000, 2)), np.full(8000, 360.0)])
    with pytest.raises(MeasurementError):
        watch(plan, replace(ScanCloud.from_points(flat), frame=np.arange(8000, dtype=np.int32)))
    with pytest.raises(MeasurementError, match="sensor"):
        watch(plan, replace(scanned(np.eye(3), rng), sensors=None))


def test_drift_is_told_against_earlier_scans() -> None:
    def records(values: list[float]) -> list[Record]:
        return [Record("watch", True, {"scale_z_percent": v}, when=f"2026-01-{k + 1:02}T00:00:00+00:00") for k, v in enumerate(values)]  # fmt: skip

    steady = records([0.01, 0.012, 0.009, 0.011, 0.010, 0.0105])
    assert drift_of({"scale_z_percent": 0.011}, steady) == ()
    (moved,) = drift_of({"scale_z_percent": 0.05}, steady)
    assert moved.figure == "scale_z_percent"
    assert "6 earlier scans" in moved.text
    assert drift_of({"scale_z_percent": 0.05}, steady[:3]) == ()  # too few to tell


@pytest.mark.parametrize("matrix", [np.diag([1.0, 1.0, 1.01]), np.array([[1.002, 0.004, -0.003], [0.001, 0.998, 0.006], [-0.005, 0.002, 1.003]])])  # fmt: skip
def test_every_point_of_a_stretched_rig_is_stretched(session, matrix: np.ndarray) -> None:  # type: ignore[no-untyped-def]
    rig = Rig.load(session.rig)
    moved = stretched(rig, matrix)
    u, v = np.meshgrid(np.linspace(60, 580, 9), np.linspace(60, 420, 7))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    laser, new = next(iter(rig.lasers.values())), next(iter(moved.lasers.values()))
    before = laser.sheet.intersect(rig.camera.rays(pixels)).points
    known = np.isfinite(before).all(axis=1)
    assert known.sum() > 10
    after = new.sheet.intersect(moved.camera.rays(pixels)).points
    assert after[known] == pytest.approx(before[known] @ matrix.T, abs=2e-6)
    near = before[known][:, 2]
    one = rig.camera.rays(pixels[known], near=near)
    two = moved.camera.rays(pixels[known], near=moved.camera.field.depth(before[known] @ matrix.T))
    assert np.cross(two.direction, one.direction @ matrix.T) == pytest.approx(0.0, abs=1e-9)
    assert moved.camera.volume.contains(before[known] @ matrix.T).tolist() == rig.camera.volume.contains(before[known]).tolist()  # fmt: skip


@pytest.mark.long
def test_commands_refuse_in_a_line(session, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "a.toml").write_text('format = 1\nmesh = "none.stl"\nuncertainty = 0.0\n')
    with pytest.raises(FileError, match="not there"):
        read_artefact(tmp_path / "a.toml")
    trimesh.creation.box((5.0, 50.0, 50.0)).export(tmp_path / "none.stl")
    cloud = tmp_path / "c.ply"
    answer = CliRunner().invoke(app, ["scan", str(session.capture), "-r", str(session.rig), "-o", str(cloud), "--watch", str(tmp_path / "a.toml"), "--json", "-q"])  # fmt: skip
    assert answer.exit_code == 3, answer.output  # the scan is written, the artefact is not in it
    assert json.loads(answer.stdout)["watch"]["why"]
    assert cloud.is_file()
    answer = CliRunner().invoke(app, ["correct", str(cloud), "-a", str(tmp_path / "a.toml"), "-r", str(session.rig), "-o", str(tmp_path / "r.json")])  # fmt: skip
    assert answer.exit_code == 1
    assert not (tmp_path / "r.json").exists()
