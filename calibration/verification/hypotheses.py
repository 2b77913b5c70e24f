"""Which misplacements of planes explain what the field of rays cannot: hypotheses, their tests and their choice.

All of it works on the score and information of seven modes a plane (`calibration.verification.redundancy`), so that thousands of
hypotheses cost little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np

from calibration.geometry import Array
from calibration.verification.misplacement import MODES, PITCH, ROTATION, SLIP_X, SLIP_Y, STAND_OFF, TILT_X, TILT_Y

Misplacement = Literal["slip", "rotation", "stand_off", "pitch", "tilt"]

MODES_OF: dict[Misplacement, tuple[int, ...]] = {
    "slip": (SLIP_X, SLIP_Y),
    "rotation": (ROTATION, SLIP_X, SLIP_Y),  # about any centre
    "stand_off": (STAND_OFF,),
    "pitch": (PITCH,),
    "tilt": (TILT_X, TILT_Y, STAND_OFF),  # about any axis
}
FALSE_ALARM = 5e-4  # a session, for planes; as much again for single marks
PENALTY = 9.0  # of chi-square a parameter: a larger hypothesis must be worth it
UNEXPLAINED = 1e-3  # probability below which what is left is more than noise
ALIKE = 6.0  # of penalised chi-square: hypotheses closer than this to the best are named with it
JITTER = ((SLIP_X, SLIP_Y), (ROTATION,), (STAND_OFF,), (TILT_X, TILT_Y))  # modes that share one scatter over planes
_TWO_SIGMA = 0.02275  # one tail of a normal distribution beyond two standard deviations
LEAST_FREEDOM = 8  # believed of a scatter over planes, however few they are: a gross fault must not hide in it


class Hypothesis(NamedTuple):
    """One plane misplaced in one way."""

    plane: int
    kind: Misplacement

    @property
    def columns(self) -> tuple[int, ...]:
        """Of the score."""
        return tuple(MODES * self.plane + mode for mode in MODES_OF[self.kind])


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Score and information of the modes, in whitened form: z = B a + noise, noise of unit covariance."""

    z: Array  # (r,)
    b: Array  # (r, 7n)
    planes: int

    @classmethod
    def of(cls, score: Array, information: Array) -> Score:
        """Whitened form of a score (7n,) and an information matrix (7n, 7n); invisible directions are left out."""
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
        seen = values > 1e-6 * values[-1]
        root = np.sqrt(values[seen])
        b = (vectors[:, seen] * root).T * scale
        z = (vectors[:, seen] / root).T @ (score / scale)
        return cls(z, b, len(score) // MODES)

    @property
    def total(self) -> float:
        """Chi-square of all visible modes."""
        return float(self.z @ self.z)

    def tempered(self, scatter: Array) -> Score:
        """The same where every plane scatters by ``scatter`` (7,) of each mode, one sigma, beside the noise."""
        spread = self.b * np.tile(scatter, self.planes)
        u, s, _ = np.linalg.svd(spread, full_matrices=False)  # no Cholesky: scatter may be a million times the noise
        less = 1.0 - 1.0 / np.sqrt(1.0 + s**2)
        return Score(self.z - (u * less) @ (u.T @ self.z), self.b - (u * less) @ (u.T @ self.b), self.planes)

    def fit(self, hypotheses: Sequence[Hypothesis]) -> Explained:
        """Least squares of some hypotheses together."""
        columns = sorted({c for h in hypotheses for c in h.columns})
        if not columns:
            return Explained((), 0.0, 0, np.zeros(0), np.zeros((0, 0)))
        a = self.b[:, columns]
        size = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
        u, s, v = np.linalg.svd(a / size, full_matrices=False)
        seen = s > 1e-4
        part = u[:, seen].T @ self.z
        back = (v[seen] / s[seen][:, None]) / size
        return Explained(tuple(columns), float(part @ part), int(seen.sum()), back.T @ part, back.T @ back)


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """What a set of hypotheses explains."""

    columns: tuple[int, ...]
    gain: float  # chi-square
    freedom: int  # parameters that the planes determine
    amounts: Array  # (columns,)
    covariance: Array  # (columns, columns)

    @property
    def score(self) -> float:
        """Chi-square less the penalty of the parameters."""
        return self.gain - PENALTY * self.freedom


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The hypotheses that the data ask for, and the score_of_modes under which they were judged."""

    hypotheses: tuple[Hypothesis, ...]
    score_of_modes: Score
    scatter: Array  # (7,) by which planes were found to scatter in each mode beside the faults, one sigma

    def widening(self, kind: Misplacement) -> float:
        """By what a standard error is to be enlarged, so that two of them still cover 95 % (Student 1908).

        The scatter of the planes is estimated from few of them, so that a size over its standard error has longer tails.
        """
        from scipy.stats import t

        if not self.scatter.any():
            return 1.0
        left = max(self.score_of_modes.planes - 2 - len(self.hypotheses), 1)
        freedom = min(len(g) * left for g in JITTER if set(g) & set(MODES_OF[kind]) or kind == "pitch")
        return float(t.isf(_TWO_SIGMA, freedom) / 2.0)


def singles(planes: int) -> list[Hypothesis]:
    """All hypotheses on one plane."""
    return [Hypothesis(k, kind) for k in range(planes) for kind in MODES_OF]


@lru_cache(maxsize=16)
def pairs(planes: int) -> tuple[tuple[Hypothesis, Hypothesis], ...]:
    """Pairs that can be told apart.

    On one plane, of kinds that do not contain one another; with five planes or more also on two planes (fewer planes
    would follow any two).
    """
    found = []
    for one, other in combinations(singles(planes), 2):
        if one.plane == other.plane:
            nested = bool(set(one.columns) & set(other.columns)) or {one.kind, other.kind} == {"stand_off", "pitch"}
            if not nested:
                found.append((one, other))
        elif planes >= 5:
            found.append((one, other))
    return tuple(found)


def choose(score_of_modes: Score) -> Choice:
    """The fewest misplacements that explain the score_of_modes.

    First with the noise of the marks alone. If something significant is left that no few faults explain, then the planes
    themselves scatter (a jig repeats only so well): that scatter is estimated, mode by mode, and the choice repeated
    with it, so that a fault must stand out from the other planes and not only from the noise.
    """
    none = np.zeros(MODES)
    if score_of_modes.planes < 3 or not len(score_of_modes.z):
        return Choice((), score_of_modes, none)
    chosen = select(score_of_modes)
    if not _left_over(score_of_modes, chosen):
        return Choice(chosen, score_of_modes, none)
    for _ in range(3):  # what no longer stands out belongs to the scatter
        scatter = _scatter(score_of_modes, chosen)
        if not scatter.any():
            return Choice(chosen, score_of_modes, none)
        tempered = score_of_modes.tempered(scatter)
        before, chosen = chosen, select(tempered, scatter)
        if chosen == before:
            break
    return Choice(chosen, tempered, scatter)


def best_single(score_of_modes: Score) -> Hypothesis:
    """The one misplacement that explains most for its parameters."""
    return max(singles(score_of_modes.planes), key=lambda h: score_of_modes.fit((h,)).score)


def _left_over(score_of_modes: Score, chosen: tuple[Hypothesis, ...]) -> bool:
    from scipy.stats import chi2

    fit = score_of_modes.fit(chosen)
    freedom = len(score_of_modes.z) - fit.freedom
    return freedom > 0 and bool(chi2.sf(score_of_modes.total - fit.gain, freedom) < UNEXPLAINED)


def select(score_of_modes: Score, scatter: Array | None = None) -> tuple[Hypothesis, ...]:
    """Nothing, one, two, or more hypotheses, each step significant after Bonferroni, beside a scatter of the planes."""
    from scipy.stats import chi2

    if chi2.sf(score_of_modes.total, len(score_of_modes.z)) > 0.05:
        return ()  # a fault that passes the tests below leaves far more than this
    one = singles(score_of_modes.planes)
    fits = {(h,): score_of_modes.fit((h,)) for h in one}
    first = max(fits, key=lambda s: fits[s].score)
    chosen: tuple[Hypothesis, ...] = ()
    if _significant(score_of_modes, (), first, len(one), scatter):
        chosen = first
    both = pairs(score_of_modes.planes)
    paired = {pair: score_of_modes.fit(pair) for pair in both}
    second = max(paired, key=lambda s: paired[s].score)
    if paired[second].score > score_of_modes.fit(chosen).score and _significant(
        score_of_modes, chosen, second, len(both), scatter
    ):
        chosen = second
    while len(chosen) >= 2 and len({h.plane for h in chosen}) <= score_of_modes.planes - 3:
        more = [
            (*chosen, h) for h in one if h not in chosen and not any(set(h.columns) & set(c.columns) for c in chosen)
        ]
        best = max(more, key=lambda s: score_of_modes.fit(s).score, default=chosen)
        if best == chosen or len({h.plane for h in best}) > score_of_modes.planes - 3:
            break
        if not _significant(score_of_modes, chosen, best, len(one), scatter):
            break
        chosen = best
    return chosen


def _significant(
    score_of_modes: Score,
    without: tuple[Hypothesis, ...],
    candidate: tuple[Hypothesis, ...],
    tried: int,
    scatter: Array | None,
) -> bool:
    """Whether a candidate explains more than chance would, ``tried`` having been looked at."""
    from scipy.stats import chi2, f

    less, more = score_of_modes.fit(without), score_of_modes.fit(candidate)
    freedom = max(more.freedom - less.freedom, 1)
    gain = more.gain - less.gain
    if scatter is None:
        return bool(chi2.sf(gain, freedom) * tried < FALSE_ALARM / 2)
    kinds = {m for h in candidate for m in MODES_OF[h.kind]}
    known = [len(g) * (score_of_modes.planes - 2 - len(candidate)) for g in JITTER if kinds & set(g)]
    left = max(min(known, default=0), LEAST_FREEDOM)
    return bool(f.sf(gain / freedom, freedom, left) * tried < FALSE_ALARM / 2)


def _scatter(score_of_modes: Score, chosen: tuple[Hypothesis, ...]) -> Array:
    """Scatter (7,) of the planes in each mode, one sigma, by restricted maximum likelihood, the chosen faults removed."""
    z, b = score_of_modes.z, score_of_modes.b
    columns = score_of_modes.fit(chosen).columns
    if columns:
        left = np.linalg.svd(b[:, columns], full_matrices=True)[0][:, score_of_modes.fit(chosen).freedom :]
        z, b = left.T @ z, left.T @ b
    size = np.array([1.0 / np.sqrt(np.mean((b[:, m::MODES] ** 2).sum(axis=0))) for m in range(MODES)])
    outer = [
        sum((np.outer(b[:, c], b[:, c]) for m in g for c in range(m, b.shape[1], MODES)), np.zeros((len(z), len(z))))
        for g in JITTER
    ]
    levels = np.concatenate([[0.0], 2.0 ** np.arange(-2, 8, 0.5)])
    variance = np.zeros(len(JITTER))

    def minus_log_likelihood(v: Array) -> float:
        values, vectors = np.linalg.eigh(np.eye(len(z)) + sum(x * o for x, o in zip(v, outer, strict=True)))
        values = np.maximum(values, 1.0)
        return float(np.log(values).sum() + ((vectors.T @ z) ** 2 / values).sum())

    for _ in range(3):
        for k, group in enumerate(JITTER):
            trials = []
            for level in levels:
                v = variance.copy()
                v[k] = (level * size[list(group)].mean()) ** 2
                trials.append((minus_log_likelihood(v), v[k]))
            variance[k] = min(trials)[1]
    scatter = np.zeros(MODES)
    for k, group in enumerate(JITTER):
        scatter[list(group)] = np.sqrt(variance[k])
    return scatter


def alternatives(choice: Choice, own: tuple[Hypothesis, ...]) -> list[tuple[Hypothesis, Explained]]:
    """Other hypotheses that explain the score_of_modes about as well as ``own``, of one plane, the other chosen ones kept.

    A wrong stand-off and a wrong pitch of one plane differ by a slip only; so each is held against the other with a slip
    allowed.
    """
    others = tuple(h for h in choice.hypotheses if h not in own)
    best = choice.score_of_modes.fit(choice.hypotheses)
    taken = {h.plane for h in others}
    kinds = {h.kind for h in own}
    found = []
    for h in singles(choice.score_of_modes.planes):
        if h in own or h.plane in taken:
            continue
        if h.plane == own[0].plane and any(set(MODES_OF[one.kind]) <= set(MODES_OF[h.kind]) for one in own):
            continue  # a larger hypothesis that contains this one
        fit = choice.score_of_modes.fit((*others, h))
        if h.plane == own[0].plane and {h.kind} | (kinds - {"slip"}) == {"stand_off", "pitch"}:
            slipped = choice.score_of_modes.fit((*others, h, Hypothesis(h.plane, "slip")))
            if slipped.gain > best.gain - ALIKE:
                found.append((h, slipped))
        elif fit.score > best.score - ALIKE:
            found.append((h, fit))
    return found
