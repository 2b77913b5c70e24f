"""Maps of one plane: equations 2 to 5 of the paper against the exact camera, refitting and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.geometry import Pose
from calibration.rays import PlaneMarks, exponents, fit_plane_map, normal_equations


def flat(z: float = 400.0, tilt: float = 0.0) -> Pose:
    return Pose.from_rotation_vector([0.0, np.deg2rad(tilt), 0.0], [0.0, 0.0, z])


def test_a_map_of_a_polynomial_camera_is_exact(truth) -> None:
    marks = truth.marks(flat(), "w")
    uv = (marks.pixels - [640, 480]) / 640
    pairs = np.array(exponents("paper"))
    powers = uv[:, 1:] ** pairs[:, 0] * uv[:, :1] ** pairs[:, 1]
    weights = np.random.default_rng(0).normal(size=(11, 2)) * 20 + 50 * (np.abs(pairs).sum(axis=1) == 1)[:, None]
    made = PlaneMarks("w", marks.pixels, powers @ weights, flat(), marks.mark, marks.covariance)
    fit = fit_plane_map(made, order="paper")
    assert np.abs(fit.residuals_mm).max() < 1e-10  # the Chebyshev basis spans the paper's terms
    assert np.abs(fit.map.points(marks.pixels)[:, 2] - 400.0).max() < 1e-12
    coefficients, _ = normal_equations(made, terms="paper", coordinates="unit")
    assert np.isfinite(coefficients).all()


def test_orders_follow_the_distortion(truth) -> None:
    rms = [fit_plane_map(truth.marks(flat(), "w"), order=n).fit_px for n in ("linear", "paper", 5, 7)]
    assert rms[0] > 1.0 > rms[1] > rms[2] > rms[3]
    assert rms[3] < 0.001
    assert fit_plane_map(truth.marks(flat(), "w"), order="auto").loo_px < 0.002


def test_a_tilted_plane_needs_its_homography(truth) -> None:
    marks = truth.marks(flat(tilt=30.0), "w")
    assert fit_plane_map(marks, order=3, tilted=True).fit_px < 0.5 * fit_plane_map(marks, order=3).fit_px


def test_left_out_is_a_fit_without_the_mark(truth) -> None:
    marks = truth.marks(flat(), "w", noise=0.05, rng=np.random.default_rng(3))
    fit = fit_plane_map(marks, order=3)
    for k in (0, 100, 220):
        rest = np.arange(len(marks)) != k
        other = fit_plane_map(marks.select(rest), order=3).map.plane_points(marks.pixels[k : k + 1])
        assert np.allclose(fit.left_out_mm[k], marks.points[k] - other[0], atol=1e-9)


def test_jacobian_and_residuals_in_px(truth) -> None:
    marks = truth.marks(flat(), "w")
    plane_map = fit_plane_map(marks, order=7).map
    for p in range(2):
        step = 0.01 * np.eye(2)[p]
        numeric = (plane_map.plane_points(marks.pixels + step) - plane_map.plane_points(marks.pixels - step)) / 0.02
        assert np.abs(plane_map.jacobian(marks.pixels)[:, :, p] - numeric).max() < 1e-6
    moved = marks.pixels.copy()
    moved[110] += [0.3, -0.2]  # a mark found off by this much stands out by as much, but for its pull on the fit
    fit = fit_plane_map(PlaneMarks("w", moved, marks.points, flat(), marks.mark, marks.covariance), order=5)
    assert np.allclose(-fit.left_out[110], [0.3, -0.2], atol=0.02)


def test_sigma_of_a_map_is_that_of_repetition(truth) -> None:
    rng = np.random.default_rng(5)
    at = np.array([[300.0, 200.0], [655.0, 470.0], [1000.0, 800.0]])
    fits = [fit_plane_map(truth.marks(flat(), "w", noise=0.05, rng=rng), order=5) for _ in range(150)]
    spread = np.sqrt(np.var([f.map.plane_points(at) for f in fits], axis=0, ddof=1).mean(axis=1))
    told = np.mean([f.map.sigma_at(at) for f in fits], axis=0)
    assert told == pytest.approx(spread, rel=0.15)


def test_normalising_saves_the_normal_equations(truth) -> None:
    marks = truth.marks(flat(), "w")
    raw = normal_equations(marks, coordinates="pixels")[1]
    unit = normal_equations(marks, coordinates="unit")[1]
    assert raw.span > 15 > unit.span  # the paper: 21 orders of magnitude become 8
    assert raw.condition > 1e6 * unit.condition


@pytest.mark.parametrize(("count", "order"), [(10, "paper"), (5, 2), (2, "linear")])
def test_too_few_marks_are_refused(truth, count: int, order: str | int) -> None:
    marks = truth.marks(flat(), "w7")
    keep = np.zeros(len(marks), dtype=bool)
    keep[np.random.default_rng(0).permutation(len(marks))[:count]] = True
    with pytest.raises(CalibrationError, match=f"w7: {count} marks found; order {order} has"):
        fit_plane_map(marks.select(keep), order=order)


@pytest.mark.parametrize("tilted", [False, True])
def test_marks_on_a_line_are_refused(truth, tilted: bool) -> None:
    marks = truth.marks(flat(), "w7")
    row = marks.select(np.arange(len(marks)) < 17)
    with pytest.raises(CalibrationError, match=r"w7.*one line"):
        fit_plane_map(row, order=1, tilted=tilted)


def test_the_papers_two_findings_on_a_symmetric_grid(truth) -> None:
    """About the centre the elements of P'P span more orders, since odd sums cancel; the columns are less alike all the same."""
    marks = truth.marks(flat(), "w")
    unit, centred, chebyshev = (normal_equations(marks, coordinates=c)[1] for c in ("unit", "centred", "chebyshev"))
    assert centred.span > unit.span + 2
    assert centred.condition < unit.condition / 100
    assert chebyshev.dependence < centred.dependence < unit.dependence
    assert chebyshev.error_single < unit.error_single / 5
    assert unit.error < 1e-6 < unit.error_single
