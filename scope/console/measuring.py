"""Measurements of a session's clouds: what the commands roughness, pose and check give, as jobs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibration.atomic import write_text
from calibration.errors import FileError
from scope.cloud import ScanCloud, parse_region
from scope.console.folder import MODELS, SessionFolder


def roughness(cloud: Path, region: str | None) -> dict[str, Any]:
    """Roughness of a region, with the page of the command beside the cloud."""
    from scope.report import roughness_page
    from scope.roughness import options_from_text, run_roughness

    options = options_from_text("auto", s_filter=None, l_filter=None, stripe_width=None, cloud_from_model=None)
    patches = run_roughness(cloud, [parse_region(region)] if region else [("cloud", None)], options)
    write_text(cloud.parent / "roughness.html", roughness_page(patches, cloud.name))
    patch = patches[0]
    rows = []
    for key, found in patch.areal.items():
        text = "-" if found.value is None else f"{found.value:.4g}"
        text += "" if found.value is None or found.uncertainty is None else f" ± {found.uncertainty:.2g}"
        rows.append((key, text, found.unit, found.reason if found.value is None else ""))
    told = "valid" if patch.valid else "not to be used: Sq is withheld or uncertain by half of itself"
    return {
        "good": bool(patch.valid),
        "told": told,
        "head": ("parameter", "value, k = 2", "unit", ""),
        "rows": rows,
        "figures": {},
    }


def pose(cloud: Path, model: Path, region: str | None) -> dict[str, Any]:
    """Pose of a part, anywhere or within a region, with the page of the command beside the cloud; matrices as ``scope pose --json`` prints them."""
    from scope.pose import estimate_pose, place, pose_result
    from scope.report import pose_html

    scan = ScanCloud.load(cloud)
    found = estimate_pose(scan, model, region=parse_region(region)[1] if region else None)
    placed = place(scan, found, "last", None)
    write_text(cloud.parent / "pose.html", pose_html(scan, placed))
    content = pose_result(placed)
    rows = []
    if content["cloud_from_model"] is not None:
        matrix = np.asarray(content["cloud_from_model"], dtype=np.float64)
        rows = [("x, y, z", ", ".join(f"{v:.3f}" for v in matrix[:3, 3]), "mm")]
        rows += [(f"row {k + 1} of the rotation", ", ".join(f"{v:.5f}" for v in matrix[k, :3]), "") for k in range(3)]
    if content.get("rmse_mm") is not None:
        rows.append(("rms distance", f"{content['rmse_mm']:.4f}", "mm"))
    why = str(content.get("why") or "")
    told = "found" if found.found else f"not to be used: {why or 'the pose is not sure'}"
    return {
        "good": bool(found.found),
        "told": told,
        "head": ("of the part", "value", "unit"),
        "rows": rows,
        "pose": content,
        "figures": {},
    }


def check(cloud: Path, artefact: str, tolerance: float | None, region: str | None) -> dict[str, Any]:
    """Errors of a scan of a known artefact."""
    from scope.check import Artefact, check_artefact, check_result, out_of_tolerance
    from scope.report import check_page

    if artefact.strip().startswith("mesh:"):
        raise ValueError("choose a plane, sphere, cylinder or steps; a mesh is checked by scope check")
    known = Artefact.parse(artefact)
    if tolerance is not None and not tolerance > 0:
        raise ValueError(f"tolerance {tolerance:g} must be positive, mm")
    scan = ScanCloud.load(cloud)
    found = check_artefact(scan, known, tolerance=tolerance, region=parse_region(region)[1] if region else None)
    write_text(cloud.parent / "check.html", check_page((found,), [(cloud.parent.name, scan)], tolerance=tolerance))
    content = check_result(found)
    rows = [
        (size["name"], f"{size['measured']:.4f}", f"{size['error']:+.4f} ± {size['uncertainty']:.4f}")
        for size in content["sizes"]
    ]
    rows += [("form", f"{content['form_mm']:.4f}", "")] if content.get("form_mm") is not None else []
    bad = out_of_tolerance((found,))
    told = (
        "out of tolerance: do not rely on this scanner before it is calibrated again"
        if bad
        else "within tolerance"
        if tolerance
        else "measured"
    )
    return {
        "good": not bad,
        "told": told,
        "head": ("size", "measured, mm", "error, k = 2, mm"),
        "rows": rows,
        "check": content,
        "tolerance_mm": tolerance,
    }


def keep_model(folder: SessionFolder, name: str, data: bytes) -> str:
    """Write a mesh into the session's folder ``models``; ``FileError`` for a name or ending that is not taken."""
    from calibration.atomic import written_whole

    path = folder.inside("models", name)
    if path.suffix.lower() not in MODELS:
        raise FileError(f"a model ends in {', '.join(MODELS)}; convert it")
    path.parent.mkdir(exist_ok=True)
    with written_whole(path) as stream:
        stream.write(data)
    return name
