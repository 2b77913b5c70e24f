"""Channels, laser-off images and what the depth of an image tells."""

from __future__ import annotations

import numpy as np
import pytest

from ranging.background import choose_channel, clipping_level, mean_image, saturation_level, to_gray
from ranging.errors import RangingError


def scene(colour: int, ambient: int) -> np.ndarray:
    """A line of one colour (0 blue, 1 green, 2 red) on a gray gradient."""
    image = np.zeros((60, 80, 3), np.uint8)
    image[:] = np.linspace(0, ambient, 80).astype(np.uint8)[None, :, None]
    image[28:32, :, colour] = 200
    return image


@pytest.mark.parametrize(("place", "name"), [(0, "blue"), (1, "green"), (2, "red")])
def test_auto_takes_the_colour_of_the_line(place, name):
    assert choose_channel([scene(place, 5)]) == name
    assert choose_channel([scene(place, 150)]) == f"{name}-excess"
    assert choose_channel([scene(place, 150)], laser_off=True) == name


def test_what_was_asked_for_stays_unless_the_scene_is_lit():
    assert choose_channel([scene(2, 5)], "green") == "green"
    assert choose_channel([scene(2, 150)], "gray") == "gray"
    assert choose_channel([np.zeros((20, 20), np.uint8)], "red") == "gray"


def test_gray_scenes_have_no_excess_and_the_line_keeps_its_own():
    image = scene(2, 150)
    excess = to_gray(image, "red-excess")
    assert excess[:28].max() <= 1
    np.testing.assert_array_equal(to_gray(image, "red"), image[:, :, 2])
    others = (image[30, :, 0].astype(int) + image[30, :, 1] + 1) // 2
    assert np.abs(excess[30].astype(int) - (200 - others)).max() <= 1


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_alpha_and_single_channels_are_read(dtype):
    gray = np.arange(400, dtype=dtype).reshape(20, 20) % 200
    bgra = np.stack([gray, gray, gray, np.full_like(gray, 255)], axis=2)
    np.testing.assert_array_equal(to_gray(bgra, "red"), gray)
    np.testing.assert_array_equal(to_gray(gray[:, :, None], "auto"), gray)
    assert to_gray(bgra, "gray").dtype == dtype


def test_other_images_are_refused():
    with pytest.raises(RangingError, match="float32"):
        to_gray(np.zeros((20, 20), np.float32), "gray")
    with pytest.raises(RangingError, match="shape"):
        to_gray(np.zeros((20, 20, 2), np.uint8), "gray")
    with pytest.raises(ValueError, match="channel"):
        to_gray(np.zeros((20, 20, 3), np.uint8), "infrared")  # type: ignore[arg-type]


def test_mean_of_laser_off_images_rounds_and_refuses_mixtures():
    images = [np.full((10, 10), value, np.uint8) for value in (10, 11, 11)]
    assert mean_image(images).dtype == np.uint8
    assert np.all(mean_image(images) == 11)
    with pytest.raises(RangingError, match="mixed"):
        mean_image([images[0], images[0][1:]])


def test_saturation_is_the_end_of_the_depth():
    assert saturation_level(np.uint8) == 255
    assert saturation_level(np.uint16) == 65535


@pytest.mark.parametrize(("bits", "shift"), [(10, 0), (12, 0), (12, 4), (14, 0)])
def test_cameras_of_10_to_14_bits_clip_below_the_end_of_their_files(bits: int, shift: int) -> None:
    rng = np.random.default_rng(3)
    full = (1 << bits) - 1
    light = 1.6 * full * np.exp(-0.5 * ((np.arange(64) - 31.3) / 2.0) ** 2) * np.ones((200, 1))
    noisy = np.rint(light + rng.normal(0.0, 0.004 * full, light.shape))
    image = (np.clip(noisy, 0, full).astype(np.uint16) << shift).astype(np.uint16)
    assert clipping_level([image, image // 2]) == full << shift
    dim = (np.clip(noisy * 0.4, 0, full).astype(np.uint16) << shift).astype(np.uint16)
    assert clipping_level([dim]) == 65535
    assert clipping_level([(image >> (bits + shift - 8)).astype(np.uint8)]) == 255
