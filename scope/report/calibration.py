"""A calibration in words, tables and pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from calibration.digits import rounded, two_digits
from calibration.grouping import grouped
from calibration.rays import TwoPlaneFit, normal_equations, ray_uncertainty
from calibration.reason import see
from calibration.rig import sha256_of
from calibration.verification import block_image
from scope.calibrating import Calibration, MeasuredPlane
from scope.report import pictures
from scope.report.freehand import add_camera, camera_lines
from scope.report.page import Page
from scope.viewer import rig_scene


def number(value: Any, digits: int = 3) -> str:
    """Format a figure; a dash where there is none."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "-"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def calibration_text(found: Calibration) -> str:
    """What a person reads on the terminal."""
    result = found.result
    lines = [f"{'passed' if result['passed'] else 'NOT PASSED'}: {result['why']}", *_see_lines(result)]
    lines += _columns(_PLANE_HEADERS, _plane_rows(result["planes"]))
    lines += [f"camera: {text}" for text in camera_lines(result)]
    for name, laser in result["lasers"].items():
        lines.append(
            f"laser {name}: {laser['n']} points, rms {laser['rms_mm']:.4f} mm, one plane left out {number(laser['loo_mm'])} mm, "
            f"flat to {number(laser['flatness_mm'])} mm{' (curved sheet used)' if laser['curved'] else ''}"
        )
    lines += [_stage_text(stage) for stage in result["stages"]]
    lines += left_out_lines(found)
    lines += [f"warning: {text}" for text in result["warnings"]]
    return "\n".join(lines)


def left_out_lines(found: Calibration) -> list[str]:
    """What was left out, counted by reason with one example each."""
    lines = []
    for part, what, total in _PARTS:
        told = [(each.name, each.reason) for each in found.left_out if each.part == part]
        if told:
            lines.append(f"left out: {grouped(told, total(found), what)}")
    return lines


_PARTS: tuple[tuple[str, str, Callable[[Calibration], int]], ...] = (
    ("view", "views", lambda found: len(found.plan.planes)),
    ("laser", "laser images", lambda found: sum(len(plane.lasers) for plane in found.plan.planes)),
    ("mark", "marks", lambda found: sum(seen.expected for seen in found.measured)),
)


def _add_left_out(page: Page, found: Calibration) -> None:
    if not found.left_out:
        return
    page.heading("Left out")
    for line in left_out_lines(found):
        page.text(line.removeprefix("left out: ") + ".")
    page.table(("what", "view", "count", "why"),
               [[each.part, each.name, str(each.count), each.reason] for each in found.left_out])  # fmt: skip
    for each in found.left_out[:_PICTURES]:
        if each.image is None:
            continue
        light = np.zeros((0, 2)) if each.pixels is None else each.pixels
        page.image(pictures.with_stripe(each.image, light), f"{each.part} {each.name}: {each.reason}", width=320)


def _stage_text(stage: dict[str, Any]) -> str:
    way = ", ".join(f"{x:.5f}" for x in stage["direction"])
    error = (
        f"+- {number(stage['direction_sigma_deg'], 2)} degrees, marks {number(stage['rms_mm'])} mm rms about the motion"
    )
    if stage["kind"] == "linear":
        return f"linear stage: direction ({way}) {error}; it travels {stage['scale']:.5f} of what is stated"
    at = ", ".join(f"{x:.3f}" for x in stage["point"])
    scaled = (
        ""
        if stage["scale"] == 1
        else f"; put to the laser's scale, {stage['scale']:.4f} of what its target's lengths say"
    )
    return f"turntable: axis ({way}) through ({at}) {error}{scaled}"


_PICTURES = 24  # of what was left out
_PLANE_HEADERS = ("plane", "found", "used", "repeat px", "fit px", "left-out px", "left-out mm", "held-out mm")


def _plane_rows(planes: list[dict[str, Any]]) -> list[list[str]]:
    keys = ("repeat_px", "fit_px", "loo_px", "loo_mm", "heldout_mm")
    return [[p["name"], str(p["found"]), str(p["used"]), *(number(p[key]) for key in keys)] for p in planes]


