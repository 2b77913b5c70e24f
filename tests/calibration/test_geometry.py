"""Rays, planes and poses against SciPy and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from calibration.geometry import Plane, Pose, Rays, fit_plane
from calibration.reason import Reason

vectors = arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))
RNG = np.random.default_rng(0)


def some_rays(n: int) -> Rays:
    direction = RNG.normal(size=(n, 3))
    return Rays(RNG.normal(size=(n, 3)) * 50, direction / np.linalg.norm(direction, axis=1, keepdims=True))


class TestPose:
    @given(vectors)
    def test_rotation_vector_is_scipys(self, w: np.ndarray) -> None:
        assert (
            np.abs(Pose.from_rotation_vector(w, np.zeros(3)).rotation - Rotation.from_rotvec(w).as_matrix()).max()
            < 1e-14
        )

    @pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, np.pi, 2 * np.pi])
    def test_special_angles(self, angle: float) -> None:
        w = angle * np.array([2.0, -1.0, 2.0]) / 3
        assert (
            np.abs(Pose.from_rotation_vector(w, np.zeros(3)).rotation - Rotation.from_rotvec(w).as_matrix()).max()
            < 1e-15
        )

    @given(vectors, vectors, vectors, vectors)
    @settings(max_examples=50)
    def test_composition_and_inverse_are_those_of_the_matrices(
        self, a: np.ndarray, b: np.ndarray, s: np.ndarray, t: np.ndarray
    ) -> None:
        one, two = Pose.from_rotation_vector(a, s), Pose.from_rotation_vector(b, t)
        assert np.allclose((one @ two).matrix, one.matrix @ two.matrix, atol=1e-13)
        assert np.allclose(one.inverse.matrix, np.linalg.inv(one.matrix), atol=1e-13)
        point = np.array([[1.0, -2.0, 3.0]])
        assert np.allclose((one @ two).apply(point), one.apply(two.apply(point)), atol=1e-12)

    def test_a_rounded_matrix_becomes_a_rotation(self) -> None:
        exact = Pose.from_rotation_vector([0.3, -1.1, 0.7], [1.0, 2.0, 3.0])
        found = Pose.from_matrix(np.round(exact.matrix, 5))
        assert np.abs(found.rotation @ found.rotation.T - np.eye(3)).max() < 1e-15
        assert np.abs(found.rotation - exact.rotation).max() < 2e-5
        assert found.translation.tolist() == [1.0, 2.0, 3.0]

    @pytest.mark.parametrize(
        ("change", "text"),
        [
            ((0, 0, 2.0), "no rotation"),
            ((3, 1, 0.5), "last row"),
            ((0, 3, np.nan), "finite"),
            ((3, 3, 0.0), "last row"),
        ],
    )
    def test_what_is_no_motion_is_refused(self, change: tuple[int, int, float], text: str) -> None:
        matrix = np.eye(4)
        matrix[change[:2]] = change[2]
        with pytest.raises(ValueError, match=text):
            Pose.from_matrix(matrix)
        with pytest.raises(ValueError, match="no rotation"):
            Pose.from_matrix(np.diag([1.0, 1.0, -1.0, 1.0]))


class TestPlane:
    def test_points_lie_on_ray_and_plane(self) -> None:
        rays, plane = some_rays(500), Plane.through([1.0, 2.0, 3.0], [0.3, -0.2, 5.0])
        found = plane.intersect(rays)
        good = found.reason == Reason.RANGED
        assert 400 < good.sum() < 500
        assert np.abs(plane.distance(found.points[good])).max() < 1e-9
        assert np.abs(rays.distance_to(found.points)[good]).max() < 1e-9
        angle = np.abs(np.arcsin(np.clip(rays.direction @ plane.normal, -1, 1)))  # between ray and plane
        assert np.array_equal(good, np.sin(angle) >= 0.02)
        assert np.isnan(found.points[~good]).all()
        assert set(found.reason[~good]) == {Reason.SHALLOW}

    def test_a_pixel_without_ray_has_no_point(self) -> None:
        rays = Rays(np.array([[np.nan] * 3, [0.0, 0.0, 0.0]]), np.array([[np.nan] * 3, [0.0, 0.0, 1.0]]))
        found = Plane.through([0, 0, 5.0], [0, 0, 1.0]).intersect(rays)
        assert found.reason.tolist() == [Reason.OUTSIDE_CALIBRATION, Reason.RANGED]
        assert np.isnan(found.points[0]).all()
        assert found.points[1].tolist() == [0.0, 0.0, 5.0]

    @pytest.mark.parametrize("normal", [[0, 0, 0], [np.nan, 0, 1]])
    def test_a_normal_must_have_a_length(self, normal: list[float]) -> None:
        with pytest.raises(ValueError, match="normal"):
            Plane.through([0, 0, 0], normal)


class TestFitPlane:
    def test_is_at_a_minimum_of_the_squared_distances(self) -> None:
        points = RNG.normal(size=(200, 3)) * [30, 20, 0.5] + [5, 6, 7]
        best = fit_plane(points)
        least = (best.distance(points) ** 2).sum()
        for _ in range(50):
            other = Plane.through(
                points.mean(axis=0) + RNG.normal(size=3) * 0.01, best.normal + RNG.normal(size=3) * 1e-3
            )
            assert (other.distance(points) ** 2).sum() >= least

    def test_weight_two_is_the_same_point_twice(self) -> None:
        points = RNG.normal(size=(40, 3))
        twice = fit_plane(np.concatenate([points, points[:10]]))
        weighted = fit_plane(points, weights=np.r_[np.full(10, 2.0), np.ones(30)])
        assert abs(twice.normal @ weighted.normal) == pytest.approx(1.0, abs=1e-14)

    @pytest.mark.parametrize("points", [np.zeros((2, 3)), np.outer(np.arange(5.0), [1.0, 2.0, 3.0])])
    def test_no_plane_from_a_line(self, points: np.ndarray) -> None:
        with pytest.raises(ValueError, match=r"three points|one line"):
            fit_plane(points)


def test_depth_and_distance_along_a_ray() -> None:
    rays = some_rays(20)
    assert np.allclose(rays.at_depth(33.0)[:, 2], 33.0, atol=1e-8)
    assert np.allclose(np.linalg.norm(rays.at(np.full(20, -7.0)) - rays.origin, axis=1), 7.0)
