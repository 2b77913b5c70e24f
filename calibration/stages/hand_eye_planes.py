"""Hand and eye without a target in the image: laser stripes across fixed planes, seen from poses of the arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Pose, rotation_from_quaternion
from calibration.stages.hand_eye import Repeatability, require_arm_turns
from calibration.stages.hand_eye_sphere import Pass
from calibration.stages.hand_eye_start import Mount
from calibration.stages.hand_eye_system import moved, robot_covariance

_LEAST = 8  # passes
_STARTS = 300  # rotations that are tried
_FURTHER = 8  # of them, the best, that are followed to the end
_BLOCKS = 12  # of a pass, over which gaps are averaged
_CHANCE = 0.01  # that a sound pass is left out, over all passes
_UNSURE = (5.0, np.deg2rad(2.0))  # mm, rad: one sigma beyond which nothing is determined
_USUAL = Repeatability(0.1, float(np.deg2rad(0.03)))  # whose ratio is taken where a robot's is not stated
_STRANGE = 3.0  # mm: median distance from their planes beyond which passes fit none


@dataclass(frozen=True, slots=True, eq=False)
class PlanesFit:
    """Where the sensor is, by passes over planes that stand still (or that the arm carries)."""

    mount: Mount
    sensor: Pose  # flange_from_camera, or base_from_camera
    normals: Array  # (k, 3) unit, of the planes: in the base, or in the flange
    offsets: Array  # (k,) mm
    covariance: Array  # (6, 6) turn rad, shift mm of ``sensor``
    robot: Repeatability
    robot_stated: bool
    used: tuple[bool, ...]  # by pass
    loo_mm: tuple[float, ...]  # rms distance of each pass's points from its plane as the other passes put it
    rms_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    x: Pose
    normals: Array
    offsets: Array


def solve_by_planes(
    passes: Sequence[Pass], plane: Sequence[int], mount: Mount, *, repeatability: Repeatability | None = None
) -> PlanesFit:
    """Least squares of the points' distances from unknown planes, with one error of the robot a pass.

    Parameters
    ----------
    passes : sequence of Pass
        Eight or more, each the stripe on one plane; 20 are wanted. The arm turned about two axes by 20 degrees or more.
    plane : sequence of int
        Number of the plane of each pass, from 0. One plane is enough where the arm turns far; three that face different ways are better.
    mount : {"hand", "fixed"}
        The planes stand still, or the arm carries them.
    repeatability : Repeatability, optional
        Of the robot. Without it, a robot whose turns and shifts have the usual ratio, as the passes scatter.

    Raises
    ------
    CalibrationError
        Passes from which nothing follows.

    Notes
    -----
    n . (F X p) = d for each point p, with X, n and d unknown (a line sensor's only marks; Carlson, Donoser and Huber,
    "Six DOF hand-eye calibration from 2D", solve the like for known planes). The start is the best of 300 rotations.
    """
    from scipy.stats import chi2

    if len(passes) < _LEAST:
        raise CalibrationError(
            f"{len(passes)} passes over planes; {_LEAST} are the least and 20 are wanted: add passes"
        )
    require_arm_turns([p.base_from_flange for p in passes], "passes")
    label = np.asarray(plane)
    full = [_some(p) for p in passes]
    state = _start(full, label, mount)
    keep = np.ones(len(full), dtype=bool)
    while True:
        kept, which = [p for p, k in zip(full, keep, strict=True) if k], label[keep]
        robot = repeatability or _scatter(kept, which, mount, state)
        state, systems, normal = _adjusted(kept, which, mount, state, robot)
        away = [_left_out(s, normal) for s in systems]
        limit = [float(chi2.isf(_CHANCE / len(full), len(s[1]))) for s in systems]
        excess = np.array([a[0] / b for a, b in zip(away, limit, strict=True)])
        if excess.max() <= 1.0 or keep.sum() <= max(_LEAST, int(0.6 * len(full))):
            break
        keep[np.flatnonzero(keep)[int(excess.argmax())]] = False
    covariance = np.linalg.pinv(normal, hermitian=True)[:6, :6]
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    even, _ = _scaled(normal)
    if np.linalg.eigvalsh(even)[0] < 1e-10 or sigma[3:].max() > _UNSURE[0] or sigma[:3].max() > _UNSURE[1]:
        raise CalibrationError(
            "the passes leave the sensor's place open: turn the arm further about two axes, tilt it against the planes both ways, and "
            "add planes that face other ways"
        )
    steps = iter(a[1] for a in away)
    loo = []
    for p, k, on in zip(full, label, keep, strict=True):
        at = _stepped(state, next(steps)) if on else state
        loo.append(float(np.sqrt(np.mean(_gap(p, int(k), mount, at)[0] ** 2))))
    square = [_gap(p, int(k), mount, state)[0] ** 2 for p, k, on in zip(full, label, keep, strict=True) if on]
    return PlanesFit(
        mount, state.x, state.normals, state.offsets, np.asarray(covariance, dtype=np.float64), robot, repeatability is not None,
        tuple(bool(k) for k in keep), tuple(loo), float(np.sqrt(np.concatenate(square).mean())),
    )  # fmt: skip


def _some(p: Pass) -> Pass:
    """Means over blocks of neighbouring points: along a straight stripe they lose nothing."""
    n = len(p.points)
    if n <= _BLOCKS:
        return p
    first = np.arange(_BLOCKS) * n // _BLOCKS
    count = np.diff([*first, n])
    mean = np.add.reduceat(p.points, first, axis=0) / count[:, None]
    ray = np.add.reduceat(p.ray, first, axis=0)
    sigma = np.sqrt(np.add.reduceat(p.sigma**2, first)) / count
    return replace(p, points=mean, ray=ray / np.linalg.norm(ray, axis=1, keepdims=True), sigma=sigma)


def _gap(p: Pass, k: int, mount: Mount, s: _State) -> tuple[Array, Array, Array, Array]:
    """Distances (b,) mm from the plane, derivatives (b, 6 + 3 planes) by X and planes, (b, 6) by the robot's error, sigma (b,)."""
    at = s.x.apply(p.points)
    here = p.base_from_flange if mount == "hand" else p.base_from_flange.inverse
    world = here.apply(at)
    out = s.normals[k]
    normal = np.broadcast_to(out @ here.rotation, at.shape)  # in the frame that X leads to
    by = np.zeros((len(at), 6 + 3 * len(s.offsets)))
    by[:, :3], by[:, 3:6] = np.cross(at - s.x.translation, normal), normal
    axes = np.linalg.svd(out[None])[2][1:]
    first = 6 + 3 * k
    by[:, first : first + 2], by[:, first + 2] = world @ axes.T, -1.0
    if mount == "hand":  # F E: a turn about the flange, then a shift
        by_robot = np.concatenate([np.cross(at, normal), normal], axis=1)
    else:  # E^-1 F^-1
        by_robot = -np.concatenate([np.cross(world, out), np.broadcast_to(out, world.shape)], axis=1)
    slope = np.abs((normal * (p.ray @ s.x.rotation.T)).sum(axis=1))
    return world @ out - s.offsets[k], by, by_robot, p.sigma * np.maximum(slope, 0.05)


