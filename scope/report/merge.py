"""A merge on a page: the whole, where each scan went, and where two that saw the same disagree."""

from __future__ import annotations

import numpy as np

from scope.merge import Merged
from scope.report.page import Page
from scope.viewer import Scalar, cloud_scene


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
    scalars = [Scalar("scan", which, "", kind="names", names=found.names)]
    told = "The whole, coloured by scan"
    if found.deviation is not None and np.isfinite(found.deviation).any():
        scalars.append(Scalar("deviation", found.deviation, label="distance from the other scans", kind="diverging"))
        told += "; choose the distance from the other scans to see where they disagree (grey: seen by one scan only)"
    page.cloud(cloud_scene(found.cloud, first=scalars), told, limit=100_000)
    return page.html()
