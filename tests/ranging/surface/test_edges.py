"""Points that an edge displaced are found; rough and smooth surfaces keep theirs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.reason import Reason
from ranging.surface import Lattice, refine
from ranging.surface.edges import FAR, nearest_end

SIGMA = 0.02  # mm along the ray


def plate(depth: np.ndarray, *, step: float = 0.4) -> Lattice:
    """Surface z = 400 + depth (F, L) mm seen along +z: frames along y, lines along x, half a mm apart."""
    frames, lines = depth.shape
    x, y = np.meshgrid(0.5 * np.arange(lines), step * np.arange(frames))
    points = np.stack([x, y, 400.0 + depth], axis=-1)
    ones = np.ones(depth.shape)
    toward = np.array([0.0, 0.4, -np.sqrt(1.0 - 0.16)])
    return Lattice(
        points=points, view=np.broadcast_to([0.0, 0.0, 1.0], points.shape),
        moved=np.broadcast_to([0.0, 0.4, 0.0], points.shape), sheet=np.broadcast_to(toward, points.shape),
        camera=np.zeros((frames, 3)), sigma=np.where(np.isfinite(depth), SIGMA, np.nan), sigma_cal=0.0 * ones,
        reason=np.where(np.isfinite(depth), Reason.RANGED, Reason.NO_LIGHT).astype(np.uint8), position=100.0 * ones,
        sigma_px=0.02 * ones, width=1.3 * ones, peak=120.0 * ones, asymmetry=0.0 * ones,
        noise=np.tile([35.0, 1.5, 0.0], (frames, 1)),
    )  # fmt: skip


def noise(shape: tuple[int, int] = (36, 60), seed: int = 1) -> np.ndarray:
    return SIGMA * np.random.default_rng(seed).standard_normal(shape)


def edges(lattice: Lattice) -> np.ndarray:
    return refine(lattice, 0, len(lattice.camera)).reason == Reason.EDGE


def test_noise_alone_is_no_edge():
    assert edges(plate(noise())).mean() < 2e-3


@pytest.mark.parametrize("displaced", [0.15, 0.3, 0.6])
def test_the_half_seen_frame_at_a_drop_is_rejected_and_the_rest_of_both_levels_stays(displaced):
    depth = noise()
    depth[18:] += 6.0
    depth[17] += displaced  # half a stripe on the upper level
    found = edges(plate(depth))
    assert found[17].mean() > 0.99
    assert found[18].all()  # the first on the other side
    assert found[:16].mean() < 0.01
    assert found[20:].mean() < 0.01


def test_a_displaced_frame_beside_a_crease_is_rejected_and_both_faces_stay():
    depth = noise()
    y = 0.4 * np.arange(36)
    depth += 0.8 * np.abs(y - y[18])[:, None]
    depth[18] -= 0.2  # a spike; a rounded crease is a surface like any other
    found = edges(plate(depth))
    assert found[18].mean() > 0.9
    assert found[:17].mean() < 0.02
    assert found[20:].mean() < 0.02


def test_a_rough_surface_keeps_its_points():
    depth = 10.0 * noise()  # not smooth anywhere
    assert edges(plate(depth)).mean() == 0.0


def test_a_hole_costs_the_points_at_its_rim_alone():
    depth = noise()
    depth[10:14, 20:26] = np.nan
    found = edges(plate(depth))
    rim = np.zeros_like(found)
    rim[9:15, 20:26] = rim[10:14, 19:27] = True
    rim &= np.isfinite(depth)
    assert found[rim].all()
    assert found[~rim].mean() < 5e-3


def test_without_motion_nothing_is_rejected_or_moved():
    lattice = plate(noise(), step=0.0)
    found = refine(lattice, 0, len(lattice.camera))
    np.testing.assert_array_equal(found.points, lattice.points)
    np.testing.assert_array_equal(found.reason, lattice.reason)


def test_reasons_of_the_stripe_are_kept_and_their_rows_are_nan():
    lattice = plate(noise())
    reason = lattice.reason.copy()
    reason[5, 7] = Reason.TWO_PEAKS
    points, sigma = lattice.points.copy(), lattice.sigma.copy()
    points[5, 7], sigma[5, 7] = np.nan, np.nan
    found = refine(replace(lattice, reason=reason, points=points, sigma=sigma), 2, 9)
    assert found.reason.shape == (7, 60)
    assert found.reason[3, 7] == Reason.TWO_PEAKS
    assert np.isnan(found.points[3, 7]).all()
    assert np.isnan(found.sigma[3, 7])


def test_ends_are_counted_in_frames_and_in_lines():
    depth = np.zeros((9, 12))
    depth[4:, :] = 5.0
    depth[2, 8] = np.nan
    lattice = plate(depth)
    ends = np.full((2, 9, 12), FAR)
    nearest_end(lattice.points, lattice.view, lattice.sigma, 0, 9, np.ones((9, 12), bool), ends)
    np.testing.assert_array_equal(ends[0, :, 0], [3, 2, 1, 0, 0, 1, 2, 3, 4])
    np.testing.assert_array_equal(ends[1, 2, 4:8], [3, 2, 1, 0])
    assert ends[1, 0, 0] == FAR  # the border of the image is no end