def _columns(headers: Iterable[str], rows: list[list[str]]) -> list[str]:
    table = [list(headers), *rows]
    widths = [max(len(row[k]) for row in table) for k in range(len(table[0]))]
    return [
        "  ".join(
            cell.ljust(w) if k == 0 else cell.rjust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in table
    ]


def check_text(result: dict[str, Any]) -> str:
    """Judgement of one plane's images, for the terminal."""
    if not result["found"]:
        return f"plane {result['name']}: not good: {result['remedy']}"
    rejected = ", ".join(f"{count} {reason}" for reason, count in result["rejected"].items()) or "none"
    return (
        f"plane {result['name']}: {'good' if not result['remedy'] else 'not good: ' + result['remedy']}\n"
        f"{result['used']} of {result['expected']} marks; rejected: {rejected}; saturated {100 * result['saturated']:.0f} %; "
        f"repeats move {number(result['repeat_px'])} px; fit {number(result['fit_px'])} px, left out {number(result['loo_px'])} px"
    )


def verification_text(result: dict[str, Any]) -> str:
    """Verification of a rig, for the terminal."""
    lines = [f"{'passed' if result['passed'] else 'NOT PASSED'}: {result['why']}", *_see_lines(result)]
    rows = [[p["name"], number(p["rms_px"]), number(p["rms_mm"])] for p in result["planes"]]
    return "\n".join(lines + (_columns(("plane", "rms px", "rms mm"), rows) if rows else []))


def verification_page(result: dict[str, Any]) -> str:
    """Verification of a rig as a page."""
    page = Page("SCOPE verification")
    page.verdict(
        "good" if result["passed"] else "bad", ("Passed: " if result["passed"] else "Not passed: ") + result["why"]
    )
    rows = [
        [
            p["name"],
            number(p["rms_px"]),
            number(p["rms_mm"]),
            "-" if p["bias_mm"] is None else ", ".join(f"{b:+.4f}" for b in p["bias_mm"]),
        ]
        for p in result["planes"]
    ]
    add_faults(page, result["faults"])
    page.table(
        ("plane", "rms, px", "rms, mm", "bias x, y, z, mm"), rows, marked=_at_fault(result["planes"], result["faults"])
    )
    return page.html()


def _see_lines(result: dict[str, Any]) -> list[str]:
    kinds = [str(fault["kind"]) for fault in result["faults"]]
    return [f"see {see(*kinds)}"] if kinds else []


def _at_fault(planes: list[dict[str, Any]], faults: Iterable[dict[str, Any]]) -> set[int]:
    """Rows of the planes that a fault names; single marks that were left out name none."""
    named = {fault["plane"] for fault in faults if fault["kind"] != "mark" or fault.get("mark") is None}
    return {k for k, plane in enumerate(planes) if plane["name"] in named or "all" in named}


def add_faults(page: Page, faults: Iterable[dict[str, Any]]) -> None:
    """Add what is wrong, with its size, what to do, and where the documentation tells of it; nothing where all is well."""
    found = list(faults)
    if not found:
        return
    page.heading("Faults")
    rows = []
    for fault in found:
        value, error = (
            float("nan") if fault[key] is None else float(fault[key]) for key in ("value", "standard_error")
        )
        size = "" if not np.isfinite(value) else f"{rounded(value, error, usual=3)} {fault['unit']}"
        spread = f" ± {two_digits(error)}" if np.isfinite(error) else ""
        rows.append(
            [str(fault["plane"]), str(fault["kind"]), f"{size}{spread}", str(fault["remedy"]), see(str(fault["kind"]))]
        )
    failing = {k for k, fault in enumerate(found) if fault["kind"] != "mark" or fault.get("mark") is None}
    page.table(("plane", "kind", "size ± standard error", "what to do", "more"), rows, marked=failing)


def calibration_page(found: Calibration) -> str:
    """One self-contained HTML page: the verdict, the figures beside what is good, and the images."""
    page, result = Page(f"SCOPE calibration of {found.plan.path.name}"), found.result
    if result["passed"]:
        page.verdict("good", f"Passed: {result['why']}.")
    else:
        page.verdict("bad", f"Not passed: {result['why']}.")
    for text in result["warnings"]:
        page.text(f"Warning: {text}.")
    add_faults(page, result["faults"])
    page.heading("Figures")
    page.table(_PLANE_HEADERS, _plane_rows(result["planes"]), marked=_at_fault(result["planes"], result["faults"]))
    page.table(("figure", "here", "good", "if it is not"), _judged(found))
    add_camera(page, found)
    _add_held_out(page, result)
    if found.two_plane is not None:
        _add_intraplane(page, found)
        _add_interplane(page, found)
        _add_uncertainty(page, found.two_plane)
        _add_numerics(page, found.two_plane)
    page.heading("The rig")
    page.cloud(rig_scene(found.rig), "Camera, sighting rays, calibrated volume, sheets of light and axes, in C, mm")
    _add_lasers(page, found)
    if result["stages"]:
        page.heading("Stages")
        for stage in result["stages"]:
            page.text(_stage_text(stage) + ".")
    _add_left_out(page, found)
    page.heading("Marks")
    for seen in found.measured:
        _add_marks(page, seen)
    page.about(
        "calibration",
        f"{found.plan.path}, sha256 {sha256_of(found.plan.path)[:12]}" if found.plan.path.is_file() else "",
    )
    page.about("images and files", str(len(found.rig.inputs)))
    page.about("limits asked", ", ".join(f"{key} {value:g}" for key, value in found.rig.accept.items()) or "none")
    page.about("camera", found.rig.camera_id)
    return page.html()


def _judged(found: Calibration) -> list[list[str]]:
    result = found.result
    rows: list[list[str]] = []
    worst = max((p["loo_px"] for p in result["planes"] if np.isfinite(p["loo_px"])), default=float("nan"))
    if found.two_plane is not None:
        rows.append(["left-out error of the plane maps, worst plane", f"{number(worst)} px", "under 0.05 px for clean spots",
                     "focus, exposure, a cleaner target, or --order"])  # fmt: skip
    limit = found.plan.accept.get("ray_mm")
    if found.freehand is not None:
        rows.append(["rays on views left out", f"{number(result['ray_mm'])} mm",
                     f"under {limit:g} mm (accept)" if limit else "under a tenth of the tolerance of the work",
                     "more views, tilted by 20 to 40 degrees, the marks filling the image"])  # fmt: skip
    if found.two_plane is not None:
        rows.append(["held-out rays, planes between others", f"{number(result['ray_mm'])} mm",
                     f"under {limit:g} mm (accept)" if limit else "under a tenth of the tolerance of the work",
                     "check stand-offs and seats; add a plane"])  # fmt: skip
        rows.append(["agreement of the planes (inter-plane)", f"{number(result['interplane_px'])} px",
                     f"about {number(result['interplane_expected_px'])} px, as the maps' own errors make it", "see the faults; measure the stand-offs again"])  # fmt: skip
    for name, laser in result["lasers"].items():
        rows.append([f"laser {name}: points about the sheet", f"{number(laser['rms_mm'])} mm", "under a tenth of the stripe's width",
                     "expose so that the stripe is not clipped; take laser-off images"])  # fmt: skip
    return rows


def _add_held_out(page: Page, result: dict[str, Any]) -> None:
    rows = []
    for plane in result["planes"]:
        if np.isfinite(plane["heldout_mm"]):
            bias = plane["heldout_bias_mm"]
            where = "freehand" if bias is None else "between others" if plane["between"] else "outermost: extrapolated"
            rows.append([plane["name"], number(plane["heldout_mm"]), number(plane["heldout_px"]),
                         "-" if bias is None else ", ".join(f"{b:+.4f}" for b in bias), where])  # fmt: skip
        elif plane.get("heldout_why"):
            rows.append([plane["name"], "-", "-", "-", f"withheld: {plane['heldout_why']}"])
    if rows:
        page.heading("Held out: the rays of the others on each plane")
        page.text(
            "Each plane (or freehand view) is left out, the rays are fitted to the others, and its marks are compared with "
            "them. The bias is the mean offset of the marks from their rays, in C."
        )
        page.table(("plane", "rms, mm", "rms, px", "bias x, y, z, mm", "where"), rows)


def _add_intraplane(page: Page, found: Calibration) -> None:
    fit, inside = found.two_plane, found.verdict.intraplane
    if fit is None or inside is None:
        return
    page.heading("Intra-plane: how well each map fits its own spots")
    split = inside.split
    if np.isfinite(split.random_px):
        worst = float(np.linalg.norm(split.target_mm, axis=1).max()) if len(split.target_mm) else 0.0
        page.text("What the residuals about the rays through all planes are made of, rms px; the squares add up.")
        page.table(("part", "rms, px", "what it is"), [
            ["repeats mark for mark on all planes", number(split.target_px),
             f"the target: marks off their stated places, the worst by {number(worst)} mm"],
            ["moves the marks of a plane together", number(split.placement_px), "the placement of the planes: "
             + ", ".join(f"{p.name} {number(float(px), 2)}" for p, px in zip(inside.planes, split.plane_px, strict=True))],
            ["the rest", number(split.random_px), "noise of the centroids"],
        ])  # fmt: skip
    page.text(
        "Grey blocks after figure 5 of DePiero & Kress: the lighter, the larger the residual at that spot (all planes to one "
        "scale). The arrows are the same residuals with their sign."
    )
    high = max(float(np.linalg.norm(f.residuals, axis=1).max()) for f in fit.planes)
    for marks, plane in zip(fit.marks, fit.planes, strict=True):
        length = np.linalg.norm(plane.residuals, axis=1)
        blocks = block_image(marks.pixels, length, fit.camera.size)
        page.image(pictures.grey_blocks(blocks, high=high, enlarge=2),
                   f"{marks.name}: residuals up to {length.max():.3f} px, rms {plane.fit_px:.4f} px (mean {plane.fit_px_mean:.4f}), left out "
                   f"{plane.loo_px:.4f} px = {plane.loo_mm:.5f} mm", width=430)  # fmt: skip
        picture, gain = pictures.arrows(fit.camera.size, marks.pixels, plane.residuals)
        page.image(picture, f"{marks.name}: residuals as arrows, {gain:.0f} times enlarged", width=430)


def _add_interplane(page: Page, found: Calibration) -> None:
    agreement = found.verdict.interplane
    if agreement is None:
        return
    page.heading("Inter-plane: whether the points of one pixel on all planes lie on a line")
    page.text(
        "Grey image after figure 6: sum of |E| of equation 8 over the pixels whose rays stay inside the calibrated volume. A "
        "rotated target shows as an image that grows darker towards the centre of rotation. The lines of equation 7 and of the "
        f"singular value decomposition differ by at most {agreement.disagreement:.1e} rad."
    )
    if not np.isfinite(agreement.sum_abs).any():
        page.text("No pixel's rays stay inside the calibrated volume on all planes.")
        return
    page.image(pictures.grey_blocks(agreement.sum_abs, enlarge=14),
               f"sum of |E|, white is {np.nanmax(agreement.sum_abs):.4f} mm", width=430)  # fmt: skip
    page.image(pictures.heat(agreement.error_px, enlarge=14),
               f"rms distance from the best line: {agreement.interplane_px:.4f} px, {agreement.interplane_mm:.5f} mm over the view", width=430)  # fmt: skip


def _add_uncertainty(page: Page, fit: TwoPlaneFit) -> None:
    page.heading("Uncertainty of the rays from the noise of the spots")
    depths = fit.camera.field.depths
    for view in ray_uncertainty(fit.camera, [float(depths[0]), float(depths.mean()), float(depths[-1])]):
        if np.isfinite(view.sigma_mm).any():
            um = view.sigma_mm * 1000
            page.image(pictures.heat(um, enlarge=10),
                       f"stand-off {view.depth:.1f} mm: one sigma from {np.nanmin(um):.2f} (dark) to {np.nanmax(um):.2f} um (light)", width=300)  # fmt: skip


def _add_numerics(page: Page, fit: TwoPlaneFit) -> None:
    marks = fit.marks[len(fit.marks) // 2]
    if len(marks) < 12:
        return
    page.heading("The paper's two numerical findings, on these spots")
    rows = []
    names = (
        ("pixels", "powers of raw pixels"),
        ("unit", "normalised to (0, 1), origin in a corner"),
        ("centred", "normalised to (-1, 1), origin at the centre"),
        ("chebyshev", "Chebyshev products about the centre"),
    )
    for coordinates, text in names:
        _, c = normal_equations(marks, terms="paper", coordinates=coordinates)  # type: ignore[arg-type]
        rows.append(
            [
                text,
                f"{c.span:.1f}",
                f"{c.condition:.1e}",
                f"{c.dependence:.2f}",
                f"{c.error:.1e}",
                f"{c.error_single:.1e}",
            ]
        )
    page.table(
        (
            "coordinates of the 11-term map",
            "orders of magnitude in P'P",
            "condition of P'P",
            "likest two columns (cosine)",
            "error of the LU solution, mm",
            "in single precision, mm",
        ),
        rows,
    )
    page.text(
        "Normalising cures the span (the paper's first finding). With the origin at the centre sums of odd powers cancel on a "
        "symmetric grid, so that the elements span more orders (its second finding); yet the condition is the better one there. In "
        "double precision neither costs anything; in single precision both show. The Chebyshev basis with QR, by which the "
        "maps are really fitted, depends on neither."
    )


def _add_lasers(page: Page, found: Calibration) -> None:
    for name, laser in found.result["lasers"].items():
        page.heading(f"Laser {name}")
        normal = ", ".join(f"{x:.6f}" for x in laser["normal"])
        shape = "a curved sheet is used" if laser["curved"] else "a plane is used"
        page.text(
            f"Sheet: normal ({normal}), offset {laser['offset']:.4f} mm; rms {laser['rms_mm']:.4f} mm over {laser['n']} points. "
            f"Quadratic part {laser['flatness_mm']:.4f} +- {number(laser['flatness_sigma_mm'])} mm peak to valley: {shape}."
        )
        _add_channel(page, found, name)
        page.table(("plane", "points", "rms, mm", "left out, mm"),
                   [[p["name"], str(p["n"]), number(p["rms_mm"]), number(p["loo_mm"])] for p in laser["planes"]])  # fmt: skip
        views = [view for view in found.views if view.laser == name]
        for view in views[:4]:
            page.image(
                pictures.with_stripe(view.image, view.pixels),
                f"stripe on {view.plane}: {len(view.pixels)} points",
                width=430,
            )


def _add_channel(page: Page, found: Calibration, name: str) -> None:
    """Why the channel was taken."""
    choice = found.choices.get(name)
    if choice is None or not choice.errors:
        return
    told = ", ".join(
        f"{channel} {error:.4f}" if np.isfinite(error) else f"{channel}: no stripe"
        for channel, error in sorted(choice.errors.items(), key=lambda item: item[1])
    )
    page.text(f"Read in {choice.channel}. Predicted error of a stripe over all its lines, px: {told}.")


def _add_marks(page: Page, seen: MeasuredPlane) -> None:
    origin = np.flatnonzero(seen.marks.mark == 0)
    picture = pictures.with_marks(
        seen.image, seen.marks.pixels, [(u, v) for u, v, _ in seen.rejected], int(origin[0]) if len(origin) else None
    )
    reasons: dict[str, int] = {}
    for _, _, reason in seen.rejected:
        reasons[reason] = reasons.get(reason, 0) + 1
    told = "; ".join(f"{count} {reason}" for reason, count in reasons.items())
    page.image(picture, f"{seen.plan.name}: {len(seen.marks)} of {seen.expected} marks (yellow: mark (0, 0))"
               + (f"; rejected (red): {told}" if told else ""), width=430)  # fmt: skip
