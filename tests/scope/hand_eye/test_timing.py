"""A robot's log over time whose clock is off: the offset found with the rest, poses between rows interpolated."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.hand_eye import STATED, measured, views_of
from calibration.errors import CalibrationError, FileError
from calibration.geometry import Pose
from scope.hand_eye.timing import with_delay
from scope.session.hand_eye_file import read_hand_eye_plan
from scope.session.robot_section import PoseTrack, read_pose_track
from tests.scope.hand_eye.arm import HEADERS, Arm, arm, numbers, write_toml

LATE = 0.083  # s, true


def moving(made: Arm, rng, speed: float, path: Path, gives: bool = True) -> np.ndarray:
    """Write a log in which the arm passes its poses, a second apart, at about this speed; returns when the images were taken, by their own clock."""
    rows, at = ["seconds," + HEADERS["quaternion-xyzw"]], []
    for k, pose in enumerate(made.said):
        turn, shift = rng.normal(0, 0.3 * speed, 3), rng.normal(0, 40.0 * speed, 3)
        for s in np.arange(-0.5, 0.499, 0.05):
            step = Pose(Rotation.from_rotvec(turn * s).as_matrix(), shift * s)
            rows.append(f"{10.0 + k + s:.3f}," + ",".join(f"{v:.10g}" for v in numbers("quaternion-xyzw", pose @ step, 1000.0)))  # fmt: skip
        at.append(10.0 + k)
    path.write_text("\n".join(rows) + "\n")
    return np.array(at) - LATE


@pytest.mark.parametrize("mount", ["hand", "fixed"])
def test_the_delay_is_found_with_its_sigma(tmp_path, mount):
    off = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        made = arm(rng, 12, mount=mount)
        seconds = moving(made, rng, 1.0, tmp_path / "log.csv")
        track = read_pose_track(tmp_path / "log.csv", "quaternion-xyzw", "m", "base_from_flange")
        plan = SimpleNamespace(mount=mount, repeatability=STATED)
        _, _, fit, delay = with_delay(plan, track, views_of(made, measured(made, rng)), seconds, None)
        assert delay.sigma < 0.001
        off.append((delay.seconds - LATE) / delay.sigma)
        assert np.abs(fit.sensor.translation - made.sensor.translation).max() < 0.25
        assert sum(v.used for v in fit.views) >= 11
    assert np.abs(off).max() < 4


def test_an_arm_that_stands_still_tells_no_delay(tmp_path):
    rng = np.random.default_rng(5)
    made = arm(rng, 8)
    seconds = moving(made, rng, 0.0, tmp_path / "log.csv")
    track = read_pose_track(tmp_path / "log.csv", "quaternion-xyzw", "m", "base_from_flange")
    plan = SimpleNamespace(mount="hand", repeatability=STATED)
    with pytest.raises(CalibrationError, match="hardly moves"):
        with_delay(plan, track, views_of(made, measured(made, rng)), seconds, None)
    with pytest.raises(CalibrationError, match="log begin"):
        with_delay(plan, track, views_of(made, measured(made, rng)), seconds - 30.0, None)


def test_poses_between_rows_are_those_of_scipy():
    rng = np.random.default_rng(1)
    turns = Rotation.random(4, random_state=2)
    q = turns.as_quat()[:, [3, 0, 1, 2]]
    for k in range(1, 4):
        q[k] *= np.sign(q[k] @ q[k - 1])
    track = PoseTrack(Path("x"), np.array([0.0, 1.0, 2.0, 3.0]), q, rng.normal(0, 10, (4, 3)))
    at = np.array([0.3, 1.999, 2.5])
    expected = Slerp([0, 1, 2, 3], turns)(at)
    for pose, wanted in zip(track.at(at), expected, strict=True):
        assert pose.rotation == pytest.approx(wanted.as_matrix(), abs=1e-9)
    twist = track.twists(np.array([0.5]))[0]
    relative = (turns[0].inv() * turns[1]).as_rotvec()
    assert twist[:3] == pytest.approx(relative, abs=1e-6)


def test_the_file_names_log_times_and_delay(tmp_path):
    (tmp_path / "views").mkdir()
    for k in range(3):
        (tmp_path / "views" / f"im{k:02}.png").write_bytes(b"x")
    rng = np.random.default_rng(3)
    made = arm(rng, 3)
    moving(made, rng, 1.0, tmp_path / "poses.csv")
    (tmp_path / "times.csv").write_text("image,seconds\nim00.png,10\nim01.png,11\nim02.png,99\n")
    plan = read_hand_eye_plan(write_toml(tmp_path, more='times = "times.csv"\ndelay = 0.1\n'))
    assert plan.pose_of(tmp_path / "im00.png").translation == pytest.approx(
        plan.track.at(np.array([10.1]))[0].translation
    )  # type: ignore[union-attr]
    assert plan.pose_of(tmp_path / "im02.png") is None  # after the log
    assert read_hand_eye_plan(write_toml(tmp_path, more='times = "times.csv"\ndelay = "find"\n')).delay is None
    with pytest.raises(FileError, match=r"needs robot\.times"):
        read_hand_eye_plan(write_toml(tmp_path, more="delay = 0.1\n"))
    text = (tmp_path / "poses.csv").read_text().splitlines()
    (tmp_path / "poses.csv").write_text("\n".join([text[0], *text[1:8], *text[30:]]))
    with pytest.raises(FileError, match="apart"):
        read_hand_eye_plan(write_toml(tmp_path, more='times = "times.csv"\ndelay = "find"\n'))