def _stepped(s: _State, step: Array) -> _State:
    normals, offsets = s.normals.copy(), s.offsets.copy()
    for k in range(len(offsets)):
        axes = np.linalg.svd(s.normals[k][None])[2][1:]
        turned = s.normals[k] + step[6 + 3 * k : 8 + 3 * k] @ axes
        length = float(np.linalg.norm(turned))
        normals[k], offsets[k] = turned / length, (offsets[k] + step[8 + 3 * k]) / length
    return _State(moved(s.x, step[:6]), normals, offsets)


System = tuple[Array, Array, Array]  # derivatives (n, q), gaps (n,), weight (n, n)


def _adjusted(
    passes: Sequence[Pass], plane: Array, mount: Mount, s: _State, robot: Repeatability, steps: int = 30
) -> tuple[_State, list[System], Array]:
    spread = robot_covariance(robot.mm, robot.rad)
    systems: list[System] = []
    normal = np.zeros((0, 0))
    for _ in range(steps):
        systems = []
        for p, k in zip(passes, plane, strict=True):
            gap, by, by_robot, sigma = _gap(p, int(k), mount, s)
            whole = np.diag(sigma**2) + by_robot @ spread @ by_robot.T
            systems.append((by, gap, np.asarray(np.linalg.inv(whole), dtype=np.float64)))
        normal = np.asarray(np.sum([b.T @ w @ b for b, _, w in systems], axis=0), dtype=np.float64)
        right = np.sum([b.T @ w @ g for b, g, w in systems], axis=0)
        step = -_solve(normal, right)
        s = _stepped(s, step)
        if np.abs(step).max() < 1e-8:
            break
    return s, systems, normal


