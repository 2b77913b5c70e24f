"""Faults of a calibration, by name: which plane, what is wrong with it, how much, and what to do.

Whole images that are mixed up come first (`calibration.verification.mix_ups`), then planes that stand where they are not said
to, and single marks (`calibration.verification.redundancy`, `calibration.verification.hypotheses`). What planes can and cannot tell is set out
in docs/method.md: an affine change of space that keeps the planes changes nothing here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Bools
from calibration.rays import MAX_ORDER, PlaneMarks, RayField, fit_ray_field
from calibration.verification import misplacement as placement
from calibration.verification._gross import coarse_starts
from calibration.verification.hypotheses import (
    FALSE_ALARM,
    Choice,
    Explained,
    Hypothesis,
    Misplacement,
    Score,
    best_single,
    choose,
)
from calibration.verification.misplacement import MODES, PITCH, SLIP_X, SLIP_Y
from calibration.verification.mix_ups import find_mix_ups, untangle
from calibration.verification.redundancy import Redundancy, redundancy_of
from calibration.verification.wording import Fault, FaultKind, Lattice, of_hypothesis, of_mark, of_mix_up, of_scatter

__all__ = ["Fault", "FaultKind", "Lattice", "find_faults"]

ROUNDS = 12  # of correction, until the faults no longer change
GROSS = 1e3  # times the score_of_modes that noise gives: so much that the modes may no longer be linear
SCATTER_PX = (
    0.1  # rms by which planes may contradict each other when no few faults explain it: a jig repeats only so well
)
SAME_POINT = (
    13.8  # chi-square of two freedoms that chance exceeds once in a thousand: a stretch about the target's middle
)
_TRUNCATION = 3.0  # times what the last order changed in a mark: as much may be the lens and not the mark
FEW = (
    32  # marks a plane, below which the field cannot be of an order so generous that a lens beyond it shows in nothing
)
MOST_MARKS = 0.05  # of all marks that may be dropped one by one; more are no matter of single marks


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
    faults = [of_mix_up(m) for m in mixed]
    if len(rest) < 2:
        return tuple(faults)
    basis = fit_ray_field(list(rest), orders=(3, 1)).field if field is None or mixed else field
    starts = coarse_starts(rest, basis)
    tried = [_explain(rest, basis, start) for start in starts]
    best = min(range(len(starts)), key=lambda i: tried[i].cost)
    start, state = starts[best], tried[best]
    for k, other in _could_be_one(state.choice.hypotheses):
        simpler = _explain(rest, basis, start, first=Hypothesis(k, other))
        if len(simpler.choice.hypotheses) < len(state.choice.hypotheses):
            state = simpler
    state, stretched = _stretched(rest, basis, start, state, lattice)
    bound = _bound(state, basis)
    for h in state.choice.hypotheses if bound.better else ():
        if not (h.plane in stretched and h.kind == "slip"):
            whole = h.plane in stretched and h.kind == "pitch"
            faults.append(of_hypothesis(h, state.stated, state.choice, state.fit, lattice, stretched=whole))
    if not state.choice.hypotheses and len(rest) > 2:
        off = float(np.sqrt((state.redundancy.moved_px**2).sum(axis=1).mean()))
        if off > SCATTER_PX and bound.contradicting and state.choice.scatter.any():
            faults.append(
                of_scatter(best_single(state.choice.score_of_modes), state.stated, state.choice.score_of_modes, off)
            )
    faults += [fault for fault in _of_marks(state, basis) if fault.value > bound.mark_px]
    return tuple(faults)


@dataclass(frozen=True, slots=True)
class _Bound:
    """What a session of few marks must show before a fault is believed; nothing where there are many."""

    better: bool = True  # whether the planes put right foretell marks so much better as a fault would have it
    contradicting: bool = True  # whether the planes contradict each other by more than marks are foretold
    mark_px: float = 0.0  # by which a single mark must be off


def _bound(state: _State, basis: RayField) -> _Bound:
    """Faults of a few marks against the error with which the marks foretell each other.

    With few marks a plane the noise of the centroids is no measure of a fault: the plate's own errors and what the lens does
    between the marks show as much. So a mark left out on all planes is foretold with the planes as stated and put right:
    misplacements are believed where its squares fall, over all planes, by more than they are on one; a scatter of the planes where
    what no field follows of it is more than that error, rms a mark; single marks where they are off by three times as much.
    """
    if min(len(p) for p in state.stated) >= FEW:
        return _Bound()
    try:
        after = fit_ray_field(list(state.right)).loo_px
        kept = [p.select(k) for p, k in zip(state.stated, state.kept, strict=True)]
        before = fit_ray_field(kept).loo_px
    except CalibrationError:
        return _Bound(False, False, float("inf"))
    stated = redundancy_of(kept, basis)
    total = Score.of(stated.score, stated.information).total
    off = stated.sigma_px * float(np.sqrt(total / sum(len(p) for p in kept)))
    return _Bound(len(kept) * (before**2 - after**2) > after**2, off > after, 3.0 * after)


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

    @property
    def cost(self) -> float:
        """Of what is not explained, and of the parameters that explain: minus twice the logarithm of the likelihood."""
        left = self.choice.score_of_modes.total - self.fit.score
        return left + 2.0 * self.redundancy.freedom * float(np.log(self.redundancy.sigma_px))


def _could_be_one(chosen: tuple[Hypothesis, ...]) -> list[tuple[int, Misplacement]]:
    """Planes with a slip beside a wrong pitch or stand-off, which could be the other of the two alone."""
    other: dict[Misplacement, Misplacement] = {"pitch": "stand_off", "stand_off": "pitch"}
    slipped = {h.plane for h in chosen if h.kind in {"slip", "rotation"}}
    return [(h.plane, other[h.kind]) for h in chosen if h.kind in other and h.plane in slipped]


def _stretched(
    rest: Sequence[PlaneMarks], basis: RayField, start: Array, state: _State, lattice: Lattice | None
) -> tuple[_State, set[int]]:
    """Planes with a slip beside a wrong pitch or stand-off that are but stretched about the middle of the target.

    To the planes, a slip with a stand-off is a slip with a pitch; where the latter leaves the middle of the target (of its
    grid, or of the marks seen) in its place, one cause explains both.
    """
    stretched: set[int] = set()
    own = {k: {h.kind for h in state.choice.hypotheses if h.plane == k} for k in range(len(rest))}
    asked = [k for k, kinds in own.items() if kinds in ({"slip", "pitch"}, {"slip", "stand_off"})]
    of_three = len(rest) == 3 and len(asked) == 1  # any of them could be the one
    for k in range(3) if of_three else asked:
        others = () if of_three else tuple(h for h in state.choice.hypotheses if h.plane != k)
        trial = _explain(rest, basis, start, fixed=(*others, Hypothesis(k, "slip"), Hypothesis(k, "pitch")))
        if trial.cost > state.cost + SAME_POINT:
            continue
        at = [trial.fit.columns.index(MODES * k + mode) for mode in (SLIP_X, SLIP_Y, PITCH)]
        amounts, covariance = trial.fit.amounts[at], trial.fit.covariance[np.ix_(at, at)]
        middles = [placement.middle(rest[k])]
        if lattice is not None:
            middles.append(np.array([lattice.columns - 1, lattice.rows - 1]) * np.array(lattice.pitch) / 2)
        for middle in middles:
            moves = np.column_stack([np.eye(2), middle])
            slip = moves @ amounts
            if slip @ np.linalg.solve(moves @ covariance @ moves.T, slip) < SAME_POINT:
                state, stretched = trial, stretched | {k}
                break
        if of_three and stretched:
            break
    return state, stretched


def _explain(
    stated: Sequence[PlaneMarks],
    basis: RayField,
    start: Array,
    *,
    first: Hypothesis | None = None,
    fixed: tuple[Hypothesis, ...] | None = None,
) -> _State:
    """Choose faults, put planes right by them, and again, until neither faults nor marks change.

    The first round follows one hypothesis only, the best or ``first``: far from the truth the modes are not linear, and
    several together would mend each other. It begins with the planes put right by ``start`` (n, 7). With ``fixed`` nothing
    is chosen.
    """
    every = tuple(np.ones(len(p), dtype=bool) for p in stated)
    kept = every
    amounts = start
    chosen: tuple[Hypothesis, ...] = ()
    for turn in range(ROUNDS):
        good = [p.select(k) for p, k in zip(stated, kept, strict=True)]
        right = tuple(placement.put_right(basis, p, a) for p, a in zip(good, amounts, strict=True))
        redundancy = redundancy_of(right, basis)
        worse = _drop(redundancy, kept, right, basis)
        if worse is not None and turn < ROUNDS - 1:
            kept = worse
            continue
        score = redundancy.score + redundancy.information @ amounts.ravel()
        score_of_modes = Score.of(score, redundancy.information)
        choice = choose(score_of_modes)
        if (
            not chosen
            and not start.any()
            and len(choice.hypotheses) > 1
            and score_of_modes.total > GROSS * len(score_of_modes.z)
        ):
            choice = replace(choice, hypotheses=(best_single(choice.score_of_modes),))
        if not chosen and choice.hypotheses and first is not None:
            choice = replace(choice, hypotheses=(first,))
        if fixed is not None:
            choice = replace(choice, hypotheses=fixed)
        fit = choice.score_of_modes.fit(choice.hypotheses)
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
    redundancy: Redundancy,
    kept: tuple[np.typing.NDArray[np.bool_], ...],
    right: Sequence[PlaneMarks],
    basis: RayField,
) -> tuple[np.typing.NDArray[np.bool_], ...] | None:
    """Masks without the marks that are off by more than chance, or None where there are none.

    A mark is off where its shift is beyond what the worst of so many good ones would show. Centroids of real spots have
    longer tails than a normal distribution: the limit follows the 95 % quantile of the shifts. Only marks at least half
    as bad as the worst go at a time, since a bad mark makes its neighbours look bad. No mark is blamed for what the field
    cannot follow.
    """
    distance = np.sqrt(redundancy.shift_chi2)
    limit = max(_limit(len(distance)), 2.5 * float(np.quantile(distance, 0.95)))
    bad = distance > max(limit, 0.5 * float(distance.max()))
    if bad.any():
        distance = np.where(_settled(redundancy, right, basis), distance, 0.0)
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


def _settled(redundancy: Redundancy, right: Sequence[PlaneMarks], basis: RayField) -> Bools:
    """Mask (N,) of the marks whose shifts are more than what the last orders of the field changed in them.

    At the corner of a very wide lens the polynomial has not converged, and what it misses is large at single marks. Where the
    order could be raised by all of `EXTRA_ORDER` it has converged, and every shift counts.
    """
    order = redundancy.field.slope_order
    if order < MAX_ORDER:
        return np.ones(len(redundancy.shift_px), dtype=bool)
    change = np.zeros(len(redundancy.shift_px))
    for most in (order - 1, order - 2):
        lower = redundancy_of(right, basis, most=most)
        fallen = min(1.0, redundancy.sigma_px / lower.sigma_px) ** 0.5  # more slowly at a corner than in the middle
        change = np.maximum(change, fallen * np.linalg.norm(redundancy.shift_px - lower.shift_px, axis=1))
    return np.asarray(np.linalg.norm(redundancy.shift_px, axis=1) > _TRUNCATION * change)


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
            faults.append(of_mark(state.stated[k], int(j), size, error))
    return faults
