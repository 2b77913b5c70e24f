"""An image of a target to the centroids of its spots, with their covariance.

The steps: a threshold at the grey level of the image's own edges, connected components, the levels and grey moments of
every component, rejection of what is no spot (each with a reason), and a fit of the blurred edge of an ellipse to the
grey levels near the outline. Only those pixels carry information on the centre (DePiero & Kress, fig. 4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.geometry import Array, Bools
from calibration.targets.layout import Polarity

Method = Literal["edge", "paper", "gray", "binary"]
Rejected: TypeAlias = tuple[float, float, str]  # u, v in px, and why

_MODEL_ERROR = 0.003  # of the contrast: how well the profile of an edge is known
_FOOT = 0.1  # of the contrast: below it lies stray light about the spots; leaving it out costs 2 % of the precision
_LEAST_TEXTURE = 0.0125  # of the contrast, one standard deviation: less is taken for noise
_CUT = 4.0  # standard deviations at which a residual is cut off
_SAMPLE = 60  # spots that are enough to tell how ragged the outlines are
_LEAST_PIXELS = 9  # smaller specks are noise and are not even listed
_FEW = 6  # spots that a target has at least: with fewer, smaller ones are looked for
_SMALL = 5.5  # px, diameter of spots that may be fitted as blurred discs
_SMALL_AREA = 45  # px^2
_SMALLEST = 2.5  # px
_SCREEN = 120  # specks, brightest and of all tiers, of which one must be a mark before all of them are fitted


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Variance of a grey level I: ``gain * I + read**2 + 1/12``, the last for rounding to whole grey levels."""

    gain: float  # grey levels of variance a grey level of signal (1 / electrons a grey level)
    read: float  # grey levels, one standard deviation

    def variance(self, level: ArrayLike) -> Array:
        """Variances of grey levels, grey levels squared."""
        return np.asarray(self.gain * np.maximum(np.asarray(level, dtype=np.float64), 0.0) + self.read**2 + 1.0 / 12.0)


@dataclass(frozen=True, slots=True, eq=False)
class Spots:
    """N spots of one image, and what was seen but is no spot."""

    centroids: Array  # (N, 2) px (u, v)
    covariance: Array  # (N, 2, 2) px^2, from image noise and raggedness of the outline
    diameter: Array  # (N,) px, of the circle of equal area, blur taken off
    contrast: Array  # (N,) grey levels between spot and surroundings, positive
    blur: Array  # (N,) px, one sigma of the edge, pixel included
    saturated: Array  # (N,) fraction of the spot's pixels that are clipped
    rejected: tuple[Rejected, ...] = ()

    def __len__(self) -> int:
        return len(self.centroids)

    @property
    def columns(self) -> tuple[Array, Array, Array, Array, Array, Array]:
        """All but ``rejected``, in order."""
        return self.centroids, self.covariance, self.diameter, self.contrast, self.blur, self.saturated

    def select(self, keep: Bools | NDArray[np.intp]) -> Spots:
        """The spots of a mask (N,) or of indices; ``rejected`` stays."""
        return Spots(
            self.centroids[keep],
            self.covariance[keep],
            self.diameter[keep],
            self.contrast[keep],
            self.blur[keep],
            self.saturated[keep],
            self.rejected,
        )


