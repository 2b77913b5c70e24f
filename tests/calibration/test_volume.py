"""Where the calibration holds."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.volume import Volume

BOX = np.stack(np.meshgrid([-50.0, 50.0], [-30.0, 30.0], [300.0, 400.0]), axis=-1).reshape(-1, 3)


def test_a_box_reaches_a_twentieth_beyond_its_ends_only() -> None:
    volume = Volume.around(BOX, np.array([0.0, 0.0, 1.0]))
    inside = np.array([[0, 0, 295.1], [0, 0, 404.9], [49.9, 29.9, 350], [-49.9, 0, 300]])
    outside = np.array([[0, 0, 294.9], [0, 0, 405.1], [50.1, 0, 350], [0, -30.1, 350], [np.nan, 0, 350]])
    assert volume.contains(inside).all()
    assert not volume.contains(outside).any()
    assert volume.contains(outside[:4], margin=0.2).all()
    assert not volume.contains(outside[4:], margin=np.inf).any()


def test_it_is_the_hull_of_its_points() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3)) * [40, 30, 20]
    volume = Volume.around(points, np.array([0.0, 0.0, 1.0]))
    mixed = rng.dirichlet(np.ones(200), 500) @ points
    assert volume.contains(mixed).all()
    assert volume.contains(points, margin=1e-6).all()


def test_everywhere_and_nowhere() -> None:
    assert Volume.everywhere().contains(np.array([[1e9, 0, 0]])).all()
    for flat in (BOX * [1, 1, 0], BOX * [1, 0, 0]):
        with pytest.raises(ValueError, match=r"one plane|no volume"):
            Volume.around(flat, np.array([0.0, 0.0, 1.0]))
