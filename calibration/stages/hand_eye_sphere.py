"""Hand and eye without a target in the image: laser stripes across a sphere, seen from poses of the arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Pose, rotation_from_quaternion
from calibration.stages.hand_eye import Repeatability, require_arm_turns
from calibration.stages.hand_eye_start import Mount
from calibration.stages.hand_eye_system import moved, robot_covariance

_LEAST = 5  # passes
_STARTS = 150  # rotations that are tried
_BLOCKS = 24  # of a pass, over which gaps are averaged
_SLANT = 0.3  # of sigma, below which a slanted surface is not taken to be known better
_CHANCE = 0.01  # that a sound pass is left out, over all passes
_UNSURE = (5.0, np.deg2rad(2.0))  # mm, rad: one sigma beyond which nothing is determined
_USUAL = Repeatability(0.1, float(np.deg2rad(0.03)))  # whose ratio is taken where a robot's is not stated


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """One stripe across the sphere; n points."""

    name: str
    base_from_flange: Pose  # as the robot says
    points: Array  # (n, 3) mm, C
    ray: Array  # (n, 3) unit sighting rays, C
    sigma: Array  # (n,) mm along the ray


@dataclass(frozen=True, slots=True, eq=False)
class SphereFit:
    """Where the sensor is, by passes over a sphere of known size."""

    mount: Mount
    sensor: Pose  # flange_from_camera, or base_from_camera
    centre: Array  # (3,) mm, of the sphere: in the base, or in the flange
    covariance: Array  # (9, 9) turn rad, shift mm of ``sensor``, then the centre
    robot: Repeatability
    robot_stated: bool
    used: tuple[bool, ...]  # by pass
    loo_mm: tuple[float, ...]  # rms distance of each pass's points from the sphere where the other passes put it
    rms_mm: float  # of the points from the sphere, the robot's poses as stated


def solve_by_sphere(
    passes: Sequence[Pass], radius: float, mount: Mount, *, repeatability: Repeatability | None = None
) -> SphereFit:
    """Least squares of the points' distances from a sphere of known radius, with one error of the robot a pass.

    Parameters
    ----------
    passes : sequence of Pass
        Five or more, the arm turned about two axes and the sphere at different places of the sheet; 15 or more are wanted.
    radius : float
        mm.
    mount : {"hand", "fixed"}
        The sphere stands still, or the arm carries it.
    repeatability : Repeatability, optional
        Of the robot. Without it, a robot whose turns and shifts have the usual ratio, as the passes scatter.

    Raises
    ------
    CalibrationError
        Passes from which nothing follows.

    Notes
    -----
    The start is sought from many rotations, the rest then being linear in the circles' centres. A pass contradicts where
    its chi-square about the others is improbable; worst first.
    """
    from scipy.stats import chi2

    if len(passes) < _LEAST:
        raise CalibrationError(
            f"{len(passes)} passes over the sphere; {_LEAST} are the least and 15 are wanted: add passes"
        )
    require_arm_turns([p.base_from_flange for p in passes], "passes")
    some = [_some(p, 12) for p in passes]
    x, c = _start(some, radius, mount)
    full = list(passes)
    keep = np.ones(len(full), dtype=bool)
    while True:
        kept = [p for p, k in zip(full, keep, strict=True) if k]
        robot = repeatability or _scatter(kept, radius, mount, x, c)
        x, c, systems, normal = _adjusted(kept, radius, mount, x, c, robot)
        away = [_left_out(s, normal, k) for k, s in enumerate(systems)]
        limit = [float(chi2.isf(_CHANCE / len(full), len(s[1]))) for s in systems]
        excess = np.array([a[0] / b for a, b in zip(away, limit, strict=True)])
        if excess.max() <= 1.0 or keep.sum() <= max(_LEAST, int(0.6 * len(full))):
            break
        keep[np.flatnonzero(keep)[int(excess.argmax())]] = False
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    sigma = np.sqrt(np.diag(covariance))
    if sigma[3:6].max() > _UNSURE[0] or sigma[:3].max() > _UNSURE[1]:
        raise CalibrationError(
            f"the passes leave the sensor's place open by {sigma[3:6].max():.2g} mm and {np.rad2deg(sigma[:3].max()):.2g} degrees: "
            "turn the arm further about two axes, and let the stripe cross the sphere at different places and distances"
        )
    steps = iter(a[1] for a in away)
    loo = tuple(
        _distance(p, radius, mount, x, c, next(steps) if k else np.zeros(9)) for p, k in zip(full, keep, strict=True)
    )
    square = [_gap(p, radius, mount, x, c)[0] ** 2 for p, k in zip(full, keep, strict=True) if k]
    return SphereFit(
        mount, x, c, covariance, robot, repeatability is not None, tuple(bool(k) for k in keep), loo,
        float(np.sqrt(np.concatenate(square).mean())),
    )  # fmt: skip


def _gap(p: Pass, radius: float, mount: Mount, x: Pose, c: Array) -> tuple[Array, Array, Array, Array]:
    """Means over b blocks: distances (b,) mm from the sphere, derivatives (b, 9) by X and centre, (b, 6) by the robot's error, sigma (b,)."""
    at = x.apply(p.points)  # flange, or base
    flange = p.base_from_flange
    here = flange if mount == "hand" else flange.inverse
    world = here.apply(at)
    out = world - c
    length = np.linalg.norm(out, axis=1)
    out = out / length[:, None]
    normal = out @ here.rotation  # in the frame that X leads to
    by_x = np.concatenate([np.cross(at - x.translation, normal), normal], axis=1)
    if mount == "hand":  # F E: a turn about the flange, then a shift
        by_robot = np.concatenate([np.cross(at, normal), normal], axis=1)
    else:  # E^-1 F^-1
        by_robot = -np.concatenate([np.cross(world, out), out], axis=1)
    slope = np.abs((normal * (p.ray @ x.rotation.T)).sum(axis=1))
    sigma = p.sigma * np.maximum(slope, _SLANT)
    both = np.concatenate([by_x, -out], axis=1)
    size = max(len(p.points) / _BLOCKS, 1.0)
    variance = _means(sigma**2, _BLOCKS) / size
    return _means(length - radius, _BLOCKS), _means(both, _BLOCKS), _means(by_robot, _BLOCKS), np.sqrt(variance)


