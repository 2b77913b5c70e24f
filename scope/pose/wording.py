"""A pose in words and in JSON that robots read."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.digits import decimals, two_digits
from calibration.geometry import Array, Pose, quaternion_from_rotation
from calibration.notation import COLUMNS, NOTATIONS, Notation, numbers_of, roll_pitch_yaw
from scope.pose.placed import Placed
from scope.variants import Undecided, Variant


def pose_json(pose: Pose) -> dict[str, Any]:
    """One transform in every notation, mm: 4x4 by rows, translation with quaternion and with angles, and as robots take it.

    Those of robots are lists under the names of `calibration.notation`, in the order of its columns.
    """
    return {
        "matrix": pose.matrix.tolist(),
        "translation_mm": pose.translation.tolist(),
        "quaternion_wxyz": quaternion_from_rotation(pose.rotation).tolist(),
        "rpy_deg": np.degrees(roll_pitch_yaw(pose.rotation)).tolist(),
        **{name: numbers_of(name, pose).tolist() for name in NOTATIONS if name != "matrix"},
    }


CONVENTION = (
    "a_from_b maps points of b to a: x_a = R x_b + t, 4x4 row-major, mm. quaternion w x y z. rpy: degrees about the fixed "
    "axes x, y, z in this order, R = Rz Ry Rx. covariance: 6x6 of (x, y, z mm, turns about x, y, z of the cloud, rad), the "
    "turns about the model's origin. Lists by name: "
    + "; ".join(f"{name} {' '.join(COLUMNS[name])}" for name in NOTATIONS if name != "matrix")
    + ": translations mm, ur turns rad, others degrees."
)


def deviation_text(deviation: Array) -> str:
    """Percentiles of signed distances in one line; points further than 2 mm are other things."""
    near = deviation[np.isfinite(deviation) & (np.abs(deviation) < 2.0)]
    if len(near) == 0:
        return "no point near the model"
    low, middle, high = np.percentile(near, [2.5, 50, 97.5])
    return f"95 % of the points lie between {low:+.3f} and {high:+.3f} mm of the mesh, median {middle:+.3f} mm"


def notations_text(pose: Pose) -> list[str]:
    """One line for each notation that robots take, numbers named in its order."""
    decimals: dict[Notation, int] = {"ur": 6, "kuka": 4, "fanuc": 4, "rpy-deg": 4}
    lines = []
    for name in NOTATIONS:
        if name == "matrix":
            continue
        numbers = zip(COLUMNS[name], numbers_of(name, pose), strict=True)
        told = " ".join(f"{c} {x:.{3 if c in 'xyz' else decimals.get(name, 7)}f}" for c, x in numbers)
        lines.append(f"  {name}: {told}")
    return lines


def variant_json(variant: Variant) -> dict[str, Any]:
    """How the part differs from its mesh; numbers are null where there are none (the mirror image)."""
    known = bool(np.isfinite(variant.size))
    return {
        "kind": variant.kind,
        "size": variant.size if known else None,
        "standard_error": variant.standard_error if known else None,
        "unit": variant.unit,
        "text": variant.text,
        "at_mm": None if variant.at is None else variant.at.tolist(),
        "alternatives": list(variant.alternatives),
    }


def undecided_text(undecided: tuple[Undecided, ...], *, most: int = 3) -> list[str]:
    """One line for all variants that one look would settle, the first ``most`` of them."""
    told: list[tuple[Array, list[str]]] = []
    for item in undecided:
        for look, names in told:
            if np.nan_to_num(look) @ np.nan_to_num(item.look_from) > 0.9:
                names.append(item.what)
                break
        else:
            told.append((item.look_from, [item.what]))
    lines = []
    for look, names in told[:most]:
        many = f" and {len(names) - 2} more" if len(names) > 2 else ""
        at = f"; look from ({', '.join(f'{x:.2f}' for x in look)}) of the cloud" if np.isfinite(look).all() else ""
        lines.append(f"undecided here: {', '.join(names[:2])}{many}{at}")
    return lines + ([f"undecided here: {len(told) - most} more, see --json"] if len(told) > most else [])


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
        "variant": None if result.variant is None else variant_json(result.variant),
        "undecided": [
            {
                "kind": u.kind,
                "what": u.what,
                "look_from": u.look_from.tolist() if np.isfinite(u.look_from).all() else None,
            }
            for u in result.undecided
        ],
        "faces": [
            {
                "what": face.what,
                "at_mm": face.at.tolist(),
                "direction": face.direction.tolist() if np.isfinite(face.direction).all() else None,
                "points": face.points,
                "mean_mm": face.mean,
                "standard_error_mm": face.error,
                "scatter_mm": face.scatter,
                "sigma_mm": face.stated if np.isfinite(face.stated) else None,
                "off": face.off,
            }
            for face in result.faces
        ],
        "points": len(result.points),
        "others": [
            {"cloud_from_model": o.cloud_from_model.matrix.tolist(), "score": o.score, "rmse_mm": o.rmse_mm}
            for o in result.others
            if o.cloud_from_model is not None
        ],
        "warnings": list(placed.warnings),
        "convention": CONVENTION,
    }


def _places(covariance: Array | None) -> tuple[int, int]:
    """Decimals of mm and of degrees that the errors of a pose allow; three of each where they are not known."""
    if covariance is None:
        return 3, 3
    sd = np.sqrt(np.diag(covariance))
    return decimals(float(sd[:3].min()), usual=3), decimals(float(np.degrees(sd[3:].min())), usual=3)


def pose_text(placed: Placed) -> str:
    """What a person reads on the terminal."""
    result = placed.result
    if result.cloud_from_model is None:
        kind = "refused" if result.variant is not None or not result.ambiguous else "ambiguous"
        other = "" if result.variant is None else "; ".join(f"or {t}" for t in result.variant.alternatives)
        return "\n".join(filter(None, [f"{kind}: {result.why}", other, result.tell_apart]))
    lines = [f"found: {result.why}; rms {result.rmse_mm:.3f} mm over {len(result.points)} points"]
    mm, deg = _places(result.covariance)
    named = [("cloud", result.cloud_from_model), (f"camera at frame {placed.at}", placed.camera_from_model)]
    for name, pose in [*named, ("robot", placed.robot_from_model)]:
        if pose is not None:
            told = pose_json(pose)
            x, y, z = told["translation_mm"]
            roll, pitch, yaw = told["rpy_deg"]
            lines.append(
                f"{name}: x {x:.{mm}f} y {y:.{mm}f} z {z:.{mm}f} mm, roll {roll:.{deg}f} pitch {pitch:.{deg}f} yaw {yaw:.{deg}f} deg"
            )
    told_of = [(name, pose) for name, pose in [*named, ("robot", placed.robot_from_model)] if pose is not None]
    lines.append(f"the part in the frame of the {told_of[-1][0]}, mm, in the notations of robots:")
    lines += notations_text(told_of[-1][1])
    if result.covariance is not None:
        sd = np.sqrt(np.diag(result.covariance))
        lines.append(
            f"one sigma: {' '.join(map(two_digits, sd[:3]))} mm, {' '.join(map(two_digits, np.degrees(sd[3:])))} deg"
        )
    if result.axis is not None:
        lines.append("the part may be turned freely about its axis of revolution")
    if result.others:
        lines.append(f"{len(result.others)} further part(s) of the same kind")
    lines.append(deviation_text(result.deviation))
    lines += undecided_text(result.undecided)
    return "\n".join(lines)
