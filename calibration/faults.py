"""Faults of a calibration, by name: which plane, what is wrong with it, how much, and what to do.

Whole images that are mixed up come first (`calibration.faults_images`), then planes that stand where they are not said
to, and single marks (`calibration.redundancy`, `calibration.faults_search`). What planes can and cannot tell is set out
in docs/method.md: an affine change of space that keeps the planes changes nothing here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from calibration import placement
from calibration.faults_images import MixUp, find_mix_ups, untangle
from calibration.faults_search import (
    FALSE_ALARM,
    Choice,
    Evidence,
    Explained,
    Hypothesis,
    Misplacement,
    alternatives,
    best_single,
    choose,
)
from calibration.geometry import Array
from calibration.placement import MODES, PITCH, ROTATION, SLIP_X, SLIP_Y, STAND_OFF, TILT_X, TILT_Y
from calibration.plane_map import PlaneMarks
from calibration.ray_field import RayField, fit_ray_field
from calibration.redundancy import Redundancy, redundancy_of

FaultKind: TypeAlias = Literal[
    "slip", "rotation", "stand_off", "tilt", "pitch", "swapped", "labelling", "mark", "moved"
]
ROUNDS = 12  # of correction, until the faults no longer change
GROSS = 1e3  # times the evidence that noise gives: so much that the modes may no longer be linear
MOST_MARKS = 0.05  # of all marks that may be dropped one by one; more are no matter of single marks


@dataclass(frozen=True, slots=True)
class Lattice:
    """The grid of a target, so that labels shifted by whole pitches are known for what they are."""

    rows: int
    columns: int
    pitch: tuple[float, float]  # mm, along x and y


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that is wrong."""

    plane: str
    kind: FaultKind
    value: float  # true minus stated where it has a sign (stand_off, pitch, rotation), else its size
    standard_error: float  # NaN where a fault has no size (swapped, labelling)
    unit: str  # "mm", "deg", "%", "px", or "" without size
    alternatives: tuple[str, ...]  # what the data cannot tell apart from it
    centre: tuple[float, float, float] | None  # mm in C, about which the plane is rotated
    mark: int | None  # number of the mark on the target
    remedy: str  # what was found and what to do, one line