System = tuple[Array, Array, Array]  # derivatives (n, 9), gaps (n,), weight (n, n)


def _adjusted(
    passes: Sequence[Pass], radius: float, mount: Mount, x: Pose, c: Array, robot: Repeatability
) -> tuple[Pose, Array, list[System], Array]:
    spread = robot_covariance(robot.mm, robot.rad)
    for _ in range(25):
        systems: list[System] = []
        for p in passes:
            gap, by, by_robot, sigma = _gap(p, radius, mount, x, c)
            whole = np.diag(sigma**2) + by_robot @ spread @ by_robot.T
            systems.append((by, gap, np.asarray(np.linalg.inv(whole), dtype=np.float64)))
        normal = np.asarray(np.sum([b.T @ w @ b for b, _, w in systems], axis=0), dtype=np.float64)
        right = np.sum([b.T @ w @ g for b, g, w in systems], axis=0)
        step = -_solve(normal, right)
        x, c = moved(x, step[:6]), c + step[6:]
        if np.abs(step).max() < 1e-8:
            break
    return x, c, systems, normal


def _left_out(system: System, normal: Array, _k: int) -> tuple[float, Array]:
    """Chi-square of a pass about the others, and the step (9,) that leaving it out makes."""
    by, gap, weight = system
    mine = by.T @ weight @ by
    rest = normal - mine + 1e-12 * np.diag(np.diag(normal))
    step = _solve(rest, by.T @ weight @ gap)
    off = gap + by @ step
    inverse = np.linalg.inv(np.linalg.inv(weight) + by @ np.linalg.pinv(rest, hermitian=True) @ by.T)
    return float(off @ inverse @ off), step


def _distance(p: Pass, radius: float, mount: Mount, x: Pose, c: Array, step: Array) -> float:
    gap = _gap(p, radius, mount, moved(x, step[:6]), c + step[6:])[0]
    return float(np.sqrt(np.mean(gap**2)))


