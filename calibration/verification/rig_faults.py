"""Faults of planes that a calibrated camera sees again: misplaced ones, or a camera that has moved against the jig.

The rays are known now, so that every plane can be judged by itself, and nothing is hidden in an affine map of space.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Pose
from calibration.rays import PlaneMarks, RayField, locate_target, rms
from calibration.verification import misplacement as placement
from calibration.verification._gross import amounts_of
from calibration.verification.faults import SCATTER_PX, Fault, Lattice
from calibration.verification.hypotheses import Choice, Hypothesis, Score, select
from calibration.verification.misplacement import MODES
from calibration.verification.wording import of_hypothesis, of_rig_moved

_ROUNDS = 4
_ONE_MOTION = 0.3  # of the misfit of all planes: as little must be left by one motion of the whole jig
_LINEAR_PX = 2.0  # misfit beyond which a plane is put back by its pose before its modes are fitted


def faults_against(
    field: RayField, planes: Sequence[PlaneMarks], *, lattice: Lattice | None = None
) -> tuple[Fault, ...]:
    """Name what is wrong with planes against the rays of a camera that was not fitted to them.

    Parameters
    ----------
    field : RayField
        The rays of the rig.
    planes : sequence of PlaneMarks
        As stated; one is enough.
    lattice : Lattice, optional
        Grid of the target, so that labels shifted by whole pitches are known for what they are.

    Returns
    -------
    tuple of Fault
        None for planes that are off by less than `SCATTER_PX`, which no jig repeats better. Where one rigid motion of all
        planes explains what two or more of them show, camera and jig have moved against each other: that is one fault.
    """
    off = [rms(_residual(field, p)) for p in planes]
    bad = [k for k, px in enumerate(off) if px > SCATTER_PX]
    if not bad:
        return ()
    if len(bad) == len(planes) >= 2:
        motion = _one_motion(field, planes)
        if motion is not None:
            return (of_rig_moved(*motion),)
    faults: list[Fault] = []
    for k in bad:
        faults += _of_plane(field, planes[k], lattice)
    return tuple(faults)


def _residual(field: RayField, marks: PlaneMarks) -> Array:
    """Where marks are seen less where the field expects them, (n, 2) px."""
    world = marks.world @ field.c_from_d
    return np.asarray(marks.pixels - placement.expected(field, marks.pixels, world))


def _of_plane(field: RayField, stated: PlaneMarks, lattice: Lattice | None) -> list[Fault]:
    amounts = np.zeros(MODES)
    if rms(_residual(field, stated)) > _LINEAR_PX:
        try:
            amounts = amounts_of(stated, locate_target(field, stated), field)
        except CalibrationError:
            amounts = np.zeros(MODES)
    chosen: tuple[Hypothesis, ...] = ()
    for _ in range(_ROUNDS):
        right = placement.put_right(field, stated, amounts)
        world = right.world @ field.c_from_d
        here = placement.expected(field, right.pixels, world)
        to_px = np.linalg.inv(field.jacobian(here, world[:, 2]))
        x = (to_px @ placement.modes(field, right, placement.slopes(field, here, world))).reshape(-1, MODES)
        y = (here - right.pixels).reshape(-1)
        rest = y - x @ np.linalg.lstsq(x, y, rcond=1e-9)[0]
        variance = float(rest @ rest) / max(len(y) - MODES, 1)
        information = x.T @ x / variance
        score_of_modes = Score.of(x.T @ y / variance + information @ amounts, information)
        chosen = select(score_of_modes)
        fit = score_of_modes.fit(chosen)
        amounts = np.zeros(MODES)
        amounts[list(fit.columns)] = fit.amounts
    choice = Choice(chosen, score_of_modes, np.zeros(MODES))
    return [of_hypothesis(h, [stated], choice, fit, lattice) for h in chosen]


def _one_motion(field: RayField, planes: Sequence[PlaneMarks]) -> tuple[Pose, Array, float] | None:
    """Rigid motion in C of all planes together that brings their marks to the rays, about which point, and what is left, px."""
    try:
        located = [locate_target(field, p) for p in planes]
    except CalibrationError:
        return None
    stated, seen = (np.concatenate([p.world for p in group]) for group in (planes, located))
    middle, to = stated.mean(axis=0), seen.mean(axis=0)
    left, _, right = np.linalg.svd((seen - to).T @ (stated - middle))
    left[:, -1] *= np.sign(np.linalg.det(left @ right))
    motion = Pose(left @ right, to - left @ right @ middle)
    moved = [PlaneMarks(p.name, p.pixels, p.points, motion @ p.c_from_plane, p.mark, p.covariance) for p in planes]
    before = rms(np.concatenate([_residual(field, p) for p in planes]))
    after = rms(np.concatenate([_residual(field, p) for p in moved]))
    return (motion, middle, after) if after < max(_ONE_MOTION * before, SCATTER_PX) else None
