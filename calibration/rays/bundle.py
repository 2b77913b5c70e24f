"""Lens and poses of freehand views adjusted together, and what every view says of the lens once its pose is eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import cv2
import numpy as np

from calibration.geometry import Array, Pose
from calibration.rays.plane_map import PlaneMarks

Term: TypeAlias = Literal["centre", "aspect", "k1", "k2", "tangential", "k3"]
LENS = 9  # fx fy cx cy k1 k2 p1 p2 k3
_COLUMNS: dict[Term, tuple[int, ...]] = {
    "centre": (2, 3), "aspect": (1,), "k1": (4,), "k2": (5,), "tangential": (6, 7), "k3": (8,),
}  # fmt: skip
_TURNS = 60
_FARTHEST = 10.0  # by this factor a focal length may leave its start
_SETTLED = 1e-9  # relative fall of the sum of squares below which nothing moves any more


@lru_cache(maxsize=64)
def columns(terms: frozenset[Term]) -> Array:
    """Directions (9, m) in which the lens may move: the focal length always (one for both axes without ``aspect``)."""
    axes = [np.eye(LENS)[0] if "aspect" in terms else np.eye(LENS)[:2].sum(axis=0)]
    axes += [np.eye(LENS)[k] for term in _COLUMNS if term in terms for k in _COLUMNS[term]]
    return np.stack(axes, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """A lens and the poses of K views, and what each view says of the lens, its own pose free to follow."""

    lens: Array  # (9,) fx fy cx cy k1 k2 p1 p2 k3
    poses: Array  # (K, 6) rotation vector, translation mm
    residuals: tuple[Array, ...]  # (n, 2) px a view, seen minus projected
    information: Array  # (K, 9, 9) px^2: of all nine, whatever was free
    score: Array  # (K, 9) px^2: towards where each view would have the lens
    squares: Array  # (K,) px^2, sums of squares, of a pose that fits best

    def left_out(self, terms: frozenset[Term]) -> Array:
        """Sum of squares (K,) px^2 of each view under the lens that the others ask for, its own pose fitted to it.

        One step of Gauss and Newton from here in the directions that ``terms`` allow: from a lens that was adjusted in them it
        is the error of a view left out to first order, from one with fewer it foretells that error. Infinite where the
        others do not determine the terms.
        """
        free = columns(terms)
        each = np.einsum("ia,kij,jb->kab", free, self.information, free)
        pulls = self.score @ free
        size = np.sqrt(np.maximum(np.einsum("kaa->a", each), 1e-300))
        each, pulls = each / np.outer(size, size), pulls / size
        others, asked = each.sum(axis=0) - each, pulls.sum(axis=0) - pulls
        found = np.full(len(each), np.inf)
        known = np.linalg.eigvalsh(others)[:, 0] > 1e-10 if np.isfinite(others).all() else np.zeros(len(each), bool)
        if known.any():
            step = np.linalg.solve(others[known], asked[known][:, :, None])[:, :, 0]
            own, pull = each[known], pulls[known]
            found[known] = (
                self.squares[known] - 2 * (step * pull).sum(axis=1) + np.einsum("ka,kab,kb->k", step, own, step)
            )
        return found


def adjust(views: Sequence[PlaneMarks], lens: Array, poses: Array, terms: frozenset[Term]) -> Adjusted:
    """Least squares of all marks by poses and lens (Levenberg and Marquardt), poses eliminated view by view.

    Parameters
    ----------
    views : sequence of PlaneMarks
        K views; their pixels (n, 2) px and points (n, 2) mm are used.
    lens : (9,) array
        From where to start: fx fy cx cy k1 k2 p1 p2 k3, in OpenCV's model.
    poses : (K, 6) array
        From where to start: rotation vectors and translations, camera from target.
    terms : frozenset of Term
        What may move beside the focal length.

    Notes
    -----
    With J = [A B] the derivatives of a view by its pose and by the lens, B' (1 - A A+) B is what the view says of the lens
    (Schur complement; Triggs et al. 2000, "Bundle adjustment", section 6.1). Views that do not determine the lens leave it
    near the start, since steps are damped; their information tells.
    """
    free = columns(terms)
    now = _linearised(views, lens, poses)
    least, most = lens[0] / _FARTHEST, lens[0] * _FARTHEST
    damping = 1e-4
    for _ in range(_TURNS):
        moved = _step(now, free, damping)
        trial = None if moved is None else _linearised(views, now.lens + moved[0], now.poses + moved[1])
        if trial is None or not trial.cost < now.cost or not least < trial.lens[0] < most:
            damping *= 10
            if damping > 1e8:
                break
            continue
        settled = now.cost - trial.cost < _SETTLED * now.cost
        now, damping = trial, max(damping / 10, 1e-10)
        if settled and damping <= 1e-6:
            break
    return _adjusted(now)


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    lens: Array
    poses: Array
    residuals: tuple[Array, ...]  # (2n,)
    by_pose: tuple[Array, ...]  # (2n, 6)
    by_lens: tuple[Array, ...]  # (2n, 9)
    cost: float


def _linearised(views: Sequence[PlaneMarks], lens: Array, poses: Array) -> _Linearised:
    matrix = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
    residuals, by_pose, by_lens = [], [], []
    for view, pose in zip(views, poses, strict=True):
        points = np.column_stack([view.points, np.zeros(len(view))])
        seen, jacobian = cv2.projectPoints(points, pose[:3], pose[3:], matrix, lens[4:])
        residuals.append((view.pixels - seen[:, 0]).ravel())
        by_pose.append(jacobian[:, :6])
        by_lens.append(jacobian[:, 6 : 6 + LENS])
    cost = float(sum(r @ r for r in residuals))
    return _Linearised(lens, poses, tuple(residuals), tuple(by_pose), tuple(by_lens), cost)


def _step(now: _Linearised, free: Array, damping: float) -> tuple[Array, Array] | None:
    """Damped step of lens (9,) and poses (K, 6); None where it cannot be solved."""
    m = free.shape[1]
    normal, right = np.zeros((m, m)), np.zeros(m)
    kept = []
    try:
        for r, a, b in zip(now.residuals, now.by_pose, now.by_lens, strict=True):
            c = b @ free
            own, mixed = a.T @ a, a.T @ c
            own[np.diag_indices(6)] *= 1 + damping
            solved = np.linalg.solve(own, np.column_stack([mixed, a.T @ r]))
            back, start = solved[:, :m], solved[:, m]
            part = c.T @ c
            part[np.diag_indices(m)] *= 1 + damping
            normal += part - mixed.T @ back
            right += c.T @ r - mixed.T @ start
            kept.append((start, back))
        size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        step = np.linalg.solve(normal / np.outer(size, size), right / size) / size
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(step).all():
        return None
    return free @ step, np.stack([start - back @ step for start, back in kept])


def _adjusted(now: _Linearised) -> Adjusted:
    information, score, squares = [], [], []
    for r, a, b in zip(now.residuals, now.by_pose, now.by_lens, strict=True):
        q = np.linalg.qr(a)[0]
        across, rest = b - q @ (q.T @ b), r - q @ (q.T @ r)
        information.append(across.T @ across)
        score.append(across.T @ rest)
        squares.append(rest @ rest)
    residuals = tuple(r.reshape(-1, 2) for r in now.residuals)
    return Adjusted(now.lens, now.poses, residuals, np.array(information), np.array(score), np.array(squares))


def information_of(points: Array, pose: Array, lens: Array) -> tuple[Array, Array]:
    """What a view would say of the lens (9, 9), px^2, and where its marks would be (n, 2) px.

    ``points`` (n, 2) mm on the target, ``pose`` (6,) of the target in the camera's frame.
    """
    view = PlaneMarks("", np.zeros((len(points), 2)), points, Pose.identity(), np.zeros(0, np.int64), np.zeros(0))
    now = _linearised([view], lens, pose[None])
    return _adjusted(now).information[0], -now.residuals[0].reshape(-1, 2)
