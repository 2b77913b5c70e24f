"""`scope pose` and `scope check` from files to results: what the commands print and write."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.atomic import written_whole
from calibration.errors import FileError
from calibration.geometry import Pose
from scope import ply
from scope.artefact import ArtefactCheck, Repeatability
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.pose import PoseResult
from scope.pose_report import CONVENTION, deviation_text, pose_json, pose_page
from scope.pose_surface import Surface


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A pose in the frames that were asked for; None where there is no pose or the cloud does not know the sensor."""

    result: PoseResult
    camera_from_model: Pose | None
    robot_from_model: Pose | None
    at: int | None  # frame


def read_transform(path: Path) -> Pose:
    """Pose of a JSON file: a 4x4 row-major list (mm), or an object with it under ``matrix`` or ``cloud_from_model``.

    Raises
    ------
    FileError
        No such file, no JSON, or a matrix that is not rigid.
    """
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); give a JSON file with a 4x4 matrix") from error
    except ValueError as error:
        raise FileError(f"{path}: is no JSON ({error}); give a 4x4 matrix, row by row, mm") from error
    rows = held.get("matrix", held.get("cloud_from_model")) if isinstance(held, dict) else held
    try:
        return Pose.from_matrix(np.array(rows, dtype=np.float64))
    except (ValueError, TypeError) as error:
        raise FileError(
            f"{path}: holds no rigid 4x4 matrix: {error}; give [[r, r, r, x], ..., [0, 0, 0, 1]], mm"
        ) from error


def frame_of(cloud: ScanCloud, at: str) -> int | None:
    """Frame number of ``last``, ``first`` or a number; None for the first two where the cloud knows no sensor.

    Raises
    ------
    ValueError
        Any other word.
    MeasurementError
        A frame that the cloud does not know.
    """
    known = None if cloud.sensors is None or len(cloud.sensors) == 0 else cloud.sensors.frame
    if at in ("last", "first"):
        if known is None:
            return None
        return int(known.max() if at == "last" else known.min())
    if not at.isdecimal():
        raise ValueError(f"--at {at!r} is neither last nor first nor the number of a frame")
    if known is None or int(at) not in known:
        told = "no frames at all" if known is None else f"frames {known.min()} to {known.max()}"
        raise MeasurementError(f"the cloud has no frame {at}: it knows {told}; choose one of them with --at")
    return int(at)


def place(cloud: ScanCloud, result: PoseResult, at: str, robot_from_camera: Pose | None) -> Placed:
    """The pose in the camera's frame when frame ``at`` was taken, and in the robot's."""
    frame = frame_of(cloud, at)
    camera = None
    if frame is not None and result.cloud_from_model is not None and np.isfinite(cloud.camera_centre).all():
        camera = cloud.cloud_from_camera(frame).inverse @ result.cloud_from_model
    robot = robot_from_camera @ camera if robot_from_camera is not None and camera is not None else None
    return Placed(result, camera, robot, frame)


def pose_result(placed: Placed) -> dict[str, Any]:
    """What --json gives."""
    result = placed.result
    poses = {
        "cloud_from_model": result.cloud_from_model,
        "camera_from_model": placed.camera_from_model,
        "robot_from_model": placed.robot_from_model,
    }
    axis = None
    if result.axis is not None:
        axis = {"point_mm": result.axis[0].tolist(), "direction": result.axis[1].tolist(), "frame": "cloud"}
    known = result.uncertainty
    return {
        **{name: None if pose is None else pose.matrix.tolist() for name, pose in poses.items()},
        "at": placed.at,
        "found": result.found,
        "ambiguous": result.ambiguous,
        "why": result.why,
        "tell_apart": result.tell_apart or None,
        "covariance": None if result.covariance is None else result.covariance.tolist(),
        "covariance_random": None if known is None or not result.found else known.random.tolist(),
        "covariance_calibration": None if known is None or not result.found else known.shared.tolist(),
        "loose": [] if known is None else list(known.loose),
        "score": result.score,
        "rmse_mm": result.rmse_mm,
        "symmetry_axis": axis,
        "equivalent": []
        if result.cloud_from_model is None
        else [(result.cloud_from_model @ motion).matrix.tolist() for motion in result.model.symmetries],
        "notations": {name: pose_json(pose) for name, pose in poses.items() if pose is not None},
        "candidates": [
            {
                "cloud_from_model": c.cloud_from_model.matrix.tolist(),
                "explained": c.explained,
                "blocked": c.blocked,
                "covered": c.covered,
                "behind": c.behind,
            }
            for c in result.candidates
        ],
        "points": len(result.points),
        "others": [
            {"cloud_from_model": o.cloud_from_model.matrix.tolist(), "score": o.score, "rmse_mm": o.rmse_mm}
            for o in result.others
            if o.cloud_from_model is not None
        ],
        "convention": CONVENTION,
    }


