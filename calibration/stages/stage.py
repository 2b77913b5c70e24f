"""The direction of a linear stage, or the axis of a turntable, from the target carried by it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array

_CHANCE = 0.01  # of a scatter of the positions about their line that is taken for noise
_STEPS = 6  # of Gauss and Newton
_SMALL = 1e-5  # rad, for derivatives


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """A stage in C, with its uncertainty."""

    kind: Literal["linear", "turntable"]
    direction: Array  # (3,) unit: of travel, or of the axis (right-hand rule for growing positions)
    point: Array  # (3,) mm: on the axis; the first position of the target for a linear stage
    direction_sigma: float  # rad, one standard deviation of the direction about either perpendicular
    scale: float  # travelled over stated; of a turntable: by which the stated lengths of its target were multiplied
    rms_mm: float  # of the marks about the motion
    coupling: Array = field(
        default_factory=lambda: np.zeros((0, 0))
    )  # (6, P) movement of point and direction, a unit of each
    # parameter of the camera; (0, 0): found as if the camera were known


def fit_linear(tracks: Array, positions: Array, *, covariance: Array | None = None) -> Stage:
    """Direction of travel from marks (positions, marks, 3) mm, each seen at every position (n,) mm.

    Each mark moves along x0 + s d with one d for all: linear least squares, eliminating the x0. ``covariance`` (n, 3, 3)
    mm^2 is that of the middle of the target at each position: the marks of a rigid target err together. Without it the
    marks are taken to err each by itself. Where the middles scatter more than that about the line, the scatter counts.
    ``CalibrationError`` where the positions do not differ or the marks do not move.
    """
    from scipy.stats import chi2

    s = positions - positions.mean()
    if not np.abs(s).max() > 0:
        raise CalibrationError(f"stage: all {len(s)} positions are {positions[0]:g} mm; move the target between images")
    centred = tracks - tracks.mean(axis=0)
    vector = np.einsum("p,pmi->i", s, centred) / (tracks.shape[1] * (s @ s))
    length = float(np.linalg.norm(vector))
    residual = centred - s[:, None, None] * vector
    freedom = max(residual.size - 3 * tracks.shape[1] - 3, 1)
    sigma = float(np.sqrt((residual**2).sum() / freedom))
    error = sigma / np.sqrt(tracks.shape[1] * (s @ s))
    if length < 10 * error or length < 1e-6:
        raise CalibrationError(
            f"stage: the target moves by {length:.4f} mm a stated mm; it does not seem to be on the stage"
        )
    spread = sigma**2 / tracks.shape[1] * np.eye(3)
    each = np.broadcast_to(spread, (len(s), 3, 3)) if covariance is None else covariance
    of_vector = np.einsum("p,pij->ij", s**2, each) / (s @ s) ** 2
    middle = residual.mean(axis=1)
    left = float(np.einsum("pi,pi->", middle, np.linalg.solve(each, middle[:, :, None])[:, :, 0]))
    beyond = left / (3 * len(s) - 6) if len(s) > 2 and chi2.sf(left, 3 * len(s) - 6) < _CHANCE else 1.0
    across = np.eye(3) - np.outer(vector, vector) / length**2
    error = float(np.sqrt(beyond * np.trace(across @ of_vector @ across) / 2))
    start = tracks[int(np.argmin(positions))].mean(axis=0)
    rms = float(np.sqrt((residual**2).sum(axis=2).mean()))
    return Stage("linear", vector / length, start, error / length, length, rms)


def fit_turntable(tracks: Array, angles: Array) -> Stage:
    """Axis of rotation from marks (positions, marks, 3) mm seen at stated angles (n,) rad.

    Every pair of positions gives a rotation (Kabsch 1976) whose axis, signed by the stated turn, is averaged with the sine of
    the turn as weight; from there direction and point are fitted by least squares over all marks turned back to the first
    position. The marks of a position err together, as the pose of the target does, so that the direction's uncertainty comes
    from what each position, left out, moves it by (the jackknife; MacKinnon and White 1985), and from the scatter of the
    marks where that is more. ``CalibrationError`` for turns under 2 degrees.
    """
    turns = angles - angles[0]
    if np.abs(turns).max() < np.deg2rad(2.0):
        raise CalibrationError(
            f"stage: the turntable turns by {np.rad2deg(np.abs(turns).max()):.2f} degrees; its axis needs 2 or more, better 90"
        )
    direction, point = _first_axis(tracks, turns)
    for _ in range(_STEPS):
        residual, slopes = _turned_back(tracks, turns, direction, point)
        normal = np.einsum("pmia,pmib->ab", slopes, slopes)
        step = -np.linalg.lstsq(normal, np.einsum("pmia,pmi->a", slopes, residual), rcond=1e-12)[0]
        across = _across(direction)
        direction, point = direction + step[:2] @ across, point + step[2:] @ across
        direction = direction / np.linalg.norm(direction)
    residual, slopes = _turned_back(tracks, turns, direction, point)
    point = point + ((tracks[0].mean(axis=0) - point) @ direction) * direction
    return Stage("turntable", direction, point, _direction_sigma(residual, slopes), 1.0, _rms(residual))


def _first_axis(tracks: Array, turns: Array) -> tuple[Array, Array]:
    """Direction and a point of the axis, from the rotations between the first and the other positions."""
    first = tracks[0]
    axes, weights = [], []
    for moved, turn in zip(tracks[1:], turns[1:], strict=True):
        rotation = _kabsch(first, moved)
        axis = np.array(
            [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
        )
        axes.append(axis * np.sign(np.sin(turn)))  # length 2 |sin|: its own weight
        weights.append(2 * abs(np.sin(turn)))
    total = np.sum(axes, axis=0)
    if np.linalg.norm(total) < 0.5 * np.sum(weights):
        raise CalibrationError(
            "stage: the target does not turn as the stated angles say; check their order and their sign"
        )
    direction = total / np.linalg.norm(total)
    matrix = np.concatenate([np.eye(3) - _about(direction, turn) for turn in turns[1:]])
    centre = first.mean(axis=0)
    shift = np.concatenate(
        [
            moved.mean(axis=0) - _about(direction, turn) @ centre
            for moved, turn in zip(tracks[1:], turns[1:], strict=True)
        ]
    )
    point = np.linalg.lstsq(matrix, shift, rcond=1e-9)[0]
    return direction, point + ((centre - point) @ direction) * direction


def _turned_back(tracks: Array, turns: Array, direction: Array, point: Array) -> tuple[Array, Array]:
    """Marks turned back to position 0 about their mean (n, m, 3) mm, and slopes (n, m, 3, 4) by tilt (rad) and shift (mm)."""
    across = _across(direction)

    def back(axis: Array, through: Array) -> Array:
        turned = np.stack(
            [through + (moved - through) @ _about(axis, turn) for moved, turn in zip(tracks, turns, strict=True)]
        )
        return np.asarray(turned - turned.mean(axis=0))

    tilts = []
    for e in across:
        ends = [(direction + sign * _SMALL * e) / np.hypot(1.0, _SMALL) for sign in (1, -1)]
        tilts.append((back(ends[0], point) - back(ends[1], point)) / (2 * _SMALL))
    residual = back(direction, point)
    shifts = [back(direction, point + e) - residual for e in across]
    return residual, np.stack([*tilts, *shifts], axis=-1)


def _direction_sigma(residual: Array, slopes: Array) -> float:
    """Standard deviation (rad) of the direction about either perpendicular."""
    positions, marks = residual.shape[:2]
    each = np.einsum("pmia,pmib->pab", slopes, slopes)
    whole = each.sum(axis=0)
    freedom = max(3 * (positions - 1) * marks - 4, 1)
    alike = np.linalg.pinv(whole, rcond=1e-12, hermitian=True) * float((residual**2).sum()) / freedom
    told = np.einsum("pmia,pmi->pa", slopes, residual)
    if positions < 3:
        return float(np.sqrt(np.trace(alike[:2, :2]) / 2))
    without = np.linalg.pinv(whole - each, rcond=1e-12, hermitian=True)  # as if each position were left out in turn
    moves = np.einsum("pab,pb->pa", without, told)
    jackknife = (
        moves.T @ moves
    )  # (n - 1) / n of it, times n / (n - 1), since each had its part in the target's mean pose
    return float(np.sqrt(max(np.trace(alike[:2, :2]), np.trace(jackknife[:2, :2])) / 2))


def _across(direction: Array) -> Array:
    """Two unit vectors (2, 3) square to a direction and to each other."""
    first = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def _rms(residual: Array) -> float:
    return float(np.sqrt((residual**2).sum(axis=2).mean()))


def _kabsch(source: Array, moved: Array) -> Array:
    """Rotation (3, 3) that turns source best to moved."""
    a, b = source - source.mean(axis=0), moved - moved.mean(axis=0)
    left, _, right = np.linalg.svd(b.T @ a)
    left[:, -1] *= np.sign(np.linalg.det(left @ right))
    return np.asarray(left @ right)


def _about(axis: Array, angle: float) -> Array:
    k = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k))
