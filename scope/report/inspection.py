"""An inspection on a page: the decision, every feature with its uncertainty, and the part coloured by its deviation."""

from __future__ import annotations

import numpy as np

from calibration.digits import rounded, two_digits
from scope.inspection import Inspection
from scope.report.page import Page
from scope.viewer import Scalar, cloud_scene, mesh_layer

_LEVELS = {"pass": "good", "fail": "bad", "undecided": "warn"}


def inspection_page(found: Inspection) -> str:
    """The page of --report."""
    page = Page(f"Inspection: {found.pose.model.name}")
    page.verdict(_LEVELS[found.decision], f"{found.decision}: {found.why}")  # type: ignore[arg-type]
    values = [*found.features, *((found.surface,) if found.surface is not None else ())]
    if values:
        page.heading("Features")
        page.table(
            ["feature", "what", "nominal", "measured", "off", "U (k = 2)", "unit", "tolerance", "decision", "points"],
            [
                [v.name, v.kind, f"{v.nominal:g}", rounded(v.measured, v.uncertainty), rounded(v.deviation, v.uncertainty, sign=True), two_digits(v.uncertainty), v.unit,
                 "-" if v.tolerance is None else f"{v.tolerance:g}", v.decision or "-", f"{v.points}"]
                if not v.reason
                else [v.name, v.kind, "-", "-", "-", "-", v.unit, "-" if v.tolerance is None else f"{v.tolerance:g}",
                      f"not measured: {v.reason}", "-"]
                for v in values
            ],
            marked={k for k, v in enumerate(values) if v.decision == "fail"},
        )  # fmt: skip
        page.text(
            "Decision rule: ISO 14253-1. Pass where the value stays within its tolerance by more than its expanded uncertainty U, "
            "fail where it is beyond by more than U, undecided between. The surface is judged by the patch that lies furthest off."
        )
    if found.pose.cloud_from_model is not None:
        off = found.deviation
        local = found.pose.cloud_from_model.inverse.apply(found.cloud.points[found.pose.points])
        limit = found.tolerance or float(np.percentile(np.abs(off), 98))
        page.heading("Deviation from the model")
        deviation = Scalar("deviation", off, kind="diverging", limits=(-1.5 * limit, 1.5 * limit))
        model = found.pose.model
        mesh = mesh_layer(model.vertices, model.faces, f"model {model.name}")
        scene = cloud_scene(
            found.cloud.select(found.pose.points), first=[deviation], layers=[mesh] if mesh else [], at=local
        )
        page.cloud(scene, "Deviation in mm, outside positive, in the frame of the model", limit=80_000)
        edges = np.linspace(-2 * limit, 2 * limit, 81)
        count, _ = np.histogram(np.clip(off, edges[0], edges[-1]), bins=edges)
        page.plot([("", 0.5 * (edges[1:] + edges[:-1]), count)], "Points by deviation", x_label="mm", y_label="points")
    return page.html()
