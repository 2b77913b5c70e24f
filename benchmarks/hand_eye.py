"""Hand and eye against OpenCV 4's calibrateHandEye and a plain least squares on OpenCV's poses.

    python -m benchmarks.hand_eye [--draws 200] [--peer PYTHON] [--faults 40] [--sphere 20] [--planes 20]

``--peer`` is a Python that has ``opencv-python-headless<5`` (OpenCV 5 has no calibrateHandEye in Python), such as that of
``python3 -m venv /tmp/cv4 && /tmp/cv4/bin/pip install "opencv-python-headless<5"``. Views: a board of 6 x 9 corners at 5 mm,
190 mm from a camera of 800 x 600 px (f 1100 px), corners with 0.05 px of noise; the robot's poses with 0.03 mm and 0.01 degrees.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.geometry import Pose
from calibration.rays import PlaneMarks
from calibration.stages import Repeatability, consensus, solve_by_planes, solve_by_sphere, solve_hand_eye
from scope.hand_eye import readings_of
from scope.hand_eye.views import seen_target
from scope.session import PoseLog
from tests.scope.hand_eye.arm import MATRIX, Arm, arm, marks, numbers, project, rig
from tests.scope.hand_eye.test_planes import passes as plane_passes
from tests.scope.hand_eye.test_sphere import SENSOR, passes

STATED = Repeatability(0.03, float(np.deg2rad(0.01)))
PIXEL = 0.05
METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")

PEER = f"""
import sys, cv2, numpy as np
d = np.load(sys.argv[1])
out = {{}}
for name in {METHODS!r}:
    method = getattr(cv2, "CALIB_HAND_EYE_" + name)
    rows = []
    for f, b in zip(d["flange"], d["board"]):
        r, t = cv2.calibrateHandEye(f[:, :3, :3], f[:, :3, 3], b[:, :3, :3], b[:, :3, 3], method=method)
        m = np.eye(4); m[:3, :3] = r; m[:3, 3] = t.ravel(); rows.append(m)
    out[name] = np.array(rows)
np.savez(sys.argv[2], **out)
"""


def measured(made: Arm, rng: np.random.Generator) -> list[np.ndarray]:
    return [project(view, marks()) + rng.normal(0, PIXEL, (len(marks()), 2)) for view in made.seen]


def views_of(made: Arm, pixels: list[np.ndarray]) -> list:
    camera, unknown = rig().camera, np.full((len(marks()), 2, 2), np.nan)
    number = np.arange(len(marks()))
    return [
        seen_target(
            camera, PlaneMarks(f"im{k:02}", p, marks()[:, :2], Pose.identity(), number, unknown), made.said[k], None
        )
        for k, p in enumerate(pixels)
    ]


def opencv_pose(pixels: np.ndarray) -> Pose:
    _, r, t = cv2.solvePnP(marks(), pixels, MATRIX, None, flags=cv2.SOLVEPNP_IPPE)
    r, t = cv2.solvePnPRefineLM(marks(), pixels, MATRIX, None, r, t)
    return Pose.from_rotation_vector(r.ravel(), t.ravel())


def plain(made: Arm, boards: list[Pose]) -> Pose:
    """Least squares of the board's corners in the base: A X B p against Y p, all alike, started at the truth."""
    corners = marks()[[0, 8, 45, 53]]

    def off(v: np.ndarray) -> np.ndarray:
        x, y = Pose.from_rotation_vector(v[:3], v[3:6]), Pose.from_rotation_vector(v[6:9], v[9:])
        return np.concatenate(
            [((f @ x @ b).apply(corners) - y.apply(corners)).ravel() for f, b in zip(made.said, boards, strict=True)]
        )

    start = [np.r_[Rotation.from_matrix(p.rotation).as_rotvec(), p.translation] for p in (made.sensor, made.target)]
    v = least_squares(off, np.concatenate(start), x_scale="jac").x
    return Pose.from_rotation_vector(v[:3], v[3:6])


def error(found: Pose, made: Arm) -> np.ndarray:
    turn = Rotation.from_matrix(found.rotation @ made.sensor.rotation.T).as_rotvec()
    return np.concatenate([turn, found.translation - made.sensor.translation])


