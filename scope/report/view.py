"""A cloud or a rig as a page to be turned in the browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array, Rays
from calibration.rig import Rig
from scope.cloud import READ, ScanCloud, unknown
from scope.report.page import Page
from scope.report.scan import about_cloud, add_uncertainty, add_views

_GRID = 16  # rays along the longer side of the image
_ALONG = 300  # points of a ray
_SHEET = 160  # rays along the longer side of the image, that meet a sheet


def view_page(path: Path, *, allow_edited: bool = False) -> str:
    """One self-contained HTML page of a cloud or of a rig (JSON); ``FileError`` for anything else."""
    ending = path.suffix.lower()
    if ending == ".json":
        return _rig_page(path, Rig.load(path, allow_edited=allow_edited))
    if ending in READ:
        return _cloud_page(path, ScanCloud.load(path))
    raise FileError(f"{path}: neither a cloud nor a rig; give a cloud, such as the .ply of scope scan, or a rig.json")


def _cloud_page(path: Path, cloud: ScanCloud) -> str:
    page = Page(f"SCOPE cloud {path.name}")
    if len(cloud) == 0:
        page.verdict("warn", "The cloud is empty.")
        return page.html()
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    size = " x ".join(f"{x:.2f}" for x in high - low)
    text = f"{len(cloud)} points within {size} mm"
    if cloud.rig_sha256:
        state = "verified rig" if cloud.verified else "rig that is not verified: do not use it"
        text += f"; {'complete' if cloud.complete else 'incomplete'}, from a {state}"
    page.verdict("good" if cloud.verified and cloud.complete else "warn", f"{text}.")
    if unread := unknown(cloud, path.name):
        page.text(unread)
    page.cloud(cloud.points, cloud.points[:, 2], "Coloured by z. Drag to turn, wheel to zoom, shift-drag to move")
    add_views(page, cloud)
    if np.isfinite(cloud.sigma).any():
        add_uncertainty(page, cloud)
    about_cloud(page, cloud)
    return page.html()


def _rig_page(path: Path, rig: Rig) -> str:
    page = Page(f"SCOPE rig {path.name}")
    verified = rig.verification
    page.verdict(
        "good" if verified.passed else "bad", f"{'Passed' if verified.passed else 'Not passed'}: {verified.why}."
    )
    if not rig.sealed:
        page.verdict("warn", "This rig has no seal (it is of an earlier version): an alteration would not be seen.")
    points, number = _rig_points(rig)
    if len(points):
        page.cloud(points, number, "Sighting rays and sheets of light within the calibrated volume, in C, mm")
    page.heading("Lasers")
    rows = []
    for name, laser in rig.lasers.items():
        normal = ", ".join(f"{x:.5f}" for x in laser.plane.normal)
        rows.append([name, laser.along, laser.channel, normal, f"{laser.plane.offset:.3f}", f"{laser.rms_mm:.4f}"])
    page.table(("laser", "runs along", "read in", "normal", "offset, mm", "rms, mm"), rows)
    page.about_rig(rig, path.name)
    return page.html()


def _rays(rig: Rig, step: float) -> Rays:
    """Sighting rays of every ``step``-th pixel."""
    width, height = rig.camera.size
    u, v = np.meshgrid(np.arange(step / 2, width, step), np.arange(step / 2, height, step))
    return rig.camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))


def _rig_points(rig: Rig) -> tuple[Array, Array]:
    """Points (N, 3) mm within the calibrated volume, 0 for those on rays and 1, 2 ... for those on the sheets."""
    longer = max(rig.camera.size)
    sheets = [laser.sheet.intersect(_rays(rig, longer / _SHEET)).points for laser in rig.lasers.values()]
    lit = np.concatenate([np.zeros((0, 3)), *sheets])
    lit = lit[rig.camera.volume.contains(lit)]
    rays = _rays(rig, longer / _GRID)
    middle = np.median((lit - rays.origin[0]) @ rays.direction[len(rays) // 2]) if len(lit) else 1e3
    along = np.linspace(0.0, 2.0 * float(middle), _ALONG)
    sighted = (rays.origin[:, None] + along[None, :, None] * rays.direction[:, None]).reshape(-1, 3)
    parts = [sighted, *sheets]
    number = np.repeat(np.arange(len(parts), dtype=np.float64), [len(part) for part in parts])
    points = np.concatenate(parts)
    inside = rig.camera.volume.contains(points)
    return points[inside], number[inside]
