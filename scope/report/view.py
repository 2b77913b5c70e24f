"""A cloud, a rig, or a cloud with the rig that ranged it, as a page to be turned in the browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array
from calibration.rig import Rig
from scope.cloud import READ, ScanCloud, other_scalars, unknown
from scope.report.page import Page
from scope.report.scan import about_cloud, add_uncertainty, add_views
from scope.viewer import Scalar, cloud_scene, rig_layers, rig_scene

_LIMIT = 6_000_000  # points in one page: beyond, browsers run out of memory


def view_page(path: Path, *, rig: Path | None = None, allow_edited: bool = False) -> str:
    """One self-contained HTML page of a cloud, with its rig where one is given, or of a rig (JSON).

    ``FileError`` for anything else.
    """
    ending = path.suffix.lower()
    if ending == ".json":
        if rig is not None:
            raise FileError(f"{path}: a rig is shown without another; give a cloud beside --rig, or this rig alone")
        return _rig_page(path, Rig.load(path, allow_edited=allow_edited))
    if ending in READ:
        return _cloud_page(
            path, ScanCloud.load(path), None if rig is None else Rig.load(rig, allow_edited=allow_edited)
        )
    raise FileError(f"{path}: neither a cloud nor a rig; give a cloud, such as the .ply of scope scan, or a rig.json")


def _cloud_page(path: Path, cloud: ScanCloud, rig: Rig | None) -> str:
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
    if rig is not None and cloud.rig_sha256 and rig.sha256 and cloud.rig_sha256 != rig.sha256:
        page.verdict("warn", "The rig that is shown is not the one that ranged this cloud.")
    scene = cloud_scene(
        cloud, first=[_scalar(name, values) for name, values in other_scalars(path, len(cloud)).items()]
    )
    told = "The cloud, with everything that its file says of each point"
    if rig is not None:
        scene, told = scene.with_layers(rig_layers(rig)), f"{told}, and the rig in C"
    page.cloud(scene, told, limit=_LIMIT)
    add_views(page, cloud)
    if np.isfinite(cloud.sigma).any():
        add_uncertainty(page, cloud)
    about_cloud(page, cloud)
    return page.html()


def _scalar(name: str, values: Array) -> Scalar:
    """A scalar of a file, in mm about zero where its name says that it is a deviation."""
    signed = any(word in name.lower() for word in ("deviation", "residual", "distance"))
    return Scalar(name, values, "mm" if signed else "", kind="diverging" if signed else "sequential")


def _rig_page(path: Path, rig: Rig) -> str:
    page = Page(f"SCOPE rig {path.name}")
    verified = rig.verification
    page.verdict(
        "good" if verified.passed else "bad", f"{'Passed' if verified.passed else 'Not passed'}: {verified.why}."
    )
    if not rig.sealed:
        page.verdict("warn", "This rig has no seal (it is of an earlier version): an alteration would not be seen.")
    page.cloud(rig_scene(rig), "Camera, sighting rays, calibrated volume, sheets of light and axes, in C, mm")
    page.heading("Lasers")
    rows = []
    for name, laser in rig.lasers.items():
        normal = ", ".join(f"{x:.5f}" for x in laser.plane.normal)
        rows.append([name, laser.along, laser.channel, normal, f"{laser.plane.offset:.3f}", f"{laser.rms_mm:.4f}"])
    page.table(("laser", "runs along", "read in", "normal", "offset, mm", "rms, mm"), rows)
    page.about_rig(rig, path.name)
    return page.html()