def _left_out(system: System, normal: Array) -> tuple[float, Array]:
    """Chi-square of a pass about the others, and the step that leaving it out makes."""
    by, gap, weight = system
    rest = normal - by.T @ weight @ by
    step = _solve(rest, by.T @ weight @ gap)
    off = gap + by @ step
    inverse = np.linalg.inv(np.linalg.inv(weight) + by @ np.linalg.pinv(rest, hermitian=True) @ by.T)
    return float(off @ inverse @ off), step


def _scatter(passes: Sequence[Pass], plane: Array, mount: Mount, s: _State) -> Repeatability:
    """A robot of the usual ratio whose scatter makes chi-square what its degrees of freedom are (bisection)."""
    low, high = 1e-3, 1e2
    freedom = sum(len(p.points) for p in passes) - 6 - 3 * len(s.offsets)
    robot = _USUAL
    for _ in range(14):
        scale = float(np.sqrt(low * high))
        robot = Repeatability(_USUAL.mm * scale, _USUAL.rad * scale)
        _, systems, _ = _adjusted(passes, plane, mount, s, robot, 6)
        chi = float(np.sum([g @ w @ g for _, g, w in systems]))
        low, high = (scale, high) if chi > freedom else (low, scale)
    return robot


def _start(passes: Sequence[Pass], plane: Array, mount: Mount) -> _State:
    """Rotations tried: for each, planes by the stripes' directions, then shift and offsets, which are linear; the best are followed."""
    rng = np.random.default_rng(2020)
    count = int(plane.max()) + 1
    arms = [p.base_from_flange if mount == "hand" else p.base_from_flange.inverse for p in passes]
    turned = np.stack([a.rotation for a in arms])
    along = np.stack([np.linalg.svd(p.points - p.points.mean(axis=0), full_matrices=False)[2][0] for p in passes])
    middle = np.stack([p.points.mean(axis=0) for p in passes])
    shift = np.stack([a.translation for a in arms])
    tried: list[tuple[float, _State]] = []
    for _ in range(_STARTS):
        rotation = rotation_from_quaternion(rng.normal(size=4))
        lines = np.einsum("nij,nj->ni", turned, along @ rotation.T)
        normals = np.stack([np.linalg.svd(lines[plane == k], full_matrices=True)[2][2] for k in range(count)])
        skew = float(np.abs((lines * normals[plane]).sum(axis=1)).mean())
        mine = normals[plane]
        matrix = np.zeros((len(passes), 3 + count))
        matrix[:, :3] = np.einsum("ni,nij->nj", mine, turned)
        matrix[np.arange(len(passes)), 3 + plane] = -1.0
        right = -(mine * (np.einsum("nij,nj->ni", turned, middle @ rotation.T) + shift)).sum(axis=1)
        found = np.linalg.lstsq(matrix, right, rcond=1e-6)[0]
        tried.append((skew, _State(Pose(rotation, found[:3]), normals, found[3:])))
    tried.sort(key=lambda t: t[0])
    best: tuple[float, _State] | None = None
    for _, state in tried[:_FURTHER]:
        state = _followed(passes, plane, mount, state)
        off = float(
            np.median([np.abs(_gap(p, int(k), mount, state)[0]).max() for p, k in zip(passes, plane, strict=True)])
        )
        if np.isfinite(off) and (best is None or off < best[0]):
            best = (off, state)
    if best is None or best[0] > _STRANGE:
        raise CalibrationError(
            "the passes fit no planes; check that each image has its pose and its plane, and that the planes are flat"
        )
    return best[1]


def _followed(passes: Sequence[Pass], plane: Array, mount: Mount, state: _State) -> _State:
    """Levenberg and Marquardt with all points alike."""
    damping, last = 1e-2, np.inf
    for _ in range(60):
        rows = [_gap(p, int(k), mount, state) for p, k in zip(passes, plane, strict=True)]
        gap, by = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
        cost = float(gap @ gap)
        if not np.isfinite(cost) or abs(last - cost) < 1e-7 * cost:
            break
        damping = min(max(damping * (0.3 if cost < last else 4.0), 1e-8), 1e6)
        last = min(cost, last)
        normal = by.T @ by
        state = _stepped(state, -_solve(normal + damping * np.diag(np.diag(normal)), by.T @ gap))
    return state


def _scaled(normal: Array) -> tuple[Array, Array]:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return normal * np.outer(scale, scale), scale


def _solve(normal: Array, right: Array) -> Array:
    even, scale = _scaled(normal)
    return np.asarray(scale * np.linalg.solve(even + 1e-12 * np.eye(len(even)), scale * right))
