"""Poses that were written, read or stated in a wrong way are recognised, and the way that fits is named."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.geometry import Pose
from calibration.rays import PlaneMarks
from calibration.stages import consensus, solve_hand_eye
from scope.hand_eye import readings_of
from scope.hand_eye.views import seen_target
from scope.session import PoseLog
from tests.scope.hand_eye.arm import arm, marks, numbers, project, rig


def views_of(made, rng, noise=0.05):
    camera = rig().camera
    found = []
    for k, view in enumerate(made.seen):
        pixels = project(view, marks()) + rng.normal(0, noise, (54, 2))
        seen = PlaneMarks(
            f"im{k:02}", pixels, marks()[:, :2], Pose.identity(), np.arange(54), np.full((54, 2, 2), np.nan)
        )
        found.append(seen_target(camera, seen, made.said[k], None))
    return found


def log_of(made, written, stated, *, written_mm=1.0, units="mm", inverse=False, gives="base_from_flange"):
    rows = [numbers(written, p.inverse if inverse else p, written_mm) for p in made.said]
    return PoseLog(None, tuple(f"im{k:02}.png" for k in range(len(rows))), np.array(rows), stated, units, gives)


WRONG = [
    ("quaternion-wxyz", "quaternion-xyzw", {}, 'notation = "quaternion-wxyz"'),
    ("quaternion-xyzw", "quaternion-wxyz", {}, 'notation = "quaternion-xyzw"'),
    ("kuka", "fanuc", {}, 'notation = "kuka"'),
    ("rpy-deg", "kuka", {}, 'notation = "fanuc"'),
    ("ur", "rpy-deg", {}, 'notation = "ur"'),
    ("quaternion-xyzw", "quaternion-xyzw", {"written_mm": 1000.0}, 'units = "m"'),
    ("ur", "ur", {"units": "m"}, 'units = "mm"'),
    ("matrix", "matrix", {"inverse": True}, 'gives = "flange_from_base"'),
    ("quaternion-xyzw", "quaternion-wxyz", {"written_mm": 1000.0}, 'notation = "quaternion-xyzw" and units = "m"'),
]


@pytest.mark.parametrize(
    ("written", "stated", "how", "named", "mount"), [(*w, "hand") for w in WRONG] + [(*w, "fixed") for w in WRONG[7:8]]
)
def test_the_convention_that_fits_is_named(written, stated, how, named, mount):
    rng = np.random.default_rng(5)
    made = arm(rng, 12, mount=mount)
    log = log_of(made, written, stated, **how)
    views = views_of(made, rng)
    as_stated = [v.saying(log.base_from_flange(k)) for k, v in enumerate(views)]
    contradiction = consensus(as_stated, mount).typical_mm
    best = readings_of(log, range(len(views)), as_stated, mount)[0]
    assert named == best.told
    assert best.start.typical_mm < 0.5 < 4 * best.start.typical_mm + 0.5 < contradiction


def test_rows_that_are_one_late_are_named():
    rng = np.random.default_rng(6)
    made = arm(rng, 12)
    late = made.said[:1] + made.said[:-1]
    log = log_of(type(made)(made.sensor, made.target, late, made.seen), "ur", "ur")
    views = [v.saying(p) for v, p in zip(views_of(made, rng), late, strict=True)]
    assert readings_of(log, range(12), views, "hand")[0].told == "each image with the pose of the row after"


@pytest.mark.parametrize("mount", ["hand", "fixed"])
def test_right_poses_need_no_other_reading(mount):
    rng = np.random.default_rng(7)
    made = arm(rng, 12, mount=mount)
    views = views_of(made, rng)
    own = consensus(views, mount).typical_mm
    others = readings_of(log_of(made, "ur", "ur"), range(12), views, mount)
    assert own < 0.3
    assert own * 4 < others[0].start.typical_mm


def test_one_wrong_pose_of_fifteen_is_left_out_by_name():
    for seed in range(3):
        rng = np.random.default_rng(100 + seed)
        made = arm(rng, 15)
        wrong = int(rng.integers(15))
        shift = rng.normal(0, 1, 3)
        said = list(made.said)
        said[wrong] = Pose(said[wrong].rotation, said[wrong].translation + 5.0 * shift / np.linalg.norm(shift))
        fit = solve_hand_eye(views_of(type(made)(made.sensor, made.target, said, made.seen), rng), "hand")
        assert [v.name for v in fit.views if not v.used] == [f"im{wrong:02}"]
        named = fit.views[wrong]
        assert abs(named.off_mm - 5.0) < 0.3
        assert np.linalg.norm(fit.sensor.translation - made.sensor.translation) < 0.3
