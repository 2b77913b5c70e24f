"""Stripe extraction against the bound of Cramer and Rao and the centre of mass: `python -m benchmarks.stripe`.

The images are drawn here from closed forms (error functions integrated over pixels, Poisson electrons, read noise,
rounding, speckle from sums of filtered complex fields) and share no code with the extractor.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
from numpy.typing import NDArray

from ranging.stripe import Stripe, StripeOptions, extract

Array = NDArray[np.float64]

GAIN, READ, OFFSET, TOP = 35.0, 1.2, 4.0, 255
LENGTH = 48  # px
_ERF = np.vectorize(math.erf, otypes=[np.float64])


def profile(position: Array, sigma: Array | float, peak: Array | float, length: int) -> Array:
    """Gaussian stripes integrated over the pixels of lines of ``length``: (N, length)."""
    edges = np.arange(length + 1) - 0.5
    sigma = np.broadcast_to(np.asarray(sigma, dtype=np.float64), position.shape)
    steps = _ERF((edges - position[:, None]) / (sigma[:, None] * math.sqrt(2)))
    scale = np.broadcast_to(np.asarray(peak), position.shape) * sigma * math.sqrt(math.pi / 2)
    return np.asarray(scale[:, None] * np.diff(steps, axis=1))


def camera(light: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Electrons, read noise, offset, rounding and clipping of 8 bits."""
    levels = rng.poisson(np.maximum(light, 0.0) * GAIN) / GAIN + rng.normal(0.0, READ, light.shape) + OFFSET
    return np.clip(np.rint(levels), 0, TOP).astype(np.uint8)


def bound(sigma: float, peak: float, *, clipped: bool = False) -> float:
    """Least standard deviation, px, of the position of a stripe on one line, averaged over the phase.

    Fisher information summed over pixels of variance m / gain + read^2 + 1/12; a pixel that may clip keeps the share
    of it that a normal value censored at the top has.
    """
    variances = []
    for phase in np.linspace(-0.5, 0.5, 41):
        position = np.array([LENGTH / 2 + phase])
        m = profile(position, sigma, peak, LENGTH)[0]
        step = 1e-4
        slope = (profile(position + step, sigma, peak, LENGTH) - profile(position - step, sigma, peak, LENGTH))[0] / (
            2 * step
        )
        variance = m / GAIN + READ**2 + 1 / 12
        information = slope**2 / variance
        if clipped:
            z = (TOP - 0.5 - OFFSET - m) / np.sqrt(variance)
            density = np.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
            above = np.maximum(0.5 * (1 - _ERF(z / math.sqrt(2))), 1e-300)
            information *= np.clip(1 - above - z * density + density**2 / above, 0, 1)
        variances.append(1 / information.sum())
    return math.sqrt(float(np.mean(variances)))


def speckle(shape: tuple[int, int], grain: float, contrast: float, rng: np.random.Generator) -> Array:
    """Multiplicative field of mean 1: a sum of speckle patterns whose fields are correlated over ``grain`` px."""
    patterns = round(1 / contrast**2)
    total = np.zeros(shape)
    wave = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None, :])
    keep = np.exp(-0.5 * (2 * np.pi * wave * grain / (2 * math.sqrt(2))) ** 2) if grain > 1 else np.ones(shape)
    for _ in range(patterns):
        field = rng.normal(size=shape) + 1j * rng.normal(size=shape)
        total += np.abs(np.fft.ifft2(np.fft.fft2(field) * keep)) ** 2
    total /= total.mean()
    return np.asarray(1 + (total - 1) * contrast / total.std())


def centre_of_mass(image: NDArray[np.uint8], half: int = 5) -> Array:
    """Brightest pixel, then the centre of mass above the offset within ``half`` px."""
    at = np.clip(image.argmax(axis=1), half, image.shape[1] - half - 1)
    near = at[:, None] + np.arange(-half, half + 1)
    value = np.take_along_axis(image, near, axis=1) - OFFSET
    return np.asarray((value * near).sum(axis=1) / value.sum(axis=1))


def rms(error: Array) -> float:
    return math.sqrt(float(np.nanmean(error**2)))


def measure(image: NDArray[np.uint8], speckle_mode: str = "auto") -> Stripe:
    options = StripeOptions(gain_e=GAIN, read_noise=READ, speckle=speckle_mode, neighbours=False)  # type: ignore[arg-type]
    return extract(image, along="columns", options=options)


def against_the_bound(rows: int, rng: np.random.Generator) -> None:
    print("| stripe | rms over bound | bias, px | error / sigma | without answer | centre of mass over bound |")
    print("| --- | --- | --- | --- | --- | --- |")
    for sigma in (1.0, 1.4, 2.5):
        for peak in (30.0, 120.0, 200.0, 300.0, 400.0):
            clipped = peak > TOP - 2 * OFFSET
            position = LENGTH / 2 + rng.uniform(-0.5, 0.5, rows)
            image = camera(profile(position, sigma, peak, LENGTH), rng)
            stripe = measure(image)
            error, least = stripe.position - position, bound(sigma, peak, clipped=clipped)
            mass = rms(centre_of_mass(image) - position) / least
            print(
                f"| sigma {sigma} px, peak {peak:.0f}{' (clipped)' if clipped else ''} | {rms(error) / least:.3f} | "
                f"{np.nanmean(error):+.4f} | {rms(error / stripe.sigma):.2f} | {np.isnan(error).mean():.4f} | {mass:.2f} |"
            )
    for sigma in (1.0, 1.4, 2.5):
        wide, slope = sigma / math.cos(math.radians(30)), math.tan(math.radians(30))
        position = LENGTH / 2 + (np.arange(rows) * slope + 0.5) % 1.0 - 0.5
        stripe = measure(camera(profile(position, wide, 120.0, LENGTH), rng))
        error = stripe.position - position
        print(
            f"| sigma {sigma} px, peak 120, tilted 30 degrees | {rms(error) / bound(wide, 120.0):.3f} | "
            f"{np.nanmean(error):+.4f} | {rms(error / stripe.sigma):.2f} | {np.isnan(error).mean():.4f} | |"
        )


def in_speckle(rows: int, rng: np.random.Generator) -> None:
    print(
        "| speckle of contrast 0.3 | auto over centre of mass | speckle mode | shot weight | error / sigma (auto) | without |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for grain in (1.0, 2.0, 4.0):
        for sigma in (1.0, 1.4, 2.5):
            position = LENGTH / 2 + 0.4 * np.sin(np.arange(rows) / 37.0)
            light = profile(position, sigma, 120.0, LENGTH) * speckle((rows, LENGTH), grain, 0.3, rng)
            image = camera(light, rng)
            mass = rms(centre_of_mass(image, max(5, math.ceil(3 * sigma))) - position)
            auto, on, off = (measure(image, mode) for mode in ("auto", "on", "off"))
            figures = [rms(stripe.position - position) / mass for stripe in (auto, on, off)]
            error = auto.position - position
            print(
                f"| grain {grain:.0f} px, sigma {sigma} px | {figures[0]:.2f} | {figures[1]:.2f} | {figures[2]:.2f} | "
                f"{rms(error / auto.sigma):.2f} | {np.isnan(error).mean():.4f} |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=20_000)
    rows = parser.parse_args().rows
    rng = np.random.default_rng(20_261_122)
    against_the_bound(rows, rng)
    in_speckle(max(2_000, rows // 5), rng)


if __name__ == "__main__":
    main()
