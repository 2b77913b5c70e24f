"""Chebyshev products and least squares against NumPy, finite differences and refitting."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.rays import Domain, exponents
from calibration.rays.polynomial import design, design_gradient, homography, left_out, solve

RNG = np.random.default_rng(1)
PIXELS = RNG.uniform([0, 0], [640, 480], (60, 2))


def test_sets_of_terms_are_those_of_the_paper() -> None:
    assert sorted(exponents("linear")) == [(0, 0), (0, 1), (1, 0)]
    assert len(exponents("paper")) == 11  # equation 3
    assert {(3, 0), (0, 3), (2, 1), (1, 2), (2, 2)} <= set(exponents("paper"))
    assert [len(exponents(n)) for n in range(6)] == [(n + 1) * (n + 2) // 2 for n in range(6)]
    with pytest.raises(ValueError, match="order"):
        exponents(-1)


@pytest.mark.parametrize("terms", ["linear", "paper", 4])
def test_the_basis_is_numpys_chebyshev(terms: str | int) -> None:
    square = RNG.uniform(-1, 1, (20, 2))
    found = design(square, terms)  # type: ignore[arg-type]
    for k, (i, j) in enumerate(exponents(terms)):  # type: ignore[arg-type]
        expected = np.polynomial.chebyshev.chebval2d(square[:, 0], square[:, 1], np.outer(np.eye(9)[j], np.eye(9)[i]))
        assert np.abs(found[:, k] - expected).max() < 1e-13


@pytest.mark.parametrize("h", [None, np.array([[1.1, 0.02, 3.0], [0.01, 0.9, -2.0], [1e-4, 2e-4, 1.0]])])
def test_gradients_are_central_differences(h: np.ndarray | None) -> None:
    domain, step = Domain.around(PIXELS, h), 1e-4
    square, by_pixel = domain.square_and_jacobian(PIXELS)
    assert np.abs(square).max() <= 1 + 1e-12
    by_square = np.stack(design_gradient(square, 5), axis=-1)
    analytic = np.einsum("ndk,nkp->ndp", by_square, by_pixel)
    for p in range(2):
        shift = step * np.eye(2)[p]
        numeric = (design(domain.square(PIXELS + shift), 5) - design(domain.square(PIXELS - shift), 5)) / (2 * step)
        assert np.abs(analytic[:, :, p] - numeric).max() < 1e-7


def test_solution_is_numpys_and_left_out_is_refitting() -> None:
    a, b, w = RNG.normal(size=(30, 5)), RNG.normal(size=(30, 2)), RNG.uniform(0.5, 2.0, 30)
    groups = np.arange(30) // 3
    fit = solve(a, b, w)
    root = np.sqrt(w)[:, None]
    assert np.allclose(fit.solution, np.linalg.lstsq(a * root, b * root, rcond=None)[0], atol=1e-12)
    assert np.allclose(fit.inverse, np.linalg.inv((a * w[:, None]).T @ a), atol=1e-12)
    for found, member in ((fit.left_out(), np.arange(30)), (fit.left_out(groups), groups)):
        for k in range(30):
            rest = member != member[k]
            without = np.linalg.lstsq((a * root)[rest], (b * root)[rest], rcond=None)[0]
            assert np.allclose(found[k], b[k] - a[k] @ without, atol=1e-6)


def test_left_out_of_unequal_groups_is_refitting() -> None:
    a, b = RNG.normal(size=(20, 3)), RNG.normal(size=(20, 1))
    groups = np.r_[np.zeros(7, int), np.ones(1, int), np.full(12, 2)]
    basis = np.linalg.qr(a)[0]
    found = left_out(basis, b - basis @ (basis.T @ b), groups)
    for g in range(3):
        out = groups == g
        without = np.linalg.lstsq(a[~out], b[~out], rcond=None)[0]
        assert np.allclose(found[out], b[out] - a[out] @ without, atol=1e-6)


def test_dependent_columns_are_refused() -> None:
    a = np.column_stack([np.ones(9), np.arange(9.0), 2 * np.arange(9.0)])
    with pytest.raises(np.linalg.LinAlgError):
        solve(a, np.ones((9, 1)))
    with pytest.raises(np.linalg.LinAlgError):
        solve(np.ones((2, 3)), np.ones((2, 1)))


def test_homography_is_exact_and_opencvs() -> None:
    true = np.array([[0.9, 0.1, 20.0], [-0.05, 1.2, 5.0], [3e-4, -2e-4, 1.0]])
    image = cv2.perspectiveTransform(PIXELS[:, None], true)[:, 0]
    assert np.abs(homography(PIXELS, image) / true - 1).max() < 1e-6
    noisy = image + RNG.normal(0, 0.1, image.shape)
    ours, theirs = homography(PIXELS, noisy), cv2.findHomography(PIXELS, noisy)[0]
    for h in (ours, theirs):
        error = cv2.perspectiveTransform(PIXELS[:, None], h)[:, 0] - image
        assert np.sqrt((error**2).sum(axis=1).mean()) < 0.1
    with pytest.raises(ValueError, match="four"):
        homography(PIXELS[:3], image[:3])
