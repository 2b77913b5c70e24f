"""A scan by a robot's poses is the scan by the motion that these poses make, in the robot's base, and less sure."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

import scope
from calibration.errors import FileError
from calibration.geometry import Pose
from calibration.rig import Rig
from calibration.stages import Repeatability
from ranging.robot import Robot
from scope.session import HandEye, read_capture
from tests.scope.hand_eye.arm import pose, write_log

SENSOR = pose([0.2, -0.3, 1.0], [30.0, -60.0, 110.0])
WORLD = pose([1.0, 0.4, -0.7], [400.0, -250.0, 300.0])  # base_from_cloud of the linear scan
COVARIANCE = np.diag([0.02, 0.03, 0.04, 1e-4, 2e-4, 3e-4]) ** 2


def capture(session, folder, mount="hand", **answer):
    shutil.copytree(session.folder, folder, ignore=shutil.ignore_patterns("truth"))
    plain = read_capture(folder / "capture.toml")
    n = 12
    told = [plain.motion.cloud_from_c(k) for k in range(n)]
    if mount == "hand":
        said = [WORLD @ p @ SENSOR.inverse for p in told]
    else:
        said = [(WORLD @ p @ SENSOR.inverse).inverse for p in told]
    lines = ["frame,x,y,z,qx,qy,qz,qw"]
    write_log(folder / "log.csv", said)
    rows = (folder / "log.csv").read_text(encoding="utf-8").splitlines()[1:]
    lines += [f"{k},{row.partition(',')[2]}" for k, row in enumerate(rows)]
    (folder / "log.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    head = (folder / "capture.toml").read_text(encoding="utf-8").split("[motion]")[0]
    (folder / "capture.toml").write_text(
        f'{head}[motion]\nkind = "robot"\nhand_eye = "he.json"\nposes = "log.csv"\nunits = "m"\n'
        'notation = "quaternion-xyzw"\ngives = "base_from_flange"\n',
        encoding="utf-8",
    )
    rig = Rig.load(folder / "rig.json")
    found = HandEye(mount, SENSOR, Pose.identity(), COVARIANCE, Repeatability(1e-9, 1e-12), rig.sha256, True, "")
    replace(found, **answer).save(folder / "he.json")
    return folder


@pytest.mark.parametrize("mount", ["hand", "fixed"])
def test_the_cloud_is_in_the_robots_base(session, tmp_path, mount):
    folder = capture(session, tmp_path / "s", mount)
    plain = scope.scan(session.capture, session.rig)
    found = scope.scan(folder / "capture.toml", folder / "rig.json")
    # the linear scan knows that its motion is linear; what both ranged is the same
    key = {
        (int(f), round(float(u), 1), round(float(v), 1)): k
        for k, (f, (u, v)) in enumerate(zip(plain.frame, plain.pixels, strict=True))
    }
    pairs = [(key[k], j) for j, (f, (u, v)) in enumerate(zip(found.frame, found.pixels, strict=True))
             if (k := (int(f), round(float(u), 1), round(float(v), 1))) in key]  # fmt: skip
    a, b = np.array(pairs).T
    assert len(a) > 0.8 * len(plain)
    away = np.linalg.norm(WORLD.apply(plain.points[a]) - found.points[b], axis=1)
    assert np.median(away) < 1e-3
    assert (found.sigma_cal[b] > plain.sigma_cal[a]).mean() > 0.98


def test_sigma_along_is_what_monte_carlo_says():
    rng = np.random.default_rng(3)
    points, view = rng.normal([0, 0, 350], 30, (5, 3)), rng.normal([0, 0, 1], 0.1, (5, 3))
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    for mount in ("hand", "fixed"):
        robot = Robot(mount, SENSOR, (WORLD,), COVARIANCE, (0.05, 2e-4))
        place, rays = robot.cloud_from_c(0), view @ robot.cloud_from_c(0).rotation.T
        draws = []
        for _ in range(4000):
            shift = rng.multivariate_normal(np.zeros(6), COVARIANCE)
            turned = pose(shift[3:], np.zeros(3))
            sensor = Pose(turned.rotation @ SENSOR.rotation, SENSOR.translation + shift[:3])
            error = pose(rng.normal(0, 2e-4, 3), rng.normal(0, 0.05, 3))
            moved = Robot(mount, sensor, (WORLD @ error,), COVARIANCE, (0.0, 0.0)).cloud_from_c(0)
            draws.append(((moved.apply(points) - place.apply(points)) * rays).sum(axis=1))
        assert np.allclose(np.std(draws, axis=0), robot.sigma_along(0, points, view), rtol=0.05)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({"passed": False, "why": "views contradict"}, "did not pass"),
        ({"rig_sha256": "0" * 64}, "run scope hand-eye with this rig"),
    ],
)
def test_an_answer_that_is_not_for_this_scan_is_refused(session, tmp_path, answer, said):
    folder = capture(session, tmp_path / "s", **answer)
    with pytest.raises(FileError, match=said):
        scope.scan(folder / "capture.toml", folder / "rig.json")


@pytest.mark.parametrize("key", ["hand_eye", "units", "notation", "gives", "poses"])
def test_each_key_must_be_given(session, tmp_path, key):
    folder = capture(session, tmp_path / "s")
    text = (folder / "capture.toml").read_text(encoding="utf-8")
    kept = [
        line for line in text.splitlines() if not line.startswith(f"{key} =") or "[motion]" not in text.split(line)[0]
    ]
    (folder / "capture.toml").write_text("\n".join(kept) + "\n", encoding="utf-8")
    with pytest.raises(FileError, match=f"{key} is missing"):
        read_capture(folder / "capture.toml")
