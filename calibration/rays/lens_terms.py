"""Which terms a lens model has earned: each must foretell views that were left out, and what is held costs its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from calibration.geometry import Array
from calibration.rays.bundle import LENS, Adjusted, Term, adjust
from calibration.rays.plane_map import PlaneMarks

TERMS: tuple[Term, ...] = ("centre", "aspect", "k1", "k2", "tangential", "k3")
_NEEDS: dict[Term, Term] = {
    "k2": "k1",
    "k3": "k2",
    "tangential": "centre",
}  # a lens off its axis has its centre off, too
# What is known of lenses beforehand, one sigma: it stands in for the terms that no view has earned.
CENTRE = 0.02  # of the image's longer side
ASPECT = 0.002  # of the focal length
RADIAL = (0.05, 0.02, 0.01)  # of the radius, at the corner of the image: k1, k2, k3
TANGENTIAL = 0.002  # likewise


def choose_terms(
    views: Sequence[PlaneMarks], start: Adjusted, terms: frozenset[Term] = frozenset()
) -> tuple[Adjusted, frozenset[Term]]:
    """Terms added one by one, or two together, as long as views left out are foretold better by them.

    A view counts by the logarithm of its left-out squares times its marks, the likelihood of a view whose noise is its own:
    a blurred one has no more say than a sharp one. A term is earned where what it gains over all views is more than that
    gain's own standard error: so much the views agree on it. ``start`` was adjusted with ``terms``.

    Returns
    -------
    adjusted, terms
        The lens adjusted with the terms that were earned.
    """
    now = start
    while True:
        before = now.left_out(terms)
        better = _better(views, now, terms, before)
        if better is None:
            return now, terms
        now, terms = better


def _better(
    views: Sequence[PlaneMarks], now: Adjusted, terms: frozenset[Term], before: Array
) -> tuple[Adjusted, frozenset[Term]] | None:
    rest = [term for term in TERMS if term not in terms]
    marks = np.array([len(view) for view in views], dtype=np.float64)
    for many in (1, 2):
        foretold: list[tuple[float, int, frozenset[Term]]] = []
        for more in combinations(rest, many):
            wider = terms | frozenset(more)
            if all(_NEEDS.get(term) is None or _NEEDS[term] in wider for term in more):
                gain = gains(before, now.left_out(wider), marks)
                foretold.append((-float(gain.sum()), len(foretold), wider))
        for loss, _, wider in sorted(foretold)[:2]:
            if not loss < 0:
                break
            trial = adjust(views, now.lens, now.poses, wider)
            if earned(gains(before, trial.left_out(wider), marks)):
                return trial, wider
    return None


def gains(without: Array, having: Array, marks: Array) -> Array:
    """What each view (K,) gains: its marks times the logarithm by which its left-out squares fall.

    Views that the others cannot foretell, with or without, gain nothing; those that they no longer foretell lose all.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = marks * np.log(without / having)
    both = ~np.isfinite(without) & ~np.isfinite(having)
    return np.asarray(np.where(both, 0.0, np.nan_to_num(gain, nan=0.0, posinf=1e9, neginf=-1e9)))


def earned(gain: Array) -> bool:
    """Whether the gains (K,) of views sum up to more than the standard error of their sum."""
    return bool(gain.sum() > np.sqrt(len(gain)) * np.std(gain, ddof=1)) if len(gain) > 1 else False


def lens_covariance(found: Adjusted, terms: frozenset[Term], size: tuple[int, int], sigma: float) -> Array:
    """Covariance (9, 9) of fx fy cx cy k1 k2 p1 p2 k3, what is held counted as uncertain as lenses are.

    The views' information and, for the terms that were not earned, a prior about the held value; and beside that covariance the
    square of the step that the lens would take if nothing were held, since a term may be true without being earned. A held
    principal point is thus no known one, and the focal length that was found with it is as uncertain as that makes it.

    Parameters
    ----------
    found : Adjusted
        Views and lens.
    terms : frozenset of Term
        What was free.
    size : (width, height)
        Of the image, px.
    sigma : float
        px, of one coordinate of a mark.
    """
    variance = max(sigma, 1e-9) ** 2
    normal = found.information.sum(axis=0) / variance + _prior(found.lens, terms, size)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    covariance = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-13) / np.outer(scale, scale)
    step = covariance @ (found.score.sum(axis=0) / variance)
    return np.asarray(covariance + np.outer(step, step))


def _prior(lens: Array, terms: frozenset[Term], size: tuple[int, int]) -> Array:
    """Inverse covariance (9, 9) of what is held."""
    focal = float(lens[:2].mean())
    corner = np.hypot(*size) / 2 / focal
    normal = np.zeros((LENS, LENS))
    if "centre" not in terms:
        normal[[2, 3], [2, 3]] = 1.0 / (CENTRE * max(size)) ** 2
    if "aspect" not in terms:
        apart = np.array([1.0, -1.0]) / (ASPECT * focal)
        normal[:2, :2] += np.outer(apart, apart)
    names: tuple[Term, ...] = ("k1", "k2", "k3")
    for power, (name, at, share) in enumerate(zip(names, (4, 5, 8), RADIAL, strict=True), start=1):
        if name not in terms:
            normal[at, at] = (corner ** (2 * power) / share) ** 2
    if "tangential" not in terms:
        normal[[6, 7], [6, 7]] = (3 * corner / TANGENTIAL) ** 2
    return normal
