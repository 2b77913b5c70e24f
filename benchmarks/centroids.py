"""Centroids of simulated disks against the Cramer-Rao bound: ``python -m benchmarks.centroids [draws]``.

The witness is a disk of radius R under a Gaussian blur (exact: a non-central chi-squared distribution), integrated over
every pixel, with noise of variance ``gain * I + read^2`` and rounding to whole grey levels. The bound is that of the
full model: centre, radius, blur and both levels unknown, variance ``gain * I + read^2 + 1/12``. Every figure is a root
mean square over both axes divided by that bound, so 1 is the best that any unbiased method can do.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import ncx2

from calibration.spots import Method, find_spots

Array = NDArray[np.float64]
GROUND, CONTRAST = 20.0, 180.0  # grey levels
BLOB = "OpenCV blob"


@dataclass(frozen=True)
class Cell:
    """One set of conditions."""

    radius: float  # px
    blur: float  # px, one sigma of the lens
    snr: float  # contrast over the noise on the spot
    shot: float  # share of the variance on the spot that is proportional to the signal

    @property
    def noise(self) -> tuple[float, float]:
        """Gain and read noise."""
        variance = (CONTRAST / self.snr) ** 2
        return self.shot * variance / (GROUND + CONTRAST), float(np.sqrt((1 - self.shot) * variance))


def cells() -> Iterator[Cell]:
    for radius in (6.0, 8.0, 10.0, 12.0):
        for blur in (0.8, 1.5):
            for snr in (20.0, 50.0, 100.0):
                for shot in (0.1, 0.9):
                    yield Cell(radius, blur, snr, shot)


def disk(u: Array, v: Array, centre: Array, radius: float, blur: float) -> Array:
    """Pixel averages (H, W) of a blurred disk of unit contrast, by Gauss-Legendre quadrature in every pixel."""
    node, weight = np.polynomial.legendre.leggauss(3)
    out = np.zeros(np.broadcast(u, v).shape)
    for a, wa in zip(node / 2, weight / 2, strict=True):
        for b, wb in zip(node / 2, weight / 2, strict=True):
            r = np.hypot(u + a - centre[0], v + b - centre[1])
            edge = np.abs(r - radius) < 7.0 * blur
            part = (r < radius).astype(float)
            part[edge] = ncx2.cdf(radius**2 / blur**2, 2, np.maximum(r[edge], 1e-6) ** 2 / blur**2)
            out += wa * wb * part
    return out


def centroid_bound(cell: Cell, centre: Array) -> float:
    """Cramer-Rao bound on one axis, px: u, v, radius, blur, contrast and ground all unknown."""
    half = int(cell.radius + 5 * cell.blur + 4)
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    p = np.array([centre[0], centre[1], cell.radius, cell.blur, CONTRAST, GROUND])

    def model(q: Array) -> Array:
        return np.asarray((q[5] + q[4] * disk(u, v, q[:2], q[2], q[3])).ravel())

    eps = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-2, 1e-2])
    jacobian = np.stack([(model(p + e) - model(p - e)) / (2 * e.sum()) for e in np.diag(eps)], axis=1)
    gain, read = cell.noise
    information = jacobian.T @ (jacobian / (gain * model(p) + read**2 + 1 / 12)[:, None])
    covariance = np.linalg.inv(information)
    return float(np.sqrt((covariance[0, 0] + covariance[1, 1]) / 2))


def scene(cell: Cell, rows: int, columns: int, rng: np.random.Generator) -> tuple[NDArray[np.uint16], Array]:
    """An image of rows x columns disks at random sub-pixel places, and their centres (N, 2)."""
    pitch = int(2 * cell.radius + 10 * cell.blur + 10)
    image = np.full((rows * pitch, columns * pitch), GROUND)
    v, u = np.mgrid[0:pitch, 0:pitch].astype(float)
    centres = []
    for i in range(rows):
        for j in range(columns):
            centre = (pitch - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
            image[i * pitch : (i + 1) * pitch, j * pitch : (j + 1) * pitch] += CONTRAST * disk(
                u, v, centre, cell.radius, cell.blur
            )
            centres.append(centre + np.array([j, i]) * pitch)
    gain, read = cell.noise
    noisy = image + rng.normal(size=image.shape) * np.sqrt(gain * image + read**2)
    return np.clip(np.round(noisy), 0, 4000).astype(np.uint16), np.array(centres)


def nearest(found: Array, truth: Array) -> tuple[Array, NDArray[np.intp]]:
    """Errors (N, 2) px of what was found, NaN where nothing is within 3 px of the truth, and which was taken."""
    out = np.full(truth.shape, np.nan)
    if not len(found):
        return out, np.zeros(len(truth), np.intp)
    gap = np.linalg.norm(truth[:, None] - found[None], axis=2)
    pick = gap.argmin(axis=1)
    near = gap[np.arange(len(truth)), pick] < 3.0
    out[near] = found[pick[near]] - truth[near]
    return out, pick


def opencv_blobs(image: NDArray[np.uint16]) -> Array:
    options = cv2.SimpleBlobDetector_Params()
    options.blobColor, options.filterByArea, options.minArea, options.maxArea = 255, True, 30, 5000
    options.filterByConvexity = options.filterByInertia = options.filterByCircularity = False
    points = cv2.SimpleBlobDetector_create(options).detect(np.clip(image, 0, 255).astype(np.uint8))
    return np.array([p.pt for p in points], dtype=np.float64).reshape(-1, 2)


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 20000
    rng = np.random.default_rng(20)
    conditions = list(cells())
    columns = 20
    rows = max(2, round(draws / len(conditions) / columns))
    methods = ("binary", "gray", BLOB, "paper", "edge")
    ratios: dict[str, list[float]] = {m: [] for m in methods}
    biases: dict[str, list[float]] = {m: [] for m in methods}
    honest, lost = [], 0
    print("| R px | blur px | SNR | shot | bound px | " + " | ".join(methods) + " | edge: rms / sigma | bias px |")
    print("| --- " * (7 + len(methods)) + "|")
    for cell in conditions:
        image, truth = scene(cell, rows, columns, rng)
        bound = np.sqrt(np.mean([centroid_bound(cell, rng.uniform(-0.5, 0.5, 2)) ** 2 for _ in range(3)]))
        for method in methods:
            if method in get_args(Method):
                spots = find_spots(image, method=method)  # type: ignore[arg-type]
                error, pick = nearest(spots.centroids, truth)
            else:
                error, pick = nearest(opencv_blobs(image), truth)
            known = np.isfinite(error[:, 0])
            ratios[method].append(float(np.sqrt(np.mean(error[known] ** 2)) / bound))
            biases[method].append(float(np.abs(error[known].mean(axis=0)).max()))
        lost += int((~known).sum())
        sigma = spots.covariance[pick[known]]
        stated = (sigma[:, 0, 0] + sigma[:, 1, 1]) / 2
        honest.append(float(np.sqrt(np.mean(np.mean(error[known] ** 2, axis=1) / stated))))
        figures = " | ".join(f"{ratios[m][-1]:.2f}" for m in methods)
        print(
            f"| {cell.radius:g} | {cell.blur:g} | {cell.snr:g} | {cell.shot:g} | {bound:.4f} | {figures} | "
            f"{honest[-1]:.2f} | {biases['edge'][-1]:.4f} |"
        )
    print(f"\n{rows * columns * len(conditions)} draws, {lost} not found by the default (edge)\n")
    print("| method | rms over the bound | largest mean error of a cell, px |")
    print("| --- | --- | --- |")
    for method in methods:
        print(f"| {method} | {min(ratios[method]):.2f} to {max(ratios[method]):.2f} | {max(biases[method]):.4f} |")
    print(f"\nedge, rms over stated sigma: {min(honest):.2f} to {max(honest):.2f}")


if __name__ == "__main__":
    main()
