"""Hand and eye by stripes across a sphere: arcs of exact geometry, and images drawn of them."""

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
from calibration.stages import Pass, Repeatability, solve_by_sphere
from cli.main import app
from scope.hand_eye.sphere import on_sphere
from tests.scope.hand_eye.arm import pose, write_log

STATED = Repeatability(0.03, float(np.deg2rad(0.01)))
SENSOR = pose([0.1, -0.2, 1.2], [40.0, -25.0, 90.0])
CENTRE = np.array([520.0, 130.0, 60.0])


def arc(normal, offset, centre, radius, count=700):
    """Points of a sphere on a plane that face the origin."""
    h = offset - normal @ centre
    u = np.cross(normal, [1.0, 0.0, 0.0])
    u /= np.linalg.norm(u)
    turn = np.linspace(-np.pi, np.pi, count)[:, None]
    points = centre + h * normal + np.sqrt(radius**2 - h**2) * (np.cos(turn) * u + np.sin(turn) * np.cross(normal, u))
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    seen = ((points - centre) * ray).sum(axis=1) < -0.25 * radius
    first = int(np.flatnonzero(~seen)[-1]) + 1 if not seen.all() else 0
    order = np.roll(np.arange(count), -first)
    order = order[seen[order]]
    return points[order], ray[order]


def robot_pose(rng, at, mount, sigma=(0.03, 0.01)):
    """A pose of the arm that brings the sphere to ``at`` in C, as the robot says it."""
    turn = pose(np.clip(rng.normal(0, 1, 3), -1.5, 1.5) * [0.4, 0.4, 0.8], np.zeros(3)).rotation
    c_of_sphere = Pose(turn, CENTRE - turn @ at)
    flange = c_of_sphere @ SENSOR.inverse if mount == "hand" else SENSOR @ c_of_sphere.inverse
    error = pose(rng.normal(0, np.deg2rad(sigma[1]), 3), rng.normal(0, sigma[0], 3))
    return flange @ error.inverse


def passes(rng, mount, n=20, noise=0.02, radius=20.0):
    normal = np.array([0.0, np.cos(0.6), np.sin(0.6)])
    offset = float(normal @ [0, 0, 250.0])
    found = []
    for k in range(n):
        at = np.array([rng.uniform(-40, 40), rng.uniform(-20, 20), 0.0])
        at[2] = (offset + rng.uniform(-10, 10) - normal[:2] @ at[:2]) / normal[2]
        points, ray = arc(normal, offset, at, radius)
        points = points + rng.normal(0, noise, len(points))[:, None] * ray
        found.append(Pass(f"p{k}", robot_pose(rng, at, mount), points, ray, np.full(len(points), noise)))
    return found


@pytest.mark.parametrize(("mount", "stated"), [("hand", STATED), ("hand", None), ("fixed", STATED)])
def test_errors_have_the_stated_size(mount, stated):
    normal = []
    for seed in range(4):
        fit = solve_by_sphere(passes(np.random.default_rng(seed), mount), 20.0, mount, repeatability=stated)
        turn = Rotation.from_matrix(fit.sensor.rotation @ SENSOR.rotation.T).as_rotvec()
        error = np.concatenate([turn, fit.sensor.translation - SENSOR.translation])
        normal.append(np.linalg.solve(np.linalg.cholesky(fit.covariance[:6, :6]), error))
        assert sum(fit.used) >= 18
        assert np.abs(error[3:]).max() < 0.6
    assert 0.3 < float(np.mean(np.square(normal))) < (2.3 if stated else 3.5)  # 24 values: three standard deviations


