"""Passages of the sheet of light, against a world in which all is known: an orthographic camera, light of one dimension."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from calibration.geometry import Pose
from calibration.reason import Reason
from ranging.stripe import StripeOptions, extract
from ranging.surface import REACH, Lattice, Timeframe, refine
from ranging.surface.spacetime import follow_points

PIXEL = 0.4  # mm
STEP = 0.45  # mm a frame, in y
SHEET = np.array([0.0, 0.9, -np.sqrt(1.0 - 0.81)])
WIDTH, LENS = 0.35, 0.6  # mm; px
GAIN, DARK = 35.0, 1.2**2 + 1.0 / 12.0
FRAMES, ROWS, LINES = 31, 60, 40
MIDDLE = ROWS / 2.0  # px, where the sheet meets the height 0
LEVEL = 150.0
TURN = Pose.from_rotation_vector([0.02, -0.01, 0.03], [5.0, -3.0, 2.0])  # nobody needs the cloud's frame to be C


def height(y: np.ndarray, slope: float) -> np.ndarray:
    return slope * y


def images(slope: float, reflectance, rng: np.random.Generator | None) -> list[np.ndarray]:
    """Frames (ROWS, LINES): light of a surface z = slope y, whose reflectance is a function of y on the object."""
    fine = np.arange(-3.0, ROWS + 3.0, 0.05)  # px
    y = (fine - MIDDLE) * PIXEL
    answer = ndtr((np.arange(ROWS)[:, None] + 0.5 - fine) / LENS) - ndtr((np.arange(ROWS)[:, None] - 0.5 - fine) / LENS)
    found = []
    for f in range(FRAMES):
        moved = STEP * (f - FRAMES // 2)
        on_object = y - moved
        off = np.stack([0.0 * y, y, height(on_object, slope)], axis=1) @ SHEET
        light = LEVEL * reflectance(on_object) * np.exp(-0.5 * (off / WIDTH) ** 2)
        line = answer @ light * 0.05
        image = np.repeat(line[:, None], LINES, axis=1) + 4.0
        if rng is not None:
            image = rng.poisson(image * GAIN) / GAIN + 1.2 * rng.standard_normal(image.shape)
        found.append(np.clip(np.rint(image * (1.0 if rng is not None else 256.0)), 0, 65535).astype(np.uint16))
    return found


def scene(slope: float, reflectance, rng: np.random.Generator | None = None):
    """The lattice of the scan, its timeframes, and the exact height (F, L) at each pixel found."""
    shots = images(slope, reflectance, rng)
    scale = 1.0 if rng is not None else 256.0
    options = StripeOptions(gain_e=GAIN / scale, read_noise=1.2 * scale, saturation=65535, speckle="off", edge=0.9)
    stripes = [extract(shot, along="rows", options=options) for shot in shots]
    shape = (FRAMES, LINES)
    position = np.stack([stripe.position for stripe in stripes])
    moved = STEP * (np.arange(FRAMES) - FRAMES // 2)[:, None] + np.zeros(LINES)
    y = (position - MIDDLE) * PIXEL
    points = np.stack([PIXEL * np.arange(LINES) + 0.0 * y, y, -SHEET[1] / SHEET[2] * y], axis=-1)
    on_object = points - np.stack([0.0 * y, moved, 0.0 * y], axis=-1)

    def turned(vector) -> np.ndarray:
        return np.broadcast_to(TURN.rotation @ np.asarray(vector), (*shape, 3))

    per_px = abs(SHEET[1] / SHEET[2]) * PIXEL
    sigma_px = np.stack([stripe.sigma for stripe in stripes])
    lattice = Lattice(
        points=TURN.apply(on_object), view=turned([0.0, 0.0, 1.0]), moved=turned([0.0, PIXEL, 0.0]), sheet=turned(SHEET),
        camera=np.broadcast_to(TURN.apply(np.array([0.0, 0.0, -1e4])), (FRAMES, 3)), sigma=sigma_px * per_px,
        sigma_cal=0.0 * position, reason=np.stack([stripe.reason for stripe in stripes]), position=position,
        sigma_px=sigma_px, width=np.stack([s.width for s in stripes]), peak=np.stack([s.peak for s in stripes]),
        asymmetry=np.stack([s.asymmetry for s in stripes]), noise=np.tile([GAIN / scale, DARK * scale**2, 0.0], (FRAMES, 1)),
    )  # fmt: skip
    timeframes = [
        Timeframe(
            shots[f], None, "rows", 65535.0, TURN @ Pose(np.eye(3), np.array([0.0, -moved[f, 0], 0.0])),
            turned([PIXEL, 0.0, 0.0])[f], stripes[f].floor,
        )
        for f in range(FRAMES)
    ]  # fmt: skip
    truth = height(on_object[..., 1], slope)
    return lattice, timeframes, truth, on_object


def passed(lattice, timeframes, slope: float):
    blurred = np.hypot(WIDTH, abs(SHEET[1] + slope * SHEET[2]) * PIXEL * np.sqrt(LENS**2 + 1 / 12 + 0.25))
    every = np.ones((FRAMES, LINES), bool)
    return follow_points(lattice, timeframes, every, np.full(every.shape, blurred), 0, FRAMES)


INNER = slice(REACH + 3, FRAMES - REACH - 3)


@pytest.mark.parametrize("slope", [0.0, 0.4, -0.3])
def test_without_noise_the_sheet_passes_an_even_surface_when_it_is_on_it(slope):
    lattice, timeframes, truth, on_object = scene(slope, lambda y: 0.8 + 0.0 * y)
    offset = (truth - on_object[..., 2]) * SHEET[2]  # of the surface from the sheet, at the pixel found
    found = passed(lattice, timeframes, slope)
    # mm; what a quadratic B-spline errs by between pixels
    np.testing.assert_allclose(found.offset[INNER], -offset[INNER], atol=0.006)


def test_its_sigma_is_that_of_repeated_scans():
    rng = np.random.default_rng(8)
    lattice, timeframes, truth, on_object = scene(0.2, lambda y: 0.8 + 0.0 * y, rng)
    offset = (truth - on_object[..., 2]) * SHEET[2]
    found = passed(lattice, timeframes, 0.2)
    z = (found.offset + offset)[INNER] / found.sigma[INNER]
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.15
    assert 0.4 < np.median(found.misfit[INNER]) < 1.2  # of chi squared with few degrees of freedom


def dark_beyond(y: np.ndarray) -> np.ndarray:
    return np.where(y < 0.13, 0.9, 0.12)


def test_at_an_edge_of_reflectance_profile_and_passage_err_to_opposite_sides_and_their_mean_much_less():
    lattice, timeframes, truth, on_object = scene(0.0, dark_beyond)
    near = np.abs(on_object[INNER, 20, 1]) < 1.0
    profile = (on_object[..., 2] - truth)[INNER, 20][near]  # mm of height
    found = passed(lattice, timeframes, 0.0)
    passage = profile - (found.offset / SHEET[2])[INNER, 20][near]
    blur = (SHEET[1] * PIXEL) ** 2 * (LENS**2 + 1 / 12 + 0.25)
    weight = WIDTH**2 / (WIDTH**2 + blur)
    joined = profile + weight * (passage - profile)
    worst = np.argmax(np.abs(profile))
    assert abs(profile[worst]) > 0.15
    assert profile[worst] * passage[worst] < 0.0
    assert np.abs(joined).max() < 0.35 * np.abs(profile).max()
    assert np.sqrt(np.mean(joined**2)) < 0.35 * np.sqrt(np.mean(profile**2))


def test_points_at_an_edge_of_reflectance_hold_their_sigma_or_are_rejected():
    rng = np.random.default_rng(9)
    lattice, timeframes, _, _ = scene(0.0, dark_beyond, rng)
    found = refine(lattice, 0, FRAMES, timeframes)
    alone = refine(lattice, 0, FRAMES)  # judged by neighbours only
    kept = found.reason[INNER] == Reason.RANGED
    assert kept.mean() > 0.75  # two frames in fifteen lie on the edge
    z, z_alone = (np.abs(TURN.inverse.apply(each.points[INNER])[..., 2]) / each.sigma[INNER] for each in (found, alone))
    assert (z[kept] < 2.0).mean() > 0.9
    assert np.nanmax(z[kept]) < 0.5 * np.nanmax(z_alone)


def test_a_sheet_that_moves_too_far_between_frames_gives_no_second_answer():
    lattice, timeframes, _, _ = scene(0.0, lambda y: 0.8 + 0.0 * y)
    sparse = [exposure if k % 4 == 2 else None for k, exposure in enumerate(timeframes)]
    assert np.isnan(passed(lattice, sparse, 0.0).offset).all()


def test_clipped_pixels_are_no_samples():
    lattice, timeframes, truth, on_object = scene(0.4, lambda y: 0.8 + 0.0 * y)
    offset = (truth - on_object[..., 2]) * SHEET[2]
    top = np.uint16(0.98 * max(exposure.image.max() for exposure in timeframes))
    clipped = [
        Timeframe(np.minimum(e.image, top), None, "rows", float(top), e.cloud_from_c, e.slide, e.floor)
        for e in timeframes
    ]
    found = passed(lattice, clipped, 0.4)
    known = np.isfinite(found.offset[INNER])
    assert 0.1 < known.mean() < 1.0
    assert np.abs(found.offset + offset)[INNER][known].max() < 0.02  # mm; unclipped samples on one side weigh more
