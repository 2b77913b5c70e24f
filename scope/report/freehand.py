"""A freehand camera in words and pictures: what its views determine of the lens, and where."""

from __future__ import annotations

from typing import Any

import numpy as np

from scope.calibrating import Calibration
from scope.report import pictures
from scope.report.page import Page


def camera_lines(result: dict[str, Any]) -> list[str]:
    """A freehand camera in words: parameters with one standard error, and what is covered."""
    camera = result.get("camera")
    if camera is None:
        return []
    focal, centre = (
        ", ".join(
            _with_sigma(float(x), float(s)) for x, s in zip(camera[f"{k}_px"], camera[f"{k}_sigma_px"], strict=True)
        )
        for k in ("focal", "centre")
    )
    names = ("k1", "k2", "p1", "p2", "k3")
    bent = ", ".join(
        f"{name} {_with_sigma(float(x), float(s))}"
        for name, x, s in zip(names, camera["distortion"], camera["distortion_sigma"], strict=True)
        if x
    )
    held = f"; held, since views left out do not ask for them: {', '.join(camera['held'])}" if camera["held"] else ""
    covered = (
        f"marks cover {100 * camera['covered']:.0f} % of the image, where the lens is known to {camera['lens_sigma_px']:.2g} px; "
        f"the view that would add most: {camera['next_view']}"
    )
    return [
        f"focal length {focal} px; principal point {centre} px; distortion {bent or 'none'}{held}",
        covered,
    ]


def _with_sigma(value: float, sigma: float) -> str:
    """Value and one standard error with as many decimals as the error deserves."""
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 9)) if sigma > 0 and np.isfinite(sigma) else 3
    return f"{value:.{digits}f} +- {sigma:.{digits}f}"


def add_camera(page: Page, found: Calibration) -> None:
    """Add the camera of freehand views to a page: figures, the part of the image that is covered, how well it is known there."""
    coverage, fit = found.verdict.coverage, found.freehand
    if coverage is None or fit is None:
        return
    page.heading("The camera")
    for line in camera_lines(found.result):
        page.text(line[0].upper() + line[1:] + ".")
    page.text(
        "Standard errors are one sigma; those of terms that are held say how far lenses are off without it being seen here."
    )
    pixels = np.concatenate([view.pixels for view in fit.views])
    page.image(
        pictures.with_coverage(found.measured[0].image, pixels, coverage.covered),
        f"covered by marks (light): {100 * coverage.share:.0f} % of the image; outside the yellow line nothing is ranged",
        width=430,
    )  # fmt: skip
    page.image(
        pictures.heat(np.where(coverage.covered, coverage.sigma_px, np.nan), enlarge=10),
        f"how well the lens is known there: one sigma from {np.nanmin(coverage.sigma_px[coverage.covered], initial=np.inf):.2g} (dark) to "
        f"{coverage.worst_px:.2g} px (light)",
        width=430,
    )  # fmt: skip
