"""Surfaces of known statistics, and scans of them, for the benchmarks of roughness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from scope.cloud import ScanCloud, Sensors

Array = NDArray[np.float64]
PITCH = (0.01, 0.01)


def random_surface(shape: tuple[int, int], spread: float | tuple[float, float], rng: np.random.Generator) -> Array:
    """Periodic Gaussian surface of Sq 0.05 mm; correlation length (1/e) twice the spread in samples."""
    z = gaussian_filter(rng.standard_normal(shape), spread, mode="wrap")
    return np.asarray(0.05 * z / z.std())


def four_surfaces(n: int, seed: int) -> dict[str, Array]:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:n, :n]
    grooves = -(np.abs(gaussian_filter(rng.standard_normal(n), 2.0, mode="wrap")) ** 1.3)
    return {
        "isotropic": random_surface((n, n), 5.0, rng),
        "anisotropic": random_surface((n, n), (4.0, 16.0), rng),
        "ground": 0.15 * grooves[None, :] + 0.15 * random_surface((n, n), 1.5, rng),
        "egg-box": 0.05 * np.sin(2 * np.pi * x / 50.3) * np.sin(2 * np.pi * y / 62.9),
    }


def scan_of(z: Array, rng: np.random.Generator, *, noise: float, pitch: float, told: float | None = None) -> ScanCloud:
    """A scan of heights (rows, columns) above a plane at 400 mm, seen at 20 degrees, noise along the sighting rays.

    The noise of the heights is exactly ``noise``; ``told`` is what the points' sigma claims it to be.
    """
    rows, columns = np.indices(z.shape)
    points = np.stack([columns * pitch, rows * pitch, 400.0 - z], axis=2).reshape(-1, 3)
    camera = np.array([points[:, 0].mean() + 150.0, points[:, 1].mean(), 0.0])
    ray = points - camera
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = noise / np.abs(ray[:, 2])
    frames = z.shape[0]
    return replace(
        ScanCloud.from_points(points + ray * (along * rng.standard_normal(len(points)))[:, None]),
        sigma=((noise if told is None else told) / np.abs(ray[:, 2])).astype(np.float32),
        pixels=np.stack([np.full(len(points), 310.37), columns.ravel() + 40.0], axis=1).astype(np.float32),
        frame=rows.ravel().astype(np.int32),
        sensors=Sensors(
            frame=np.arange(frames, dtype=np.int32),
            laser=np.zeros(frames, dtype=np.uint8),
            centre=np.tile(camera, (frames, 1)),
            rotation=np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)),
            laser_origin=np.full((frames, 3), np.nan),
        ),
    )