def against_peers(draws: int, peer: str | None) -> None:
    ours, stated, lsq, scattered, flange, board, sessions = [], [], [], [], [], [], []
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        made = arm(rng, 15)
        pixels = measured(made, rng)
        views = views_of(made, pixels)
        start = consensus(views, "hand")
        fit = solve_hand_eye(views, "hand", repeatability=STATED, start=start)
        ours.append(error(fit.sensor, made))
        stated.append(np.sqrt(np.diag(fit.covariance)[:6]))
        free = solve_hand_eye(views, "hand", start=start)
        scattered.append(error(free.sensor, made) / np.sqrt(np.diag(free.covariance)[:6]))
        boards = [opencv_pose(p) for p in pixels]
        lsq.append(error(plain(made, boards), made))
        flange.append([p.matrix for p in made.said])
        board.append([p.matrix for p in boards])
        sessions.append(made)
    e, s = np.array(ours), np.array(stated)
    print(f"{draws} draws of 15 views, robot 0.03 mm and 0.01 degrees, corners 0.05 px")
    print(f"error over stated sigma, rms of 6 components: {np.sqrt(np.mean((e / s) ** 2)):.3f}"
          f"  (turns {np.sqrt(np.mean((e / s)[:, :3] ** 2)):.3f}, place {np.sqrt(np.mean((e / s)[:, 3:] ** 2)):.3f});"
          f" robot not stated: {np.sqrt(np.mean(np.square(scattered))):.3f}")  # fmt: skip
    rows = {"scope hand-eye": e, "plain least squares on OpenCV poses": np.array(lsq)}
    if peer:
        with tempfile.TemporaryDirectory() as folder:
            there, back = Path(folder) / "a.npz", Path(folder) / "b.npz"
            np.savez(there, flange=np.array(flange), board=np.array(board))
            subprocess.run([peer, "-c", PEER, str(there), str(back)], check=True)
            for name, found in np.load(back).items():
                rows[f"calibrateHandEye {name}"] = np.array(
                    [error(Pose.from_matrix(m, tolerance=1e-2), made) for m, made in zip(found, sessions, strict=True)]
                )
    for name, values in rows.items():
        mm, rad = (np.sqrt((values[:, k] ** 2).sum(axis=1).mean()) for k in (slice(3, 6), slice(0, 3)))
        ours_mm, ours_rad = (np.sqrt((e[:, k] ** 2).sum(axis=1).mean()) for k in (slice(3, 6), slice(0, 3)))
        print(
            f"{name:38} {mm:8.4f} mm {np.rad2deg(rad):8.4f} deg   ours / this: place {ours_mm / mm:.2f}, turn {ours_rad / rad:.2f}"
        )


WRONG = [
    ("quaternion-wxyz", "quaternion-xyzw", 1.0, "mm", False, 'notation = "quaternion-wxyz"'),
    ("kuka", "fanuc", 1.0, "mm", False, 'notation = "kuka"'),
    ("ur", "rpy-deg", 1.0, "mm", False, 'notation = "ur"'),
    ("ur", "ur", 1000.0, "mm", False, 'units = "m"'),
    ("fanuc", "fanuc", 1.0, "m", False, 'units = "mm"'),
    ("matrix", "matrix", 1.0, "mm", True, 'gives = "flange_from_base"'),
]