def find_spots(
    image: NDArray[np.generic],
    *,
    polarity: Polarity = "light",
    method: Method = "edge",
    noise: Noise | None = None,
    min_diameter: float = 4.0,
) -> Spots:
    """Find the round spots of an image and measure their centroids.

    Parameters
    ----------
    image : (H, W) array
        Grey levels of one channel: uint8, uint16 or floating (a mean of repeats).
    polarity : {"light", "dark"}
        Whether spots are lighter or darker than what surrounds them.
    method : {"edge", "paper", "gray", "binary"}
        ``edge`` fits the blurred edge of an ellipse, weighted by noise and raggedness: nearly efficient. ``paper`` is
        the truncated error function of DePiero & Kress (section "Camera calibration"): the levels of spot and
        background lie three standard deviations either side of the mean of a Gaussian, whose cumulative weights the
        pixels. ``gray`` weights by the grey level above the background, ``binary`` counts pixels above half.
    noise : Noise, optional
        Noise of the camera; measured on plateaus and backgrounds of the spots themselves when not given.
    min_diameter : float
        Smaller spots, px, are rejected where there are larger ones; where there are none, spots of 2.5 px and more are
        fitted as blurred discs.

    Returns
    -------
    Spots
        In no particular order. Empty where the image has no spots; nothing is guessed.

    Raises
    ------
    CalibrationError
        The image has no contrast at all: black, saturated or uniform.
    ValueError
        The image is not a 2-D array of finite numbers.
    """
    from calibration.targets import _spot_kernels as kernel
    from calibration.targets._detect import clip_level, spot_mask

    grey, clip = np.asarray(image), np.inf
    if grey.ndim != 2 or not grey.size:
        raise ValueError(f"an image is (H, W), one channel; found shape {grey.shape}")
    full = clip_level(grey)
    light = np.ascontiguousarray(grey, dtype=np.float32)
    if not np.isfinite(light.sum()):
        raise ValueError("an image holds finite grey levels only")
    if polarity == "dark":
        light = -light
    else:
        clip = full
    labels, table = kernel.components(spot_mask(light), _LEAST_PIXELS)
    shapes = kernel.shapes(light, labels, table, clip)
    why = _no_spot(shapes, table, light.shape, min_diameter)
    chosen = np.flatnonzero(why == "")
    sign = -1.0 if polarity == "dark" else 1.0
    variance = _plateau_noise(shapes[chosen], noise, sign, whole=grey.dtype.kind in "ui")
    fit = _fit_edges(light, labels, chosen, shapes[chosen], variance)
    spots = _assemble(shapes[chosen], fit)
    if method != "edge":
        centre = _weighted_centroids(light, labels, chosen, shapes[chosen], method)
        spots = Spots(centre, spots.covariance, spots.diameter, spots.contrast, spots.blur, spots.saturated)
    late = _bad_fit(spots, shapes[chosen], fit)
    keep = late == ""
    middle = np.stack([table[:, kernel.SUM_U], table[:, kernel.SUM_V]], axis=1) / table[:, kernel.AREA, None]
    why[chosen] = late
    listed = tuple((float(middle[k, 0]), float(middle[k, 1]), str(why[k])) for k in np.flatnonzero(why != ""))
    kept = spots.select(keep)
    # of marks about as large as the least that has an edge, some would be taken and some not
    lost = int(np.char.startswith(why, "smaller than").sum())
    if len(kept) < _FEW or (float(np.median(kept.diameter)) < _SMALL and lost > 0.05 * len(kept)):
        tiny = _small_spots(light, clip, min_diameter)
        if len(tiny) >= max(len(kept), _FEW) or not len(kept):
            larger = tuple(each for each in listed if not each[2].startswith("smaller than"))
            return Spots(*tiny.columns, (*tiny.rejected, *larger))
    return Spots(kept.centroids, kept.covariance, kept.diameter, kept.contrast, kept.blur, kept.saturated, listed)


