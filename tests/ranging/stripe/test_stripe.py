"""Laws of stripe extraction: truth is drawn from closed forms, bounds are Fisher's."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.stripe import GAIN, LENGTH, OFFSET, READ, bound, camera, centre_of_mass, profile, rms, speckle
from calibration.reason import Reason
from ranging.errors import RangingError
from ranging.stripe import StripeOptions, extract, find_along
from ranging.stripe.extraction import estimate_noise

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"
KNOWN = StripeOptions(gain_e=GAIN, read_noise=READ, speckle="off", neighbours=False)


def scattered(rows, rng):
    return LENGTH / 2 + rng.uniform(-0.5, 0.5, rows)


def tilted(rows, slope, sigma, peak, rng, length=None):
    """A straight stripe; sigma is measured along its normal."""
    position = 20 + slope * np.arange(rows) + rng.uniform()
    length = length or int(position[-1]) + 20
    return position, camera(profile(position, sigma * math.hypot(1, slope), peak, length), rng)


@pytest.mark.parametrize("sigma", [1.0, 1.4, 2.5])
@pytest.mark.parametrize("peak", [30.0, 120.0, 200.0])
def test_scatter_is_that_of_cramer_and_rao_and_sigma_tells_it(sigma, peak):
    rng = np.random.default_rng(1)
    position = scattered(6000, rng)
    stripe = extract(camera(profile(position, sigma, peak, LENGTH), rng), along="columns", options=KNOWN)
    error = stripe.position - position
    least = bound(sigma, peak)
    assert np.mean(stripe.reason == Reason.RANGED) > 0.999
    assert 0.95 < rms(error) / least < 1.05
    assert abs(np.nanmean(error)) < 0.001 + 3 * least / math.sqrt(6000)
    assert 0.95 < rms(error / stripe.sigma) < 1.05


@pytest.mark.parametrize(("peak", "limit"), [(300.0, 1.10), (400.0, 1.20)])
@pytest.mark.parametrize("sigma", [1.0, 1.4, 2.5])
def test_clipped_stripes_keep_what_their_flanks_tell(sigma, peak, limit):
    rng = np.random.default_rng(2)
    position = scattered(4000, rng)
    stripe = extract(camera(profile(position, sigma, peak, LENGTH), rng), along="columns", options=KNOWN)
    error = stripe.position - position
    assert rms(error) < limit * bound(sigma, peak, clipped=True)
    assert abs(np.nanmean(error)) < 0.003
    assert 0.9 < rms(error / stripe.sigma) < 1.2


def test_no_phase_is_favoured():
    rng = np.random.default_rng(3)
    phase = np.repeat(np.linspace(-0.5, 0.5, 11), 1500)
    stripe = extract(camera(profile(LENGTH / 2 + phase, 1.0, 120.0, LENGTH), rng), along="columns", options=KNOWN)
    bias = (stripe.position - LENGTH / 2 - phase).reshape(11, -1).mean(axis=1)
    assert np.abs(bias).max() < 0.002


@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_tilt_costs_nothing_and_rows_are_columns_transposed(degrees):
    rng = np.random.default_rng(4)
    slope = math.tan(math.radians(degrees))
    position, image = tilted(900, slope, 1.4, 120.0, rng)
    stripe = extract(image, along="columns", options=StripeOptions(gain_e=GAIN, read_noise=READ))
    turned = extract(np.ascontiguousarray(image.T), along="rows", options=StripeOptions(gain_e=GAIN, read_noise=READ))
    error = stripe.position - position
    assert rms(error) < 1.08 * bound(1.4 * math.hypot(1, slope), 120.0)
    assert np.mean(np.isfinite(error)) > 0.99
    np.testing.assert_array_equal(stripe.position, turned.position)
    np.testing.assert_array_equal(stripe.reason, turned.reason)
    np.testing.assert_array_equal(turned.pixels[:, 1], turned.position)
    np.testing.assert_array_equal(stripe.pixels[:, 1], np.arange(900))


@settings(max_examples=20, deadline=None)
@given(slope=st.floats(-0.7, 0.7), peak=st.floats(40, 220), offset=st.integers(0, 30))
def test_the_axis_is_found(slope, peak, offset):
    rng = np.random.default_rng(5)
    position = 250 + slope * (np.arange(300) - 150)
    image = camera(profile(position, 1.5, peak, 500) + offset, rng)
    assert find_along(image) == "columns"
    assert find_along(np.ascontiguousarray(image.T)) == "rows"


def test_sixteen_bits_are_eight_bits_with_finer_levels():
    rng = np.random.default_rng(6)
    position = scattered(400, rng)
    image = camera(profile(position, 1.4, 120.0, LENGTH), rng)
    stripe = extract(image, along="columns", options=KNOWN)
    fine = StripeOptions(gain_e=GAIN / 200, read_noise=READ * 200, speckle="off", neighbours=False)
    other = extract(image.astype(np.uint16) * 200, along="columns", options=fine)
    # Only the noise of rounding, 1/12 of a level, is another.
    np.testing.assert_allclose(other.position, stripe.position, atol=0.004)
    np.testing.assert_allclose(other.peak, stripe.peak * 200, rtol=0.01)


@pytest.mark.parametrize("grain", [1.0, 2.0, 4.0])
def test_speckle_is_recognised_and_beats_the_centre_of_mass(grain):
    rng = np.random.default_rng(7)
    rows = 1500
    position = LENGTH / 2 + 0.4 * np.sin(np.arange(rows) / 37.0)
    light = profile(position, 1.4, 120.0, LENGTH) * speckle((rows, LENGTH), grain, 0.3, rng)
    image = camera(light, rng)
    stripe = extract(image, along="columns", options=StripeOptions(gain_e=GAIN, read_noise=READ, neighbours=False))
    error = stripe.position - position
    assert 0.2 < stripe.speckle < 0.4
    assert rms(error) < 0.9 * rms(centre_of_mass(image) - position)
    assert 0.8 < rms(error / stripe.sigma) < 1.25


def test_shot_noise_is_not_taken_for_speckle_and_the_noise_is_learnt():
    rng = np.random.default_rng(8)
    position = scattered(1500, rng)
    image = camera(profile(position, 1.4, 120.0, LENGTH), rng)
    stripe = extract(image, along="columns", options=StripeOptions())
    assert stripe.speckle == 0.0
    assert stripe.noise is not None
    assert 0.8 * GAIN < stripe.noise.gain_e < 1.25 * GAIN
    assert 0.9 * READ < stripe.noise.read_noise < 1.1 * READ
    assert rms(stripe.position - position) < 1.05 * bound(1.4, 120.0)


def test_dark_lines_and_edges_tell_nothing_about_noise_and_speckle():
    rng = np.random.default_rng(18)
    position = 150.0 + 0.02 * np.arange(480)
    light = profile(position, 1.2, 150.0, 300)
    light[:150] = light[330:] = 0.0
    light[150] *= 0.3  # the ends of the object cover a part of a line
    light[329] *= 0.4
    light[240] = 0.5 * (light[240] + np.roll(light[240], 4))
    light[241:, 4:] = light[241:, :-4].copy()  # a step
    stripe = extract(camera(light, rng), along="columns")
    lit = np.arange(160, 235)
    assert stripe.speckle == 0.0
    assert stripe.noise is not None
    assert 0.6 * GAIN < stripe.noise.gain_e < 1.7 * GAIN  # of 180 lines only
    assert 0.9 * READ < stripe.noise.read_noise < 1.15 * READ
    assert rms(stripe.position[lit] - position[lit]) < 1.2 * bound(1.2, 150.0)
    assert 0.75 < rms((stripe.position - position)[lit] / stripe.sigma[lit]) < 1.3
    dark = np.r_[np.arange(149), np.arange(331, 480)]
    assert np.mean(stripe.reason[dark] == Reason.NO_LIGHT) > 0.99


def test_the_noise_of_a_camera_is_known_from_a_few_frames():
    rng = np.random.default_rng(17)
    noise = estimate_noise([tilted(500, 0.2, 1.4, 150.0, rng)[1] for _ in range(4)], along="columns")
    assert 0.85 * GAIN < noise.gain_e < 1.3 * GAIN
    assert 0.9 * READ < noise.read_noise < 1.1 * READ
    with pytest.raises(ValueError, match="one image"):
        estimate_noise([], along="columns")


def test_every_line_without_an_answer_says_why():
    rng = np.random.default_rng(9)
    rows = 30
    light = profile(np.full(8 * rows, LENGTH / 2.0), 1.4, 120.0, LENGTH)
    light[:rows] = 0.0
    light[rows : 2 * rows] = profile(np.full(rows, 0.4), 1.4, 120.0, LENGTH)
    light[2 * rows : 3 * rows] = profile(np.full(rows, LENGTH / 2.0), 8.0, 120.0, LENGTH)
    light[3 * rows : 4 * rows] = 0.0
    light[3 * rows : 4 * rows, 20] = 150.0
    light[4 * rows : 5 * rows] = profile(np.full(rows, 11.0), 1.4, 120.0, LENGTH) + profile(
        np.full(rows, 36.0), 1.4, 118.0, LENGTH
    )
    light[5 * rows : 6 * rows] = profile(np.full(rows, LENGTH / 2.0), 3.0, 4000.0, LENGTH)
    light[6 * rows : 7 * rows, 25:] = 0.0
    options = StripeOptions(gain_e=GAIN, read_noise=READ, speckle="off", maximum_width=6.0)
    stripe = extract(camera(light, rng), along="columns", options=options)
    expected = [
        Reason.NO_LIGHT, Reason.OUT_OF_VIEW, Reason.TOO_WIDE, Reason.TOO_NARROW, Reason.TWO_PEAKS, Reason.SATURATED,
        Reason.EDGE, Reason.RANGED,
    ]  # fmt: skip
    for block, reason in zip(stripe.reason.reshape(8, rows)[:, 2:-2], expected, strict=True):
        assert np.mean(block == reason) > 0.9, (reason, np.unique(block, return_counts=True))
    np.testing.assert_array_equal(np.isnan(stripe.position), stripe.reason != Reason.RANGED)
    np.testing.assert_array_equal(np.isnan(stripe.sigma), stripe.reason != Reason.RANGED)


@pytest.mark.parametrize("lines_a_pixel", [2, 3])
def test_a_stripe_cut_by_an_oblique_edge_is_left_out_or_doubted(lines_a_pixel):
    rng = np.random.default_rng(10)
    rows = 400
    position = np.full(rows, LENGTH / 2.0)
    light = profile(position, 1.4, 120.0, LENGTH)
    # Nothing is lit beyond an edge that runs across the stripe; the lens blurs what is left.
    edge = LENGTH / 2.0 - (np.arange(rows) - 200) / lines_a_pixel
    light *= np.clip(edge[:, None] - np.arange(LENGTH) + 0.5, 0.0, 1.0)
    lens = np.exp(-0.5 * (np.arange(-3, 4) / 0.6) ** 2)
    blurred = np.apply_along_axis(np.convolve, 1, light, lens / lens.sum(), mode="same")
    stripe = extract(
        camera(blurred, rng), along="columns", options=StripeOptions(gain_e=GAIN, read_noise=READ, speckle="off")
    )
    error = stripe.position - position
    assert np.nanmax(np.abs(error)) < 0.25
    assert np.mean(np.abs(error / stripe.sigma)[np.isfinite(error)] < 3) > 0.98
    assert np.mean(np.isfinite(error[5:180])) > 0.99


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_line_that_is_clipped_over_most_of_its_length_is_not_dark(share):
    image = np.full((60, LENGTH), 255, np.uint8)
    image[:, int(share * LENGTH) :] = 4
    stripe = extract(image, along="columns", options=KNOWN)
    assert (stripe.reason == Reason.SATURATED).all()


@pytest.mark.parametrize("step", [2.6, 3.2, 4.0])
@pytest.mark.parametrize("neighbours", [True, False])
def test_a_line_that_sees_two_surfaces_is_an_edge(step, neighbours):
    rng = np.random.default_rng(20)
    position = np.where(np.arange(200) < 100, 20.3, 20.3 + step)
    light = profile(position, 1.2, 150.0, LENGTH)
    light[100] = 0.5 * (light[99] + light[101])
    light[:30] = profile(np.full(30, 15.0), 2.2, 90.0, LENGTH)  # a steeper surface is wider, and no edge but at its end
    options = StripeOptions(gain_e=GAIN, read_noise=READ, speckle="off", neighbours=neighbours)
    stripe = extract(camera(light, rng), along="columns", options=options)
    assert stripe.reason[100] == Reason.EDGE
    assert np.mean(stripe.reason[2:28] == Reason.RANGED) > 0.95
    assert np.mean(stripe.reason[34:96] == Reason.RANGED) > 0.95
    error = (stripe.position - position)[34:]
    assert np.nanmax(np.abs(error)) < 5 * bound(1.2, 150.0)


def test_the_peak_that_is_asked_for_is_taken():
    rng = np.random.default_rng(11)
    rows, length = 300, 200
    near = 40 + 0.1 * np.arange(rows)
    far = 150 - 0.1 * np.arange(rows)
    light = profile(near, 1.4, 100.0, length) + profile(far, 1.4, 140.0, length)
    light[::7] += profile(np.full(len(light[::7]), 95.0), 1.4, 190.0, length)
    image = camera(light, rng)

    def places(which):
        options = StripeOptions(which=which, gain_e=GAIN, read_noise=READ, speckle="off", neighbours=False)
        return extract(image, along="columns", options=options).position

    assert np.nanmax(np.abs(places("first") - near)) < 0.3
    assert np.nanmax(np.abs(places("last") - far)) < 0.3
    assert np.nanmax(np.abs(places("continuous") - far)) < 0.3
    assert np.nanmedian(places("strongest")[::7]) == pytest.approx(95.0, abs=0.1)


def test_laser_off_image_takes_the_scene_away():
    rng = np.random.default_rng(12)
    position = scattered(500, rng)
    scene = 90.0 * (np.arange(LENGTH) % 16 < 8)[None, :] * np.ones((500, 1))
    image = camera(scene + profile(position, 1.4, 100.0, LENGTH), rng)
    off = np.rint(scene + OFFSET).astype(np.uint8)
    stripe = extract(image, along="columns", background=off, options=KNOWN)
    assert rms(stripe.position - position) < 1.5 * bound(1.4, 100.0)
    assert np.nanmedian(stripe.peak) == pytest.approx(98.0, rel=0.03)


@pytest.mark.parametrize("method", ["centroid", "gaussian", "ridge"])
def test_methods_agree_and_know_their_noise(method):
    rng = np.random.default_rng(13)
    position, image = tilted(600, math.tan(math.radians(20)), 1.5, 120.0, rng)
    options = StripeOptions(method=method, gain_e=GAIN, read_noise=READ, speckle="off")
    stripe = extract(image, along="columns", options=options)
    error = stripe.position - position
    assert abs(np.nanmean(error)) < 0.005
    assert 0.8 < rms(error / stripe.sigma) < 1.25
    assert np.mean(np.isfinite(error)) > 0.95


def test_ridge_of_a_straight_stripe_is_quieter_than_one_line():
    rng = np.random.default_rng(14)
    position, image = tilted(600, 0.3, 1.5, 60.0, rng)
    ridge = extract(image, along="columns", options=StripeOptions(method="ridge", gain_e=GAIN, read_noise=READ))
    assert rms(ridge.position - position) < 0.8 * bound(1.5 * math.hypot(1, 0.3), 60.0)


@pytest.mark.parametrize("method", ["gaussian", "ridge"])
def test_no_phase_is_favoured_where_the_stripe_keeps_it(method):
    rng = np.random.default_rng(19)
    for phase in (-0.5, -0.25, 0.1, 0.4):
        image = camera(profile(np.full(300, LENGTH / 2 + phase), 1.2, 150.0, LENGTH), rng)
        options = StripeOptions(method=method, gain_e=GAIN, read_noise=READ, neighbours=False)
        error = extract(image, along="columns", options=options).position - LENGTH / 2 - phase
        assert abs(np.nanmean(error)) < 0.004
        assert rms(error) < 1.05 * bound(1.2, 150.0)


def test_threads_give_what_one_gives():
    rng = np.random.default_rng(15)
    images = [tilted(300, 0.2, 1.4, 120.0, rng)[1] for _ in range(8)]
    alone = [extract(image, along="columns") for image in images]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda image: extract(image, along="columns"), images))
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one.position, other.position)


def test_a_channel_of_a_colour_image_needs_no_copy_by_the_caller():
    rng = np.random.default_rng(16)
    _, image = tilted(200, 0.2, 1.4, 120.0, rng)
    colour = np.stack([np.zeros_like(image), np.zeros_like(image), image], axis=2)
    np.testing.assert_array_equal(
        extract(colour[:, :, 2], along="columns").position, extract(image, along="columns").position
    )


def test_impossible_images_and_options_are_refused():
    image = np.zeros((20, 30), np.uint8)
    with pytest.raises(RangingError, match="float64"):
        extract(image.astype(float), along="rows")
    with pytest.raises(RangingError, match="channel"):
        extract(np.zeros((20, 30, 3), np.uint8), along="rows")
    with pytest.raises(RangingError, match="laser-off"):
        extract(image, along="rows", background=image[1:])
    with pytest.raises(ValueError, match="width"):
        StripeOptions(minimum_width=2.0, maximum_width=1.0)
    assert np.all(extract(image, along="rows").reason == Reason.NO_LIGHT)
    assert np.isnan(extract(image + np.uint8(255), along="columns").position).all()


@pytest.mark.shared
@pytest.mark.skipif(not SHARED.exists(), reason="no shared captures")
def test_most_of_a_traced_stripe_is_ranged_along_rows():
    import cv2

    image = cv2.imread(str(SHARED / "twin-a/scan/frames/0030.png"), cv2.IMREAD_UNCHANGED)
    assert find_along(image) == "rows"
    stripe = extract(image, along="rows")
    lit = image.max(axis=0) > 40
    assert np.mean(np.isfinite(stripe.position[lit])) > 0.97
    assert not np.isfinite(stripe.position[image.max(axis=0) < 12]).any()


@pytest.mark.parametrize("place", [np.nan, np.inf, -np.inf, 1e300, -50.0])
def test_a_fit_that_ran_away_is_left_alone(place: float) -> None:
    from ranging.stripe import _speckle as stripe_speckle
    from ranging.stripe import _table as stripe_table

    image = np.full((8, 64), 20, dtype=np.uint8)
    rows = max(stripe_table.GOOD, *(v for k, v in vars(stripe_table).items() if k.isupper() and isinstance(v, int))) + 1
    table = np.ones((rows, 8))
    table[stripe_table.STATE] = stripe_table.GOOD
    table[stripe_table.POSITION] = place
    lines = stripe_table.Lines(image.ravel(), image.ravel()[:0], (8, 64, 64, 1), 255.0)
    grains = stripe_speckle.Grains(1.0, 25.0)
    stripe_speckle.refit_lines(lines, stripe_table.CameraNoise(35.0, 1.5), np.full(8, 0.3), grains, np.ones(8), table)
    assert np.array_equal(table[stripe_table.POSITION], np.full(8, place), equal_nan=True)
