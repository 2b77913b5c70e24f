"""Faint and small marks: ``python -m benchmarks.small_marks``.

Discs drawn by oversampling 16 times (no formula of the fit), blurred, exposed with noise. Faint ones beside metal of 200 grey
levels, listed to a pixel; small ones in a clean grid on black ground. The peer is OpenCV's SimpleBlobDetector with an area from 3 px^2.
"""

from __future__ import annotations

import cv2
import numpy as np

from benchmarks.shared import head, row
from calibration.geometry import Array
from calibration.targets import find_spots, measure_marks


def drawn(
    rng: np.random.Generator, diameter: float, blur: float, *, side: int = 9, pitch: int = 24
) -> tuple[Array, Array]:
    """Discs of height 1 on 0, with their centres (n, 2) px."""
    fine, reach = 16, int(diameter / 2 + 6 * blur + 3)
    image = np.zeros((side * pitch + 20, side * pitch + 20))
    at = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    centres = 20.0 + pitch * at + rng.uniform(-0.5, 0.5, at.shape)
    axis = (np.arange((2 * reach + 1) * fine) + 0.5) / fine - 0.5
    for u, v in centres:
        left, top = int(u) - reach, int(v) - reach
        away = np.hypot(axis[None] - (u - left), axis[:, None] - (v - top))
        disc = cv2.GaussianBlur(np.clip((diameter / 2 - away) * fine + 0.5, 0, 1), (0, 0), blur * fine)
        size = 2 * reach + 1
        image[top : top + size, left : left + size] += disc.reshape(size, fine, size, fine).mean(axis=(1, 3))
    return image, centres


def faint_scene(rng: np.random.Generator, contrast: float, noise: float) -> tuple[np.ndarray, Array]:
    """Dots of 5 px on a dark plate beside bright metal, 8 bits, and their centres."""
    dots, centres = drawn(rng, 5.0, 0.8, side=7, pitch=26)
    height, width = dots.shape
    image = np.full((height + 120, width + 160), 200.0)
    image[:20] = 250.0
    image[60 : 60 + height, 80 : 80 + width] = 25.0 + contrast * dots
    image += noise * rng.standard_normal(image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8), centres + np.array([80.0, 60.0])


def _blobs(image: np.ndarray) -> Array:
    settings = cv2.SimpleBlobDetector.Params()
    settings.filterByColor, settings.blobColor, settings.minArea = True, 255, 3.0
    settings.filterByConvexity = settings.filterByInertia = settings.filterByCircularity = False
    settings.minDistBetweenBlobs, settings.thresholdStep = 3.0, 2.0
    grey = image if image.dtype == np.uint8 else np.clip(image / (image.max() / 255.0), 0, 255).astype(np.uint8)
    return np.array([k.pt for k in cv2.SimpleBlobDetector.create(settings).detect(grey)]).reshape(-1, 2)


def _hit(found: Array, centres: Array) -> int:
    if not len(found):
        return 0
    return int((np.linalg.norm(found[:, None] - centres[None], axis=2).min(axis=0) < 1.0).sum())


def main() -> None:
    head(
        "faint dots of 5 px beside metal, listed to a pixel",
        "found",
        "places without a mark",
        "error over sigma",
        "reach",
        "OpenCV finds",
    )
    for contrast, noise in ((20.0, 2.0), (15.0, 1.5), (10.0, 2.0), (10.0, 3.0)):
        rng = np.random.default_rng([int(contrast), int(10 * noise)])
        found = false = total = peer = 0
        pulls = []
        for _ in range(4):
            image, centres = faint_scene(rng, contrast, noise)
            marks = measure_marks(image, np.concatenate([np.round(centres), centres[:10] + 13.0]))
            good = marks.measured[: len(centres)]
            total, found, false = (
                total + len(centres),
                found + int(good.sum()),
                false + int(marks.measured[len(centres) :].sum()),
            )
            sigma = np.sqrt(marks.covariance[: len(centres)][good][:, [0, 1], [0, 1]])
            pulls.append((marks.centroids[: len(centres)] - centres)[good] / sigma)
            peer += _hit(_blobs(image), centres)
        ratio = float(np.sqrt(np.mean(np.concatenate(pulls) ** 2)))
        row(f"{contrast:.0f} levels, noise {noise:g}", f"{found} of {total}", f"{false} of 40", f"{ratio:.2f}", "0.8 to 1.25", f"{peer} of {total}")  # fmt: skip
    print()
    head("clean grid of 81 small dots, black ground", "found", "rms error, px", "OpenCV finds; rms, px")
    for diameter, bits in ((2.5, 8), (3.0, 8), (4.0, 8), (2.5, 16), (3.0, 16), (3.5, 16), (4.0, 16), (1.5, 8)):
        rng = np.random.default_rng([int(10 * diameter), bits])
        dots, centres = drawn(rng, diameter, 0.55)
        top, noise = (150.0, 1.0) if bits == 8 else (30000.0, 20.0)
        exposed = np.clip(np.round(top * dots + 3 + noise * rng.standard_normal(dots.shape)), 0, 2**bits - 1)
        image = exposed.astype(np.uint8 if bits == 8 else np.uint16)
        spots = find_spots(image)
        blobs = _blobs(image)
        told = "" if len(spots) else f": {spots.rejected[0][2]}"
        row(
            f"{diameter:g} px, {bits} bits",
            f"{len(spots)}{told}",
            _rms(spots.centroids, centres),
            f"{_hit(blobs, centres)}; {_rms(blobs, centres)}",
        )


def _rms(found: Array, centres: Array) -> str:
    if not len(found):
        return "-"
    away = np.linalg.norm(found[:, None] - centres[None], axis=2).min(axis=1)
    return f"{np.sqrt((away**2).mean() / 2):.4f}"


if __name__ == "__main__":
    main()
