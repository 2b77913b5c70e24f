"""The laser plane from freehand views, beside vision-calibration fed the same points: python -m benchmarks.laser."""

from __future__ import annotations

import cv2
import numpy as np

from benchmarks.shared import head, row
from calibration.geometry import Array, Plane, Pose
from calibration.rays import PlaneMarks, fit_freehand
from calibration.sheet import StripePoints, fit_laser

SIZE = (1280, 960)
MATRIX = np.array([[1400.0, 0, 655.0], [0, 1400.0, 470.0], [0, 0, 1]])
DISTORTION = np.array([-0.18, 0.05, 0.0004, -0.0003, 0.0])
LASER = Plane.through(np.array([-160.0, 0.0, 10.0]), np.cross([160.0, 0.0, 400.0], [0.02, 1.0, 0.0]))
MARK_NOISE, STRIPE_NOISE = 0.05, 0.1  # px
SESSIONS = 50
VIEWS = 12

View = tuple[PlaneMarks, Array]  # marks, stripe pixels (n, 2)


def session(rng: np.random.Generator) -> list[View]:
    """Views of an 11 x 15 board, tilted by up to 35 degrees, with the stripe on each."""
    r, c = np.mgrid[0:11, 0:15]
    board = np.column_stack([c.ravel() * 12.0 - 84.0, r.ravel() * 12.0 - 60.0])
    views: list[View] = []
    while len(views) < VIEWS:
        turn = np.deg2rad([*rng.uniform(-35, 35, 2), rng.uniform(-15, 15)])
        pose = Pose.from_rotation_vector(turn, [rng.uniform(-30, 30), rng.uniform(-20, 20), rng.uniform(340, 460)])
        pixels = _project(pose.apply(np.column_stack([board, np.zeros(len(board))])))
        stripe = _stripe(pose)
        if ((pixels < 5) | (pixels > np.array(SIZE) - 6)).any() or len(stripe) < 50:
            continue
        pixels = pixels + rng.normal(0, MARK_NOISE, pixels.shape)
        stripe = stripe + np.column_stack([rng.normal(0, STRIPE_NOISE, len(stripe)), np.zeros(len(stripe))])
        unknown = np.full((len(board), 2, 2), np.nan)
        marks = PlaneMarks(f"view{len(views)}", pixels, board, Pose.identity(), np.arange(len(board)), unknown)
        views.append((marks, stripe))
    return views


def _project(points: Array) -> Array:
    return np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, DISTORTION)[0][:, 0])


def _stripe(pose: Pose) -> Array:
    """Pixels where the laser crosses the board, one an image row or so."""
    normal, offset = pose.rotation.T @ LASER.normal, LASER.offset - LASER.normal @ pose.translation
    y = np.linspace(-60, 60, 300)
    x = (offset - normal[1] * y) / normal[0]
    inside = np.abs(x) < 84
    return _project(pose.apply(np.column_stack([x, y, np.zeros(len(y))])[inside]))


def ours(views: list[View]) -> Plane:
    """SCOPE's freehand path."""
    fit = fit_freehand([marks for marks, _ in views], SIZE)
    stripes = []
    for marks, (_, stripe) in zip(fit.views, views, strict=True):
        board = Plane.through(marks.c_from_plane.translation, marks.c_from_plane.rotation[:, 2])
        points = board.intersect(fit.camera.rays(stripe)).points
        stripes.append(StripePoints(marks.name, points, np.full(len(points), np.nan)))
    return fit_laser("laser", stripes, along="columns", channel="gray", curved=False).plane


def theirs(views: list[View]) -> Plane:
    """vision-calibration's bundle adjustment, at its defaults."""
    import vision_calibration as vc

    data = [
        vc.LaserlineView(
            observation=vc.Observation(
                points_3d=np.column_stack([m.points, np.zeros(len(m))]).tolist(), points_2d=m.pixels.tolist()
            ),
            laser_pixels=stripe.tolist(),
            laser_weights=[1.0] * len(stripe),
        )
        for m, stripe in views
    ]
    plane = vc.run_laserline_device(vc.LaserlineDataset(views=data)).estimate.params.plane
    return Plane(np.array(plane.normal_xyz), -plane.distance)


def errors(found: Plane) -> tuple[float, float]:
    """Angle, degrees, and distance in the middle of the views, mm."""
    angle = float(np.degrees(np.linalg.norm(np.cross(found.normal, LASER.normal))))
    middle = np.array([0.0, 0.0, 400.0])
    middle = middle - LASER.distance(middle[None])[0] * LASER.normal
    gap = abs(float(found.normal @ middle) - found.offset)
    return angle, min(gap, abs(float(found.normal @ middle) + found.offset))


def main() -> None:
    a, b = [], []
    for seed in range(SESSIONS):
        views = session(np.random.default_rng(seed))
        a.append(errors(ours(views)))
        b.append(errors(theirs(views)))
    mine, peer = np.median(a, axis=0), np.median(b, axis=0)
    head(
        f"laser plane, median of {SESSIONS} sessions of {VIEWS} views", "vision-calibration", "SCOPE", "ratio", "reach"
    )
    row("angle, deg", peer[0], mine[0], mine[0] / peer[0], "<= 1.0")
    row("offset in the middle, mm", peer[1], mine[1], mine[1] / peer[1], "<= 1.0")


if __name__ == "__main__":
    main()
