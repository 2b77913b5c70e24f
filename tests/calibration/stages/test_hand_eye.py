"""Hand and eye: errors of the size that is stated, whatever the mount, and no answer where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.errors import CalibrationError
from calibration.geometry import Pose
from calibration.stages import Repeatability, SeenTarget, closed_form, consensus, solve_hand_eye
from tests.scope.hand_eye.arm import MATRIX, arm, marks, pose, project

STATED = Repeatability(0.03, np.deg2rad(0.01))


def seen(made, rng, noise=0.05):
    """Views of an ideal pinhole; the pose of the board starts 0.1 mm and 0.1 degrees off."""
    points, found = marks(), []
    for k, (said, view) in enumerate(zip(made.said, made.seen, strict=True)):
        pixels = project(view, points) + rng.normal(0, noise, (len(points), 2))
        rays = np.column_stack([(pixels - MATRIX[:2, 2]) / MATRIX[0, 0], np.ones(len(points))])
        depth = view.apply(points)[:, 2]
        to_pixels = np.zeros((len(points), 2, 3))
        to_pixels[:, 0, 0] = to_pixels[:, 1, 1] = MATRIX[0, 0] / depth
        to_pixels[:, :, 2] = -MATRIX[0, 0] / depth[:, None] * rays[:, :2]
        off = pose(rng.normal(0, 0.002, 3), rng.normal(0, 0.1, 3))
        found.append(
            SeenTarget(
                f"v{k}", said, (off @ view,), (points,), np.zeros_like(points), to_pixels,
                np.broadcast_to(noise**2 * np.eye(2), (len(points), 2, 2)),
            )
        )  # fmt: skip
    return found


def error(fit, made):
    turn = Rotation.from_matrix(fit.sensor.rotation @ made.sensor.rotation.T).as_rotvec()
    return np.concatenate([turn, fit.sensor.translation - made.sensor.translation])


@pytest.mark.parametrize("mount", ["hand", "fixed"])
def test_without_noise_the_truth_is_found(mount):
    rng = np.random.default_rng(1)
    made = arm(rng, 6, mount=mount, sigma=(0.0, 0.0))
    exact = closed_form([p if mount == "hand" else p.inverse for p in made.said], made.seen)
    assert np.abs(exact[0].matrix - made.sensor.matrix).max() < 1e-9
    assert np.abs(exact[1].matrix - made.target.matrix).max() < 1e-9
    fit = solve_hand_eye(seen(made, rng, noise=1e-9), mount, repeatability=Repeatability(1e-6, 1e-9))
    assert np.abs(fit.sensor.translation - made.sensor.translation).max() < 1e-5


@pytest.mark.parametrize(("mount", "stated"), [("hand", STATED), ("fixed", STATED), ("hand", None)])
def test_errors_have_the_stated_size(mount, stated):
    # 14 draws of 6 components: the mean square of 84 standard normal values lies in 0.58 to 1.55 with 99.7 %
    normal = []
    for seed in range(14):
        rng = np.random.default_rng(seed)
        made = arm(rng, 12, mount=mount)
        fit = solve_hand_eye(seen(made, rng), mount, repeatability=stated)
        whitened = np.linalg.solve(np.linalg.cholesky(fit.covariance[:6, :6]), error(fit, made))
        normal.append(whitened)
        assert fit.used >= 11
    assert (
        0.58 < float(np.mean(np.square(normal))) < (1.55 if stated else 1.9)
    )  # few views: the scatter itself is unsure


def test_pixels_and_repeatability_weigh_against_each_other():
    """The adjustment is better than its closed form by far where depth is what pixels tell worst."""
    adjusted, closed = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        made = arm(rng, 12)
        views = seen(made, rng)
        start = consensus(views, "hand")
        fit = solve_hand_eye(views, "hand", repeatability=STATED, start=start)
        adjusted.append(error(fit, made)[3:])
        closed.append(start.sensor.translation - made.sensor.translation)
    assert np.square(adjusted).mean() < 0.25 * np.square(closed).mean()


def test_a_robot_less_accurate_than_stated_is_told_by_the_scatter():
    rng = np.random.default_rng(4)
    made = arm(rng, 25, sigma=(0.4, 0.05))
    fit = solve_hand_eye(seen(made, rng), "hand", repeatability=STATED)
    assert not fit.robot_stated
    assert fit.beyond > 3
    assert 0.25 < fit.robot.mm < 0.6  # 69 degrees of freedom: 10 % and a margin of three
    assert fit.used >= 24


def test_a_board_that_is_counted_from_either_end():
    rng = np.random.default_rng(5)
    made = arm(rng, 8)
    views = seen(made, rng)
    corner = marks()[-1]
    half = Pose(np.diag([-1.0, -1.0, 1.0]), corner)
    mixed = []
    for k, view in enumerate(views):
        options = [
            (view.camera_from_target[0], view.points[0]),
            (view.camera_from_target[0] @ half.inverse, half.apply(view.points[0])),
        ]
        options = options[:: -1 if k % 3 == 1 else 1]
        mixed.append(
            SeenTarget(view.name, view.base_from_flange, tuple(o[0] for o in options), tuple(o[1] for o in options),
                       view.origin, view.to_pixels, view.covariance)
        )  # fmt: skip
    fit = solve_hand_eye(mixed, "hand", repeatability=STATED)
    assert fit.used == 8
    assert np.linalg.norm(error(fit, made)[3:]) < 0.2


def test_shifts_alone_and_one_axis_are_refused_with_what_to_add():
    rng = np.random.default_rng(6)
    still = arm(rng, 6, axes=(0.0, 0.0, 0.0))
    with pytest.raises(CalibrationError, match="shifts alone do not tell.*two different axes"):
        solve_hand_eye(seen(still, rng), "hand")
    one = arm(rng, 6, axes=(0.0, 0.0, 0.8))
    with pytest.raises(CalibrationError, match="about one axis only.*about another axis"):
        solve_hand_eye(seen(one, rng), "hand")
    with pytest.raises(CalibrationError, match="2 views; 3 are the least"):
        solve_hand_eye(seen(arm(rng, 2), rng), "hand")


def test_left_out_in_turn_is_what_an_adjustment_without_the_view_says():
    rng = np.random.default_rng(8)
    made = arm(rng, 8)
    views = seen(made, rng)
    whole = solve_hand_eye(views, "hand", repeatability=STATED)
    rest = solve_hand_eye(views[:3] + views[4:], "hand", repeatability=STATED)
    back = (made.said[3] @ rest.sensor).inverse @ rest.target
    own = views[3].camera_from_target[0]
    away = np.sqrt(((back.apply(marks()) - own.apply(marks())) ** 2).sum(axis=1).mean())
    assert abs(whole.views[3].loo_mm - away) < 1e-3