def find_faults(
    planes: Sequence[PlaneMarks], *, field: RayField | None = None, lattice: Lattice | None = None
) -> tuple[Fault, ...]:
    """Name what is wrong with the planes of a calibration.

    Parameters
    ----------
    planes : sequence of PlaneMarks
        Two or more, at different stand-offs, as stated. Marks of one number are the same mark of the target.
    field : RayField, optional
        A joint field of these planes: only its frame, domain and pivot are used. Fitted here where not given.
    lattice : Lattice, optional
        Grid of the target; without it (listed marks) a shift by whole pitches is reported as a slip.

    Returns
    -------
    tuple of Fault
        Empty for a clean session: on data without faults, Gaussian noise alone raises an alarm in one session of a
        thousand. With two planes only marks and mix-ups can be found, since any two planes agree with each other. With
        three, a misplaced plane is found, but every plane could be the one: the others are listed as alternatives.

    Notes
    -----
    Noise comes from the data: the scatter of the centroids about a field of generous order, the errors of the target
    that repeat on all planes, and, where more is left than a few faults explain, the scatter of the planes themselves.
    Estimates are least squares, repeated on marks put right until they no longer change, so that large faults are
    estimated as well as small ones.

    Raises
    ------
    CalibrationError
        Planes from which no field of rays follows.
    """
    if len(planes) < 2:
        raise ValueError("faults are found between planes: give two or more")
    mixed = find_mix_ups(planes)
    rest = untangle(planes, mixed)
    faults = [_of_mix_up(m) for m in mixed]
    if len(rest) < 2:
        return tuple(faults)
    basis = fit_ray_field(list(rest), orders=(3, 1)).field if field is None or mixed else field
    state = _explain(rest, basis)
    for k, other in _could_be_one(state.choice.hypotheses):
        simpler = _explain(rest, basis, first=Hypothesis(k, other))
        if len(simpler.choice.hypotheses) < len(state.choice.hypotheses):
            state = simpler
    faults += [_of_hypothesis(h, state, lattice) for h in state.choice.hypotheses]
    faults += _of_marks(state, basis)
    return tuple(faults)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Planes put right, and what put them right."""

    stated: tuple[PlaneMarks, ...]  # all marks, as stated
    right: tuple[PlaneMarks, ...]  # good marks, where the chosen faults say they are
    kept: tuple[np.typing.NDArray[np.bool_], ...]  # masks of the good marks, a plane
    redundancy: Redundancy  # of the planes put right
    choice: Choice
    amounts: Array  # (n, 7)
    fit: Explained


def _could_be_one(chosen: tuple[Hypothesis, ...]) -> list[tuple[int, Misplacement]]:
    """Planes with a slip beside a wrong pitch or stand-off, which could be the other of the two alone."""
    other: dict[Misplacement, Misplacement] = {"pitch": "stand_off", "stand_off": "pitch"}
    slipped = {h.plane for h in chosen if h.kind in {"slip", "rotation"}}
    return [(h.plane, other[h.kind]) for h in chosen if h.kind in other and h.plane in slipped]


def _explain(stated: Sequence[PlaneMarks], basis: RayField, first: Hypothesis | None = None) -> _State:
    """Choose faults, put planes right by them, and again, until neither faults nor marks change.

    The first round follows one hypothesis only, the best or ``first``: far from the truth the modes are not linear, and
    several together would mend each other.
    """
    every = tuple(np.ones(len(p), dtype=bool) for p in stated)
    kept = every
    amounts = np.zeros((len(stated), MODES))
    chosen: tuple[Hypothesis, ...] = ()
    for turn in range(ROUNDS):
        good = [p.select(k) for p, k in zip(stated, kept, strict=True)]
        right = tuple(placement.put_right(basis, p, a) for p, a in zip(good, amounts, strict=True))
        redundancy = redundancy_of(right, basis)
        worse = _drop(redundancy, kept)
        if worse is not None and turn < ROUNDS - 1:
            kept = worse
            continue
        score = redundancy.score + redundancy.information @ amounts.ravel()
        evidence = Evidence.of(score, redundancy.information)
        choice = choose(evidence)
        if not chosen and len(choice.hypotheses) > 1 and evidence.total > GROSS * len(evidence.z):
            choice = replace(choice, hypotheses=(best_single(choice.evidence),))
        if not chosen and choice.hypotheses and first is not None:
            choice = replace(choice, hypotheses=(first,))
        fit = choice.evidence.fit(choice.hypotheses)
        step = np.zeros(MODES * len(stated))
        step[list(fit.columns)] = fit.amounts
        change = np.abs(step - amounts.ravel())[list(fit.columns)]
        same = choice.hypotheses == chosen
        chosen, amounts = choice.hypotheses, step.reshape(-1, MODES)
        if same and np.all(change <= 0.1 * np.sqrt(np.diag(fit.covariance))):
            break
        if not same:
            kept = every  # marks that looked bad beside a misplaced plane get another hearing
    return _State(tuple(stated), right, kept, redundancy, choice, amounts, fit)


def _drop(
    redundancy: Redundancy, kept: tuple[np.typing.NDArray[np.bool_], ...]
) -> tuple[np.typing.NDArray[np.bool_], ...] | None:
    """Masks without the marks that are off by more than chance, or None where there are none.

    A mark is off where its shift is beyond what the worst of so many good ones would show. Centroids of real spots have
    longer tails than a normal distribution: the limit follows the 95 % quantile of the shifts. Only marks at least half
    as bad as the worst go at a time, since a bad mark makes its neighbours look bad.
    """
    distance = np.sqrt(redundancy.shift_chi2)
    limit = max(_limit(len(distance)), 2.5 * float(np.quantile(distance, 0.95)))
    bad = distance > max(limit, 0.5 * float(distance.max()))
    before = sum(int((~k).sum()) for k in kept)
    if not bad.any() or bad.sum() + before > max(1, MOST_MARKS * (len(distance) + before)):
        return None
    masks, at = [], 0
    for mask in kept:
        new, n = mask.copy(), int(mask.sum())
        new[np.flatnonzero(mask)[bad[at : at + n]]] = False
        masks.append(new)
        at += n
    return tuple(masks)


def _limit(marks: int) -> float:
    """Distance, in standard errors, that the worst of so many good marks exceeds with probability `FALSE_ALARM`."""
    return float(np.sqrt(-2.0 * np.log(FALSE_ALARM / marks)))


def _of_marks(state: _State, basis: RayField) -> list[Fault]:
    """Every dropped mark, measured against all good ones by putting it back alone."""
    faults = []
    for k, mask in enumerate(state.kept):
        for j in np.flatnonzero(~mask):
            back = mask.copy()
            back[j] = True
            trial = list(state.right)
            trial[k] = placement.put_right(basis, state.stated[k].select(back), state.amounts[k])
            test = redundancy_of(trial, basis)
            at = sum(len(p) for p in trial[:k]) + int(back[:j].sum())
            size = float(np.linalg.norm(test.shift_px[at]))
            # the bad mark itself is no measure of noise
            error = float(test.shift_sigma[at]) * state.redundancy.sigma_px / test.sigma_px
            plane = state.stated[k]
            number, (u, v) = int(plane.mark[j]), plane.pixels[j]
            remedy = (
                f"plane {plane.name}: mark {number} near pixel ({u:.0f}, {v:.0f}) is off by {size:.3g} +- {error:.1g} px: "
                "look for dirt, a reflection or a damaged spot there; clean it and take the images again, or leave the mark out"
            )
            faults.append(Fault(plane.name, "mark", size, error, "px", (), None, number, remedy))
    return faults


def _of_hypothesis(one: Hypothesis, state: _State, lattice: Lattice | None) -> Fault:
    """A chosen hypothesis as a fault: its size, and what to do."""
    size = _size(one, state.fit)
    names = [p.name for p in state.stated]
    others = tuple(
        f"{names[h.plane]}: {h.kind} {_written(_size(h, fit))}" for h, fit in alternatives(state.choice, one)
    )
    plane = state.stated[one.plane]
    centre = None
    slip = _amounts(one, state.fit)[[SLIP_X, SLIP_Y]]
    if one.kind == "rotation":
        angle = _amounts(one, state.fit)[ROTATION]
        flat = placement.middle(plane) + np.array([-slip[1], slip[0]]) / angle
        x, y, z = plane.c_from_plane.apply(np.append(flat, 0.0))
        centre = (float(x), float(y), float(z))
    shift = _whole_pitches(slip, size, lattice) if one.kind == "slip" and lattice else None
    kind: FaultKind = "labelling" if shift else one.kind
    found = _WORDS[one.kind].format(size=_written(size), x=slip[0], y=slip[1])
    if centre is not None:
        found += f" about ({centre[0]:.0f}, {centre[1]:.0f})"
    advice = _ADVICE[kind]
    if shift:
        found = f"its labels are shifted by {shift[0]} rows and {shift[1]} columns"
    if others:
        advice += f" (cannot be told apart from: {'; '.join(others)})"
    remedy = f"plane {plane.name}: {found}: {advice}"
    return Fault(plane.name, kind, size.value, size.error, size.unit, others, centre, None, remedy)


@dataclass(frozen=True, slots=True)
class _Size:
    value: float
    error: float
    unit: str


def _written(size: _Size) -> str:
    """Value and standard error with as many decimals as the error deserves."""
    digits = max(0, 1 - int(np.floor(np.log10(size.error)))) if size.error > 0 and np.isfinite(size.error) else 3
    return f"{size.value:+.{digits}f} +- {size.error:.{digits}f} {size.unit}"


def _amounts(one: Hypothesis, fit: Explained) -> Array:
    """Amounts (7,) of the modes of one plane; 0 where not fitted."""
    amounts = np.zeros(MODES)
    for mode in range(MODES):
        column = MODES * one.plane + mode
        if column in fit.columns:
            amounts[mode] = fit.amounts[fit.columns.index(column)]
    return amounts


def _size(one: Hypothesis, fit: Explained) -> _Size:
    """Size of a misplacement: signed for one mode, the length of two, with its standard error along itself."""
    modes, unit, factor = _MEASURE[one.kind]
    at = [fit.columns.index(MODES * one.plane + m) for m in modes]
    vector, covariance = fit.amounts[at], fit.covariance[np.ix_(at, at)]
    if len(modes) == 1:
        return _Size(factor * float(vector[0]), factor * float(np.sqrt(covariance[0, 0])), unit)
    length = float(np.linalg.norm(vector))
    along = vector / max(length, 1e-300)
    return _Size(factor * length, factor * float(np.sqrt(along @ covariance @ along)), unit)


_MEASURE: dict[str, tuple[tuple[int, ...], str, float]] = {
    "slip": ((SLIP_X, SLIP_Y), "mm", 1.0),
    "rotation": ((ROTATION,), "deg", 180.0 / np.pi),
    "stand_off": ((STAND_OFF,), "mm", 1.0),
    "pitch": ((PITCH,), "%", 100.0),
    "tilt": ((TILT_X, TILT_Y), "deg", 180.0 / np.pi),
}
_WORDS = {
    "slip": "slipped sideways by {size}, ({x:+.3f}, {y:+.3f}) along its own x and y",
    "rotation": "rotated about its normal by {size}",
    "stand_off": "stands {size} from its stated stand-off",
    "pitch": "its pitch differs from the stated one by {size}",
    "tilt": "tilted by {size}",
}
_ADVICE: dict[FaultKind, str] = {
    "slip": "seat the target against its stops and take the images again, or correct `origin`",
    "rotation": "check how the target is seated and take the images again",
    "stand_off": "check the offset that was used against `origin`, correct the typing or take the images again",
    "pitch": "check that this plane was taken with the same target, and its `pitch`",
    "tilt": "check for dirt under the target or its offsets and take the images again, or correct `rotation`",
    "labelling": "check the fiducials in the image and `fiducials`, rows and columns of the target",
}


def _whole_pitches(slip: Array, size: _Size, lattice: Lattice) -> tuple[int, int] | None:
    """Rows and columns of a slip by whole pitches, or None where it is none."""
    pitches = slip / np.array(lattice.pitch)
    whole = np.round(pitches)
    near = np.abs(pitches - whole) * np.array(lattice.pitch) <= max(4 * size.error, 0.02 * min(lattice.pitch))
    if not whole.any() or not near.all():
        return None
    return int(whole[1]), int(whole[0])


def _of_mix_up(mixed: MixUp) -> Fault:
    """A mix-up as a fault without a size."""
    nan = float("nan")
    if mixed.kind == "labelling":
        remedy = (
            f"plane {mixed.plane}: its labels are {mixed.what} against the other planes: check that the image is not flipped, "
            "and how the target lies"
        )
        return Fault(
            mixed.plane, "labelling", nan, nan, "", tuple(f"{n}: labelling" for n in mixed.suspects), None, None, remedy
        )
    if mixed.kind == "swapped":
        remedy = (
            f"plane {mixed.plane}: its images and those of plane {mixed.other} have changed places: exchange `images` of the "
            "two, or their stand-offs"
        )
    else:
        remedy = (
            f"plane {mixed.plane}: shows the very view of plane {mixed.other}: the same images are used twice; give the images "
            f"that were taken at {mixed.plane}, or take them again"
        )
    return Fault(
        mixed.plane, "swapped", nan, nan, "", tuple(f"{n}: swapped" for n in mixed.suspects), None, None, remedy
    )
