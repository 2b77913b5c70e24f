"""Filters of clouds on lattices whose answer is known by construction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scope.cloud import FilterOptions, ScanCloud, Sensors, filtered
from scope.cloud.filters import incidence, most_certain, neighbours


def lattice(frames: int = 12, lines: int = 15, slope: float = 0.0, step: float = 0.5) -> ScanCloud:
    """Plane z = 400 + slope x, frames along y, lines along x, seen from the origin."""
    frame, line = np.meshgrid(np.arange(frames), np.arange(lines), indexing="ij")
    x, y = (line.ravel() - lines // 2) * step, (frame.ravel() - frames // 2) * step
    n = x.size
    return replace(
        ScanCloud.from_points(np.column_stack([x, y, 400.0 + slope * x])),
        pixels=np.column_stack([line.ravel(), np.full(n, 100.3)]).astype(np.float32),
        frame=frame.ravel().astype(np.int32),
        sigma=np.full(n, 0.01, np.float32),
        sensors=Sensors(
            np.arange(frames, dtype=np.int32), np.zeros(frames, np.uint8), np.zeros((frames, 3)),
            np.tile([1.0, 0, 0, 0], (frames, 1)), np.full((frames, 3), np.nan),
        ),
    )  # fmt: skip


def test_nothing_is_removed_unless_asked() -> None:
    cloud = lattice()
    left, removed = filtered(cloud, FilterOptions())
    assert left is cloud
    assert removed == {}
    assert not FilterOptions().any


def test_neighbours_of_a_full_lattice() -> None:
    count = neighbours(lattice(5, 7)).reshape(5, 7)
    assert (count[1:-1, 1:-1] == 8).all()
    assert (count[[0, 0, -1, -1], [0, -1, 0, -1]] == 3).all()
    assert (count[0, 1:-1] == 5).all()


def test_neighbours_with_turns_of_two_lasers() -> None:
    cloud = lattice(6, 7)
    assert np.array_equal(neighbours(replace(cloud, frame=cloud.frame * 2)), neighbours(cloud))


def test_a_point_off_the_surface_is_isolated_and_the_surface_is_not() -> None:
    cloud = lattice()
    points = cloud.points.copy()
    points[80, 2] -= 40.0
    left, removed = filtered(replace(cloud, points=points), FilterOptions(isolated=1))
    assert removed == {"isolated": 1}
    assert len(left) == len(cloud) - 1
    assert (left.points[:, 2] == 400.0).all()


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.7])
def test_incidence_is_the_angle_of_the_slope(slope: float) -> None:
    cloud = lattice(slope=slope)
    found = incidence(cloud)
    sight = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    normal = np.array([slope, 0.0, -1.0]) / np.hypot(slope, 1.0)
    known = np.isfinite(found)
    assert known.mean() > 0.8
    assert np.allclose(found[known], np.degrees(np.arccos(np.abs(sight @ normal)))[known], atol=1e-4)
    _, removed = filtered(cloud, FilterOptions(max_incidence=45.0))
    assert removed["incidence"] == (int(known.sum()) if slope > 1.1 else 0)


def test_incidence_needs_to_know_the_camera() -> None:
    with pytest.raises(ValueError, match="sensor"):
        incidence(replace(lattice(), sensors=None))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), edge=st.floats(0.05, 3.0))
def test_voxels_keep_the_most_certain_point_of_each_cube(seed: int, edge: float) -> None:
    rng = np.random.default_rng(seed)
    cloud = ScanCloud.from_points(rng.uniform(-2, 2, (200, 3)))
    cloud = replace(cloud, sigma=rng.uniform(0.01, 0.1, 200).astype(np.float32))
    best: dict[tuple[int, ...], int] = {}
    for k, cube in enumerate(np.floor(cloud.points / edge).astype(int)):
        other = best.setdefault(tuple(cube), k)
        if cloud.sigma[k] < cloud.sigma[other]:
            best[tuple(cube)] = k
    assert set(np.flatnonzero(most_certain(cloud, edge))) == set(best.values())


def test_an_empty_cloud_passes_every_filter() -> None:
    cloud = replace(lattice().select(np.zeros(0, dtype=np.intp)))
    left, removed = filtered(cloud, FilterOptions(isolated=2, max_incidence=60.0, voxel=1.0))
    assert len(left) == 0
    assert removed == {"isolated": 0, "incidence": 0, "voxel": 0}


@pytest.mark.parametrize(
    "wrong", [{"isolated": 0}, {"isolated": 9}, {"max_incidence": 0.0}, {"max_incidence": 91.0}, {"voxel": 0.0}]
)
def test_impossible_options_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        FilterOptions(**wrong)  # type: ignore[arg-type]
