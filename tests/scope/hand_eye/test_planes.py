"""Hand and eye by stripes across fixed planes: lines of exact geometry, and images drawn of them."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from calibration.errors import CalibrationError
from calibration.geometry import Pose
from calibration.rig import Rig
from calibration.stages import Pass, Repeatability, solve_by_planes
from cli.main import app
from scope.hand_eye.planes import on_line
from tests.scope.hand_eye.arm import pose, write_log

STATED = Repeatability(0.03, float(np.deg2rad(0.01)))
SENSOR = pose([0.1, -0.2, 1.2], [40.0, -25.0, 90.0])
NORMALS = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -0.5, np.sqrt(0.75)]])
OFFSETS = np.array([60.0, 380.0, 10.0])


def frame(axis, spin):
    u = np.cross(axis, [1.0, 0.3, 0.2])
    u /= np.linalg.norm(u)
    w = np.cross(axis, u)
    c, s = np.cos(spin), np.sin(spin)
    return np.column_stack([c * u + s * w, c * w - s * u, axis])


def looking(rng, k, mount, at, sigma=(0.03, 0.01)):
    """What the robot says where plane k passes through ``at`` of C at a slant, and the plane's normal in C."""
    tilt = Rotation.from_euler("xyz", np.clip(rng.normal(0, 1, 3), -1.5, 1.5) * [0.4, 0.4, 0.8]).as_matrix()
    normal = tilt @ [0.0, 0.0, -1.0]
    turn = frame(NORMALS[k], rng.uniform(0, 6)) @ frame(normal, 0.0).T
    foot = OFFSETS[k] * NORMALS[k] + (np.eye(3) - np.outer(NORMALS[k], NORMALS[k])) @ rng.uniform(-100, 100, 3)
    of_c = Pose(turn, foot - turn @ at)
    flange = of_c @ SENSOR.inverse if mount == "hand" else SENSOR @ of_c.inverse
    error = pose(rng.normal(0, np.deg2rad(sigma[1]), 3), rng.normal(0, sigma[0], 3))
    return flange @ error.inverse, normal


def stripe(sheet, offset, normal, at):
    """Points of the line where a plane through ``at`` meets the sheet."""
    line = np.cross(sheet, normal)
    line /= np.linalg.norm(line)
    base = np.linalg.solve(np.stack([sheet, normal, line]), [offset, normal @ at, line @ at])
    return base + np.linspace(-45, 45, 300)[:, None] * line


def passes(rng, mount, planes, n=18, noise=0.02):
    sheet = np.array([0.0, np.cos(0.6), np.sin(0.6)])
    offset = float(sheet @ [0, 0, 250.0])
    found, label = [], []
    for i in range(n):
        k = i % planes
        at = np.array([rng.uniform(-20, 20), rng.uniform(-15, 15), 250 + rng.uniform(-15, 15)])
        said, normal = looking(rng, k, mount, at)
        points = stripe(sheet, offset, normal, at)
        ray = points / np.linalg.norm(points, axis=1, keepdims=True)
        points = points + rng.normal(0, noise, len(points))[:, None] * ray
        found.append(Pass(f"p{i}", said, points, ray, np.full(len(points), noise)))
        label.append(k)
    return found, label


@pytest.mark.parametrize(("mount", "planes"), [("hand", 1), ("hand", 3), ("fixed", 3)])
def test_errors_have_the_stated_size(mount, planes):
    normal = []
    for seed in range(2):
        fit = solve_by_planes(*passes(np.random.default_rng(seed), mount, planes), mount, repeatability=STATED)
        turn = Rotation.from_matrix(fit.sensor.rotation @ SENSOR.rotation.T).as_rotvec()
        error = np.concatenate([turn, fit.sensor.translation - SENSOR.translation])
        normal.append(np.linalg.solve(np.linalg.cholesky(fit.covariance), error))
        assert sum(fit.used) >= 17
        assert np.abs(error[3:]).max() < 0.6
        assert np.abs(np.abs((fit.normals * NORMALS[:planes]).sum(axis=1)) - 1.0).max() < 1e-5
    assert 0.2 < float(np.mean(np.square(normal))) < 2.6  # 12 values


