"""What an artefact says, on a page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scope.report import Page, cloud_from
from scope.watch.correction import Correction
from scope.watch.drift import Drift
from scope.watch.run import Watched
from scope.watch.wording import watch_text


def watch_rows(found: Watched, drift: Sequence[Drift] = ()) -> list[list[str]]:
    """Rows (what, value, U for k = 2) of a table."""
    s = found.strain
    rows = [
        ["worst patch off the mesh, mm", f"{s.error_mm:+.4f}", f"{found.error_uncertainty:.4f}"],
        ["rms of the points, mm", f"{s.rms_mm:.4f}", "-"],
        ["the same without the stretch, mm", f"{s.rms_after_mm:.4f}", "-"],
    ]
    rows += [
        [f"lengths along {axis}, %", f"{100 * s.scale[k]:+.4f}", f"{100 * found.scale_uncertainty[k]:.4f}"]
        for k, axis in enumerate("xyz") if s.told[k, k]
    ]  # fmt: skip
    return [*rows, *([f"drift: {d.figure}", d.text, "-"] for d in drift)]


def correction_page(found: Correction, cloud_points: np.typing.NDArray[np.float64]) -> str:
    """The page of `scope correct --report`; ``cloud_points`` (N, 3) mm are those of the whole scan."""
    s = found.watched.strain
    page = Page(f"Scale and tilt by {found.watched.plan.name}")
    page.verdict("good" if s.rms_after_mm <= s.rms_mm else "warn", watch_text(found.watched).replace("\n", "; "))
    page.heading("What the artefact shows")
    page.table(("what", "value", "U (k = 2)"), watch_rows(found.watched))
    page.heading("The correction")
    page.table(
        ("true", "x seen", "y seen", "z seen"),
        [[axis, *(f"{v:.7f}" for v in s.matrix[k])] for k, axis in enumerate("xyz")],
    )
    page.text(
        "What the artefact does not determine is held near what it was: 0.5 % of scale and 0.1 % of tilt were thought possible. Within one sheet "
        "of light nothing tells what happens across it, and nothing needs to. The motion of the scan is believed."
    )
    page.heading("Points on the artefact")
    points = cloud_points[s.points]
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    reach = max(float(np.percentile(np.abs(s.deviation), 98)), 1e-6)
    for what, off in (("as scanned", s.deviation), ("with the corrected rig", s.after)):
        rows = off if len(off) == len(points) else np.zeros(len(points))
        page.image(
            cloud_from(points, np.clip(rows, -reach, reach), axes[0], axes[1]),
            f"{what}: from {-reach:.4f} (dark) to {reach:.4f} mm (light) off the mesh",
            width=430,
        )
    page.about("scan", found.cloud)
    page.about("rig before", found.rig.camera_id)
    return page.html()
