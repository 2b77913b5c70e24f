"""The spot nearest to each of the pixels asked for: marks that are listed one by one.

Where the image as a whole shows none, each place is looked at by itself, with the contrast that it has there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Bools
from calibration.targets.layout import Polarity
from calibration.targets.spots import Method, Noise, find_spots

_SIZES = (3.0, 5.0, 8.0)  # px, of marks that are looked for each at its own place
_CLOSE = 3.0  # px from the pixel asked for
# what the image as a whole says of marks that it does not see; what it sees and refuses stays refused
_UNSEEN = ("no mark", "much fainter", "smaller than", "no plateau", "cut by the border")


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """M marks that were asked for; row i belongs to pixel i, NaN where none was measured."""

    centroids: Array  # (M, 2) px (u, v)
    covariance: Array  # (M, 2, 2) px^2
    diameter: Array  # (M,) px
    contrast: Array  # (M,) grey levels
    blur: Array  # (M,) px
    saturated: Array  # (M,) fraction
    reason: tuple[str, ...]  # (M,) empty where measured

    @property
    def measured(self) -> Bools:
        """(M,) which marks were measured."""
        return np.isfinite(self.centroids[:, 0])


def measure_marks(
    image: NDArray[np.generic],
    pixels: Array,
    *,
    polarity: Polarity = "light",
    method: Method = "edge",
    noise: Noise | None = None,
    reach: float | None = None,
) -> Marks:
    """Centroid of the mark nearest to each of the pixels asked for.

    Parameters
    ----------
    image : (H, W) array
        As for `find_spots`.
    pixels : (M, 2) array, px
        About where the marks are, (u, v).
    polarity, method, noise
        As for `find_spots`.
    reach : float, optional
        A mark farther from its pixel than this, px, is not taken for it; by default the mark's own diameter.

    Returns
    -------
    Marks
        Row i belongs to pixel i: NaN, and the reason, where no mark is near or the nearest is no good. Two pixels
        that meet the same mark both get none, since one of them must be wrong. Marks that are too faint or too small
        (2.5 px and more) for the image as a whole are fitted as blurred discs, each against its own surroundings.
    """
    asked = np.asarray(pixels, dtype=np.float64)
    if asked.ndim != 2 or asked.shape[1] != 2:
        raise ValueError(f"pixels are (M, 2); found shape {asked.shape}")
    spots = find_spots(image, polarity=polarity, method=method, noise=noise)
    bad = np.array([(u, v) for u, v, _ in spots.rejected], dtype=np.float64).reshape(-1, 2)
    places = np.concatenate([spots.centroids, bad])
    chosen = np.full(len(asked), -1)
    reason = [""] * len(asked)
    if len(places):
        offset = asked[:, None] - places[None]
        distance = np.sqrt(np.einsum("nmi,nmi->nm", offset, offset))
        rows_of = np.arange(len(asked))
        if len(spots):
            near = distance[:, : len(spots)].argmin(axis=1)
            close = distance[rows_of, near] <= (spots.diameter[near] if reach is None else reach)
            chosen[close] = near[close]
        limit = reach if reach is not None else float(np.median(spots.diameter)) if len(spots) else 20.0
        for i in np.flatnonzero(chosen < 0).tolist():
            k = int(distance[i].argmin())
            if k >= len(spots) and distance[i, k] <= limit:
                reason[i] = spots.rejected[k - len(spots)][2]
            else:
                reason[i] = f"no mark within reach; the nearest is {distance[i].min():.0f} px away"
    else:
        reason = ["no mark in the image"] * len(asked)
    names, counts = np.unique(chosen[chosen >= 0], return_counts=True)
    for twice in names[counts > 1]:
        for i in np.flatnonzero(chosen == twice).tolist():
            chosen[i], reason[i] = -1, "another listed pixel is nearest to the same mark"
    hit = chosen >= 0

    def rows(values: Array) -> Array:
        out = np.full((len(asked), *values.shape[1:]), np.nan)
        out[hit] = values[chosen[hit]]
        return out

    marks = Marks(
        rows(spots.centroids),
        rows(spots.covariance),
        rows(spots.diameter),
        rows(spots.contrast),
        rows(spots.blur),
        rows(spots.saturated),
        tuple(reason),
    )
    return _by_themselves(image, asked, marks, polarity)


def _by_themselves(image: NDArray[np.generic], asked: Array, marks: Marks, polarity: Polarity) -> Marks:
    """The same, with marks that are too faint or too small to be seen in the image as a whole, each at its own place."""
    from calibration.targets._points import fit_points, judged, matched_start

    inside = (np.minimum(asked, np.array(image.shape[::-1]) - 1 - asked) > _CLOSE * 2).all(axis=1)
    unseen = np.array([any(text in why for text in _UNSEEN) for why in marks.reason], dtype=bool)
    open_ = np.flatnonzero(unseen & inside)
    if not len(open_):
        return marks
    light = np.asarray(image, dtype=np.float32) * (1.0 if polarity == "light" else -1.0)
    reason = list(marks.reason)
    best = np.zeros(len(asked))
    values = [np.array(v) for v in (marks.centroids, marks.covariance, marks.diameter, marks.contrast, marks.blur)]
    for diameter in _SIZES:
        start = matched_start(light, asked[open_], diameter)
        found = fit_points(light, start, diameter)
        moved = np.linalg.norm(found.centre - asked[open_], axis=1)
        told = judged(found, moved=moved, reach=max(_CLOSE, 0.75 * diameter), fitted_for=diameter)
        for k, i in enumerate(open_.tolist()):
            if told[k] == "" and found.significance[k] > best[i]:
                best[i], reason[i] = found.significance[k], ""
                for into, fitted in zip(values, found[:5], strict=True):
                    into[i] = fitted[k]
            elif best[i] == 0.0 and "across" in told[k]:
                reason[i] = told[k]
    new = np.flatnonzero(best > 0.0)
    away = np.linalg.norm(values[0][new, None] - values[0][None], axis=2)
    away[np.arange(len(new)), new] = np.inf
    for i in new[np.nanmin(np.where(np.isfinite(away), away, np.inf), axis=1) < 1.0].tolist():
        reason[i] = "another listed pixel is nearest to the same mark"
        for into in values:
            into[i] = np.nan
    centroids, covariance, size, contrast, blur = values
    saturated = np.where(best > 0.0, 0.0, marks.saturated)
    return Marks(centroids, covariance, size, contrast, blur, saturated, tuple(reason))
