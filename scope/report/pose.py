"""A pose in words, in JSON that robots read, and on a page."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.geometry import Array
from scope.cloud import ScanCloud
from scope.model import Surface
from scope.pose import CONVENTION, Placed, pose_text
from scope.report.page import Page

SHOWN = 20_000  # points of a cloud on the page


def pose_page(
    title: str, found: bool, words: str, tell: str, rows: list[dict[str, Any]], scans: list[tuple[str, Array, Array]]
) -> str:
    """One HTML page.

    Parameters
    ----------
    title, words, tell : str
        Heading, verdict, and what would settle an ambiguity ('' for nothing).
    found : bool
        Whether there is a pose to use.
    rows : list of dict
        Candidates, best first, with explained, blocked, covered and behind.
    scans : list of (caption, points (N, 3), values (N,))
        Clouds to be shown, coloured by value.
    """
    page = Page(title)
    page.verdict("good" if found else "bad", words)
    if tell:
        page.text(f"What would settle it: {tell}.")
    page.heading("Candidates")
    page.text(
        "Explained: share of the points that lie on the model. Blocked: share of the points that camera or laser would have "
        "seen through it. Covered: share of the surface that both should have seen and that has points. Behind: evidence, in "
        "nats, by which a pose is worse than the best."
    )
    page.table(
        ["candidate", "explained", "blocked", "covered", "behind"],
        [
            [
                f"{k + 1}",
                f"{100 * r['explained']:.1f} %",
                f"{100 * r['blocked']:.1f} %",
                "-" if not np.isfinite(r["covered"]) else f"{100 * r['covered']:.1f} %",
                f"{r['behind']:.0f}",
            ]
            for k, r in enumerate(rows)
        ],
    )
    for caption, points, values in scans:
        page.cloud(points, values, caption, limit=2 * SHOWN)
    page.text(CONVENTION)
    return page.html()


def pose_html(cloud: ScanCloud, placed: Placed) -> str:
    """The page of --report: the scan coloured by its deviation, the candidates, and the runner-up beside the best."""
    result = placed.result
    rows = [
        {"explained": c.explained, "blocked": c.blocked, "covered": c.covered, "behind": c.behind}
        for c in result.candidates
    ]
    shown = []
    if result.candidates:
        surface = Surface(result.model.vertices, result.model.faces)
        points = cloud.points[result.points][:: max(1, len(result.points) // 20_000)]
        for k, candidate in enumerate(result.candidates[:2]):
            inverse = candidate.cloud_from_model.inverse
            pose = (
                result.cloud_from_model
                if k == 0 and result.cloud_from_model is not None
                else candidate.cloud_from_model
            )
            inverse = pose.inverse
            deviation = surface.signed_distance(inverse.apply(points))
            ghost = result.model.samples[::4]
            both = np.concatenate([inverse.apply(points), ghost])
            values = np.concatenate([np.clip(deviation, -1, 1), np.full(len(ghost), np.nan)])
            name = "Best pose" if k == 0 else "Runner-up"
            shown.append(
                (f"{name}: scan on the model, coloured by its deviation within +-1 mm; the mesh in grey", both, values)
            )
    words = pose_text(placed).replace("\n", "; ")
    return pose_page(f"Pose of {result.model.name}", result.found, words, result.tell_apart, rows, shown)