def _small_spots(light: NDArray[np.float32], clip: float, min_diameter: float) -> Spots:
    """Spots of two and a half to about six pixels, which have no plateau: fitted as blurred discs, where there are six or more.

    Specks of noise are as small: what differs from most in size, or is much fainter, is none of them.
    """
    from calibration.targets import _points as points
    from calibration.targets import _spot_kernels as kernel
    from calibration.targets._detect import spot_mask

    nothing = np.zeros(0)
    none = Spots(np.zeros((0, 2)), np.zeros((0, 2, 2)), nothing, nothing, nothing, nothing)
    table = kernel.components(spot_mask(light), 1)[1]
    area = table[:, kernel.AREA]
    side = (
        np.maximum(table[:, kernel.BOTTOM] - table[:, kernel.TOP], table[:, kernel.RIGHT] - table[:, kernel.LEFT]) + 1
    )
    middle = np.stack([table[:, kernel.SUM_U], table[:, kernel.SUM_V]], axis=1) / np.maximum(area, 1.0)[:, None]
    peak = light[np.round(middle[:, 1]).astype(int), np.round(middle[:, 0]).astype(int)] - np.median(light)
    tried = (area <= _SMALL_AREA) & (side <= 9) & (area >= 0.4 * side**2)
    if tried.sum() < _FEW:
        return none
    tried &= peak > 0.25 * np.sort(peak[tried])[-_FEW]
    if tried.sum() < _FEW:
        return none
    about = max(float(np.sqrt(4.0 * np.median(area[tried]) / np.pi)), 2.0)

    def fitted(start: Array) -> tuple[points.Points, list[str]]:
        found = points.fit_points(light, start, about)
        moved = np.linalg.norm(found.centre - start, axis=1)
        return found, points.judged(found, moved=moved, reach=1.5, fitted_for=2.0 * about)

    start, order = middle[tried], np.argsort(-peak[tried], kind="stable")
    if len(start) > 2 * _SCREEN and "" not in fitted(start[np.sort(order[_screened(len(order))])])[1]:
        return none  # grain: not one of the brightest, nor of a sample of the others
    found, told = fitted(start)
    usual = float(np.median(found.contrast[[not why for why in told]])) if "" in told else 0.0
    told = [
        "much fainter than the others" if not w and c < 0.25 * usual else w
        for w, c in zip(told, found.contrast, strict=True)
    ]
    good = np.array([not why for why in told], dtype=bool) & (
        found.diameter + 2.0 * found.blur >= min(min_diameter, _SMALLEST)
    )
    place = np.where(np.isfinite(found.centre), found.centre, middle[tried])
    rejected = tuple((float(u), float(v), why) for (u, v), why in zip(place, told, strict=True) if why)
    column, row = np.round(place).astype(int).T
    over = light[np.clip(row, 0, light.shape[0] - 1), np.clip(column, 0, light.shape[1] - 1)] >= clip
    return Spots(
        found.centre[good], found.covariance[good], found.diameter[good], found.contrast[good], found.blur[good],
        over[good].astype(np.float64), rejected,
    )  # fmt: skip


def _screened(count: int) -> NDArray[np.intp]:
    """Of so many specks, brightest first, those that tell whether marks are among them: the first and some of each tier."""
    return np.unique(np.concatenate([np.arange(_SCREEN), np.linspace(0, count - 1, _SCREEN).astype(np.intp)]))


