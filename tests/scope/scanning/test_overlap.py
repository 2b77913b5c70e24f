"""A turntable that turns otherwise than the capture says: the table is a closed form, cut by a sheet of light."""

from __future__ import annotations

import numpy as np
import pytest

from ranging.motion import Turntable
from scope.cloud import ScanCloud
from scope.scanning.overlap import turn_trouble

LINES, AXIS = 160, np.array([0.0, 0.0, 1.0])


def surface(x: np.ndarray, y: np.ndarray, tilt: float, ball: bool) -> np.ndarray:
    """Heights of the table at position 0: a tilted disk, and a ball of 15 mm upon it."""
    base = tilt * (0.8 * x + 0.6 * y)
    inside = 15.0**2 - (x - 25.0) ** 2 - (y + 10.0) ** 2
    return (
        np.maximum(base, 8.0 + np.sqrt(np.maximum(inside, 0.0)) * (inside > 0) - 100.0 * (inside <= 0))
        if ball
        else base
    )


def turned(
    factor: float, frames: int, *, step: float = 5.0, tilt: float = 0.03, ball: bool = True, offset: float = 20.0
) -> tuple[ScanCloud, Turntable]:
    """Cloud put together by the stated step, of a table that turned by ``factor`` of it; sheet of light x = ``offset``."""
    stated = np.radians(step) * np.arange(frames)
    motion = Turntable(np.zeros(3), AXIS, np.radians(step))
    rng = np.random.default_rng(4)
    y = np.linspace(-60, 60, LINES)
    parts = []
    for k, s in enumerate(factor * stated):
        x0, y0 = np.cos(s) * offset + np.sin(s) * y, -np.sin(s) * offset + np.cos(s) * y  # where the table had it
        z = surface(x0, y0, tilt, ball) + rng.normal(scale=0.01, size=LINES)
        parts.append(motion.cloud_from_c(k).apply(np.stack([np.full(LINES, offset), y, z], axis=1)))
    bare = ScanCloud.from_points(np.concatenate(parts))
    n = len(bare)
    pixels = np.stack([np.tile(np.arange(LINES), frames), rng.uniform(0, 400, n)], axis=1).astype(np.float32)
    from dataclasses import replace

    return replace(bare, pixels=pixels, sigma=np.full(n, 0.01, np.float32), frame=np.repeat(np.arange(frames), LINES).astype(np.int32)), motion  # fmt: skip


@pytest.mark.parametrize("frames", [40, 72, 90, 150])
@pytest.mark.parametrize("tilt", [0.0, 0.03])
def test_the_right_angles_are_no_trouble(frames: int, tilt: float) -> None:
    assert turn_trouble(*turned(1.0, frames, tilt=tilt)) == ""
    assert turn_trouble(*turned(1.0, frames, tilt=tilt, step=-5.0)) == ""


@pytest.mark.parametrize(
    ("factor", "said"),
    [(-1.0, "the other way"), (2.0, "twice"), (0.5, "half"), (-2.0, "the other way, twice"), (1.5, "one and a half")],
)
def test_a_base_that_wobbles_tells_sign_and_step(factor: float, said: str) -> None:
    told = turn_trouble(*turned(factor, 60, ball=False))
    assert "base wobbles" in told
    assert said in told


@pytest.mark.parametrize(("factor", "frames"), [(0.5, 120), (0.9, 120), (1.5, 100), (0.75, 120)])
def test_a_full_turn_that_does_not_come_back_is_said(factor: float, frames: int) -> None:
    told = turn_trouble(*turned(factor, frames, tilt=0.0, offset=5.0))
    assert "after the full turn" in told
    if factor == 1.5:
        assert "one and a half times" in told


def test_what_cannot_be_told_is_not_said() -> None:
    """A flat table square to the axis, and less than a turn: any angle fits."""
    assert turn_trouble(*turned(2.0, 50, tilt=0.0, ball=False)) == ""
    assert turn_trouble(*turned(-1.0, 90, tilt=0.0, ball=False)) == ""
