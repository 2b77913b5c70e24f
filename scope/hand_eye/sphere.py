"""Hand and eye by stripes across a sphere, where no target can be seen: images to passes, passes to the answer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import CalibrationError, FileError, ScopeError
from calibration.geometry import Array, Bools, Pose
from calibration.notation import NOTATIONS, numbers_of
from calibration.rig import Rig
from calibration.stages import Pass, SphereFit, solve_by_sphere
from ranging.profile import Profile
from scope.hand_eye.agreement import Wording, judged
from scope.hand_eye.covariance import by_place_first
from scope.hand_eye.planes import on_line
from scope.scanning import Scanner
from scope.session import HandEye, HandEyePlan, read_image

_LEAST = 40  # points of a pass
_TRIALS = 300
_LOW, _HIGH = 0.25, 1.01  # radii of a circle of the sphere, over the sphere's
_ARC = 8  # of 36 parts of the circle that must be seen

_WORDS = Wording(
    contradicts="where the other passes put the sphere: wrong row, or the arm moved",
    few_agree="that rows and images belong together",
    apart=", and the diameter",
    least=8,
    wanted=15,
)


def passes_of(plan: HandEyePlan, rig: Rig, on_view: Any) -> tuple[list[Pass], list[dict[str, Any]]]:
    """Passes with a stripe on the sphere, or on a plane, and a pose, and what was left out."""
    scanner = Scanner(rig, laser=plan.laser or (next(iter(rig.lasers)) if len(rig.lasers) == 1 else None))
    found: list[Pass] = []
    dropped: list[dict[str, Any]] = []
    for done, plane in enumerate(plan.marks.planes, start=1):
        image = Path(str(plane.images[0]))
        try:
            pose = plan.pose_of(image)
            if pose is None:
                raise CalibrationError(f"no row of {plan.log.path.name} names {image.name}")
            profile = scanner.profile(read_image(image))
            good = np.asarray(np.isfinite(profile.points).all(axis=1))
            points, sigma = profile.points[good], profile.sigma[good]
            on = on_line(points, sigma) if plan.radius is None else on_sphere(points, plan.radius)
            pixels = _pixels(profile, good, rig.lasers[profile.laser].along)
            ray = rig.camera.rays(pixels, near=points[:, 2] if rig.camera.model == "two-plane" else None).direction
            found.append(Pass(plane.name, pose, points[on], ray[on], sigma[on]))
        except FileError:
            raise
        except ScopeError as error:
            dropped.append({"part": "view", "name": plane.name, "reason": str(error), "count": 1})
        on_view(done, len(plan.marks.planes))
    return found, dropped


def on_sphere(points: Array, radius: float) -> Bools:
    """Which points (n, 3) mm of a stripe lie on a sphere: the circle, not larger than it, that most lie on and that bulges to the camera.

    ``CalibrationError`` where too few do.
    """
    if len(points) < _LEAST:
        raise CalibrationError(f"{len(points)} points of a stripe; {_LEAST} on the sphere are needed")
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    flat = (points - middle) @ axes[:2].T
    rng = np.random.default_rng(0)
    pick = np.sort(rng.integers(len(flat), size=(_TRIALS, 2)), axis=1)
    near = np.minimum(pick[:, 0] + 1 + (pick[:, 1] - pick[:, 0]) // 2, len(flat) - 1)
    best = np.zeros(len(flat), dtype=bool)
    for i, j, k in zip(pick[:, 0], near, pick[:, 1], strict=True):
        centre, size = _through(flat[[i, j, k]])
        if not _LOW * radius < size < _HIGH * radius:
            continue
        on = np.abs(np.linalg.norm(flat - centre, axis=1) - size) < 0.01 * radius
        if on.sum() > best.sum():
            away = float(np.linalg.norm(middle + centre @ axes[:2])) - float(np.linalg.norm(points[on], axis=1).mean())
            if away > 0:  # its middle is further away than its points
                best = on
    if best.any():  # once more, from all of them
        a = np.column_stack([2 * flat[best], np.ones(int(best.sum()))])
        x = np.linalg.lstsq(a, (flat[best] ** 2).sum(axis=1), rcond=None)[0]
        size = float(np.sqrt(max(x[2] + x[:2] @ x[:2], 0.0)))
        off = np.abs(np.linalg.norm(flat - x[:2], axis=1) - size)
        best = off < max(4.0 * 1.4826 * float(np.median(off[best])), 0.001 * radius)
        turn = np.arctan2(*(flat[best] - x[:2]).T)
        seen = len(np.unique(np.floor((turn + np.pi) / (np.pi / 18))))
        if best.sum() >= _LEAST and seen >= _ARC and _LOW * radius < size < _HIGH * radius:
            return np.asarray(best)
    raise CalibrationError(
        f"no arc of a sphere of diameter {2 * radius:g} mm in its stripe ({int(best.sum())} points): let the stripe cross the sphere"
    )


def sphere_answer(plan: HandEyePlan, rig: Rig, passes: list[Pass], dropped: list[dict[str, Any]]) -> HandEye:
    """Answer; ``CalibrationError`` where nothing follows."""
    fit = solve_by_sphere(passes, plan.radius or 0.0, plan.mount, repeatability=plan.repeatability)
    passed, why, loo = judged(plan, fit, passes, dropped, _WORDS)
    return _answer(rig, fit, passes, dropped, passed, why, loo)


def _answer(
    rig: Rig, fit: SphereFit, passes: list[Pass], dropped: list[dict[str, Any]], passed: bool, why: str, loo: float
) -> HandEye:
    told = {
        "by": "sphere",
        "covariance_target": fit.covariance[6:, 6:].tolist(),
        "rms_mm": fit.rms_mm,
        "loo_mm": loo,
        "repeatability": "stated" if fit.robot_stated else "from the scatter of the views",
        "views": [{"name": p.name, "used": u, "loo_mm": v} for p, u, v in zip(passes, fit.used, fit.loo_mm, strict=True)],
        "notations": {name: numbers_of(name, fit.sensor).tolist() for name in NOTATIONS},
        "dropped": dropped,
        "warnings": [],
    }  # fmt: skip
    covariance = by_place_first(fit.covariance[:6, :6])
    return HandEye(
        fit.mount, fit.sensor, Pose(np.eye(3), fit.centre), covariance, fit.robot, rig.sha256, passed, why, told
    )


def _pixels(profile: Profile, good: Bools, along: str) -> Array:
    line, position = np.flatnonzero(good).astype(np.float64), profile.position[good]
    return np.stack([line, position] if along == "rows" else [position, line], axis=1)


def _through(three: Array) -> tuple[Array, float]:
    """Circle through three points (3, 2); radius inf where they lie on a line."""
    a = 2.0 * (three[1:] - three[0])
    b = (three[1:] ** 2).sum(axis=1) - (three[0] ** 2).sum()
    if abs(np.linalg.det(a)) < 1e-12:
        return np.zeros(2), float("inf")
    centre = np.linalg.solve(a, b)
    return centre, float(np.linalg.norm(three[0] - centre))