def pose_text(placed: Placed) -> str:
    """What a person reads on the terminal."""
    result = placed.result
    if result.cloud_from_model is None:
        kind = "ambiguous" if result.ambiguous else "refused"
        return "\n".join(filter(None, [f"{kind}: {result.why}", result.tell_apart]))
    lines = [f"found: {result.why}; rms {result.rmse_mm:.3f} mm over {len(result.points)} points"]
    named = [("cloud", result.cloud_from_model), (f"camera at frame {placed.at}", placed.camera_from_model)]
    for name, pose in [*named, ("robot", placed.robot_from_model)]:
        if pose is not None:
            told = pose_json(pose)
            x, y, z = told["translation_mm"]
            roll, pitch, yaw = told["rpy_deg"]
            lines.append(
                f"{name}: x {x:.3f} y {y:.3f} z {z:.3f} mm, roll {roll:.3f} pitch {pitch:.3f} yaw {yaw:.3f} deg"
            )
    if result.covariance is not None:
        sd = np.sqrt(np.diag(result.covariance))
        lines.append(
            f"one sigma: {np.array2string(sd[:3], precision=4)} mm, {np.array2string(np.degrees(sd[3:]), precision=4)} deg"
        )
    if result.axis is not None:
        lines.append("the part may be turned freely about its axis of revolution")
    if result.others:
        lines.append(f"{len(result.others)} further part(s) of the same kind")
    lines.append(deviation_text(result.deviation))
    return "\n".join(lines)


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
        points = cloud.points[result.points][:: max(1, len(result.points) // 20_000)]
        for k, candidate in enumerate(result.candidates[:2]):
            inverse = candidate.cloud_from_model.inverse
            pose = (
                result.cloud_from_model
                if k == 0 and result.cloud_from_model is not None
                else candidate.cloud_from_model
            )
            inverse = pose.inverse
            deviation = surface.signed_distance(inverse.apply(points))
            ghost = result.model.samples[::4]
            both = np.concatenate([inverse.apply(points), ghost])
            values = np.concatenate([np.clip(deviation, -1, 1), np.full(len(ghost), np.nan)])
            name = "Best pose" if k == 0 else "Runner-up"
            shown.append(
                (f"{name}: scan on the model, coloured by its deviation within +-1 mm; the mesh in grey", both, values)
            )
    words = pose_text(placed).replace("\n", "; ")
    return pose_page(f"Pose of {result.model.name}", result.found, words, result.tell_apart, rows, shown)


def write_deviation(path: Path, cloud: ScanCloud, result: PoseResult) -> None:
    """A PLY of the part's points with their signed distance (mm, outside positive) from the model at the best pose."""
    if not result.candidates:
        raise MeasurementError(f"{path}: there is no pose to compare with ({result.why}); nothing was written")
    points = cloud.points[result.points]
    rows = np.zeros(len(points), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("deviation", "<f4")])
    rows["x"], rows["y"], rows["z"] = points.T
    rows["deviation"] = result.deviation
    with written_whole(path) as stream:
        ply.write(
            stream, ply.Ply({"vertex": rows}, ("units mm", f"deviation from {result.model.name}, mm, outside positive"))
        )


def check_result(check: ArtefactCheck) -> dict[str, Any]:
    """What `scope check --json` gives of one scan."""
    return {
        "artefact": check.artefact.kind,
        "error_mm": check.error_mm,
        "form_mm": check.form_mm,
        "rms_mm": check.rms_mm,
        "linearity_percent": check.linearity_percent,
        "span_mm": check.span_mm,
        "points": check.points,
        "within": check.within,
        "within_claimed_uncertainty": check.claimed,
        "sizes": [
            {
                "name": s.name,
                "nominal": s.nominal,
                "measured": s.measured,
                "error": s.error,
                "uncertainty": s.uncertainty,
                "uncertainty_parts": {"scatter": s.scatter, "calibration": s.calibration, "slope": s.slope},
            }
            for s in check.sizes
        ],
    }


def check_text(check: ArtefactCheck) -> str:
    """One scan of an artefact for a person."""
    lines = [
        f"{s.name}: {s.measured:.4f} mm, nominal {s.nominal:g}, error {s.error:+.4f} (claimed uncertainty {s.uncertainty:.4f}, k = 2)"
        for s in check.sizes
    ]
    linearity = (
        f"{check.linearity_percent:.4f} % of {check.span_mm:.1f} mm"
        if np.isfinite(check.linearity_percent)
        else "not covered"
    )
    lines.append(
        f"error {check.error_mm:+.4f} mm, form (95 %) {check.form_mm:.4f} mm, rms {check.rms_mm:.4f} mm, linearity {linearity}, "
        f"{check.points} points"
    )
    if check.claimed is False:
        lines.append(
            "the error is larger than the claimed uncertainty: look for what neither noise nor calibration explains"
        )
    if check.within is not None:
        lines.append("within tolerance" if check.within else "OUT OF TOLERANCE")
    return "\n".join(lines)


def repeat_result(repeat: Repeatability) -> dict[str, Any]:
    """What `scope check --json` gives of several scans: the worst one's keys, all scans, and how they repeat."""
    worst = max(repeat.checks, key=lambda c: abs(c.error_mm))
    return {
        **check_result(worst),
        "scans": [check_result(c) for c in repeat.checks],
        "repeatability_mm": repeat.worst_mm,
        "deviations_mm": list(repeat.deviation_mm),
    }


def out_of_tolerance(checks: Sequence[ArtefactCheck]) -> bool:
    """Whether any scan of an artefact is out of the tolerance given."""
    return any(c.within is False for c in checks)
