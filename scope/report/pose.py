"""A pose in words, in JSON that robots read, and on a page."""

from __future__ import annotations

from typing import Any

import numpy as np

from scope.cloud import ScanCloud
from scope.model import Surface
from scope.pose import CONVENTION, Placed, pose_text
from scope.report.page import Page
from scope.viewer import Scalar, Scene, cloud_scene, mesh_layer

SHOWN = 20_000  # points of a cloud on the page


def pose_page(
    title: str, found: bool, words: str, tell: str, rows: list[dict[str, Any]], scans: list[tuple[str, Scene]]
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
    scans : list of (caption, Scene)
        What is to be shown.
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
    for caption, scene in scans:
        page.cloud(scene, caption, limit=2 * SHOWN)
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
        chosen = result.points[:: max(1, len(result.points) // SHOWN)]
        part = cloud.select(chosen)
        mesh = mesh_layer(result.model.vertices, result.model.faces, "model")
        for k, candidate in enumerate(result.candidates[:2]):
            pose = (
                result.cloud_from_model
                if k == 0 and result.cloud_from_model is not None
                else candidate.cloud_from_model
            )
            local = pose.inverse.apply(part.points)
            off = Scalar("deviation", surface.signed_distance(local), kind="diverging", limits=(-1.0, 1.0))
            name = "Best pose" if k == 0 else "Runner-up"
            scene = cloud_scene(part, first=[off], layers=[mesh] if mesh else [], at=local)
            shown.append(
                (f"{name}: scan on the model (grey), coloured by its deviation in mm, outside positive", scene)
            )
    words = pose_text(placed).replace("\n", "; ")
    return pose_page(f"Pose of {result.model.name}", result.found, words, result.tell_apart, rows, shown)
