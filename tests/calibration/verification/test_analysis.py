from dataclasses import replace

import numpy as np
import pytest

from benchmarks.sessions import FIVE, FOUR, SIZE, session
from calibration.camera import pixel_grid
from calibration.rays import fit_plane_map, fit_ray_field, fit_two_plane, ray_uncertainty
from calibration.rays.two_plane import with_model
from calibration.verification import against, block_image, held_out, interplane, intraplane
from calibration.verification.analysis import lines, lines_paper


@pytest.fixture(scope="module")
def fit():
    return fit_two_plane(session(np.random.default_rng(1)), SIZE)


def test_the_best_line_is_that_of_the_largest_eigenvector():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(6, 40, 3)) * [1.0, 2.0, 9.0]
    centroid, direction, offset = lines(points)
    for k in range(40):
        p = points[:, k] - points[:, k].mean(axis=0)
        values, vectors = np.linalg.eigh(p.T @ p)
        assert abs(vectors[:, -1] @ direction[k]) == pytest.approx(1.0, abs=1e-9)
        assert (offset[:, k] ** 2).sum() == pytest.approx(values[:2].sum(), rel=1e-9)
    assert np.allclose(np.einsum("kni,ni->kn", offset, direction), 0.0, atol=1e-12)
    assert np.allclose(centroid, points.mean(axis=0))


def test_the_papers_line_follows_its_equations_and_agrees_to_second_order():
    rng = np.random.default_rng(3)
    s = np.array([-80.0, -30.0, 10.0, 45.0, 90.0])
    way = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    angle = []
    for error in (0.1, 0.01):
        points = s[:, None, None] * way + error * rng.normal(size=(5, 30, 3))
        direction, e = lines_paper(points)
        p = points - points.mean(axis=0)
        signed = np.sign(p @ way) * np.linalg.norm(p, axis=2)
        m = np.linalg.pinv(signed[:, 3][:, None]) @ p[:, 3]  # equation 7, one pixel, by the pseudoinverse itself
        assert np.allclose(e[:, 3], p[:, 3] - signed[:, 3][:, None] * m, atol=1e-12)
        angle.append(np.linalg.norm(np.cross(direction, lines(points)[1]), axis=1).max())
    assert angle[0] < 1e-5
    assert angle[1] < angle[0] / 100  # ten times less error: at least a hundred times less difference


def test_two_planes_agree_exactly_and_outside_is_unknown():
    camera = fit_two_plane(session(np.random.default_rng(4), stand_offs=(320.0, 480.0)), SIZE).camera
    found = interplane(camera, grid=(12, 16))
    assert found.interplane_px < 1e-9
    assert np.isnan(found.error_px[0, 0])
    assert np.isfinite(found.error_px[6, 8])


def test_a_slip_shows_in_the_inter_plane_image_as_its_component_off_the_line():
    slip = 0.3
    marks = session(np.random.default_rng(5), noise_px=0.0)
    clean = interplane(fit_two_plane(marks, SIZE).camera, grid=(9, 12))
    moved = replace(marks[1], points=marks[1].points + np.array([slip, 0.0]))
    found = interplane(fit_two_plane([marks[0], moved, *marks[2:]], SIZE).camera, grid=(9, 12))
    z = np.array(FIVE) - np.mean(FIVE)
    left = slip * np.sqrt(1 - 1 / 5 - z[1] ** 2 / (z @ z)) / np.sqrt(5)  # what no line follows, rms over five planes
    inside = np.isfinite(found.error_mm)
    assert clean.interplane_mm < 0.003
    assert found.error_mm[inside].mean() == pytest.approx(left, rel=0.05)  # across rays up to 30 degrees off the normal
    assert found.sum_abs[inside].min() > found.error_mm[inside].min()


def test_pictures(fit):
    pixels = pixel_grid((8, 4), (2, 4))
    assert np.allclose(pixels[0, 0], [0.5, 0.5])
    assert np.allclose(pixels[1, 3], [6.5, 2.5])
    picture = block_image(np.array([[100.0, 40.0], [200.0, 40.0]]), np.array([1.0, 2.0]), (320, 80), step=4)
    assert picture.shape == (20, 80)
    assert picture[10, 25] == 1.0
    assert picture[10, 50] == 2.0
    assert np.isnan(picture[0, 0])
    rows = intraplane(fit).planes
    assert [len(r.pixels) for r in rows] == [len(m) for m in fit.marks]
    assert all(r.loo_px > r.fit_px >= r.fit_px_mean for r in rows)


@pytest.mark.parametrize(("target_mm", "noise_px"), [(0.0, 0.02), (0.03, 0.01)])
def test_residuals_split_into_what_was_put_in(target_mm, noise_px):
    marks = session(np.random.default_rng(6), target_mm=target_mm, noise_px=noise_px)
    split = intraplane(fit_two_plane(marks, SIZE)).split
    assert split.random_px == pytest.approx(noise_px * np.sqrt(2), rel=0.05)
    assert split.placement_px < 0.4 * split.random_px
    scale = 1400.0 / 400.0  # px a mm in the middle of the volume
    assert split.target_px == pytest.approx(target_mm * scale * np.sqrt(2), rel=0.12, abs=1e-9)