def _no_spot(shapes: Array, table: Array, size: tuple[int, ...], min_diameter: float) -> NDArray[np.str_]:
    """Why a component is no spot, judged by its levels and moments; an empty text where it may be one."""
    from calibration.targets import _spot_kernels as kernel

    why = np.full(len(table), "", dtype="U80")
    if not len(table):
        return why
    height, width = size
    blur = np.where(np.isfinite(shapes[:, kernel.BLUR]), shapes[:, kernel.BLUR], 1.0)
    margin = 2.0 * blur
    border = (
        (table[:, kernel.TOP] < margin)
        | (table[:, kernel.LEFT] < margin)
        | (table[:, kernel.BOTTOM] > height - 1 - margin)
        | (table[:, kernel.RIGHT] > width - 1 - margin)
    )
    diameter = 2.0 * (shapes[:, kernel.GUU] * shapes[:, kernel.GVV] - shapes[:, kernel.GUV] ** 2) ** 0.25
    contrast = shapes[:, kernel.LEVEL] - shapes[:, kernel.GROUND]
    trace, det = shapes[:, kernel.GUU] + shapes[:, kernel.GVV], (diameter / 2.0) ** 4
    long = np.sqrt(trace / 2.0 + np.sqrt(np.maximum(trace**2 / 4.0 - det, 0.0)))
    elongation = long / (diameter / 2.0)
    # a disk of few pixels is never quite round
    rough = 0.05 + 0.3 / np.maximum(diameter, 1.0)

    def mark(bad: Bools, text: str) -> None:
        why[bad & (why == "")] = text

    mark(border, "cut by the border of the image")
    mark(~np.isfinite(shapes[:, kernel.U]), "no plateau above its surroundings")
    mark(diameter < min_diameter, f"smaller than {min_diameter:g} px: dirt or noise")
    mark(elongation > 1.75, "too long for a spot: a scratch or a streak")
    mark(shapes[:, kernel.TRIANGLE] > rough, "not round: three corners")
    mark(shapes[:, kernel.SQUARE] > rough, "not round: four corners")
    mark(shapes[:, kernel.SKEW] > rough, "not round: one-sided")
    # a blurred disk has larger moments than a sharp one of its area
    soft = (2.0 * blur / np.maximum(diameter, 1.0)) ** 2
    whole = (1.0 + soft) ** 2 / (1.0 + 6.0 * soft + 3.0 * soft**2)
    mark(shapes[:, kernel.FILL] < 0.85 * whole, "not round: hollow or ragged")
    good = why == ""
    if good.sum() >= 5:
        usual, size_usual = np.median(contrast[good]), np.median(diameter[good])
        mark(contrast < 0.25 * usual, "much fainter than the others: a reflection or dirt")
        mark(diameter < 0.4 * size_usual, "much smaller than the others: dirt")
        mark(diameter > 4.0 * size_usual, "much larger than the others")
        mark(blur > 3.0 * np.median(blur[good]), "much more blurred than the others: a reflection")
    return why


def _plateau_noise(shapes: Array, noise: Noise | None, sign: float, *, whole: bool) -> Array:
    """Variances (N, 2) of background and plateau: of the camera where known, else the median over the spots."""
    from calibration.targets import _spot_kernels as kernel

    if noise is not None:
        return noise.variance(sign * shapes[:, [kernel.GROUND, kernel.LEVEL]])
    contrast = shapes[:, kernel.LEVEL] - shapes[:, kernel.GROUND]
    # no edge is known to better than a few thousandths of its contrast, however quiet the camera
    out = np.repeat(_MODEL_ERROR**2 * contrast[:, None] ** 2 + (1.0 / 12.0 if whole else 0.0), 2, axis=1)
    for column, source in enumerate((kernel.NOISE_OUT, kernel.NOISE_IN)):
        measured = shapes[np.isfinite(shapes[:, source]), source]
        if len(measured):
            out[:, column] = np.maximum(out[:, column], float(np.median(measured)))
    out[:, 0] += (_typical_spread(shapes[:, kernel.HALO]) * contrast) ** 2
    return out


def _fit_edges(
    light: NDArray[np.float32], labels: NDArray[np.int32], chosen: NDArray[np.intp], shapes: Array, variance: Array
) -> Array:
    """Fit the edges, weighted by noise and by how ragged the outlines are, which a first fit of some spots measures."""
    from calibration.targets import _spot_kernels as kernel

    # texture of the plateau is no part of the edge: what lies within its spread of the level is cut off
    spread = _typical_spread(shapes[:, kernel.TEXTURE])
    high = max(0.6, 1.0 - 4.0 * spread) if spread > _LEAST_TEXTURE else np.inf
    owner = (chosen + 1).astype(np.int32)
    some = np.linspace(0, len(shapes) - 1, min(len(shapes), _SAMPLE)).astype(np.intp)
    rules = kernel.EdgeRules(0.0, _FOOT, float(high), 3, _CUT)
    first = kernel.edges(light, labels, owner[some], shapes[some], variance[some], rules)
    ragged = first[np.isfinite(first[:, kernel.RAGGED]), kernel.RAGGED]
    tau2 = max(0.0, float(np.median(ragged))) if len(ragged) else 0.0
    rules = kernel.EdgeRules(tau2, _FOOT, float(high), 5, _CUT)
    return np.asarray(kernel.edges(light, labels, owner, shapes, variance, rules))


