"""Pictures and the table of a pose's page: a box whose depth, colours and residuals are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from calibration.geometry import Pose

pytest.importorskip("open3d")

from scope.model import Surface
from scope.pose.residuals import residuals_by_face
from scope.report.part import INSIDE, ON, OUTSIDE, Look, colour_bar, deviation_colours, nice_limit, shaded, with_scan


@pytest.fixture(scope="module")
def box() -> Surface:
    mesh = trimesh.creation.box(extents=(40.0, 20.0, 10.0))
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def test_the_scale_fits_the_deviations() -> None:
    """The limit is round and just holds 95 % of them, from a hundredth to a millimetre."""
    rng = np.random.default_rng(0)
    for sigma in (0.003, 0.015, 0.2, 3.0):
        off = rng.normal(scale=sigma, size=20_000)
        limit = nice_limit(off)
        assert limit == pytest.approx(0.01) or 1.0 <= limit / (1.96 * sigma) <= 2.05
        assert float(f"{limit:.0e}") == pytest.approx(limit)
    colours = deviation_colours(np.array([-1.0, -0.05, 0.0, 0.05, 1.0]), 0.05)
    assert (colours == np.array([INSIDE, INSIDE, ON, OUTSIDE, OUTSIDE])).all()
    assert "+0.05" in colour_bar(0.05, 0.02)
    assert "0.02 mm" in colour_bar(0.05, 0.02)
    assert "tolerance" not in colour_bar(0.05, 0.1)  # would lie off the bar


def test_a_picture_shows_the_part_where_it_is_and_hides_what_is_behind(box: Surface) -> None:
    """Depth of a box seen from above is closed form; a point on its far side is not drawn, one on it is."""
    pose = Pose.from_rotation_vector([0.0, 0.0, 0.0], [5.0, -3.0, 400.0])
    corners = pose.apply(np.array(np.meshgrid([-20, 20], [-10, 10], [-5, 5])).reshape(3, -1).T.astype(float))
    look = Look.along(np.array([0.0, 0.0, 1.0]), corners, width=200)
    picture, depth = shaded(box, pose, look)
    shown = np.isfinite(depth)
    assert np.abs(depth[shown]).max() < 1e-3  # its upper face is the nearest corner
    assert shown.sum() / look.scale**2 == pytest.approx(800.0, rel=0.02)  # mm2
    points = np.array([[5.0, -3.0, 395.0], [-10.0, -3.0, 405.0]])
    dotted = with_scan(picture, depth, look, points, np.array([OUTSIDE, OUTSIDE], dtype=np.uint8))
    at = np.floor(look.pixels(points)[0]).astype(int)
    assert (dotted[at[0, 1], at[0, 0]] == OUTSIDE).all()
    assert (dotted[at[1, 1], at[1, 0]] == picture[at[1, 1], at[1, 0]]).all()


def test_residuals_of_a_face_are_told_of_that_face(box: Surface) -> None:
    """Only the face that is off by more than the tolerance is called off, with a mean and a scatter that are known."""
    rng = np.random.default_rng(1)
    top = np.column_stack([rng.uniform(-19, 19, 3000), rng.uniform(-9, 9, 3000), rng.normal(5.0, 0.02, 3000)])
    side = np.column_stack([np.full(800, 20.3), rng.uniform(-9, 9, 800), rng.uniform(-4, 4, 800)])
    side[:, 0] += rng.normal(scale=0.03, size=800)
    pose = Pose.from_rotation_vector([0.3, -0.2, 0.5], [10.0, 20.0, 300.0])
    sigma = np.full(3800, 0.02)
    points = pose.apply(np.concatenate([top, side]))
    first, second = residuals_by_face(box, pose, points, sigma, diameter=46.0, tolerance=0.1)
    assert (first.points, second.points) == (3000, 800)
    assert np.allclose(first.direction, [0, 0, 1])
    assert np.allclose(second.direction, [1, 0, 0])
    assert not first.off
    assert second.off
    assert first.mean == pytest.approx(0.0, abs=4 * first.error)
    assert second.mean == pytest.approx(0.3, abs=0.005)
    assert first.scatter == pytest.approx(0.02, rel=0.1)
    assert first.stated == pytest.approx(0.02)
    assert first.error == pytest.approx(0.02 / np.sqrt(3000), rel=0.35)