def test_a_wrong_pose_is_left_out_and_too_little_is_refused():
    rng = np.random.default_rng(9)
    made = passes(rng, "hand")
    wrong = made[6].base_from_flange
    made[6] = Pass(
        "p6",
        Pose(wrong.rotation, wrong.translation + np.array([0, 5.0, 0])),
        made[6].points,
        made[6].ray,
        made[6].sigma,
    )
    fit = solve_by_sphere(made, 20.0, "hand", repeatability=STATED)
    assert [k for k, used in enumerate(fit.used) if not used] == [6]
    with pytest.raises(CalibrationError, match="4 passes"):
        solve_by_sphere(made[:4], 20.0, "hand")
    still = [Pass(p.name, made[0].base_from_flange, p.points, p.ray, p.sigma) for p in made]
    with pytest.raises(CalibrationError, match="two different axes"):
        solve_by_sphere(still, 20.0, "hand")


def test_only_the_arc_of_the_sphere_is_taken():
    rng = np.random.default_rng(2)
    normal = np.array([0.0, np.cos(0.6), np.sin(0.6)])
    points, _ = arc(normal, float(normal @ [0, 0, 250.0]), np.array([5.0, 2.0, 250.0]), 20.0, 300)
    table = np.stack([np.linspace(-80, 80, 300), *(np.array([[-14.0], [270.0]]) + np.zeros((1, 300)))], axis=1)
    both = np.concatenate([table, points]) + rng.normal(0, 0.02, (300 + len(points), 3))
    found = on_sphere(both, 20.0)
    assert found[300:].mean() > 0.95
    assert found[:300].mean() < 0.02
    with pytest.raises(CalibrationError, match="no arc"):
        on_sphere(table, 20.0)


def test_the_command_on_drawn_stripes(session, tmp_path):
    rng = np.random.default_rng(4)
    rig = Rig.load(session.rig)
    laser = next(iter(rig.lasers.values()))
    matrix, distortion = (
        np.array([[700.0, 0, 322], [0, 700, 236], [0, 0, 1]]),
        np.array([-0.12, 0.03, 0.0004, -0.0003, 0]),
    )
    plane = laser.sheet if hasattr(laser.sheet, "normal") else laser.sheet.plane
    said = []
    (tmp_path / "views").mkdir()
    for k in range(14):
        at = np.array([rng.uniform(-30, 30), 0.0, rng.uniform(325, 365)])
        at[1] = (plane.offset + rng.uniform(-9, 9) - plane.normal[[0, 2]] @ at[[0, 2]]) / plane.normal[1]
        points, _ = arc(plane.normal, plane.offset, at, 20.0, 3000)
        u, v = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0].T
        order = np.argsort(u)
        image = np.full((480, 640), 8.0)
        columns = np.arange(int(np.ceil(u.min())), int(u.max()))
        at_v = np.interp(columns, u[order], v[order])
        image[:, columns] += 180 * np.exp(-0.5 * ((np.arange(480)[:, None] - at_v) / 1.3) ** 2)
        noisy = image + rng.normal(0, 1, image.shape) * np.sqrt(1.5 + image / 35)
        cv2.imwrite(str(tmp_path / "views" / f"im{k:02}.png"), np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
        said.append(robot_pose(rng, at, "hand"))
    write_log(tmp_path / "poses.csv", said)
    (tmp_path / "hand-eye.toml").write_text(
        'format = 1\nmount = "hand"\n[target]\nkind = "sphere"\ndiameter = 40.0\n[robot]\nposes = "poses.csv"\nunits = "m"\n'
        'notation = "quaternion-xyzw"\ngives = "base_from_flange"\nimages = "views/*.png"\nrepeatability_mm = 0.03\n'
        "repeatability_deg = 0.01\n",
        encoding="utf-8",
    )
    done = CliRunner().invoke(
        app, ["hand-eye", str(tmp_path / "hand-eye.toml"), "--rig", str(session.rig), "-o", str(tmp_path / "he.json"), "--json", "-q",
              "--report", str(tmp_path / "he.html")]
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["passed"], told["why"]
    sigma = np.sqrt(np.diag(told["covariance"]))
    error = np.array(told["flange_from_camera"])[:3, 3] - SENSOR.translation
    assert (np.abs(error) < 4 * sigma[:3] + 0.1).all()  # the rig's own error is not in it
    assert told["loo_mm"] < 0.2
