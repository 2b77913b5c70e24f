"""Hand and eye by stripes across planes that stand still, where no target can be seen: images to passes, passes to the answer."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Bools, Pose
from calibration.notation import NOTATIONS, numbers_of
from calibration.rig import Rig
from calibration.stages import Pass, PlanesFit, solve_by_planes
from scope.hand_eye.agreement import Wording, judged
from scope.hand_eye.covariance import by_place_first
from scope.session import HandEye, HandEyePlan

_LEAST = 40  # points of a pass
_TRIALS = 200
_SHARE = 0.3  # of a stripe's points that lie on its line, at least
_NEAR = 4.0  # sigma of a point, within which it lies on the line

_WORDS = Wording(
    contradicts="where the other passes put the plane: wrong row, wrong plane, or the arm moved",
    few_agree="which plane each image shows",
    apart="",
    least=12,
    wanted=20,
)


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
    passed, why, loo = judged(plan, fit, passes, dropped, _WORDS)
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