def test_a_slipped_plane_is_placement_and_the_target_is_recovered():
    rng = np.random.default_rng(7)
    marks = session(rng, target_mm=0.03, noise_px=0.01)
    marks[2] = replace(marks[2], points=marks[2].points + np.array([0.1, 0.0]))
    split = intraplane(fit_two_plane(marks, SIZE)).split
    assert np.argmax(split.plane_px) == 2
    assert split.random_px == pytest.approx(0.01 * np.sqrt(2), rel=0.1)
    real = np.random.default_rng(7).standard_normal((475, 2)) * 0.03  # the first that the session draws
    moved = split.target_mm
    assert np.corrcoef(moved.ravel(), real[split.mark].ravel())[0, 1] > 0.9


def test_held_out_planes_equal_a_fit_without_them(fit):
    """The closed form against brute force."""
    orders = (fit.joint.field.slope_order, fit.joint.field.origin_order)
    for k, row in enumerate(held_out(fit)):
        others = [m for i, m in enumerate(fit.marks) if i != k]
        rays = fit_ray_field(others, orders=orders).field.rays(fit.marks[k].pixels)
        distance = rays.distance_to(fit.marks[k].world)
        assert row.rms_mm == pytest.approx(np.sqrt((distance**2).mean()), rel=0.01)
        assert row.between == (0 < k < 4)


def test_held_out_planes_of_the_two_plane_camera(fit):
    for k, row in enumerate(held_out(fit, model="two-plane")):
        if 0 < k < 4:
            others = [m for i, m in enumerate(fit.marks) if i != k]
            camera = fit_two_plane(others, SIZE, order=fit.planes[0].map.terms, model="two-plane").camera
            there = against(camera, fit.marks[k])
            assert row.rms_mm == pytest.approx(there.rms_mm, rel=1e-6)
            assert np.allclose(row.bias_mm, there.bias_mm, atol=1e-9)


def test_bias_of_a_held_out_plane_is_the_slip_of_that_plane():
    marks = session(np.random.default_rng(8))
    marks[2] = replace(marks[2], points=marks[2].points + np.array([0.2, -0.1]))
    row = held_out(fit_two_plane(marks, SIZE))[2]
    assert row.bias_mm[:2] == pytest.approx([0.2, -0.1], rel=0.15)  # perpendicular to rays up to 25 degrees off
    assert row.rms_mm > 0.18


def test_two_planes_have_nothing_to_hold_out():
    two = fit_two_plane(session(np.random.default_rng(9), stand_offs=(320.0, 480.0)), SIZE)
    assert held_out(two) == ()
    assert np.isnan(intraplane(two).split.random_px)


def sparse(stand_offs, noise_px):
    return session(np.random.default_rng(0), stand_offs=stand_offs, rows=10, columns=13, pitch=24.0, noise_px=noise_px)


def noisy(exact, rng):
    return [replace(m, pixels=m.pixels + 0.02 * rng.standard_normal(m.pixels.shape)) for m in exact]


def check_uncertainty(stated, crossings):
    """Within 10 % as a whole, and nowhere far off."""
    known = np.isfinite(stated.sigma_mm)
    scatter = np.sqrt(np.var(crossings, axis=0).mean(axis=1))
    ratio = stated.sigma_mm[known] / scatter
    assert np.sqrt((ratio**2).mean()) == pytest.approx(1.0, abs=0.1)
    assert np.all((ratio > 0.75) & (ratio < 1.33))


@pytest.mark.long
def test_uncertainty_of_joint_rays_is_that_of_monte_carlo():
    fit = fit_two_plane(sparse(FOUR, 0.02), SIZE)
    (stated,) = ray_uncertainty(fit.camera, [400.0], grid=(7, 9))
    pixels = stated.pixels[np.isfinite(stated.sigma_mm)]
    orders = (fit.joint.field.slope_order, fit.joint.field.origin_order)
    exact, rng = sparse(FOUR, 0.0), np.random.default_rng(10)
    rays = [fit_ray_field(noisy(exact, rng), orders=orders).field.rays(pixels) for _ in range(80)]
    check_uncertainty(stated, [r.at_depth(400.0)[:, :2] for r in rays])


def test_uncertainty_of_two_plane_rays_is_that_of_monte_carlo():
    pair = (360.0, 420.0)
    camera = with_model(fit_two_plane(sparse(pair, 0.02), SIZE, order=5).camera, "two-plane")
    (stated,) = ray_uncertainty(camera, [400.0], grid=(7, 9))
    pixels = stated.pixels[np.isfinite(stated.sigma_mm)]
    exact, rng = sparse(pair, 0.0), np.random.default_rng(11)
    crossings = []
    for _ in range(150):
        first, second = (fit_plane_map(m, order=5).map.points(pixels)[:, :2] for m in noisy(exact, rng))
        crossings.append(first / 3 + second * 2 / 3)  # at 400 mm, two thirds of the way
    check_uncertainty(stated, crossings)
