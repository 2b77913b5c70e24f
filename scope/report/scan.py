"""A scan in words, tables and pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from calibration.digits import rounded, two_digits
from calibration.reason import see
from calibration.rig import sha256_of
from ranging.background import Image, choose_channel, to_gray
from scope.cloud import ScanCloud, lattice_index
from scope.report import pictures
from scope.report.page import Page
from scope.scanning import Agreement, Scan, Table
from scope.session import Capture, open_source, read_capture, read_image
from scope.viewer import cloud_from, cloud_scene

_WHY = {
    "no_light": "no peak clear of the noise: nothing there, too dark, or in shadow",
    "too_narrow": "a hot pixel or a glint, not a stripe",
    "too_wide": "a halo, a grazing or a scattered stripe",
    "saturated": "clipped over its whole width: expose shorter",
    "two_peaks": "two stripes of like strength: a reflection; --which chooses one",
    "edge": "half a stripe, at an occlusion or an edge",
    "out_of_view": "cut by the border of the image",
    "outside_calibration": "outside the calibrated volume: calibrate further, or --extrapolate",
    "shallow": "the ray nearly runs within the sheet of light",
    "uncertain": "sigma above --max-sigma",
}


def why_no_point(reason: str) -> str:
    """What a reason for a line without a point means, in words; empty for one that is not known."""
    return _WHY.get(reason, "")


def scan_result(found: Scan) -> dict[str, Any]:
    """What --json gives."""
    return {
        "frames": found.frames,
        "points": found.points,
        "empty_frames": found.empty_frames,
        "rejected": dict(found.rejected),
        "filtered": dict(found.filtered),
        "lasers_agree": [asdict(pair) for pair in found.agreement],
        "seconds": round(found.seconds, 3),
        "sigma_mm": found.sigma_mm,
        "sigma_cal_mm": found.sigma_cal_mm,
        "complete": not found.why_incomplete,
        "verified": found.verified,
        "why_incomplete": found.why_incomplete,
        "troubles": list(found.troubles),
        **({} if found.table is None else {"table": _table(found.table)}),
    }


def _table(table: Table) -> dict[str, Any]:
    stage = table.stage
    return {
        "kind": stage.kind, "direction": stage.direction.tolist(), "point": stage.point.tolist(),
        "direction_sigma_deg": float(np.rad2deg(stage.direction_sigma)), "scale": stage.scale, "rms_mm": stage.rms_mm,
        "frames": len(table.frames), "looked_at": table.looked, "warning": table.warning,
    }  # fmt: skip


def _table_text(table: Table) -> str:
    x, y, z = table.stage.direction
    what = "axis" if table.stage.kind == "turntable" else "direction"
    told = (
        f"{what} by the table's markers in {len(table.frames)} of {table.looked} frames: ({x:.4f}, {y:.4f}, {z:.4f}), "
    )
    told += f"one sigma {np.rad2deg(table.stage.direction_sigma):.3f} degrees, rms {table.stage.rms_mm:.3f} mm"
    return f"{told}\nwarning: {table.warning}" if table.warning else told


def scan_text(found: Scan) -> str:
    """What a person reads on the terminal."""
    rejected = ", ".join(f"{count} {reason}" for reason, count in _most_first(found.rejected)) or "none"
    sigma = f"median sigma {two_digits(found.sigma_mm)} mm, of the calibration {two_digits(found.sigma_cal_mm)} mm"
    lines = [
        f"{found.points} points from {found.frames} frames in {found.seconds:.1f} s; {sigma}",
        f"lines without a point: {rejected}{f'; see {see(*found.rejected)}' if found.rejected else ''}",
    ]
    if found.empty_frames:
        lines.append(f"frames without any point: {found.empty_frames}")
    if found.filtered:
        lines.append(f"removed by filters: {', '.join(f'{count} {name}' for name, count in found.filtered.items())}")
    if found.table is not None:
        lines.append(_table_text(found.table))
    lines += [f"lasers {pair.first} and {pair.second}: {_agreement_text(pair)}" for pair in found.agreement]
    lines += [f"contradiction: {trouble}" for trouble in found.troubles]
    return "\n".join(lines)


def _most_first(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    return sorted(counts.items(), key=lambda item: -item[1])


def _agreement_text(pair: Agreement) -> str:
    if pair.cells == 0:
        return "no surface was seen by both"
    return (
        f"apart by {rounded(pair.mean_mm, pair.sigma_mm, sign=True)} mm in the mean, {two_digits(pair.rms_mm)} mm rms along the normal "
        f"({pair.cells} cells; {two_digits(pair.sigma_mm)} mm expected; {100 * pair.beyond:.1f} % of the cells more than 3 sigma apart)"
    )


def scan_page(found: Scan, capture: str | Path, *, artefact: Sequence[Sequence[str]] = ()) -> str:
    """One self-contained HTML page: the cloud to be turned, the reasons, sigma, and the hardest frames.

    ``artefact``: rows (what, value, U) that an artefact beside the part says of this scan.
    """
    page, cloud = Page(f"SCOPE scan of {Path(capture).name}"), found.cloud
    level, text = (
        ("good", "Complete, from a verified rig")
        if cloud.verified
        else ("bad", "The rig is not verified: do not use this cloud")
    )
    if found.why_incomplete:
        level, text = "warn" if cloud.verified else "bad", f"Incomplete: {found.why_incomplete}"
    for trouble in found.troubles:
        page.verdict("bad", f"Do not use this cloud: {trouble}.")
    page.verdict(level, f"{text}: {len(cloud)} points from {found.frames} frames.")  # type: ignore[arg-type]
    page.cloud(cloud_scene(cloud), "The cloud")
    add_views(page, cloud)
    page.heading("Lines of the images without a point, and why")
    lines = max(1, sum(found.rejected.values()) + found.points + sum(found.filtered.values()))
    page.table(
        ("reason", "lines", "of all", "what it means", "more"),
        [
            [key, str(count), f"{100 * count / lines:.1f} %", _WHY.get(key, ""), see(key)]
            for key, count in _most_first(found.rejected)
        ],
    )
    if found.filtered:
        page.heading("Points that filters removed")
        page.table(("filter", "points"), [[name, str(count)] for name, count in found.filtered.items()])
    if found.agreement:
        page.heading("Where two lasers see one surface")
        for pair in found.agreement:
            page.text(f"{pair.first} and {pair.second}: {_agreement_text(pair)}.")
    if found.table is not None:
        page.heading("The table's markers")
        page.text(f"{_table_text(found.table)}.".replace("\n", "; "))
    if artefact:
        page.heading("The artefact beside the part")
        page.table(("what", "value", "U (k = 2)"), artefact)
    add_uncertainty(page, cloud)
    _add_hard_frames(page, found, Path(capture))
    page.about(
        "capture", f"{capture}, sha256 {sha256_of(Path(capture))[:12]}" if Path(capture).is_file() else str(capture)
    )
    about_cloud(page, cloud)
    return page.html()


def about_cloud(page: Page, cloud: ScanCloud) -> None:
    """Say in the footer of which rig a cloud is, and what its file says of itself."""
    if cloud.rig_sha256:
        page.about("rig", f"sha256 {cloud.rig_sha256[:12]}, {'verified' if cloud.verified else 'not verified'}")
    for line in cloud.origin:
        what, _, value = line.partition(": ")
        page.about(what if what.startswith(("rig", "limits", "camera")) else f"cloud, {what}", value)


def add_uncertainty(page: Page, cloud: ScanCloud) -> None:
    """Add quantiles of both sigmas of a cloud."""
    page.heading("Uncertainty")
    quantiles = [10, 50, 90, 99]
    page.table(("mm along the ray", *(f"{q} %" for q in quantiles)), [
        ["sigma: stripe noise, independent from point to point", *(two_digits(x) for x in np.percentile(cloud.sigma, quantiles))],
        ["sigma_cal: calibration, shared", *(two_digits(x) for x in np.percentile(cloud.sigma_cal, quantiles))],
    ])  # fmt: skip


def add_views(page: Page, cloud: ScanCloud) -> None:
    """Pictures of the cloud from above and from the side, and the map of its sigma in the order of the scan."""
    x, y, z = np.eye(3)
    if len(cloud) == 0:
        return
    page.image(cloud_from(cloud.points, cloud.points[:, 2], x, y), "seen along z, coloured by z", width=430)
    page.image(
        cloud_from(cloud.points, cloud.intensity.astype(np.float64), x, z),
        "seen along y (z down), coloured by brightness",
        width=430,
    )
    for laser, name in enumerate(cloud.laser_names):
        index = lattice_index(cloud, laser)
        if index.size == 0:
            continue
        sigma = np.where(index >= 0, cloud.sigma[index].astype(np.float64), np.nan)
        low, high = np.nanpercentile(sigma, [2, 98])
        page.image(
            pictures.heat(sigma, enlarge=max(1, 430 // max(sigma.shape)), low=low, high=high),
            f"sigma of {name}: one row a frame, one column a line of the image; dark {two_digits(low)} mm, light {two_digits(high)} mm, grey: no "
            "point",
            width=430,
        )


def _add_hard_frames(page: Page, found: Scan, capture: Path) -> None:
    """Show the frames with the fewest points beside their neighbours, with the stripe drawn on them."""
    plan = read_capture(capture)
    if not plan.images and plan.video is None:
        return  # a camera's frames are gone
    cloud = found.cloud
    numbers = np.arange(found.frames) if plan.numbers is None else np.array(plan.numbers[: found.frames])
    count = np.bincount(cloud.frame, minlength=int(numbers.max()) + 1)[numbers]
    page.heading("Hardest frames (fewest points, least certain), and a typical one")
    order = np.argsort(count, kind="stable")
    doubt = np.bincount(cloud.frame, cloud.sigma, int(numbers.max()) + 1)[numbers] / np.maximum(count, 1)
    chosen = [*order[:2].tolist(), *np.argsort(-doubt, kind="stable")[:2].tolist(), int(order[len(order) // 2])]
    for k, name, image in _frames(plan, list(dict.fromkeys(chosen))):
        shown = to_gray(image, choose_channel([image], plan.channel))
        pixels = cloud.pixels[cloud.frame == numbers[k]].astype(np.float64)
        caption = f"{name}: {count[k]} points, mean sigma {two_digits(doubt[k])} mm"
        page.image(pictures.with_stripe(shown, pixels), caption, width=430)


def _frames(plan: Capture, wanted: list[int]) -> Iterator[tuple[int, str, Image]]:
    """Position, name and image of some frames: of a folder in the order wanted, of a video in its own."""
    if plan.images:
        images = plan.images[::2] if plan.background_mode == "alternate" else plan.images
        for k in wanted:
            yield k, images[k].name, read_image(images[k])
        return
    for k, load in enumerate(open_source(plan).loaders(0)):
        if k in wanted and (frame := load()) is not None:
            yield k, frame.name, frame.image
        if k == max(wanted):
            break
