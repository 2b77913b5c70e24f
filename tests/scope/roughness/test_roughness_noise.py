"""What noise does to parameters, and what is left when it is taken out: against the same heights without it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from scope.errors import MeasurementError
from scope.heightmap import HeightMap, remove_form, s_filter
from scope.roughness import Roughness, RoughnessOptions, measure_heights
from scope.roughness.areal import root_mean_square_gradient
from scope.roughness.attenuation import attenuation_of
from scope.roughness.noise import predicted_noise, repeat_noise

PITCH = (0.1, 0.1)
QUICK = RoughnessOptions(form="plane", uncertainty=False)


def rough(shape: tuple[int, int], length: float, rng: np.random.Generator) -> np.ndarray:
    """Gaussian surface of Sq 0.05 mm and correlation exp(-r^2 / length^2), length in samples."""
    z = gaussian_filter(rng.standard_normal(shape), length / 2.0, mode="wrap")
    return np.asarray(0.05 * z / z.std())


def noisy(z: np.ndarray, noise: np.ndarray, sigma: float) -> HeightMap:
    """Map of heights with noise on them, which claims to be sigma."""
    return HeightMap(z + noise, PITCH, sigma=np.full(z.shape, sigma))


def worst(found: Roughness, truth: Roughness, keys: tuple[str, ...], way: str = "") -> float:
    """Largest relative deviation of parameters from those of the truth."""
    a, b = (r.profile[way] if way else r.areal for r in (found, truth))
    return max(abs(a[key].value / b[key].value - 1.0) for key in keys)


@pytest.fixture(scope="module")
def pair() -> tuple[Roughness, Roughness]:
    """Roughness of 200 x 200 heights, correlation length 10 samples, with noise of 0.4 Sq and without."""
    rng = np.random.default_rng(61)
    z = rough((200, 200), 10.0, rng)
    with_noise = measure_heights(
        noisy(z, 0.02 * rng.standard_normal(z.shape), 0.02), options=RoughnessOptions(form="plane")
    )
    return with_noise, measure_heights(HeightMap(z, PITCH), options=QUICK)


def test_extremes_are_freed_of_the_noise_that_makes_them(pair: tuple[Roughness, Roughness]) -> None:
    """Raw, Rz is a third too large; scaled by the ratio of Rq it would still be a fifth."""
    found, truth = pair
    for way in ("along", "across"):
        assert found.profile[way]["Rz"].raw > 1.25 * truth.profile[way]["Rz"].value
        assert worst(found, truth, ("Rz", "Rt"), way) < 0.05
    assert worst(found, truth, ("Sp", "Sv", "Sz")) < 0.2  # each rests on one point
    assert worst(found, truth, ("Sk", "Spk", "Svk", "Vmp", "Vvv")) < 0.05


def test_elements_are_those_of_the_surface_and_not_of_the_noise(pair: tuple[Roughness, Roughness]) -> None:
    """Without smoothing noise of 0.4 Sq halves them."""
    found, truth = pair
    for way in ("along", "across"):
        assert found.profile[way]["RSm"].raw < 0.7 * truth.profile[way]["RSm"].value
        assert worst(found, truth, ("RSm", "Rc"), way) < 0.1


def test_every_profile_parameter_that_is_given_has_an_uncertainty_that_covers_it(
    pair: tuple[Roughness, Roughness],
) -> None:
    found, truth = pair
    given = 0
    for way, table in found.profile.items():
        for key, p in table.items():
            assert (p.value is None) == bool(p.reason), key
            if p.value is not None:
                given += 1
                assert p.uncertainty is not None, key
                assert abs(p.value - truth.profile[way][key].value) <= p.uncertainty, key
    assert given >= 16
    assert {"Z2", "JRC"} <= {key for key, p in found.profile["along"].items() if p.value is not None}


def test_noise_has_no_shape_of_its_own() -> None:
    """A kurtosis below 1 is impossible; cumulants of mostly noise gave one."""
    rng = np.random.default_rng(62)
    z = rough((160, 160), 10.0, rng)
    found = measure_heights(noisy(z, 0.06 * rng.standard_normal(z.shape), 0.06), options=QUICK)
    for table in found.profile.values():
        for key in ("Rsk", "Rku"):
            assert table[key].value is None
            assert "of the variance (limit 50 %)" in table[key].reason


def test_an_s_filter_calms_the_noise_of_slopes_as_it_calms_the_slopes() -> None:
    """Behind an S-filter noise is smooth: taken for white, it was subtracted many times over."""
    rng = np.random.default_rng(63)
    z = rough((200, 200), 10.0, rng)
    options = replace(QUICK, s_filter=0.5)
    found = measure_heights(noisy(z, 0.01 * rng.standard_normal(z.shape), 0.01), options=options)
    clean = s_filter(remove_form(HeightMap(z, PITCH), "plane"), 0.5).z
    assert found.areal["Sdq"].value == pytest.approx(root_mean_square_gradient(clean, PITCH), rel=0.02)


def test_noise_that_neighbours_share_is_trusted_less() -> None:
    """Noise correlated over a sample and a half, which sigma tells 15 % too low: k = 2 must hold all the same."""
    rng = np.random.default_rng(64)
    z = rough((220, 220), 16.0, rng)
    speckle = gaussian_filter(rng.standard_normal(z.shape), (0.0, 0.6), mode="wrap")
    speckle *= 0.05 / speckle.std()
    heights = noisy(z, speckle, 0.0435)
    known = predicted_noise(heights)
    assert known.trust > 0.1
    assert any("speckle" in note for note in known.notes)
    found = measure_heights(heights, options=RoughnessOptions(form="plane")).areal["Sq"]
    truth = float(remove_form(HeightMap(z, PITCH), "plane").z.std())
    assert abs(found.value - truth) > 0.1 * truth
    assert abs(found.value - truth) <= found.uncertainty
    independent = predicted_noise(noisy(z, 0.05 * rng.standard_normal(z.shape), 0.05))
    assert independent.trust == 0.05
    assert not independent.notes


def test_a_scan_is_no_repeat_of_itself() -> None:
    rng = np.random.default_rng(65)
    z = rough((60, 60), 6.0, rng)
    rows, columns = np.indices(z.shape)
    points = np.stack([0.1 * columns, 0.1 * rows, z], axis=2)
    first = HeightMap(z, PITCH, points=points)
    with pytest.raises(MeasurementError, match="very same scan"):
        repeat_noise(first, HeightMap(z, PITCH, points=points.copy()))
    again = z + 0.001 * rng.standard_normal(z.shape)
    over = HeightMap(-again, PITCH, points=np.dstack([points[..., :2], again]))  # its sensor on the other side
    assert repeat_noise(first, over).correlation > 0.95


def test_slopes_are_regained_where_more_smoothing_takes_them() -> None:
    """Behind Gaussians of variance v a spectrum exp(-(L k)^2 / 4) leaves (1 + 4 v / L^2)^-2 of the squared slopes."""
    share = 0.05
    before, after = ((1.0 + n * share) ** -2 * np.ones(8) for n in (1.0, 2.0))
    found = attenuation_of(before, after)
    assert found.factor == pytest.approx(1.0 + share, rel=0.01)
    assert 0.3 * share < found.doubt < share
    rng = np.random.default_rng(66)
    lost = attenuation_of(before, after * (1.0 + 0.5 * rng.standard_normal(8)))
    assert lost.factor == 1.0
    assert lost.doubt > 0.05
    assert math.isinf(attenuation_of(before, -after).doubt)
