"""Profile parameters and extras against closed forms and surfalize."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from scope.roughness.extras import Joint, joint_roughness, mean_profile_depth
from scope.roughness.profile import Profiles, elements, profile_parameters, roughness_profiles


def test_agrees_with_surfalize():
    surfalize = pytest.importorskip("surfalize")
    rng = np.random.default_rng(1)
    z = gaussian_filter1d(rng.standard_normal((6, 1000)), 6.0, axis=1)
    found = profile_parameters(Profiles(z, 0.01, 2.0, 5, 0.0))
    for row in range(len(z)):
        peer = surfalize.Profile(z[row] - z[row].mean(), 0.01)
        for key in ("Ra", "Rq", "Rz", "Rt", "Rsk", "Rku", "Rdq"):
            assert found[key][row] == pytest.approx(getattr(peer, key)(), rel=1e-9), key


@given(amplitude=st.floats(0.001, 1.0), wave=st.floats(0.3, 0.5), phase=st.floats(0.0, 6.0), noise=st.floats(0.0, 0.02))
@settings(max_examples=20, deadline=None)
def test_a_sinusoid_behind_its_cutoff(amplitude, wave, phase, noise):
    """Cut-off 2.5 mm passes a wave of 0.4 mm to all but exp(-ln 2 (2.5 / 0.4)^2), which is nothing."""
    x = np.arange(2600) * 0.01
    rng = np.random.default_rng(0)
    z = amplitude * (np.sin(2 * np.pi * x / wave + phase) + noise * rng.standard_normal((4, len(x)))) + 3.0
    profiles = roughness_profiles(z, 0.01, 2.5)
    assert profiles.sections == 5
    found = {key: float(np.mean(values)) for key, values in profile_parameters(profiles).items()}
    loose = 0.02 + 6.0 * noise
    assert found["RSm"] == pytest.approx(wave, rel=0.01)  # noise within a tenth of Rz makes no elements
    assert found["Rq"] == pytest.approx(amplitude / math.sqrt(2.0), rel=loose)
    assert found["Ra"] == pytest.approx(2.0 * amplitude / math.pi, rel=loose)
    assert found["Rz"] == pytest.approx(2.0 * amplitude, rel=loose)
    assert found["Rc"] == pytest.approx(2.0 * amplitude, rel=loose)
    assert abs(found["Rsk"]) < 0.05
    assert found["Rku"] == pytest.approx(1.5, rel=loose)


@pytest.mark.parametrize(("wave", "cutoff"), [(0.1, 0.25), (0.3, 0.8), (0.8, 2.5), (2.0, 8.0)])
def test_default_cutoff_is_the_standards_class(wave, cutoff):
    """ISO 21920-3: RSm of 0.04 to 0.13 mm takes 0.25 mm, to 0.4 mm 0.8 mm, to 1.3 mm 2.5 mm, to 4 mm 8 mm."""
    x = np.arange(6000) * 0.01
    assert roughness_profiles(np.tile(np.sin(2 * np.pi * x / wave), (3, 1)), 0.01).cutoff == cutoff


def test_short_profiles_take_what_fits():
    x = np.arange(300) * 0.1
    profiles = roughness_profiles(np.tile(np.sin(2 * np.pi * x / 3.0), (3, 1)), 0.1)
    assert (profiles.cutoff, profiles.sections) == (8.0, 3)  # 2.5 mm would take most of a wave of 3 mm
    assert roughness_profiles(np.tile(np.sin(2 * np.pi * x[:120] / 3.0), (3, 1)), 0.1).cutoff == 2.5  # nor 8 mm in 12
    with pytest.raises(ValueError, match="does not fit"):
        roughness_profiles(np.zeros((3, 300)), 0.1, 31.0)
    with pytest.raises(ValueError, match="does not fit"):
        roughness_profiles(np.zeros((3, 300)), 0.1, 0.1)


def test_elements_do_not_reach_across_gaps():
    x = np.arange(1000) * 0.01
    z = np.sin(2 * np.pi * x / 0.5 - 0.3)
    z[200:420] = np.nan  # 4.4 waves
    width, height = elements(z, 0.01, 0.1)
    assert width == pytest.approx(0.5, rel=1e-3)
    assert height == pytest.approx(2.0, rel=1e-2)
    assert math.isnan(elements(np.ones(50), 0.01, 0.1)[0])


def test_a_small_ripple_is_no_element():
    x = np.arange(4000) * 0.01
    z = np.sin(2 * np.pi * x / 4.0) + 0.15 * np.sin(2 * np.pi * x / 0.2)
    assert elements(z, 0.01, 0.2)[0] == pytest.approx(4.0, rel=0.05)
    assert elements(z, 0.01, 0.0)[0] < 3.0


def test_profiles_with_gaps_keep_their_parameters():
    rng = np.random.default_rng(2)
    z = gaussian_filter1d(rng.standard_normal((200, 1000)), 6.0, axis=1)
    whole = profile_parameters(roughness_profiles(z, 0.01, 2.0))
    part = profile_parameters(roughness_profiles(np.where(rng.random(z.shape) < 0.1, np.nan, z), 0.01, 2.0))
    for key in ("Ra", "Rq", "Rz", "Rt", "Rdq"):
        assert np.nanmean(part[key]) == pytest.approx(np.mean(whole[key]), rel=0.02), key


def test_z2_and_joint_roughness():
    """A triangle wave of slope s has Z2 = s; Yu & Vayssade's line at 0.5 mm: JRC = 61.79 Z2 - 3.47."""
    x = np.arange(2000) * 0.1
    slope = 0.2
    z = slope * np.abs((x % 20.0) - 10.0)[None, :]
    z2, jrc = joint_roughness(z, 0.1)
    assert z2.value == pytest.approx(slope, rel=0.02)
    assert jrc.value == pytest.approx(61.79 * z2.value - 3.47)
    joint = Joint.gather(z, 0.1)
    assert joint.step == pytest.approx(0.5)
    assert "61.79" in joint.formula
    steep = joint_roughness(5.0 * z, 0.1)[1]
    assert math.isnan(steep.value)
    assert "outside 0 to 20" in steep.reason
    assert "no formula for a step" in joint_roughness(z, 3.0)[1].reason
    noisy = z + 0.05 * np.random.default_rng(0).standard_normal((400, 2000))
    assert joint_roughness(noisy, 0.1)[0].value > 1.05 * slope
    assert joint_roughness(noisy, 0.1, noise_variance=0.0025)[0].value == pytest.approx(slope, rel=0.02)
    again = z + 0.05 * np.random.default_rng(1).standard_normal((400, 2000))
    repeated = Joint.gather(noisy, 0.1, second=again, noise_variance=0.0025).of(np.ones(400, dtype=bool))[0]
    assert repeated.value == pytest.approx(slope, rel=0.02)
    for extra in joint_roughness(noisy, 0.1, noise_variance=0.05):
        assert math.isnan(extra.value)
        assert "of the squared slopes" in extra.reason


def test_mean_profile_depth_needs_its_length():
    x = np.arange(2100) * 0.1
    z = (0.8 * np.sin(2 * np.pi * x / 10.0) + 0.05 * x)[None, :]  # whole waves, tilted
    assert mean_profile_depth(z, 0.1) == pytest.approx(0.8, rel=0.05)  # the regression line tilts by a wave's share
    assert math.isnan(mean_profile_depth(z[:, :900], 0.1))
    assert math.isnan(mean_profile_depth(z, 100.0))  # a base length of one sample has no two halves


def test_a_few_lost_heights_end_no_element():
    """A fifth missing at random left only short elements, of half the width."""
    rng = np.random.default_rng(3)
    z = gaussian_filter1d(rng.standard_normal(20_000), 6.0)
    whole = elements(z, 0.01, 0.1 * np.ptp(z) / 3.0)
    part = elements(np.where(rng.random(len(z)) < 0.2, np.nan, z), 0.01, 0.1 * np.ptp(z) / 3.0)
    assert part == pytest.approx(whole, rel=0.05)
