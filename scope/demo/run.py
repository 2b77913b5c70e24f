"""The whole path on a simulated rig, each result beside the truth."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from calibration.atomic import write_text
from calibration.digits import rounded, two_digits
from calibration.geometry import Array, Plane, Pose
from scope import simulation
from scope.calibrating import Calibration, calibrate
from scope.cloud import Box
from scope.errors import MissingLibraryError
from scope.origin import origin_of
from scope.report import (
    Page,
    add_views,
    calibration_page,
    grey_blocks,
    linked,
    scan_page,
    signed,
    with_marks,
    with_stripe,
)
from scope.scanning import Scan, run_scan
from scope.viewer import cloud_scene, rig_layers

_STEPS = 5
_FINEST = 1e-3  # mm, degrees: no deviation is known to better than a tenth of that
_PAGES = {"demo": "Demo", "calibration": "Calibration", "scan": "Scan", "roughness": "Roughness", "pose": "Pose"}


@dataclass(frozen=True, slots=True)
class Deviation:
    """One result beside the truth."""

    what: str
    found: float
    true: float
    unit: str
    note: str = ""

    @property
    def error(self) -> float:
        """Found minus true."""
        return self.found - self.true


def run_demo(
    out: Path,
    *,
    on_step: Callable[[int, int], None] = lambda _done, _total: None,
    say: Callable[[str], None] = lambda _text: None,
) -> dict[str, Any]:
    """Simulate a rig and a scan, calibrate, scan, compare with the truth, and write everything into a folder.

    Parameters
    ----------
    out : Path
        Folder; made where it does not exist. A former demo in it is replaced.
    on_step : callable
        Called with (done, total) after each stage.
    say : callable
        Told what is being done.

    Returns
    -------
    dict
        ``deviations`` (what, found, true, error, unit), ``calibration``, ``scan``, ``files``, ``skipped``.
    """
    started = time.perf_counter()
    out.mkdir(exist_ok=True, parents=False) if out.parent.is_dir() else None
    text = resources.files("scope.demo").joinpath("rig-design.toml").read_text(encoding="utf-8")
    write_text(out / "rig-design.toml", text)
    say("simulating a rig, its targets and a scan")
    simulation.simulate(simulation.read_design(out / "rig-design.toml"), out / "session", np.random.default_rng(1))
    on_step(1, _STEPS)
    say("calibrating")
    calibration = calibrate(out / "session" / "calibration.toml")
    calibration.rig.save(out / "rig.json")
    write_text(out / "calibration.html", calibration_page(calibration))
    on_step(2, _STEPS)
    say("scanning")
    found = run_scan(out / "session" / "capture.toml", out / "rig.json")
    found.cloud.save(out / "cloud.ply")
    write_text(out / "scan.html", scan_page(found, out / "session" / "capture.toml"))
    on_step(3, _STEPS)
    say("comparing with the truth")
    truth = json.loads((out / "session" / "truth" / "truth.json").read_text(encoding="utf-8"))
    deviations = [*_of_calibration(calibration, truth, out), *_of_scan(found, truth, out)]
    skipped = ""
    try:
        deviations += _pose(found, truth, out)
    except MissingLibraryError as error:
        skipped = f"no pose: {error}"
        say(skipped)
    on_step(4, _STEPS)
    write_text(out / "demo.html", _page(calibration, found, deviations, skipped))
    _link(out)
    on_step(5, _STEPS)
    return {
        "deviations": [
            {"what": d.what, "found": d.found, "true": d.true, "error": d.error, "unit": d.unit, "note": d.note}
            for d in deviations
        ],
        "calibration": calibration.result,
        "points": len(found.cloud),
        "skipped": skipped,
        "files": [str(p) for p in sorted(out.iterdir(), key=lambda p: p.name != "demo.html") if p.is_file()],
        "seconds": round(time.perf_counter() - started, 1),
    }


def _link(out: Path) -> None:
    """Sign the pages and lead from each to the others; what could not be made is left out."""
    origin = origin_of([out / "rig-design.toml", out / "rig.json", out / "cloud.ply"])
    there = {name: out / f"{name}.html" for name in _PAGES if (out / f"{name}.html").is_file()}
    for name, path in there.items():
        beside = [(f"{other}.html", _PAGES[other]) for other in there if other != name]
        write_text(path, linked(signed(path.read_text(encoding="utf-8"), origin), beside))


def demo_text(result: dict[str, Any]) -> str:
    """Table of deviations for the terminal."""
    rows = [("", "found", "true", "deviation")]
    rows += [
        (
            d["what"],
            rounded(d["found"], max(abs(d["error"]), _FINEST)),
            f"{d['true']:.6g}",
            f"{rounded(d['error'], max(abs(d['error']), _FINEST), sign=True)} {d['unit']}",
        )
        for d in result["deviations"]
    ]
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    lines = [
        "  ".join(
            cell.ljust(w) if k == 0 else cell.rjust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    return "\n".join([*lines, "", f"{result['points']} points; see {result['files'][0]}"])


def _of_calibration(found: Calibration, truth: dict[str, Any], out: Path) -> list[Deviation]:
    camera = found.rig.camera
    pixels = np.stack(
        np.meshgrid(np.linspace(0, camera.size[0] - 1, 33), np.linspace(0, camera.size[1] - 1, 25)), axis=-1
    )
    flat = pixels.reshape(-1, 2)
    exact = simulation.exact_rays(
        simulation.VirtualRig.of(simulation.read_design(out / "rig-design.toml")).camera, flat
    )
    depth = np.array([p["stated"][2][3] for p in truth["planes"]])
    points = exact.at_depth(np.full(len(flat), (depth.min() + depth.max()) / 2))
    inside = camera.volume.contains(points)
    off = camera.rays(flat[inside]).distance_to(points[inside])
    (laser,) = found.rig.lasers.values()
    sheet = Plane.through(np.array(truth["laser"]["origin"]), np.array(truth["laser"]["normal"]))
    angle = float(np.degrees(np.arcsin(min(1.0, float(np.linalg.norm(np.cross(sheet.normal, laser.plane.normal)))))))
    middle = points[inside].mean(axis=0)
    on_sheet = middle - sheet.distance(middle[None])[0] * sheet.normal
    return [
        Deviation("sighting rays, median distance from the exact", float(np.median(off)), 0.0, "mm"),
        Deviation("laser plane, angle", angle, 0.0, "deg"),
        Deviation(
            "laser plane, distance in the middle of the volume",
            float(abs(laser.sheet.distance(on_sheet[None])[0])),
            0.0,
            "mm",
        ),
    ]


def _of_scan(found: Scan, truth: dict[str, Any], out: Path) -> list[Deviation]:
    deviations = [_against_points(found, out)]
    points = found.cloud.points
    for item in truth["object"]:
        pose = Pose.from_matrix(item["cloud_from_model"])
        match item["solid"]:
            case "sphere":
                deviations += _sphere(points, pose.translation, float(item["radius"]))
            case "steps":
                deviations += _steps(points, pose, item)
            case "rough":
                deviations.append(_roughness(found, pose, item, out))
    return deviations


def _against_points(found: Scan, out: Path) -> Deviation:
    """Distance along depth between each point and the true middle of the stripe on its image column."""
    true = np.load(out / "session" / "truth" / "stripe_points.npy", allow_pickle=False)
    line = np.rint(found.cloud.pixels[:, 0]).astype(int)
    nearest = true[found.cloud.frame, line]
    gap = np.linalg.norm(found.cloud.points - nearest, axis=1)
    return Deviation("all points, median distance from the true stripe", float(np.nanmedian(gap)), 0.0, "mm")


def _sphere(points: Array, centre: Array, radius: float) -> list[Deviation]:
    near = points[np.abs(np.linalg.norm(points - centre, axis=1) - radius) < 1.0]
    for _ in range(3):
        rows = np.column_stack([2 * near, np.ones(len(near))])
        solution = np.linalg.lstsq(rows, (near**2).sum(axis=1), rcond=None)[0]
        size = float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))
        off = np.linalg.norm(near - solution[:3], axis=1) - size
        near = near[np.abs(off) < 4 * off.std() + 1e-9]
    return [
        Deviation("sphere, radius", size, radius, "mm"),
        Deviation("sphere, centre", float(np.linalg.norm(solution[:3] - centre)), 0.0, "mm", "distance"),
    ]


def _steps(points: Array, pose: Pose, item: dict[str, Any]) -> list[Deviation]:
    own = pose.inverse.apply(points)
    width, depth = item["tread"]
    deviations = []
    base_box = Box(x=(-width, len(item["heights"]) * (width + item["gap"])), y=(-depth, 2 * depth), z=(-0.4, 0.4))
    base = float(np.median(own[base_box.contains(own), 2]))
    for k, height in enumerate(item["heights"]):
        start = k * (width + item["gap"])
        top = Box(x=(start + 2, start + width - 2), y=(3, depth - 3), z=(height - 0.4, height + 0.4))
        on_top = own[top.contains(own), 2]
        if len(on_top) > 20:
            deviations.append(Deviation(f"step of {height:g} mm", float(on_top.mean()) - base, float(height), "mm"))
    return deviations


def _roughness(found: Scan, pose: Pose, item: dict[str, Any], out: Path) -> Deviation:
    """Sq of the coupon, noise removed, beside that of its true heights on the same patch; writes roughness.html."""
    from scope.report import roughness_page
    from scope.roughness import measure_roughness

    margin = 3.0
    length, width = item["size"]
    corners = pose.apply(np.array([[margin, margin, 0.0], [length - margin, width - margin, 0.0]]))
    (x0, y0, _), (x1, y1, _) = np.sort(corners, axis=0)
    patch = measure_roughness(found.cloud, region=Box(x=(x0, x1), y=(y0, y1)), name="coupon")
    write_text(out / "roughness.html", roughness_page([patch], "cloud.ply"))
    heights = np.load(out / "session" / "truth" / item["heights"], allow_pickle=False)
    edge = round(margin / item["spacing"])
    inside = heights[edge:-edge, edge:-edge]
    rows, columns = np.mgrid[0 : inside.shape[0], 0 : inside.shape[1]]
    plane = np.column_stack([rows.ravel(), columns.ravel(), np.ones(inside.size)])
    rest = inside.ravel() - plane @ np.linalg.lstsq(plane, inside.ravel(), rcond=None)[0]
    sq = patch.areal["Sq"]
    note = f"+- {two_digits(sq.uncertainty)} (k = 2)" if sq.uncertainty is not None else ""
    return Deviation("rough coupon, Sq", float("nan") if sq.value is None else sq.value, float(rest.std()), "mm", note)


def _pose(found: Scan, truth: dict[str, Any], out: Path) -> list[Deviation]:
    """Pose of the angle bracket beside the true one; writes part.stl and pose.html.

    ``MissingLibraryError`` where Open3D is not to be had.
    """
    from scope.optional import import_open3d
    from scope.pose import estimate_pose, place
    from scope.report import pose_html

    import_open3d()
    foot = next(item for item in truth["object"] if item["solid"] == "box")
    true = Pose.from_matrix(foot["cloud_from_model"]) @ Pose(np.eye(3), np.array([0.0, 0.0, -foot["size"][2] / 2]))
    corners = true.apply(_bracket(out / "part.stl"))
    low, high = corners.min(axis=0) - 2.0, corners.max(axis=0) + np.array([2.0, 2.0, -0.7])
    region = Box(x=(low[0], high[0]), y=(low[1], high[1]), z=(low[2], high[2]))
    answer = estimate_pose(found.cloud, out / "part.stl", region=region)
    write_text(out / "pose.html", pose_html(found.cloud, place(found.cloud, answer, "last", None)))
    if answer.cloud_from_model is None:
        return [Deviation("pose of the bracket: none", float("nan"), 0.0, "mm", answer.why)]
    gap = true.inverse @ answer.cloud_from_model
    turn = float(np.degrees(np.arccos(np.clip((np.trace(gap.rotation) - 1) / 2, -1, 1))))
    claimed = (
        ""
        if answer.covariance is None
        else f" (sigma {two_digits(float(np.sqrt(np.trace(answer.covariance[:3, :3]))))} mm)"
    )
    return [
        Deviation(
            f"pose of the bracket, position{claimed}", float(np.linalg.norm(gap.translation)), 0.0, "mm", answer.why
        ),
        Deviation("pose of the bracket, orientation", turn, 0.0, "deg"),
    ]


def _bracket(path: Path) -> Array:
    """Write the mesh of the two blocks of the design, one closed shell standing on z = 0, and return its vertices."""
    import trimesh

    outline = np.array([(-17, 0), (17, 0), (17, 6), (-9, 6), (-9, 16), (-17, 16)], dtype=np.float64)  # x, z
    n = len(outline)
    vertices = np.concatenate([np.insert(outline, 1, y, axis=1) for y in (-13.0, 13.0)])
    cap = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    faces = [*cap, *((c + n, b + n, a + n) for a, b, c in cap)]
    for k in range(n):
        after = (k + 1) % n
        faces += [(after, k, k + n), (after, k + n, after + n)]
    trimesh.Trimesh(vertices, faces).export(path)
    return vertices


def _page(calibration: Calibration, found: Scan, deviations: list[Deviation], skipped: str) -> str:
    page = Page("SCOPE demo: a simulated rig, measured, beside the truth")
    page.verdict("good" if calibration.result["passed"] else "bad", f"Calibration: {calibration.result['why']}.")
    page.heading("Deviations from the truth")
    page.table(
        ("result", "found", "true", "deviation"),
        [
            [
                d.what,
                rounded(d.found, max(abs(d.error), _FINEST)),
                f"{d.true:.6g}",
                f"{rounded(d.error, max(abs(d.error), _FINEST), sign=True)} {d.unit}",
            ]
            for d in deviations
        ],
    )
    if skipped:
        page.verdict("warn", skipped)
    page.heading("The cloud")
    page.cloud(
        cloud_scene(found.cloud).with_layers(rig_layers(calibration.rig)), "The cloud, and the rig that ranged it"
    )
    add_views(page, found.cloud)
    page.heading("From the images")
    seen = calibration.measured[0]
    page.image(
        with_marks(seen.image, seen.marks.pixels, [(u, v) for u, v, _ in seen.rejected], None),
        f"spots found on {seen.plan.name}",
        width=430,
    )
    if calibration.two_plane is not None:
        from calibration.verification import block_image

        fit = calibration.two_plane
        length = np.linalg.norm(fit.planes[0].residuals, axis=1)
        blocks = block_image(fit.marks[0].pixels, length, fit.camera.size)
        page.image(grey_blocks(blocks, enlarge=2), f"fit error, up to {length.max():.3f} px", width=430)
    view = calibration.views[0]
    page.image(with_stripe(view.image, view.pixels), f"stripe on {view.plane}", width=430)
    return page.html()
