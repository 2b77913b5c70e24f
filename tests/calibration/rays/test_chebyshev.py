"""Series against NumPy's own Chebyshev sums, and the ray field that is built on them against its design."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import chebyshev

from calibration.rays import Domain, RayField, exponents
from calibration.rays.chebyshev import Series
from calibration.rays.polynomial import design, design_gradient


def _square(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.1, 1.1, (count, 2))


@pytest.mark.parametrize(("order", "count"), [(0, 1), (1, 63), (5, 64), (9, 1000)])
def test_values_and_slopes_are_those_of_numpy(order: int, count: int) -> None:
    rng = np.random.default_rng(order)
    table = rng.standard_normal((3, order + 1, order + 1))
    square = _square(count)
    values, by_s, by_t = Series(table).values_and_slopes(square)
    for k in range(3):
        assert np.allclose(values[k], chebyshev.chebval2d(square[:, 1], square[:, 0], table[k]), atol=1e-11)
        for axis, found in ((1, by_s), (0, by_t)):
            derived = chebyshev.chebder(table[k], axis=axis)
            assert np.allclose(found[k], chebyshev.chebval2d(square[:, 1], square[:, 0], derived), atol=1e-9)
    assert np.array_equal(Series(table).values(square), values)


def test_a_form_is_the_product_of_designs() -> None:
    rng = np.random.default_rng(3)
    square = _square(200)
    matrix = rng.standard_normal((len(exponents(4)), len(exponents(2))))
    found = Series.of_form(exponents(4), exponents(2), matrix, 9).values(square)[0]
    assert np.allclose(found, np.einsum("nd,de,ne->n", design(square, 4), matrix, design(square, 2)), atol=1e-11)


def test_no_points_give_no_values() -> None:
    assert Series(np.ones((2, 3, 3))).values(np.zeros((0, 2))).shape == (2, 0)


def test_a_nan_pixel_stays_nan_and_spoils_no_other() -> None:
    square = _square(130)
    clean = Series(np.ones((1, 4, 4))).values(square)[0]
    square[70] = np.nan
    found = Series(np.ones((1, 4, 4))).values(square)[0]
    assert np.isnan(found[70])
    assert np.array_equal(np.delete(found, 70), np.delete(clean, 70))


@pytest.mark.parametrize("oblique", [False, True])
def test_ray_field_agrees_with_its_own_design(oblique: bool) -> None:
    rng = np.random.default_rng(5)
    pixels = rng.uniform(0, 1000, (400, 2))
    homography = np.array([[1.0, 0.02, 3.0], [-0.03, 1.1, -7.0], [2e-5, -1e-5, 1.0]]) if oblique else None
    slope, start = 6, 3
    d = len(exponents(slope)) + len(exponents(start))
    root = rng.standard_normal((d, d)) / d
    field = RayField(
        c_from_d=np.eye(3), domain=Domain.around(pixels, homography), slope_order=slope, origin_order=start, pivot=12.0,
        reach=400.0, coefficients=rng.standard_normal((d, 2)), inverse=root @ root.T, sigma=0.02,
        depths=np.array([330.0, 480.0]), forward=1.0,
    )  # fmt: skip
    depth = rng.uniform(300, 500, 400)
    rows = field.design(pixels, depth)
    lever = ((depth - 12.0) / 400.0)[:, None]
    assert np.allclose(field.rays(pixels).at_depth(depth)[:, :2], rows @ field.coefficients, atol=1e-10)
    assert np.allclose(
        field.sigma_at(pixels, depth) / 0.02, np.sqrt(np.einsum("nd,de,ne->n", rows, field.inverse, rows)), rtol=1e-9
    )
    square, by_pixel = field.domain.square_and_jacobian(pixels)
    both = [
        np.hstack([b * lever, a])
        for b, a in zip(design_gradient(square, slope), design_gradient(square, start), strict=True)
    ]
    expected = np.einsum("ndk,dc,nkp->ncp", np.stack(both, axis=-1), field.coefficients, by_pixel, optimize=True)
    assert np.allclose(field.jacobian(pixels, depth), expected, atol=1e-10)