def test_a_wrong_pose_is_left_out_and_too_little_is_refused():
    made, label = passes(np.random.default_rng(9), "hand", 2)
    wrong = made[6]
    made[6] = Pass("p6", Pose(wrong.base_from_flange.rotation, wrong.base_from_flange.translation + np.array([0, 3.0, 4.0])), wrong.points, wrong.ray, wrong.sigma)  # fmt: skip
    fit = solve_by_planes(made, label, "hand", repeatability=STATED)
    assert [k for k, used in enumerate(fit.used) if not used] == [6]
    with pytest.raises(CalibrationError, match="5 passes"):
        solve_by_planes(made[:5], label[:5], "hand")
    still = [Pass(p.name, made[0].base_from_flange, p.points, p.ray, p.sigma) for p in made]
    with pytest.raises(CalibrationError, match="two different axes"):
        solve_by_planes(still, label, "hand")


def test_only_the_straight_part_is_taken():
    rng = np.random.default_rng(2)
    line = np.outer(np.linspace(-40, 40, 400), [1.0, 0.2, 0.1]) + np.array([0, 0, 250.0])
    step = np.outer(np.linspace(0, 15, 100), [1.0, 0.2, 0.1]) + np.array([40, 8.0, 240.0])
    points = np.concatenate([line, step]) + rng.normal(0, 0.02, (500, 3))
    found = on_line(points, np.full(500, 0.02))
    assert found[:400].mean() > 0.98
    assert found[400:].mean() < 0.02
    with pytest.raises(CalibrationError, match="no straight part"):
        on_line(rng.uniform(-30, 30, (300, 3)), np.full(300, 0.02))


def test_the_command_on_drawn_stripes(session, tmp_path):
    rng = np.random.default_rng(4)
    rig = Rig.load(session.rig)
    laser = next(iter(rig.lasers.values()))
    matrix, distortion = np.array([[700.0, 0, 322], [0, 700, 236], [0, 0, 1]]), np.array([-0.12, 0.03, 0.0004, -0.0003, 0])  # fmt: skip
    sheet = laser.sheet if hasattr(laser.sheet, "normal") else laser.sheet.plane
    said = []
    (tmp_path / "views").mkdir()
    for i in range(16):
        at = np.array([rng.uniform(-20, 20), 0.0, rng.uniform(330, 360)])
        at[1] = (sheet.offset - sheet.normal[[0, 2]] @ at[[0, 2]]) / sheet.normal[1]
        told, normal = looking(rng, i % 2, "hand", at)
        u, v = cv2.projectPoints(
            stripe(sheet.normal, sheet.offset, normal, at), np.zeros(3), np.zeros(3), matrix, distortion
        )[0][:, 0].T
        order = np.argsort(u)
        columns = np.arange(max(int(np.ceil(u.min())), 0), min(int(u.max()), 640))
        image = np.full((480, 640), 8.0)
        at_v = np.interp(columns, u[order], v[order])
        image[:, columns] += 180 * np.exp(-0.5 * ((np.arange(480)[:, None] - at_v) / 1.3) ** 2)
        noisy = image + rng.normal(0, 1, image.shape) * np.sqrt(1.5 + image / 35)
        cv2.imwrite(str(tmp_path / "views" / f"im{i:02}.png"), np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
        said.append(told)
    write_log(tmp_path / "poses.csv", said)
    (tmp_path / "hand-eye.toml").write_text(
        'format = 1\nmount = "hand"\n[target]\nkind = "planes"\nplanes = { floor = "im?[02468].png", ramp = "im?[13579].png" }\n[robot]\n'
        'poses = "poses.csv"\nunits = "m"\nnotation = "quaternion-xyzw"\ngives = "base_from_flange"\nimages = "views/*.png"\n'
        "repeatability_mm = 0.03\nrepeatability_deg = 0.01\n",
        encoding="utf-8",
    )
    asked = ["hand-eye", str(tmp_path / "hand-eye.toml"), "--rig", str(session.rig), "-o", str(tmp_path / "he.json"), "--report", str(tmp_path / "he.html")]  # fmt: skip
    done = CliRunner().invoke(app, [*asked, "--json", "-q"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["passed"], told["why"]
    assert set(told["planes"]) == {"floor", "ramp"}
    sigma = np.sqrt(np.diag(told["covariance"]))
    error = np.array(told["flange_from_camera"])[:3, 3] - SENSOR.translation
    assert (np.abs(error) < 4 * sigma[:3] + 0.15).all()  # the rig's own error is not in it
    assert told["loo_mm"] < 0.2
    assert "planes" in CliRunner().invoke(app, asked).stdout