def _scatter(passes: Sequence[Pass], radius: float, mount: Mount, x: Pose, c: Array) -> Repeatability:
    """A robot of the usual ratio whose scatter makes chi-square what its degrees of freedom are (bisection)."""
    low, high = 1e-3, 1e2
    freedom = sum(min(len(p.points), _BLOCKS) for p in passes) - 9
    for _ in range(14):
        scale = float(np.sqrt(low * high))
        robot = Repeatability(_USUAL.mm * scale, _USUAL.rad * scale)
        _, _, systems, _ = _adjusted(passes, radius, mount, x, c, robot)
        chi = float(np.sum([g @ w @ g for _, g, w in systems]))
        low, high = (scale, high) if chi > freedom else (low, scale)
    return robot


def _start(passes: Sequence[Pass], radius: float, mount: Mount) -> tuple[Pose, Array]:
    """X and centre: for many rotations the linear rest from the circles' centres, each then adjusted with all points alike; the best."""
    circles = [_circle(p.points) for p in passes]
    arms = [p.base_from_flange if mount == "hand" else p.base_from_flange.inverse for p in passes]
    turned = np.stack([a.rotation for a in arms])
    matrix = np.concatenate([turned, -np.broadcast_to(np.eye(3), turned.shape)], axis=2).reshape(-1, 6)
    inverse = np.linalg.pinv(matrix, rcond=1e-9)
    points = np.concatenate([p.points for p in passes])
    count = [len(p.points) for p in passes]
    turn, shift = np.repeat(turned, count, axis=0), np.repeat(np.stack([a.translation for a in arms]), count, axis=0)
    rng = np.random.default_rng(2020)
    best: tuple[float, Pose, Array] | None = None
    for _ in range(_STARTS):
        rotation = rotation_from_quaternion(rng.normal(size=4))
        right = np.concatenate([-a.translation - a.rotation @ rotation @ m for a, m in zip(arms, circles, strict=True)])
        t = inverse @ right
        x, c, damping, last = Pose(rotation, t[:3]), t[3:], 1e-2, np.inf
        for _ in range(40):
            at = x.apply(points)
            out = np.einsum("nij,nj->ni", turn, at) + shift - c
            length = np.linalg.norm(out, axis=1)
            gap, out = length - radius, out / length[:, None]
            cost = float(gap @ gap)
            if last - cost < 1e-4 * last and damping < 1e-4:
                break
            damping = max(damping * (0.3 if cost < last else 4.0), 1e-6)
            last = min(cost, last)
            normal = np.einsum("ni,nij->nj", out, turn)
            by = np.concatenate([np.cross(at - x.translation, normal), normal, -out], axis=1)
            square = by.T @ by
            step = -np.linalg.solve(square + damping * np.diag(np.diag(square)) + 1e-9 * np.eye(9), by.T @ gap)
            x, c = moved(x, step[:6]), c + step[6:]
        middle = float(np.median(np.abs(gap)))
        if np.isfinite(middle) and (best is None or middle < best[0]):
            best = (middle, x, c)
    if best is None or best[0] > 0.1 * radius:
        raise CalibrationError("the passes fit no sphere; check its diameter, and that each image has its pose")
    return best[1], best[2]


def _circle(points: Array) -> Array:
    """Centre (3,) of the circle through points of one plane (least squares, Kasa 1976)."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    flat = (points - middle) @ axes[:2].T
    a = np.column_stack([2 * flat, np.ones(len(flat))])
    centre = np.linalg.lstsq(a, (flat**2).sum(axis=1), rcond=None)[0][:2]
    return np.asarray(middle + centre @ axes[:2])


def _solve(normal: Array, right: Array) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    even = normal * np.outer(scale, scale)
    return np.asarray(scale * np.linalg.solve(even + 1e-12 * np.eye(len(even)), scale * right))


def _some(p: Pass, count: int) -> Pass:
    """Every k-th point, about ``count`` of them."""
    rows = np.unique(np.linspace(0, len(p.points) - 1, count).astype(int))
    return replace(p, points=p.points[rows], ray=p.ray[rows], sigma=p.sigma[rows])


def _means(values: Array, blocks: int) -> Array:
    """Means (blocks, ...) of neighbouring rows: what noise leaves is less, and nothing else is changed."""
    n = len(values)
    if n <= blocks:
        return values
    first = np.arange(blocks) * n // blocks
    return np.asarray(np.add.reduceat(values, first, axis=0).T / np.diff([*first, n])).T
