"""Faults in words: what is wrong with which plane, by how much, what cannot be told from it, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from calibration.digits import decimals
from calibration.geometry import Array, Pose
from calibration.rays import MOST_BAD, BadMarks, PlaneMarks
from calibration.verification import misplacement as placement
from calibration.verification.hypotheses import Choice, Explained, Hypothesis, Score, alternatives
from calibration.verification.misplacement import MODES, PITCH, ROTATION, SLIP_X, SLIP_Y, STAND_OFF, TILT_X, TILT_Y
from calibration.verification.mix_ups import MixUp

FaultKind: TypeAlias = Literal[
    "slip", "rotation", "stand_off", "tilt", "pitch", "swapped", "labelling", "mark", "moved"
]


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
    mark: int | None  # number of the mark on the target; such a fault does not make a session fail
    remedy: str  # what was found and what to do, one line


def of_hypothesis(
    one: Hypothesis,
    stated: Sequence[PlaneMarks],
    choice: Choice,
    fit: Explained,
    lattice: Lattice | None,
    *,
    stretched: bool = False,
) -> Fault:
    """A chosen hypothesis as a fault: its size, and what to do.

    ``stretched``: a pitch whose slip, chosen with it, only says about which point the spacing is wrong.
    """
    size = _size(one, fit, choice.widening(one.kind))
    names = [p.name for p in stated]
    own = (one, Hypothesis(one.plane, "slip")) if stretched else (one,)
    others = tuple(
        f"{names[h.plane]}: {h.kind} {_written(_size(h, fitted, choice.widening(h.kind)))}{' with a slip' if stretched else ''}"
        for h, fitted in alternatives(choice, own)
    )
    if stretched and len(stated) == 3:
        others += tuple(f"{name}: stand_off or pitch, with a slip" for name in names if name != names[one.plane])
    plane = stated[one.plane]
    centre = None
    amounts = _amounts(one.plane, fit)
    slip = amounts[[SLIP_X, SLIP_Y]]
    if one.kind == "rotation":
        centre = _in_c(plane, placement.middle(plane) + np.array([-slip[1], slip[0]]) / amounts[ROTATION])
    elif stretched:
        centre = _in_c(plane, -slip / amounts[PITCH])
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
    digits = decimals(size.error, usual=3)
    return f"{size.value:+.{digits}f} +- {size.error:.{digits}f} {size.unit}"


def _in_c(plane: PlaneMarks, flat: Array) -> tuple[float, float, float]:
    x, y, z = plane.c_from_plane.apply(np.append(flat, 0.0))
    return float(x), float(y), float(z)


def _amounts(plane: int, fit: Explained) -> Array:
    """Amounts (7,) of the modes of one plane; 0 where not fitted."""
    amounts = np.zeros(MODES)
    for mode in range(MODES):
        column = MODES * plane + mode
        if column in fit.columns:
            amounts[mode] = fit.amounts[fit.columns.index(column)]
    return amounts


def _size(one: Hypothesis, fit: Explained, widening: float = 1.0) -> _Size:
    """Size of a misplacement: signed for one mode, the length of two, with its standard error along itself."""
    modes, unit, factor = _MEASURE[one.kind]
    at = [fit.columns.index(MODES * one.plane + m) for m in modes]
    vector, covariance = fit.amounts[at], widening**2 * fit.covariance[np.ix_(at, at)]
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


def of_rig_moved(motion: Pose, about: Array, left_px: float) -> Fault:
    """Camera and jig that have moved against each other: every plane is seen elsewhere by one rigid motion."""
    angle = float(np.degrees(np.arccos(np.clip((np.trace(motion.rotation) - 1) / 2, -1, 1))))
    shift = motion.apply(about[None])[0] - about
    size = float(np.linalg.norm(shift))
    remedy = (
        f"all planes: the jig stands ({shift[0]:+.3f}, {shift[1]:+.3f}, {shift[2]:+.3f}) mm and {angle:.3f} degrees from where the rig "
        f"was calibrated (that motion leaves {left_px:.3f} px): the camera has moved, or the jig: calibrate again"
    )
    return Fault("all", "moved", size, float("nan"), "mm", (), None, None, remedy)


def of_mark(plane: PlaneMarks, row: int, size: float, error: float) -> Fault:
    """A single mark that is off by size px."""
    number, (u, v) = int(plane.mark[row]), plane.pixels[row]
    remedy = (
        f"plane {plane.name}: mark {number} near pixel ({u:.0f}, {v:.0f}) is off by {size:.3g} +- {error:.1g} px: "
        "it is left out; look for dirt, a reflection or a damaged spot there"
    )
    return Fault(plane.name, "mark", size, error, "px", (), None, number, remedy)


def of_marks(plane: PlaneMarks, bad: BadMarks) -> tuple[Fault, ...]:
    """Every bad mark of a plane."""
    return tuple(of_mark(plane, int(k), float(bad.size[k]), float(bad.sigma[k])) for k in np.flatnonzero(bad.rows))


def of_too_many_marks(plane: str, faults: Sequence[Fault], marks: int) -> Fault | None:
    """A plane of so many marks with more bad ones than may be left out, or None."""
    if len(faults) <= max(1, int(MOST_BAD * marks)):
        return None
    low, high = min(f.value for f in faults), max(f.value for f in faults)
    remedy = (
        f"plane {plane}: {len(faults)} of {marks} marks are off by {low:.2g} to {high:.2g} px, and no more than "
        f"{100 * MOST_BAD:.0f} % may be left out: clean the target, look for reflections, and take the images again"
    )
    return Fault(plane, "mark", float(len(faults)), float("nan"), "", (), None, None, remedy)


def of_scatter(worst: Hypothesis, stated: Sequence[PlaneMarks], score_of_modes: Score, off: float) -> Fault:
    """Planes that contradict each other by ``off`` px (rms) in a way that no few misplaced ones explain.

    The one that stands out most is named, but every other is a suspect.
    """
    size = _size(worst, score_of_modes.fit((worst,)))
    plane = stated[worst.plane]
    others = tuple(
        f"{p.name}: {worst.kind} {_written(_size(h, score_of_modes.fit((h,))))}"
        for p, h in zip(stated, (Hypothesis(k, worst.kind) for k in range(len(stated))), strict=True)
        if p is not plane
    )
    remedy = (
        f"the planes contradict each other by {off:.2f} px, and no one or two misplaced ones explain it (most of it: "
        f"plane {plane.name}, {worst.kind} {_written(size)}): check how the target is seated at every stand-off and what was "
        "typed, and take all planes again; with more planes more faults can be told apart"
    )
    return Fault(plane.name, worst.kind, size.value, size.error, size.unit, others, None, None, remedy)


def of_mix_up(mixed: MixUp) -> Fault:
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
            f"plane {mixed.plane}: shows what belongs to plane {mixed.other}: images or stand-offs have changed places: "
            "exchange `images` of the planes, or their `origin`"
        )
    elif mixed.kind == "reversed":
        remedy = (
            f"planes {mixed.plane} to {mixed.other}: the stand-offs grow towards the camera although it sees the target unmirrored, so "
            "that all that is ranged would be its own mirror image: count the stand-offs from the other end, or correct the "
            "handedness of the target's x, y and `origin`"
        )
    else:
        remedy = (
            f"plane {mixed.plane}: shows the very view of plane {mixed.other}: the same images are used twice; give the images "
            f"that were taken at {mixed.plane}, or take them again"
        )
    return Fault(
        mixed.plane, "swapped", nan, nan, "", tuple(f"{n}: swapped" for n in mixed.suspects), None, None, remedy
    )
