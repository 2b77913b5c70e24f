"""Normals and triangles of the scan lattice on surfaces whose normals are known."""

from __future__ import annotations

import numpy as np

from scope.cloud import ScanCloud, lattice_normals
from scope.cloud.lattice import lattice_triangles


def lattice(height, rows: int = 30, columns: int = 40) -> ScanCloud:
    frame, column = (part.ravel() for part in np.mgrid[0:rows, 0:columns])
    x, y = 0.5 * column - 10.0, 0.5 * frame - 7.0
    n = len(x)
    plain = ScanCloud.from_points(np.stack([x, y, height(x, y)], axis=1))
    pixels = np.stack([column.astype(np.float32), np.linspace(0.2, 300.7, n).astype(np.float32)], axis=1)
    return ScanCloud(
        plain.points, plain.intensity, plain.sigma, plain.sigma_cal, pixels, frame.astype(np.int32), plain.laser
    )


def test_a_plane_has_one_normal() -> None:
    true = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0])
    normals = lattice_normals(lattice(lambda x, y: 400 + 0.2 * x - 0.1 * y))
    assert np.isfinite(normals).all()
    assert np.abs(normals - true).max() < 1e-9  # towards the camera at z = 0


def test_a_sphere_has_its_radii_for_normals() -> None:
    cloud = lattice(lambda x, y: 400 - np.sqrt(40.0**2 - x * x - y * y))
    radii = (cloud.points - [0, 0, 400]) / 40.0
    inner = (np.abs(cloud.points[:, 0]) < 8) & (np.abs(cloud.points[:, 1]) < 6)
    assert np.degrees(np.arccos((lattice_normals(cloud)[inner] * radii[inner]).sum(axis=1).clip(-1, 1))).max() < 0.1


def test_no_triangle_and_no_normal_spans_a_step() -> None:
    cloud = lattice(lambda x, y: np.where(x < 0, 400.0, 410.0))
    corners = cloud.points[lattice_triangles(cloud)]
    assert np.ptp(corners[:, :, 2], axis=1).max() == 0.0
    assert len(corners) == 2 * 29 * 38  # one column of squares is missing
    assert np.abs(np.abs(lattice_normals(cloud)[:, 2]) - 1).max() < 1e-9


def test_bare_points_have_neither() -> None:
    bare = ScanCloud.from_points(np.random.default_rng(0).normal(size=(20, 3)))
    assert lattice_triangles(bare).shape == (0, 3)
    assert np.isnan(lattice_normals(bare)).all()
