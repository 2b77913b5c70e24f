"""Laws of stripes of any width: at the bound of their width, with a true sigma, and narrow ones as if there were no wide ones."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.stripe import GAIN, READ, camera, profile, rms, speckle
from benchmarks.stripe_width import FWHM, bound, correlation_of, plain
from calibration.reason import Reason
from ranging.background import Noise
from ranging.stripe import StripeOptions, _scales, extract, find_along
from ranging.stripe._table import Lines

ROWS = 500
ALONE = StripeOptions(neighbours=False)


def drawn(width, peak, rng, contrast=0.0, grain=2.0, rows=ROWS):
    """True positions, an image, and the correlation of its speckle."""
    sigma = width / FWHM
    length = int(max(96, 14 * sigma + 48)) // 8 * 8
    position = length / 2 + 0.2 * sigma * np.sin(np.arange(rows) / 37.0) + rng.uniform(-0.5, 0.5)
    light = profile(position, sigma, peak, length)
    correlation = np.eye(1, length)[0]
    if contrast:
        field = speckle(light.shape, grain, contrast, rng)
        light, correlation = light * field, correlation_of(field)
    return position, camera(light, rng), correlation


@pytest.mark.parametrize("width", [8.0, 16.0, 30.0, 60.0])
@pytest.mark.parametrize("peak", [40.0, 200.0, 400.0])
def test_scatter_is_that_of_the_bound_and_sigma_tells_it(width, peak):
    position, image, correlation = drawn(width, peak, np.random.default_rng(1))
    stripe = extract(image, along="columns", options=ALONE)
    error = stripe.position - position
    least = bound(width / FWHM, peak, 0.0, correlation, image.shape[1])
    assert np.mean(np.isfinite(error)) > 0.99
    assert rms(error) < 1.2 * least
    assert abs(np.nanmean(error)) < 4.0 * least / np.sqrt(ROWS)
    assert 0.8 < rms(error / stripe.sigma) < 1.25
    assert abs(np.nanmedian(stripe.width) * FWHM / width - 1.0) < 0.02
    assert abs(np.nanmedian(stripe.peak) / peak - 1.0) < 0.03


@pytest.mark.parametrize(("width", "peak", "contrast"), [(16.0, 120.0, 0.2), (30.0, 120.0, 0.5), (45.0, 240.0, 0.2)])
def test_speckled_and_clipped_stripes_beat_the_plain_script_and_hold_their_sigma(width, peak, contrast):
    position, image, correlation = drawn(width, peak, np.random.default_rng(2), contrast)
    stripe = extract(image, along="columns", options=ALONE)
    error = stripe.position - position
    assert np.mean(np.isfinite(error)) > 0.95
    assert rms(error) < 1.25 * bound(width / FWHM, peak, contrast, correlation, image.shape[1])
    assert rms(error) < 0.9 * rms(plain(image, width / FWHM) - position)
    assert 0.8 < rms(error / stripe.sigma) < 1.25


@pytest.mark.parametrize("options", [{}, {"gain_e": GAIN, "read_noise": READ}, {"which": "first"}])
@pytest.mark.parametrize("width", [1.5, 3.0, 6.0])
def test_narrow_stripes_are_measured_bit_for_bit_as_if_none_were_wide(width, options):
    _, image, _ = drawn(width, 120.0, np.random.default_rng(3))
    wide, narrow = (
        extract(image, along="columns", options=StripeOptions(**options, maximum_width=most)) for most in (32.0, 6.0)
    )
    for name in ("position", "sigma", "width", "peak", "reason", "asymmetry"):
        np.testing.assert_array_equal(getattr(wide, name), getattr(narrow, name))


def test_rows_are_columns_transposed_and_sixteen_bits_finer_levels():
    _, image, _ = drawn(24.0, 120.0, np.random.default_rng(4))
    known = StripeOptions(gain_e=GAIN, read_noise=READ)
    stripe = extract(image, along="columns", options=known)
    turned = extract(np.ascontiguousarray(image.T), along="rows", options=known)
    np.testing.assert_array_equal(stripe.position, turned.position)
    for factor in (16, 250):  # sums that 16 bits hold, and that they do not
        fine = StripeOptions(gain_e=GAIN / factor, read_noise=READ * factor, saturation=255 * factor)
        other = extract(image.astype(np.uint16) * factor, along="columns", options=fine)
        np.testing.assert_allclose(other.position, stripe.position, atol=0.15 * np.nanmedian(stripe.sigma))
        assert np.mean(np.abs(other.sigma / stripe.sigma - 1.0) < 0.05) > 0.98


def test_a_laser_off_image_is_subtracted():
    rng = np.random.default_rng(5)
    position, image, _ = drawn(24.0, 100.0, rng)
    scene = np.rint(rng.uniform(0.0, 60.0, image.shape[1])).astype(np.uint8)
    off = np.tile(scene, (ROWS, 1))
    stripe = extract(image + scene, along="columns", background=off, options=ALONE)
    assert rms(stripe.position - position) < 1.3 * np.nanmedian(stripe.sigma)


def test_lines_without_an_answer_say_why_and_narrow_lines_beside_wide_ones_are_narrow():
    rng = np.random.default_rng(6)
    rows, length = 60, 400
    wide = np.full(rows, length / 2.0)
    light = np.concatenate([
        profile(wide, 12.0, 120.0, length), profile(wide, 1.4, 120.0, length), np.zeros((rows, length)),
        profile(np.full(rows, 6.0), 12.0, 120.0, length), profile(wide, 60.0, 120.0, length),
        profile(wide - 80, 12.0, 120.0, length) + profile(wide + 80, 12.0, 116.0, length),
        profile(wide, 12.0, 4000.0, length),
    ])  # fmt: skip
    stripe = extract(
        camera(light, rng), along="columns", options=StripeOptions(gain_e=GAIN, read_noise=READ, speckle="off")
    )
    expected = [
        Reason.RANGED, Reason.RANGED, Reason.NO_LIGHT, Reason.OUT_OF_VIEW, Reason.TOO_WIDE, Reason.TWO_PEAKS,
        Reason.SATURATED,
    ]  # fmt: skip
    for block, reason in zip(stripe.reason.reshape(7, rows)[:, 14:-14], expected, strict=True):
        assert np.mean(block == reason) > 0.9, (reason, np.unique(block, return_counts=True))
    assert 1.3 < np.nanmedian(stripe.width[rows + 14 : 2 * rows - 14]) < 1.5
    assert 11.5 < np.nanmedian(stripe.width[:rows]) < 12.5
    np.testing.assert_array_equal(np.isnan(stripe.position), stripe.reason != Reason.RANGED)


@pytest.mark.parametrize("contrast", [0.0, 0.5])
def test_the_axis_of_a_wide_stripe_is_found(contrast):
    rng = np.random.default_rng(7)
    _, image, _ = drawn(60.0, 120.0, rng, contrast)
    assert find_along(image) == "columns"
    assert find_along(np.ascontiguousarray(image.T)) == "rows"


def test_noise_of_pixels_taken_together_is_that_of_their_sum():
    lines = Lines(np.zeros(800, np.uint8), np.zeros(0, np.uint8), (10, 80, 80, 1), 255.0)
    taken = _scales.binned(lines, 4)
    noise = taken.noise(Noise(GAIN, READ))
    assert taken.lines.layout == (10, 20, 20, 1)
    assert noise.gain_e == GAIN
    assert noise.read_noise**2 + 1 / 12 == pytest.approx(4 * (READ**2 + 1 / 12))
    back = taken.noise_of_pixels(noise)
    assert (back.gain_e, back.read_noise) == pytest.approx((GAIN, READ))
