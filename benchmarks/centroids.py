"""Centroids of simulated disks against the Cramer-Rao bound: ``python -m benchmarks.centroids [draws a cell]``.

The witness is a disk of radius R under a Gaussian blur (exact: a non-central chi-squared distribution), integrated over
every pixel, with noise of variance ``gain * I + read^2`` and rounding to whole grey levels. The bound is that of the
full model: centre, radius, blur and both levels unknown, variance ``gain * I + read^2 + 1/12``. Every figure is a root
mean square over both axes divided by that bound, so 1 is the best that any unbiased method can do. The default sees all
draws of a cell, the paper's weights a quarter of them, and the simpler peers, which are slow and far off, a thousand.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import ncx2

from calibration.targets import find_spots
from calibration.targets.spots import Method

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


@lru_cache(maxsize=16)
def profile(radius: float, blur: float) -> tuple[float, float, Array]:
    """The blurred disk's grey level over the distance from its centre: where a table begins, its step, exact values."""
    first, last, n = max(radius - 7.0 * blur, 0.0), radius + 7.0 * blur, 8192
    r = np.linspace(first, last, n)
    return first, (last - first) / (n - 1), ncx2.cdf(radius**2 / blur**2, 2, np.maximum(r, 1e-6) ** 2 / blur**2)


def disk(u: Array, v: Array, centre: Array, radius: float, blur: float) -> Array:
    """Pixel averages (H, W) of a blurred disk of unit contrast, by Gauss-Legendre quadrature in every pixel.

    Between the values of the table it is linear: wrong by less than 1e-6 of the contrast.
    """
    node, weight = np.polynomial.legendre.leggauss(3)
    first, step, level = profile(radius, blur)
    x2 = ((u[..., None, None] + node[:, None] / 2) - centre[0]) ** 2
    y2 = ((v[..., None, None] + node[None, :] / 2) - centre[1]) ** 2
    at = (np.sqrt(x2 + y2) - first) / step
    np.clip(at, 0.0, len(level) - 1.000001, out=at)
    whole = at.astype(np.intp)
    at -= whole
    return np.asarray(
        np.einsum("...ab,a,b->...", level[whole] + at * (level[whole + 1] - level[whole]), weight / 2, weight / 2)
    )


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


COLUMNS, ROWS = 25, 20  # disks of one image
METHODS = ("binary", "gray", BLOB, "paper", "edge")
SHARE = {"edge": 1.0, "paper": 0.25}  # of the draws that a method sees; the others see a thousand


@dataclass
class ScanStatistics:
    """Errors of one method in one cell, summed up."""

    square: float = 0.0  # px^2, both axes
    total: Array = field(default_factory=lambda: np.zeros(2))  # px
    pull: float = 0.0  # squares over stated variances, both axes
    n: int = 0  # found

    def add(self, error: Array, variance: Array | None = None) -> None:
        """Take in errors (N, 2), NaN where nothing was found, and the variances (N,) that were stated."""
        known = np.isfinite(error[:, 0])
        self.square += float((error[known] ** 2).sum())
        self.total += error[known].sum(axis=0)
        self.n += int(known.sum())
        if variance is not None:
            self.pull += float((error[known] ** 2 / variance[known, None]).sum())

    @property
    def rms(self) -> float:
        """Of one axis, px."""
        return float(np.sqrt(self.square / (2 * max(self.n, 1))))

    @property
    def bias(self) -> float:
        """Larger of the mean errors along u and v, px."""
        return float(np.abs(self.total / max(self.n, 1)).max())


def measured(image: NDArray[np.uint16], truth: Array, method: str) -> tuple[Array, Array | None]:
    """Errors (N, 2) px of a method and, of SCOPE's own, the variances (N,) that it states an axis."""
    if method not in get_args(Method):
        return nearest(opencv_blobs(image), truth)[0], None
    spots = find_spots(image, method=method)  # type: ignore[arg-type]
    error, pick = nearest(spots.centroids, truth)
    stated = spots.covariance[pick]
    return error, (stated[:, 0, 0] + stated[:, 1, 1]) / 2


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 20000
    rng = np.random.default_rng(20)
    conditions = list(cells())
    ratios: dict[str, list[float]] = {m: [] for m in METHODS}
    biases: dict[str, list[float]] = {m: [] for m in METHODS}
    honest, lost = [], 0
    print("| R px | blur px | SNR | shot | bound px | " + " | ".join(METHODS) + " | edge: rms / sigma | bias px |")
    print("| --- " * (7 + len(METHODS)) + "|")
    for cell in conditions:
        tally = {m: ScanStatistics() for m in METHODS}
        for first in range(0, draws, ROWS * COLUMNS):
            image, truth = scene(cell, ROWS, COLUMNS, rng)
            for method in METHODS:
                if first >= max(SHARE.get(method, 0.0) * draws, 1000):
                    continue
                error, variance = measured(image, truth, method)
                tally[method].add(error, variance)
                lost += int((~np.isfinite(error[:, 0])).sum()) if method == "edge" else 0
        bound = np.sqrt(np.mean([centroid_bound(cell, rng.uniform(-0.5, 0.5, 2)) ** 2 for _ in range(5)]))
        for method in METHODS:
            ratios[method].append(float(tally[method].rms / bound))
            biases[method].append(tally[method].bias)
        honest.append(float(np.sqrt(tally["edge"].pull / (2 * tally["edge"].n))))
        figures = " | ".join(f"{ratios[m][-1]:.3f}" for m in METHODS)
        print(
            f"| {cell.radius:g} | {cell.blur:g} | {cell.snr:g} | {cell.shot:g} | {bound:.4f} | {figures} | "
            f"{honest[-1]:.3f} | {biases['edge'][-1]:.5f} |",
            flush=True,
        )
    each = -(-draws // (ROWS * COLUMNS)) * ROWS * COLUMNS
    print(f"\n{each} draws in each of {len(conditions)} cells, {lost} not found by the default (edge)\n")
    print("| method | rms over the bound | largest mean error of a cell, px |")
    print("| --- | --- | --- |")
    for method in METHODS:
        print(f"| {method} | {min(ratios[method]):.3f} to {max(ratios[method]):.3f} | {max(biases[method]):.5f} |")
    print(f"\nedge, rms over stated sigma: {min(honest):.3f} to {max(honest):.3f}")


if __name__ == "__main__":
    main()