def _typical_spread(correlated: Array) -> float:
    """One standard deviation of what neighbouring pixels share, median over the spots, as a part of the contrast."""
    known = correlated[np.isfinite(correlated)]
    return float(np.sqrt(max(np.median(known), 0.0))) if len(known) else 0.0


def _assemble(shapes: Array, fit: Array) -> Spots:
    from calibration.targets import _spot_kernels as kernel

    excess = np.maximum(fit[:, kernel.CHI2], 1.0)[:, None, None]
    covariance = fit[:, [kernel.CUU, kernel.CUV, kernel.CUV, kernel.CVV]].reshape(-1, 2, 2) * excess
    half = 2.0 * (fit[:, kernel.GUU] * fit[:, kernel.GVV] - fit[:, kernel.GUV] ** 2) ** 0.25
    # blur draws the half level of a curved edge inwards
    diameter = half + 2.0 * fit[:, kernel.E_BLUR] ** 2 / half
    contrast = shapes[:, kernel.LEVEL] - shapes[:, kernel.GROUND]
    return Spots(
        fit[:, :2].copy(),
        covariance,
        diameter,
        contrast,
        fit[:, kernel.E_BLUR].copy(),
        shapes[:, kernel.CLIPPED].copy(),
    )


def _bad_fit(spots: Spots, shapes: Array, fit: Array) -> NDArray[np.str_]:
    """Why the fit of a spot's edge is not to be believed."""
    from calibration.targets import _spot_kernels as kernel

    why = np.full(len(spots), "", dtype="U80")
    if not len(spots):
        return why
    moved = np.linalg.norm(fit[:, :2] - shapes[:, :2], axis=1)
    sigma = np.sqrt(spots.covariance[:, 0, 0] + spots.covariance[:, 1, 1])
    why[~(moved < 0.3 + 0.03 * spots.diameter + 4.0 * sigma)] = (
        "its outline and its grey levels disagree: dirt or a shadow on it"
    )
    why[~np.isfinite(fit[:, kernel.U])] = "no edge could be fitted"
    return why


def _weighted_centroids(
    light: NDArray[np.float32], labels: NDArray[np.int32], chosen: NDArray[np.intp], shapes: Array, method: Method
) -> Array:
    """Centroids (N, 2) px by a weight of each pixel's own grey level: the peers of the edge fit."""
    from scipy.special import ndtr

    from calibration.targets import _spot_kernels as kernel

    out = np.full((len(shapes), 2), np.nan)
    height, width = light.shape
    truncated = 2.0 * float(ndtr(3.0)) - 1.0
    for i, (k, s) in enumerate(zip(chosen, shapes, strict=True)):
        margin = 3.0 * s[kernel.BLUR] + 1.0
        reach = np.sqrt(s[[kernel.GUU, kernel.GVV]]) + margin
        u0, v0 = np.maximum(np.floor(s[:2] - reach), 0).astype(int)
        u1, v1 = np.minimum(np.ceil(s[:2] + reach) + 1, (width, height)).astype(int)
        v, u = np.mgrid[v0:v1, u0:u1]
        own = (labels[v0:v1, u0:u1] == 0) | (labels[v0:v1, u0:u1] == k + 1)
        level = (light[v0:v1, u0:u1] - s[kernel.GROUND]) / (s[kernel.LEVEL] - s[kernel.GROUND])
        if method == "paper":
            weight = np.clip((ndtr(6.0 * level - 3.0) - ndtr(-3.0)) / truncated, 0.0, 1.0)
        elif method == "gray":
            weight = level
        else:
            weight = (level > 0.5).astype(np.float64)
        weight = np.where(own, weight, 0.0)
        out[i] = (weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()
    return out
