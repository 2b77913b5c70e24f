"""Stripes 1 to 60 px wide at half maximum, in noise and speckle, clipped or not: `python -m benchmarks.stripe_width`.

The bound is that of the best unbiased linear weighing of a line's pixels under their true covariance (Cramer and Rao's where there
is no speckle; averaged over the phase): shot and read noise, speckle of known contrast and grain, and of a pixel that may clip the share
that a normal value censored at the top keeps. SNR is the peak over the noise of a dark pixel. The peer is what a plain script does: blur,
the brightest place, centre of mass. Images are drawn as in `benchmarks.stripe`, which shares no code with the extractor.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
from numpy.typing import NDArray

from benchmarks.stripe import GAIN, OFFSET, READ, TOP, camera, profile, rms, speckle
from ranging.stripe import StripeOptions, extract

Array = NDArray[np.float64]

FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))
DARK = math.hypot(READ, math.sqrt(1 / 12))  # grey levels
WIDTHS = (1, 1.5, 2, 3, 5, 8, 12, 16, 24, 30, 45, 60)  # px
SNRS = (10.0, 30.0, 100.0, 200.0)
CLIPPED = 400.0  # grey levels at the peak, of 255
CONTRASTS = (0.0, 0.2, 0.5)
_ERF = np.vectorize(math.erf, otypes=[np.float64])


def bound(sigma: float, peak: float, contrast: float, correlation: Array, length: int) -> float:
    """Least standard deviation, px, of the position on one line; ``correlation`` of the speckle by lag."""
    variances = []
    for phase in np.linspace(-0.4, 0.5, 10):
        p = np.array([length / 2 + phase])
        m = profile(p, sigma, peak, length)[0]
        slope = (profile(p + 1e-3, sigma, peak, length) - profile(p - 1e-3, sigma, peak, length))[0] / 2e-3
        near = m > 1e-4 * peak
        m, slope = m[near], slope[near]
        lag = np.abs(np.subtract.outer(np.arange(len(m)), np.arange(len(m))))
        covariance = np.diag(m / GAIN + DARK**2) + contrast**2 * np.outer(m, m) * correlation[lag]
        deviation = np.sqrt(np.diagonal(covariance))
        z = (TOP - 0.5 - OFFSET - m) / deviation
        density = np.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
        above = np.maximum(0.5 * (1 - _ERF(z / math.sqrt(2))), 1e-300)
        kept = np.sqrt(np.clip(1 - above - z * density + density**2 / above, 0, 1))
        variances.append(1.0 / ((kept * slope) @ np.linalg.solve(covariance, kept * slope)))
    return math.sqrt(float(np.mean(variances)))


def correlation_of(field: Array) -> Array:
    """Correlation of a field along its lines, by lag."""
    spectrum = np.abs(np.fft.fft(field - field.mean(), axis=1)) ** 2
    found = np.fft.ifft(spectrum.mean(axis=0)).real
    found = found / found[0]
    found[np.abs(found) < 0.03] = 0.0
    return np.asarray(found)


def plain(image: NDArray[np.uint8], sigma: float) -> Array:
    """Blur, the brightest place, centre of mass above the offset within three sigma: told the width."""
    light = image.astype(np.float64) - OFFSET
    x = np.arange(-math.ceil(3 * sigma), math.ceil(3 * sigma) + 1)
    kernel = np.exp(-0.5 * (x / sigma) ** 2)
    blurred = np.array([np.convolve(line, kernel, mode="same") for line in light])
    half = max(3, math.ceil(3 * sigma))
    at = np.clip(blurred.argmax(axis=1), half, image.shape[1] - half - 1)
    near = at[:, None] + np.arange(-half, half + 1)
    value = np.maximum(np.take_along_axis(light, near, axis=1), 0.0)
    return np.asarray((value * near).sum(axis=1) / value.sum(axis=1))


def row(width: float, peak: float, contrast: float, grain: float, rows: int, rng: np.random.Generator) -> str:
    sigma = width / FWHM
    length = int(max(96, 14 * sigma + 48)) // 8 * 8
    position = length / 2 + max(0.4, 0.2 * sigma) * np.sin(np.arange(rows) / 37.0) + rng.uniform(-0.5, 0.5)
    light = profile(position, sigma, peak, length)
    correlation = np.zeros(length)
    correlation[0] = 1.0
    if contrast:
        field = speckle(light.shape, grain, contrast, rng)
        light, correlation = light * field, correlation_of(field)
    image = camera(light, rng)
    stripe = extract(image, along="columns", options=StripeOptions(neighbours=False))
    error = stripe.position - position
    least = bound(sigma, peak, contrast, correlation, length)
    mass = rms(plain(image, sigma) - position)
    return (
        f"| {width:g} | {peak / DARK:.0f}{', clipped' if peak > TOP - 2 * OFFSET else ''} | {contrast:g}{f', {grain:g} px' if contrast else ''} | "
        f"{rms(error) / least:.2f} | {rms(error / stripe.sigma):.2f} | {np.nanmean(error) / least:+.2f} | {np.isnan(error).mean():.3f} | "
        f"{mass / least:.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000)
    parser.add_argument("--widths", type=float, nargs="*", default=WIDTHS)
    asked = parser.parse_args()
    rng = np.random.default_rng(20_261_128)
    print(
        "| FWHM, px | SNR | speckle, grain | rms over bound | error / sigma | bias over bound | without | plain over bound |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for width in asked.widths:
        for contrast in CONTRASTS:
            for peak in (*(snr * DARK for snr in SNRS), CLIPPED):
                grain = max(1.0, min(4.0, width / 8))
                print(row(width, peak, contrast, grain, asked.rows, rng), flush=True)


if __name__ == "__main__":
    main()
