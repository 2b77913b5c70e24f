"""A merge on a page: the whole, where each scan went, and where two that saw the same disagree."""

from __future__ import annotations

import numpy as np

from scope.merge import Merged
from scope.report.page import Page


def merge_page(found: Merged) -> str:
    """The page of --report."""
    page = Page(f"Merge of {len(found.names)} scans")
    page.verdict("good" if found.passed else "bad", found.why)
    if found.cloud is None or found.poses is None:
        return page.html()
    page.table(
        ["scan", "x mm", "y mm", "z mm"],
        [[name, *(f"{v:.3f}" for v in p.translation)] for name, p in zip(found.names, found.poses, strict=True)],
    )
    page.heading("Overlaps")
    page.text(
        "Apart: median distance of the first scan outside the second, where both saw the same surface; explained: rms that noise and "
        "calibrations account for."
    )
    page.table(
        ["scans", "overlap", "points", "apart, mm", "rms, mm", "explained, mm", "calibrations, mm"],
        [
            [
                f"{p.first} / {p.second}",
                f"{100 * p.share:.0f} %",
                f"{p.points}",
                f"{p.offset_mm:+.4f}",
                f"{p.rms_mm:.4f}",
                f"{p.expected_mm:.4f}",
                f"{p.shared_mm:.4f}",
            ]
            for p in found.pairs
        ],
    )
    page.heading("The whole")
    which = np.concatenate([np.full(n, k, dtype=np.float64) for k, n in enumerate(found.sizes)])
    page.cloud(found.cloud.points, which, "coloured by scan", limit=60_000)
    if found.deviation is not None and np.isfinite(found.deviation).any():
        page.cloud(
            found.cloud.points,
            found.deviation,
            "distance from the other scans, mm; grey: seen by one scan only",
            limit=60_000,
        )
    return page.html()
