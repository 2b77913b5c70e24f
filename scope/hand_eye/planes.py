"""Hand and eye by stripes across planes that stand still, where no target can be seen: images to passes, passes to the answer."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Bools, Pose
from calibration.notation import NOTATIONS, numbers_of
from calibration.rig import Rig
from calibration.stages import Pass, PlanesFit, solve_by_planes
from scope.hand_eye.covariance import by_place_first
from scope.session import HandEye, HandEyePlan

_LEAST = 40  # points of a pass
_TRIALS = 200
_SHARE = 0.3  # of a stripe's points that lie on its line, at least
_NEAR = 4.0  # sigma of a point, within which it lies on the line


def on_line(points: Array, sigma: Array) -> Bools:
    """Which points (n, 3) mm of a stripe lie on the straight line that most lie on; ``CalibrationError`` where too few do."""
    if len(points) < _LEAST:
        raise CalibrationError(f"{len(points)} points of a stripe; {_LEAST} on the plane are needed")
    rng = np.random.default_rng(0)
    near = _NEAR * max(float(np.median(sigma)), 1e-3)
    best = np.zeros(len(points), dtype=bool)
    for _ in range(_TRIALS):
        i, j = rng.integers(len(points), size=2)
        along = points[j] - points[i]
        length = float(np.linalg.norm(along))
        if length < 1e-6:
            continue
        arm = points - points[i]
        on = np.linalg.norm(arm - np.outer(arm @ along / length**2, along), axis=1) < near
        if on.sum() > best.sum():
            best = on
    if best.sum() < max(_LEAST, _SHARE * len(points)):
        raise CalibrationError(
            f"no straight part in its stripe ({int(best.sum())} of {len(points)} points on a line): let it cross one flat face alone"
        )
    middle = points[best].mean(axis=0)
    along = np.linalg.svd(points[best] - middle, full_matrices=False)[2][0]
    arm = points - middle
    return np.asarray(np.linalg.norm(arm - np.outer(arm @ along, along), axis=1) < near)


def planes_answer(plan: HandEyePlan, rig: Rig, passes: list[Pass], dropped: list[dict[str, Any]]) -> HandEye:
    """Answer; ``CalibrationError`` where nothing follows."""
    names = sorted({plan.plane_of(p.name) for p in passes})
    fit = solve_by_planes(
        passes, [names.index(plan.plane_of(p.name)) for p in passes], plan.mount, repeatability=plan.repeatability
    )
    used = int(sum(fit.used))
    for p, use, loo in zip(passes, fit.used, fit.loo_mm, strict=True):
        if not use:
            reason = f"its points are {loo:.3g} mm (rms) from where the other passes put the plane: wrong row, wrong plane, or the arm moved"
            dropped.append({"part": "view", "name": p.name, "reason": reason, "count": 1})
    loo = float(np.median([v for v, u in zip(fit.loo_mm, fit.used, strict=True) if u]))
    passed, why = True, f"{used} of {len(passes)} passes agree; left out in turn they are off by {loo:.2g} mm (median)"
    if used < 0.6 * len(passes) + 1e-9 and used < len(passes):
        passed, why = (
            False,
            f"only {used} of {len(passes)} passes agree: check units, notation and gives, and which plane each image shows",
        )
    elif fit.robot.mm > 10.0:
        passed, why = (
            False,
            f"the passes contradict the poses by {fit.robot.mm:.3g} mm: check units, notation and gives of the log",
        )
    elif used < 12:
        passed, why = (
            False,
            f"{used} passes leave too little to tell whether one of them is wrong; add passes, 20 are wanted",
        )
    elif plan.loo_mm is not None and not loo <= plan.loo_mm:
        passed, why = (
            False,
            f"left out in turn, passes are off by {loo:.3g} mm (median); accept.loo_mm allows {plan.loo_mm:g}",
        )
    return _answer(rig, fit, names, passes, dropped, (passed, why), loo)


def _answer(
    rig: Rig,
    fit: PlanesFit,
    names: list[str],
    passes: list[Pass],
    dropped: list[dict[str, Any]],
    verdict: tuple[bool, str],
    loo: float,
) -> HandEye:
    told = {
        "by": "planes",
        "planes": {
            name: {"normal": n.tolist(), "offset": float(d)}
            for name, n, d in zip(names, fit.normals, fit.offsets, strict=True)
        },
        "covariance_target": None,
        "rms_mm": fit.rms_mm,
        "loo_mm": loo,
        "repeatability": "stated" if fit.robot_stated else "from the scatter of the views",
        "views": [
            {"name": p.name, "used": u, "loo_mm": v} for p, u, v in zip(passes, fit.used, fit.loo_mm, strict=True)
        ],
        "notations": {name: numbers_of(name, fit.sensor).tolist() for name in NOTATIONS},
        "dropped": dropped,
        "warnings": [],
    }
    n = fit.normals[0]
    axes = np.linalg.svd(n[None])[2][1:]
    turn = np.stack([axes[0], np.cross(n, axes[0]), n], axis=1)
    target = Pose(turn, fit.offsets[0] * n)  # the first plane is z = 0 of it
    return HandEye(
        fit.mount,
        fit.sensor,
        target,
        by_place_first(fit.covariance),
        fit.robot,
        rig.sha256,
        verdict[0],
        verdict[1],
        told,
    )
