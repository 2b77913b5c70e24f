"""Checks against an artefact as a page: sizes beside what was known, deviations point by point, repeatability."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.digits import rounded, two_digits
from scope.check import ArtefactCheck, Size, error_text, out_of_tolerance
from scope.cloud import ScanCloud
from scope.report.page import Level, Page
from scope.report.scan import about_cloud
from scope.viewer import Scalar, Scene

_BINS = 60


def check_page(
    checks: Sequence[ArtefactCheck],
    scans: Sequence[tuple[str, ScanCloud]],
    *,
    tolerance: float | None = None,
    repeatability: float | None = None,
) -> str:
    """One self-contained HTML page of one check or several of the same artefact.

    Parameters
    ----------
    checks : sequence of ArtefactCheck
    scans : sequence of (name, ScanCloud)
        What each was made of, in the same order.
    tolerance : float, optional
        Largest error that was allowed, mm.
    repeatability : float, optional
        Standard deviation of the worst size over the scans, mm.
    """
    page = Page(f"SCOPE check of a {checks[0].artefact.kind}")
    page.verdict(*_verdict(checks, tolerance))
    if repeatability is not None:
        page.text(
            f"Repeatability over {len(checks)} scans: {two_digits(repeatability)} mm (one sigma of the worst size)."
        )
    for check, (name, cloud) in zip(checks, scans, strict=True):
        page.heading(name)
        _add_sizes(page, check, tolerance)
        page.table(
            ("error, mm", "form (95 %), mm", "rms, mm", "linearity, %", "points"),
            [[
                error_text(check),
                f"{check.form_mm:.3g}",
                f"{check.rms_mm:.3g}",
                two_digits(check.linearity_percent),
                str(check.points),
            ]],
        )  # fmt: skip
        _add_deviations(page, check)
        page.about("scan", name)
        about_cloud(page, cloud)
    page.text(
        "The uncertainty (k = 2) is the scanner's: noise of the points, calibration, and what slopes do to a stripe. That of the "
        "artefact's own size is not in it. Form is the width that holds 95 % of the deviations (ISO 10360-8)."
    )
    return page.html()


def _verdict(checks: Sequence[ArtefactCheck], tolerance: float | None) -> tuple[Level, str]:
    worst = error_text(max(checks, key=lambda check: abs(check.error_mm)))
    if out_of_tolerance(checks):
        return "bad", (
            f"Out of tolerance: error {worst} mm, {tolerance:g} mm allowed. Do not rely on this scanner before it is "
            "calibrated again."
        )
    if any(check.claimed is False for check in checks):
        return "warn", (
            f"Error {worst} mm: larger than the claimed uncertainty; look for what neither noise nor calibration explains."
        )
    told = "no tolerance was given" if tolerance is None else f"within the tolerance of {tolerance:g} mm"
    return ("plain" if tolerance is None else "good"), f"Error {worst} mm: {told}."


def _at_fault(size: Size, tolerance: float | None) -> bool:
    """Whether a size is out of tolerance or, without one, off by more than it claims."""
    return abs(size.error) > (size.uncertainty if tolerance is None else tolerance)


def _add_sizes(page: Page, check: ArtefactCheck, tolerance: float | None) -> None:
    if check.sizes:
        page.table(
            ("size", "nominal, mm", "measured, mm", "error, mm", "k = 2, mm", "noise", "calibration", "slopes"),
            [
                [
                    size.name,
                    f"{size.nominal:g}",
                    rounded(size.measured, size.uncertainty),
                    rounded(size.error, size.uncertainty, sign=True),
                    two_digits(size.uncertainty),
                    two_digits(size.scatter),
                    two_digits(size.calibration),
                    two_digits(size.slope),
                ]
                for size in check.sizes
            ],
            marked={k for k, size in enumerate(check.sizes) if _at_fault(size, tolerance)},
        )


def _add_deviations(page: Page, check: ArtefactCheck) -> None:
    reach = float(np.percentile(np.abs(check.deviation), 99)) or 1e-6
    count, edges = np.histogram(check.deviation, bins=_BINS, range=(-1.2 * reach, 1.2 * reach))
    page.plot(
        [("", np.repeat(edges, 2)[1:-1], np.repeat(count, 2))],
        "Deviations of the points from the fitted artefact",
        x_label="deviation, mm",
        y_label="points",
    )
    deviation = Scalar("deviation", check.deviation, kind="diverging", limits=(-reach, reach))
    page.cloud(
        Scene(check.where, (deviation,)),
        "The points that took part, by their deviation from the fitted artefact",
        limit=100_000,
    )