def faults(draws: int) -> None:
    named, only, false = 0, 0, 0
    for seed in range(draws):
        rng = np.random.default_rng(10_000 + seed)
        made = arm(rng, 15)
        pixels = measured(made, rng)
        sound = solve_hand_eye(views_of(made, pixels), "hand", repeatability=STATED)
        false += 15 - sound.used
        wrong, shift = int(rng.integers(15)), rng.normal(0, 1, 3)
        said = list(made.said)
        said[wrong] = Pose(said[wrong].rotation, said[wrong].translation + 5.0 * shift / np.linalg.norm(shift))
        spoilt = Arm(made.sensor, made.target, said, made.seen)
        out = [
            v.name for v in solve_hand_eye(views_of(spoilt, pixels), "hand", repeatability=STATED).views if not v.used
        ]
        named += f"im{wrong:02}" in out
        only += out == [f"im{wrong:02}"]
    print(
        f"1 of 15 poses wrong by 5 mm, {draws} draws: named {named}, it alone {only}; sound views left out without a fault: {false} of {15 * draws}"
    )
    told = 0
    count = max(2, draws // 10)
    for seed in range(count):
        for written, stated, mm, units, inverse, name in WRONG:
            rng = np.random.default_rng(20_000 + seed)
            made = arm(rng, 15)
            rows = [numbers(written, p.inverse if inverse else p, mm) for p in made.said]
            log = PoseLog(
                Path("poses.csv"),
                tuple(f"im{k:02}.png" for k in range(15)),
                np.array(rows),
                stated,
                units,
                "base_from_flange",
            )
            views = [v.saying(log.base_from_flange(k)) for k, v in enumerate(views_of(made, measured(made, rng)))]
            found = readings_of(log, range(15), views, "hand")[0]
            told += found.told == name and 4 * found.start.typical_mm < consensus(views, "hand").typical_mm
    print(f"six wrong conventions, {count} draws each: named {told} of {6 * count}")


def sphere(draws: int) -> None:
    """20 passes over a sphere of 40 mm (points of 0.02 mm) against 15 views of the board."""
    by_sphere, by_target, stated = [], [], []
    for seed in range(draws):
        rng = np.random.default_rng(30_000 + seed)
        fit = solve_by_sphere(passes(rng, "hand"), 20.0, "hand", repeatability=STATED)
        by_sphere.append(error(fit.sensor, Arm(SENSOR, SENSOR, [], [])))
        stated.append(by_sphere[-1] / np.sqrt(np.diag(fit.covariance)[:6]))
        made = arm(rng, 15)
        by_target.append(
            error(solve_hand_eye(views_of(made, measured(made, rng)), "hand", repeatability=STATED).sensor, made)
        )
    s, t = np.array(by_sphere), np.array(by_target)
    rms = [[float(np.sqrt((e[:, k] ** 2).sum(axis=1).mean())) for k in (slice(3, 6), slice(0, 3))] for e in (s, t)]
    print(
        f"by 20 passes over a sphere, {draws} draws: {rms[0][0]:.4f} mm {np.rad2deg(rms[0][1]):.4f} deg, over the target's {rms[0][0] / rms[1][0]:.2f} "
        f"(turn {rms[0][1] / rms[1][1]:.2f}); error over stated sigma {np.sqrt(np.mean(np.square(stated))):.2f}"
    )


def planes(draws: int) -> None:
    """20 stripes on one plane, and on three, against 15 views of the board; points of 0.02 mm."""
    for count in (1, 3):
        off, by_target, stated = [], [], []
        for seed in range(draws):
            rng = np.random.default_rng(40_000 + seed)
            made, label = plane_passes(rng, "hand", count, n=20)
            fit = solve_by_planes(made, label, "hand", repeatability=STATED)
            off.append(error(fit.sensor, Arm(SENSOR, SENSOR, [], [])))
            stated.append(off[-1] / np.sqrt(np.diag(fit.covariance)))
            views = arm(rng, 15)
            by_target.append(
                error(solve_hand_eye(views_of(views, measured(views, rng)), "hand", repeatability=STATED).sensor, views)
            )
        p, t = np.array(off), np.array(by_target)
        rms = [[float(np.sqrt((e[:, k] ** 2).sum(axis=1).mean())) for k in (slice(3, 6), slice(0, 3))] for e in (p, t)]
        print(
            f"by 20 passes over {count} plane(s), {draws} draws: {rms[0][0]:.4f} mm {np.rad2deg(rms[0][1]):.4f} deg, over the target's "
            f"{rms[0][0] / rms[1][0]:.2f} (turn {rms[0][1] / rms[1][1]:.2f}); error over stated sigma {np.sqrt(np.mean(np.square(stated))):.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--faults", type=int, default=40)
    parser.add_argument("--peer", default=None)
    parser.add_argument("--sphere", type=int, default=20)
    parser.add_argument("--planes", type=int, default=20)
    asked = parser.parse_args()
    if asked.planes:
        planes(asked.planes)
    if asked.sphere:
        sphere(asked.sphere)
    if asked.draws:
        against_peers(asked.draws, asked.peer)
    if asked.faults:
        faults(asked.faults)


if __name__ == "__main__":
    main()
