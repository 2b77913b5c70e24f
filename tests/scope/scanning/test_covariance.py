"""Covariance of points and their Jacobian to the calibration: against differences, repeats and the sigmas of the cloud."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.geometry import Pose
from calibration.rays import PinholeCamera, TwoPlaneCamera
from calibration.rig import Rig
from calibration.sheet import CurvedSheet, Laser, SheetFrame
from calibration.stages import Stage
from calibration.volume import Volume
from ranging.covariance import propagate
from ranging.motion import Fixed, Turntable
from ranging.triangulation import triangulate
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.scanning import point_covariance, scan, systematic_of


@pytest.fixture(scope="module")
def rig(session) -> Rig:
    return Rig.load(session.rig)


@pytest.fixture(scope="module")
def cloud(session, rig: Rig) -> ScanCloud:
    found = scan(session.capture, rig)
    return found.select(np.arange(0, len(found), 37))


def bent(laser: Laser) -> Laser:
    """The same laser with a sheet of the fourth order."""
    rng = np.random.default_rng(1)
    sheet = CurvedSheet(laser.plane, laser.frame, rng.normal(0.0, 0.3, 11))
    return replace(laser, sheet=sheet, covariance=np.eye(14) * 1e-4)


def moved_camera(camera: TwoPlaneCamera, step: np.ndarray) -> TwoPlaneCamera:
    field = camera.field
    return replace(camera, field=replace(field, coefficients=field.coefficients + step.reshape(2, -1).T))


def moved_laser(laser: Laser, step: np.ndarray) -> Laser:
    """The sheet after its parameters have changed: n . x = offset + terms . step."""
    curvature = laser.sheet.curvature if isinstance(laser.sheet, CurvedSheet) else np.zeros(0)
    tilt, offset, more = step[:2], step[2], step[3:]
    frame, plane = laser.frame, laser.plane
    normal = plane.normal - (tilt / frame.reach) @ frame.axes
    length = float(np.linalg.norm(normal))
    flat = replace(plane, normal=normal / length, offset=(normal @ frame.centre + offset) / length)
    if len(curvature) == 0:
        return replace(laser, sheet=flat)
    return replace(
        laser, sheet=CurvedSheet(flat, SheetFrame(frame.centre, frame.axes, frame.reach), (curvature + more) / length)
    )


@pytest.mark.parametrize("shape", ["plane", "curved"])
def test_the_jacobian_is_that_of_differences(rig: Rig, shape: str) -> None:
    camera = rig.camera
    assert isinstance(camera, TwoPlaneCamera)
    laser = rig.lasers["laser"] if shape == "plane" else bent(rig.lasers["laser"])
    rng = np.random.default_rng(2)
    seen = np.stack([rng.uniform(60, 580, 40), rng.uniform(180, 330, 40)], axis=1)

    def ranged(camera: TwoPlaneCamera, laser: Laser) -> np.ndarray:
        return triangulate(camera, laser, seen, np.full(40, 0.02), 1, extrapolate=1e4).points

    points = ranged(camera, laser)
    found = propagate(camera, laser, seen, points, np.full(40, 0.02), 1, jacobian=True)
    assert found.jacobian is not None
    own = len(camera.covariance)
    assert found.jacobian.shape == (40, 3, own + len(laser.covariance))
    for k in [*range(0, own, 7), *range(own, found.jacobian.shape[2])]:
        step = np.zeros(found.jacobian.shape[2])
        step[k] = 1e-3
        ahead, behind = (
            ranged(moved_camera(camera, sign * step[:own]), moved_laser(laser, sign * step[own:])) for sign in (1, -1)
        )
        np.testing.assert_allclose(found.jacobian[:, :, k], (ahead - behind) / 2e-3, rtol=2e-3, atol=2e-4)


def test_a_pinhole_moves_by_its_intrinsics(rig: Rig) -> None:
    matrix = np.array([[700.0, 0.0, 322.0], [0.0, 705.0, 236.0], [0.0, 0.0, 1.0]])
    spread = np.diag([0.2, 0.2, 0.3, 0.3, 1e-3, 1e-3, 1e-4, 1e-4, 0.0]) ** 2
    pose = Pose.from_rotation_vector([0.02, -0.05, 0.3], [3.0, -2.0, 5.0])
    camera = PinholeCamera(
        matrix, np.array([-0.12, 0.03, 0.0, 0.0, 0.0]), pose, (640, 480), Volume.everywhere(), spread, 0.02
    )
    laser = rig.lasers["laser"]
    rng = np.random.default_rng(5)
    seen = np.stack([rng.uniform(60, 580, 20), rng.uniform(180, 330, 20)], axis=1)
    points = triangulate(camera, laser, seen, np.full(20, 0.02), 1).points
    found = propagate(camera, laser, seen, points, np.full(20, 0.02), 1, jacobian=True)
    assert found.jacobian is not None
    for k, (i, j) in enumerate([(0, 0), (1, 1), (0, 2), (1, 2)]):
        moved = []
        for sign in (1, -1):
            other = matrix.copy()
            other[i, j] += sign * 0.1
            moved.append(triangulate(replace(camera, matrix=other), laser, seen, np.full(20, 0.02), 1).points)
        np.testing.assert_allclose(found.jacobian[:, :, k], (moved[0] - moved[1]) / 0.2, rtol=2e-3, atol=2e-4)


def test_along_the_ray_it_says_what_the_cloud_says(rig: Rig, cloud: ScanCloud) -> None:
    found = point_covariance(cloud, rig)
    assert cloud.sensors is not None
    at = np.searchsorted(cloud.sensors.frame, cloud.frame)
    view = cloud.points - cloud.sensors.centre[at]
    depth = view[:, 2] / np.linalg.norm(
        view, axis=1
    )  # both move rays across depth: what is left in depth is along the ray
    for told, covariance in ((cloud.sigma, found.noise), (cloud.sigma_cal, found.calibration)):
        np.testing.assert_allclose(np.sqrt(covariance[:, 2, 2]) / depth, told, rtol=0.03)
        assert np.linalg.eigvalsh(covariance).min() > -1e-9
        np.testing.assert_allclose(covariance, covariance.transpose(0, 2, 1), atol=1e-12)
    normal = rig.lasers["laser"].plane.normal  # noise leaves a point in the sheet; this stage does not turn
    assert np.abs(found.noise @ normal).max() < 1e-6 * found.noise.max()


def test_calibrations_drawn_from_their_covariance_scatter_points_so(rig: Rig, cloud: ScanCloud) -> None:
    few = cloud.select(np.arange(0, len(cloud), 16))
    found = point_covariance(few, rig, jacobian=True)
    assert found.jacobian is not None
    camera, laser = rig.camera, rig.lasers["laser"]
    assert isinstance(camera, TwoPlaneCamera)
    own = len(camera.covariance)
    seen = few.pixels.astype(np.float64)
    draws = np.random.default_rng(3).multivariate_normal(np.zeros(len(found.parameters)), found.parameters, 400)
    ranged = np.array(
        [
            triangulate(
                moved_camera(camera, draw[:own]), moved_laser(laser, draw[own:]), seen, np.full(len(seen), 0.02), 1,
                extrapolate=1e4,
            ).points
            for draw in draws
        ]
    )  # fmt: skip
    scatter = ranged - ranged.mean(axis=0)
    measured = np.einsum("dni,dnj->nij", scatter, scatter) / (len(draws) - 1)
    scale = np.abs(found.calibration).max(axis=(1, 2), keepdims=True)
    assert np.abs((measured - found.calibration) / scale).max() < 0.3  # of 400 draws: 7 % are one standard error
    assert np.abs(((measured - found.calibration) / scale).mean(axis=0)).max() < 0.12
    first, last = found.jacobian[0], found.jacobian[-1]
    shared = np.einsum("di,dj->ij", scatter[:, 0], scatter[:, -1]) / (len(draws) - 1)
    np.testing.assert_allclose(first @ found.parameters @ last.T, shared, atol=0.3 * float(scale.max()))


def test_another_rig_and_bare_points_are_refused(rig: Rig, cloud: ScanCloud) -> None:
    with pytest.raises(MeasurementError, match="give the rig of the scan"):
        point_covariance(replace(cloud, rig_sha256="0" * 64), rig)
    with pytest.raises(MeasurementError, match="where its sensor was"):
        point_covariance(replace(cloud, sensors=None), rig)


def test_a_turntable_found_with_the_camera_takes_along_what_moves_it(rig: Rig) -> None:
    """A camera wrong by a rigid motion puts sheet and axis wrong alike: its cloud is moved as a whole, and no size with it."""
    camera = PinholeCamera(
        np.array([[700.0, 0.0, 322.0], [0.0, 705.0, 236.0], [0.0, 0.0, 1.0]]), np.zeros(5), Pose.identity(), (640, 480),
        Volume.everywhere(), np.diag([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.1,
    )  # fmt: skip
    laser = rig.lasers["laser"]
    about = np.array([5.0, 40.0, 380.0])
    axis = np.array([0.0, -np.cos(0.6), -np.sin(0.6)])
    turns = np.zeros((3, 9))  # rad a px of the principal point, roughly: a pan and a tilt of the camera
    turns[1, 2], turns[0, 3] = -1 / 700, 1 / 705
    shift = np.cross(turns.T, about).T
    direction = np.cross(turns.T, axis).T
    stage = Stage("turntable", axis, about, 0.0, 1.0, 0.0, coupling=np.concatenate([shift, direction]))
    lift = np.array([laser.frame.axes @ np.cross(w, laser.plane.normal) * -laser.frame.reach for w in turns.T])
    offset = np.array([np.cross(w, laser.frame.centre) @ laser.plane.normal for w in turns.T])
    coupling = np.column_stack([lift, offset]).T
    still = replace(laser, sheet=laser.plane, covariance=np.zeros((3, 3)), coupling=coupling, local_mm=0.0)
    own = replace(rig, camera=camera, lasers={"laser": still}, stages=(stage,))
    seen = {
        0: np.array([[320.0, 234.0], [324.0, 238.0]])
    }  # there a principal point that is off is a camera that is turned
    turning = Turntable(about, axis, 0.1)
    alone, together = systematic_of(own, [still], seen, Fixed()), systematic_of(own, [still], seen, turning)
    assert alone is not None
    assert together is not None
    points = still.sheet.intersect(camera.rays(together.pixels)).points
    spin = np.cross(axis, points - about)  # about the axis itself: the whole cloud turns, whatever the angle
    share = np.einsum("gki,gi->k", together.moves, spin) / (spin**2).sum()
    left = together.moves - share[None, :, None] * spin[:, None]
    assert np.abs(left).max() < 0.01 * np.abs(alone.moves).max()
