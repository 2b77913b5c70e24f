"""The page of a designed rig: drawing to scale, maps over the sheet of light, what may be expected, what else was considered."""

from __future__ import annotations

from typing import Any

import numpy as np

from scope.design import DesignResult, Drawn, Proposal, expected_rows, figure_name, length
from scope.design_report.drawing import hidden_svg, map_svg, rig_svg
from scope.report import Page

_MAPS = (
    ("noise along the ray, mm", "sigma", 1.0),
    ("calibration error along the ray, um", "sigma_cal", 1e3),
    ("depth of a pixel across the stripe, mm", "along_ray", 1.0),
    ("a pixel along the stripe, mm", "across_mm", 1.0),
    ("stripe, one sigma, px", "stripe_px", 1.0),
    ("blur, one sigma, px", "blur_px", 1.0),
    ("stripe's peak, grey levels", "signal", 1.0),
)


def design_page(
    found: DesignResult, title: str, *, proposal: Proposal | None = None, drawn: Drawn | None = None
) -> str:
    """Self-contained page of one designed rig."""
    page = Page(f"Design of {title}")
    result = found.result
    volume = result.get("volume", result)
    if found.troubles:
        page.verdict("bad", f"{len(found.troubles)} thing(s) to change before this rig is built:")
        for sentence in found.troubles:
            page.text(f"- {sentence}")
    else:
        page.verdict(
            "good",
            f"Noise {volume['sigma_mm']['median']:.3g} mm and calibration {volume['sigma_cal_mm']['median']:.2g} mm along the ray "
            "(medians over the working volume, one sigma).",
        )
    if proposal is not None:
        _wanted(page, proposal)
    page.heading("The rig, to scale")
    for name, axes in (("side", (2, 1)), ("top", (2, 0))):
        page.drawing(
            rig_svg(found, axes), f"Seen from the {name}: camera left, z to the right, {'xyz'[axes[1]]} down, mm."
        )
    page.text(_sizes(found))
    page.heading("Over the sheet of light, within the working volume")
    for name, key, factor in _MAPS:
        values = found.area.prediction.sigma_cal if key == "sigma_cal" else getattr(found.area.prediction.look, key)
        page.drawing(map_svg(found, found.area.grid(values) * factor, name), name)
    if found.hidden is not None:
        page.heading("What stays out of sight")
        page.drawing(hidden_svg(found.hidden), "The objects of the design at position 0, seen along z, as the motion carries them through the sheet.")  # fmt: skip
    page.heading("What one may expect")
    page.table(
        ["measured", "standard uncertainty, k = 1 (scatter, calibration)"],
        [(name, part) for name, part in expected_rows(result["expected"])],
    )
    page.text(
        "One scan by the motion's step, each object in the middle of the volume. What ranging itself gets wrong on slopes and at "
        "edges, and errors of the target, are not in it."
    )
    _figures(page, volume, result)
    if drawn is not None:
        _draws(page, drawn)
    return page.html()


def _figures(page: Page, volume: dict[str, Any], result: dict[str, Any]) -> None:
    names = {
        "sigma_mm": "noise along the ray, mm", "sigma_cal_mm": "calibration along the ray, mm",
        "lateral_mm": "a pixel along the stripe, mm", "depth_mm": "a pixel across it, in depth, mm",
        "px_per_mm": "px a mm", "stripe_px": "stripe, px", "blur_px": "blur, px", "signal": "stripe's peak, grey levels",
        "triangulation_deg": "triangulation angle, degrees",
    }  # fmt: skip
    page.heading("Over the volume")
    rows = [[name, *(f"{volume[key][part]:.4g}" for part in ("min", "median", "max"))] for key, name in names.items()]
    page.table(["", "least", "median", "largest"], rows)
    box = ", ".join(f"{axis} {low:.0f} to {high:.0f}" for axis, (low, high) in result["volume_mm"].items())
    page.text(f"The sheet of light is inside the calibrated volume at {box} mm.")
    page.heading("The jig")
    planes = [
        [p["name"], f"{p['seen']} of {p['of']}", f"{p['diameter_px']['min']:.1f}", f"{p['centre_px']['median']:.4f}"]
        for p in result["planes"]
    ]
    page.table(["plane", "spots in view", "smallest, px", "noise of a centre, px"], planes)


def _wanted(page: Page, proposal: Proposal) -> None:
    wanted, chosen = proposal.wanted, proposal.chosen
    size = " x ".join(f"{side:g}" for side in wanted.volume)
    page.verdict(
        "good" if proposal.met else "bad",
        f"Wanted: {wanted.sigma:g} mm over {size} mm. {'Proposed' if proposal.met else 'Not possible; the nearest'}: lens of "
        f"{chosen.focal:g} mm, middle of the volume at {chosen.stand_off:.0f} mm, baseline {chosen.baseline:.0f} mm "
        f"({chosen.angle:g} degrees), largest noise {chosen.sigma:.4f} mm.",
    )
    page.heading("Wanted, and expected")
    inside = proposal.predicted.area.prediction.inside
    points = proposal.predicted.area.prediction.points[inside]
    axis = "xyz".index(proposal.predicted.area.axis)
    reached = float(proposal.predicted.area.prediction.look.sigma[inside].max())
    along, deep = float(np.ptp(points[:, axis])), float(np.ptp(points[:, 2]))
    page.table(
        ["", "wanted", "expected", ""],
        [
            ("largest noise along the ray", length(wanted.sigma), length(reached), _met(chosen.sigma <= wanted.sigma)),
            ("width along the stripe", f"{wanted.volume[0]:g} mm", f"{along:.0f} mm", _met(along >= 0.95 * wanted.volume[0])),
            ("length along the motion", f"{wanted.volume[1]:g} mm", "by the motion", ""),
            ("depth", f"{wanted.volume[2]:g} mm", f"{deep:.0f} mm", _met(deep >= 0.95 * wanted.volume[2])),
        ],
    )  # fmt: skip
    page.heading("What each lens would cost")
    page.table(
        ["lens, mm", "angle, degrees", "stand-off, mm", "baseline, mm", "together, mm", "laser line, mm", "largest noise, mm", "largest blur, px", ""],
        [
            [
                f"{c.focal:g}", f"{c.angle:g}", f"{c.stand_off:.0f}", f"{c.baseline:.0f}", f"{c.stand_off + c.baseline:.0f}",
                f"{c.design.laser.width:.3g}", f"{c.sigma:.4f}", f"{c.blur:.2f}", "chosen" if c is chosen else "",
            ]
            for c in proposal.choices
        ],
    )  # fmt: skip


def _met(there: bool) -> str:
    return "met" if there else "NOT met"


def _sizes(found: DesignResult) -> str:
    laser, jig = found.rig.laser.origin, found.rig.design.jig.stand_offs
    angle = float(np.degrees(np.median(found.area.prediction.angle[found.area.prediction.inside])))
    return f"Baseline {np.hypot(*laser[:2]):.0f} mm, stand-offs of the jig {min(jig):g} to {max(jig):g} mm, triangulation angle {angle:.1f} degrees."


def _draws(page: Page, drawn: Drawn) -> None:
    page.heading(f"Tolerances: {drawn.count} rigs drawn")
    page.text(
        f"{drawn.failed} cannot be calibrated or miss the volume; {drawn.troubled} have something that will not work."
    )
    told = drawn.result["figures"]
    page.table(
        ["figure", "5 %", "median", "95 %"],
        [[figure_name(name), *(f"{part[key]:.3g}" for key in ("p5", "p50", "p95"))] for name, part in told.items()],
    )
