"""Faint and small marks, drawn by oversampling: found, with a sigma that is true, or refused with their size."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.small_marks import drawn, faint_scene
from calibration.errors import CalibrationError
from calibration.targets import SpotGrid, find_spots, label_grid, measure_marks


@pytest.mark.parametrize(("contrast", "noise"), [(10.0, 2.0), (20.0, 2.0)])
@pytest.mark.long
def test_faint_marks_beside_metal(contrast: float, noise: float) -> None:
    rng = np.random.default_rng([1, int(contrast)])
    pulls = []
    for _ in range(2):
        image, centres = faint_scene(rng, contrast, noise)
        marks = measure_marks(image, np.concatenate([np.round(centres), centres[:10] + 13.0]))
        known = marks.measured[: len(centres)]
        assert known.mean() > 0.97
        assert not marks.measured[len(centres) :].any()
        assert all(marks.reason[len(centres) :])
        sigma = np.sqrt(marks.covariance[: len(centres)][known][:, [0, 1], [0, 1]])
        pulls.append((marks.centroids[: len(centres)][known] - centres[known]) / sigma)
    assert 0.8 < np.sqrt(np.mean(np.concatenate(pulls) ** 2)) < 1.25


def test_the_fainter_the_larger_the_sigma() -> None:
    rng = np.random.default_rng(2)
    sigma = []
    for contrast in (10.0, 20.0):
        image, centres = faint_scene(rng, contrast, 2.0)
        sigma.append(np.sqrt(np.nanmedian(measure_marks(image, np.round(centres)).covariance[:, 0, 0])))
    assert sigma[0] / sigma[1] == pytest.approx(2.0, rel=0.15)


@pytest.mark.parametrize("diameter", [2.5, 3.0, 4.0])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_grid_of_small_dots(diameter: float, bits: int) -> None:
    rng = np.random.default_rng([3, bits])
    dots, centres = drawn(rng, diameter, 0.55)
    top, noise = (150.0, 1.0) if bits == 8 else (30000.0, 20.0)
    exposed = np.clip(np.round(top * dots + 3 + noise * rng.standard_normal(dots.shape)), 0, 2**bits - 1)
    spots = find_spots(exposed.astype(np.uint8 if bits == 8 else np.uint16))
    assert len(spots) == 81
    away = spots.centroids[:, None] - centres[None]
    nearest = np.linalg.norm(away, axis=2).argmin(axis=1)
    error = away[np.arange(81), nearest]
    assert len(set(nearest.tolist())) == 81
    sigma = np.sqrt(spots.covariance[:, [0, 1], [0, 1]])
    assert np.sqrt((error**2).mean()) < 0.012
    assert np.sqrt(((error / sigma) ** 2).mean()) < 1.25
    assert label_grid(spots, SpotGrid(9, 9, (1.0, 1.0), None), image_size=(236, 236)).labelled.all()


def test_too_small_dots_are_told_with_their_size() -> None:
    rng = np.random.default_rng(4)
    dots, _ = drawn(rng, 1.2, 0.45)
    image = np.clip(np.round(200.0 * dots + 3 + rng.standard_normal(dots.shape)), 0, 255).astype(np.uint8)
    spots = find_spots(image)
    assert len(spots) == 0
    with pytest.raises(CalibrationError, match=r"more are too small, e.g. [01]\.\d px across"):
        label_grid(spots, SpotGrid(9, 9, (1.0, 1.0), None), image_size=(236, 236))


def test_dots_of_two_hundred_pixels() -> None:
    y, x = np.mgrid[0:1000, 0:1000]
    image = np.full((1000, 1000), 20, np.uint8)
    for u, v in ((250.3, 260.1), (740.8, 255.0), (245.0, 750.2), (752.0, 748.0)):
        image[np.hypot(x - u, y - v) < 100.0] = 180
    assert find_spots(image).diameter == pytest.approx(np.full(4, 200.0), abs=0.5)
