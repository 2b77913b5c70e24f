"""Images as they are stored, and those that cannot be."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.errors import FileError
from scope.session import gray, mean_gray, mean_image, read_alike, read_image

RNG = np.random.default_rng(0)


def stored(folder: Path, name: str, image: np.ndarray) -> Path:
    path = folder / name
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())
    return path


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_grey_levels_come_back_as_they_were(tmp_path: Path, dtype: type, suffix: str) -> None:
    image = RNG.integers(0, np.iinfo(dtype).max, (7, 9), dtype=dtype)
    found = read_image(stored(tmp_path, "a" + suffix, image))
    assert found.dtype == dtype
    assert np.array_equal(found, image)


def test_an_alpha_channel_is_dropped_and_colours_stay_bgr(tmp_path: Path) -> None:
    image = RNG.integers(0, 255, (5, 6, 4), dtype=np.uint8)
    assert np.array_equal(read_image(stored(tmp_path, "a.png", image)), image[:, :, :3])


def test_grey_is_the_weighted_mean_of_bt_601() -> None:
    pure = np.zeros((1, 3, 3), np.uint8)
    pure[0, 0, 0] = pure[0, 1, 1] = pure[0, 2, 2] = 200  # blue, green, red
    assert np.allclose(gray(pure)[0], [0.114 * 200, 0.587 * 200, 0.299 * 200], atol=0.51)


def test_a_mean_of_repeats_keeps_what_averaging_gained() -> None:
    low = [np.full((2, 2), level, np.uint8) for level in (10, 10, 11)]
    assert mean_gray(low)[0, 0] == pytest.approx(31 / 3)
    mean = mean_image(low)
    assert mean.dtype == np.uint16
    assert mean[0, 0] / 257 == pytest.approx(31 / 3, abs=1 / 257)
    assert mean_image(low[:1]) is low[0]


@pytest.mark.parametrize(("suffix", "cut"), [(".png", 20), (".jpg", 40), (".png", 0)])
def test_a_file_without_its_end_is_refused(tmp_path: Path, suffix: str, cut: int) -> None:
    path = stored(tmp_path, "a" + suffix, RNG.integers(0, 255, (64, 64), dtype=np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: -cut or 0])
    with pytest.raises(FileError, match=r"truncated|is empty"):
        read_image(path)


def test_what_is_no_image_or_has_the_wrong_pixels_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(FileError, match=r"text\.png: is no image"):
        read_image(tmp_path / "text.png")
    with pytest.raises(FileError, match="float32"):
        read_image(stored(tmp_path, "deep.tif", np.zeros((4, 4), np.float32)))


def test_repeats_must_agree(tmp_path: Path) -> None:
    one = stored(tmp_path, "a.png", np.zeros((4, 6), np.uint8))
    deep = stored(tmp_path, "b.png", np.zeros((4, 6), np.uint16))
    with pytest.raises(FileError, match=r"b\.png: 6 x 4 px, 16 bit grey, but a\.png has 6 x 4 px, 8 bit grey"):
        read_alike([one, deep], "plane w1")
