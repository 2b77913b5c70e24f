"""A stripe image to sub-pixel positions, one a row or column."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Codes
from calibration.reason import Reason
from ranging.background import Image, Noise, check_image, saturation_level, typical_noise
from ranging.errors import RangingError
from ranging.stripe import _table as t

CLEAR = 0.1  # contrast of speckle that clipped stripes must show to be taken as speckled
WANDERING = 0.4  # of the light in peaks that go on from line to line: where less does, the stripe may be a wide one
COARSE = 8  # px of the blocks that are then looked at
LONELY = 10  # lines from the next wide one, from where on a line is looked at pixel by pixel
FINEST = 6.0  # px, one sigma: wider stripes are measured with pixels taken together

Along = Literal["rows", "columns"]
Method = Literal["auto", "centroid", "gaussian", "ridge"]
Which = Literal["strongest", "first", "last", "continuous"]
Switch = Literal["auto", "on", "off"]


@dataclass(frozen=True, slots=True, eq=False)
class Stripe:
    """One answer a line of the image: a column where the stripe runs along rows, a row where along columns."""

    along: Along  # the stripe runs along image rows (one answer a column) or columns (one a row)
    position: Array  # (N,) px across the line, NaN where there is none; N = all lines of the image
    sigma: Array  # (N,) px, one standard deviation, independent from line to line
    width: Array  # (N,) px, one sigma of the stripe's profile across the line
    peak: Array  # (N,) grey levels above the background
    reason: Codes  # (N,) a Reason
    floor: Array  # (N,) grey levels, the background under the stripe
    asymmetry: (
        Array  # (N,) third Hermite term of the profile over its peak; positive: the longer tail is at the higher pixels
    )
    noise: Noise | None = None  # of the camera, as known or estimated
    speckle: float = 0.0  # contrast of the speckle that sigma allows for; 0 where none was recognised

    @property
    def pixels(self) -> Array:
        """(N, 2) px as (u, v)."""
        lines = np.arange(len(self.position), dtype=np.float64)
        pair = (lines, self.position) if self.along == "rows" else (self.position, lines)
        return np.stack(pair, axis=1)


@dataclass(frozen=True, slots=True)
class StripeOptions:
    """How a stripe is looked for and measured; grey levels and pixels of the image as given."""

    method: Method = "auto"  # auto: gaussian
    which: Which = "strongest"  # of several peaks on a line
    gain_e: float | None = None  # electrons a grey level; None: estimated
    read_noise: float | None = None  # grey levels; None: estimated
    saturation: int | None = None  # grey level at which the camera clips; None: the end of the depth
    threshold: float | None = None  # least peak above the background, grey levels; None: six times the noise
    minimum_width: float = 0.42  # px, one sigma
    maximum_width: float = (
        32.0  # px, one sigma; up to 6 a line is measured pixel by pixel, beyond with pixels taken together
    )
    two_peaks: float = 0.8  # a second peak of this share of the strongest leaves the line without an answer
    edge: float = 0.15  # an asymmetry beyond this is a stripe cut by an edge
    narrowing: float = 0.94  # a line this much narrower than its stretch is usually is cut by an edge
    neighbours: bool = True  # lines are compared with their neighbours to find those at edges
    speckle: Switch = "auto"

    def __post_init__(self) -> None:
        if not 0.0 < self.minimum_width < self.maximum_width:
            raise ValueError("0 < minimum_width < maximum_width")


def find_along(image: Image) -> Along:
    """Along which axis of the image the stripe runs.

    The peaks of all rows and of all columns are found. A stripe along the rows is crossed once by every column: the
    peaks of neighbouring columns lie close together, those of neighbouring rows are noise or a long way apart. Where
    peaks wander along either axis, as on a wide stripe, blocks of pixels are looked at instead.
    """
    check_image(image)
    scores, shares = _going_on(image)
    if max(shares.values()) < WANDERING and min(image.shape[:2]) >= 8 * COARSE:
        rows, columns = (size // COARSE * COARSE for size in image.shape[:2])
        blocks = image[:rows, :columns].reshape(rows // COARSE, COARSE, columns // COARSE, COARSE)
        scores, _ = _going_on(np.ascontiguousarray(blocks.mean(axis=(1, 3)).astype(image.dtype)))
    return "columns" if scores["columns"] > scores["rows"] else "rows"


def _going_on(image: Image) -> tuple[dict[Along, float], dict[Along, float]]:
    """How much light is in peaks that go on from line to line, along either axis, and what share of all peaks that is."""
    scores: dict[Along, float] = {}
    shares: dict[Along, float] = {}
    floor = float(np.median(image[::4, ::4]))
    axes: tuple[Along, Along] = ("columns", "rows")
    for along in axes:
        peaks = _peaks(image, image[:0], False, along, 12)
        place, value = peaks[0].astype(np.float64), peaks[1].astype(np.float64)
        weight = np.maximum(np.minimum(value[1:], value[:-1]) - floor, 0.0)
        step = np.abs(np.diff(place))
        scores[along] = float(np.sum(weight * np.maximum(0.0, 1.0 - step / 3.0)))
        shares[along] = scores[along] / max(float(weight.sum()), 1e-9)
    return scores, shares


def extract(
    image: Image, *, along: Along, options: StripeOptions | None = None, background: Image | None = None
) -> Stripe:
    """Sub-pixel position of the stripe on every line of a gray image.

    Parameters
    ----------
    image : (rows, columns) uint8 or uint16
    along : "rows" or "columns"
        The axis along which the stripe runs; see `find_along`.
    options : StripeOptions
    background : (rows, columns) of the same depth
        The scene with the laser off, subtracted.

    Returns
    -------
    Stripe
        One answer a line: a column where the stripe runs along rows. Lines without an answer are NaN and say why.

    Raises
    ------
    RangingError
        For an image of another depth or with channels, and a background that does not fit.
    """
    options = options or StripeOptions()
    check_image(image)
    if image.ndim != 2:
        raise RangingError(f"an image with {image.shape[2]} channels; one is needed: choose a channel")
    if background is not None and (background.shape != image.shape or background.dtype != image.dtype):
        raise RangingError(
            f"a laser-off image of {background.shape} {background.dtype} for a frame of {image.shape} {image.dtype}; both must be alike"
        )
    image = np.ascontiguousarray(image)
    has_dark = background is not None
    dark = np.ascontiguousarray(background) if background is not None else image[:0]
    fine = replace(options, maximum_width=min(options.maximum_width, FINEST))
    peaks = _peaks(image, dark, has_dark, along, math.ceil(2.5 * fine.maximum_width))
    rows, columns = image.shape
    view = t.Lines(
        pixels=image.ravel(),
        dark=dark.ravel(),
        layout=(rows, columns, columns, 1) if along == "columns" else (columns, rows, 1, columns),
        saturation=float(saturation_level(image.dtype) if options.saturation is None else options.saturation),
    )
    first = _first_look(view, peaks, fine, typical_noise(view.saturation))
    if options.maximum_width > FINEST:
        size = _size(first, fine)
        if size > 1:
            return _with_wide(along, first, fine, size, *_wide(along, view, size, options))
    return _second_look(along, first, fine)


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """Lines of one scale, each fitted for itself."""

    lines: t.Lines
    peaks: NDArray[np.int32]  # (3, N), see `_peaks`
    table: Array  # (ROWS, N)
    usual: Noise  # of a camera of which nothing better is known


def _first_look(view: t.Lines, peaks: NDArray[np.int32], options: StripeOptions, usual: Noise) -> _Fitted:
    guess = _known_noise(options) or usual
    if options.which != "strongest":
        peaks[0] = _choose(view, options.which, _threshold(options, guess))
        peaks[2] = 0  # the choice is made: other peaks do not matter
    return _Fitted(view, peaks, _METHODS[options.method](view, peaks[0], guess), usual)


def _second_look(along: Along, first: _Fitted, options: StripeOptions) -> Stripe:
    """What the lines tell together: noise and speckle, and which of them have an answer."""
    noise, contrast = _known_noise(options), 0.0
    if (
        noise is None
        or options.speckle == "on"
        or (options.speckle == "auto" and _looks_speckled(first.table, _threshold(options, noise)))
    ):
        noise, contrast = _learn(first, noise, options)
    return _stripe(along, first.table, first.peaks, noise, contrast, first.lines, options)


def _size(first: _Fitted, options: StripeOptions) -> int:
    """How many pixels of this frame are taken together, since its stripe is wide: 1 where it is not."""
    from ranging.stripe._scales import size_for

    threshold = _threshold(options, _known_noise(options) or first.usual)
    uneven = _looks_speckled(first.table, threshold)
    return size_for(first.lines, first.peaks[0], first.table, threshold, uneven=uneven)


def _wide(along: Along, view: t.Lines, size: int, options: StripeOptions) -> tuple[Stripe, Array]:
    """The stripe with ``size`` px of each line taken together, in px and grey levels of the image as given.

    Also (N,) px: how wide every line with light was before it was judged.
    """
    from ranging.stripe._scales import binned, to_middle

    taken = binned(view, size)
    noise = _known_noise(options)
    scaled = None if noise is None else taken.noise(noise)
    coarse = replace(
        options,
        gain_e=scaled.gain_e if scaled else None,
        read_noise=scaled.read_noise if scaled else None,
        threshold=None if options.threshold is None else options.threshold * taken.unit,
        minimum_width=options.minimum_width / size,
        maximum_width=options.maximum_width / size,
    )
    count, length = taken.lines.layout[:2]
    together = taken.lines.pixels.reshape(count, length)
    dark = taken.lines.dark.reshape(-1, length)
    peaks = _peaks(together, dark, dark.size > 0, "columns", math.ceil(2.5 * FINEST))
    to_middle(taken.lines, peaks[0])
    usual = taken.noise(typical_noise(view.saturation))
    first = _first_look(taken.lines, peaks, coarse, usual)
    seen = first.table[t.WIDTH].copy()
    found = _second_look(along, first, coarse)
    seen[found.reason == Reason.NO_LIGHT] = np.nan
    seen, width = (
        np.sqrt(np.maximum((each * size) ** 2 - (size * size - 1) / 12.0, 0.0)) for each in (seen, found.width)
    )
    stripe = replace(
        found,
        position=(found.position + 0.5) * size - 0.5,
        sigma=found.sigma * size,
        width=width,
        peak=found.peak / taken.unit,
        floor=found.floor / taken.unit,
        noise=noise or (None if found.noise is None else taken.noise_of_pixels(found.noise)),
    )
    return stripe, seen


def _with_wide(along: Along, first: _Fitted, options: StripeOptions, size: int, wide: Stripe, seen: Array) -> Stripe:
    """Join both scales: lines whose neighbourhood is narrow, or that are narrow themselves at both, are those of the fine one."""
    from ranging.stripe._scales import UNEVEN
    from ranging.stripe._speckle import running_median

    good = np.flatnonzero(np.isfinite(seen))
    if len(good) == 0 or not np.isfinite(wide.width).any():
        return _second_look(along, first, options)
    lines, least = np.arange(len(seen)), max(UNEVEN, 0.6 * size)
    usual = np.interp(lines, good, running_median(seen[good]))
    after = np.searchsorted(good, lines)
    before = np.abs(lines - good[np.maximum(after - 1, 0)])
    lost = np.minimum(before, np.abs(good[np.minimum(after, len(good) - 1)] - lines))
    explained = np.isin(wide.reason, (Reason.TOO_WIDE, Reason.SATURATED, Reason.TWO_PEAKS, Reason.OUT_OF_VIEW))
    narrow = ((usual < least) | (wide.width < 0.7 * least) | (lost > LONELY)) & ~explained
    if not narrow.any():
        return wide
    fine = _second_look(along, first, options)
    rows = {
        name: np.where(narrow, getattr(fine, name), getattr(wide, name))
        for name in ("position", "sigma", "width", "peak", "reason", "floor", "asymmetry")
    }
    return replace(wide, **rows, speckle=max(fine.speckle, wide.speckle))


def estimate_noise(
    images: Sequence[Image], *, along: Along, options: StripeOptions | None = None, background: Image | None = None
) -> Noise:
    """Gain and read noise of the camera from a few stripe images of one capture.

    Each image tells its own by how its lines differ from their neighbours (see `ranging.stripe._speckle`); texture can
    only add to that, so the quieter images are believed: upper quartile of the gains, lower quartile of the read noises.
    Give the result to `StripeOptions`, so that not every frame has to learn it anew. Images on which too few lines are
    lit fall back to `typical_noise`.
    """
    if not images:
        raise ValueError("at least one image")
    asked = replace(options or StripeOptions(), gain_e=None, read_noise=None, speckle="off", neighbours=False)
    found = [extract(image, along=along, options=asked, background=background).noise for image in images]
    known = [noise for noise in found if noise is not None]
    return Noise(
        float(np.percentile([noise.gain_e for noise in known], 75)),
        float(np.percentile([noise.read_noise for noise in known], 25)),
    )


def _threshold(options: StripeOptions, noise: Noise) -> float:
    """Least peak above the background, grey levels."""
    if options.threshold is not None:
        return options.threshold
    return 6.0 * math.sqrt(noise.read_noise**2 + 1 / 12)


def _known_noise(options: StripeOptions) -> Noise | None:
    if options.gain_e is None or options.read_noise is None:
        return None
    return Noise(options.gain_e, options.read_noise)


def _looks_speckled(table: Array, threshold: float) -> bool:
    """Whether the profiles, or the peaks of neighbouring lines, differ by more than shot and read noise explain."""
    from ranging.stripe._judgement import count_uneven

    good, misfits, rough = count_uneven(table, threshold, 2.2, 0.06)
    return bool(good >= 40 and max(misfits, rough) > 0.5 * good)


def _learn(first: _Fitted, noise: Noise | None, options: StripeOptions) -> tuple[Noise, float]:
    """Noise and speckle of this frame; the table is improved by what they tell. Returns the noise and the contrast."""
    from ranging.stripe import _speckle as speckles

    view, peaks, table = first.lines, first.peaks, first.table
    guess = noise or first.usual
    found = speckles.leftover(view, table)
    if found is None:
        return guess, 0.0
    learnt, speckle = speckles.analyse(found, noise, first.usual)
    learnt = Noise(
        options.gain_e or learnt.gain_e, learnt.read_noise if options.read_noise is None else options.read_noise
    )
    if noise is None:
        table[:] = _METHODS[options.method](view, peaks[0], learnt)
    if options.method in ("centroid", "ridge") or options.speckle == "off":
        return learnt, 0.0
    contrast = speckles.local_contrast(found, learnt, speckle.grain, table.shape[1])
    if not found.seen.all() and np.median(contrast) < CLEAR:
        table[:] = _METHODS[options.method](view, peaks[0], guess)
        return guess, 0.0  # what the flanks alone show is as well their shape
    if options.speckle == "on":
        contrast = np.maximum(contrast, max(speckle.contrast, 0.05))
    if not contrast.any():
        return learnt, 0.0
    widths = speckles.usual_widths(table)
    if (
        np.median(contrast) == 0.0
    ):  # here and there: clipped lines keep their fit, but are no better than their neighbours
        before, clipped = table[t.SIGMA].copy(), (table[t.CLIPPED] > 0) & (contrast > 0)
        grains = speckles.Grains(speckle.grain, 0.0)
        speckles.refit_lines(view, _camera(learnt), np.where(clipped, 0.0, contrast), grains, widths, table)
        if clipped.any():
            others = (table[t.SIGMA] / before)[~clipped & (contrast > 0)]
            others = others[np.isfinite(others)]
            table[t.SIGMA, clipped] *= np.median(others) if len(others) else 1.0
    else:
        speckles.refit_lines(
            view, _camera(learnt), contrast, speckles.Grains(speckle.grain, speckles.HOLD), widths, table
        )
        found = speckles.leftover(view, table)  # again: these positions no longer weigh speckle as shot noise
        if found is not None:
            learnt, speckle = speckles.analyse(found, noise, first.usual)
            if noise is None:
                learnt = speckles.within_reason(learnt, first.usual)
            again = speckles.local_contrast(found, learnt, speckle.grain, table.shape[1])
            contrast = np.where(again > 0.0, again, contrast)
            speckles.refit_lines(
                view, _camera(learnt), contrast, speckles.Grains(speckle.grain, speckles.HOLD), widths, table
            )
    table[t.MISFIT, contrast > 0] = 1.0  # sigma holds it now
    table[t.ASYMMETRY_SIGMA] += contrast * math.sqrt(speckle.grain)
    return learnt, float(np.median(contrast))


def _stripe(
    along: Along, table: Array, peaks: NDArray[np.int32], noise: Noise, contrast: float, view: t.Lines,
    options: StripeOptions,
) -> Stripe:  # fmt: skip
    """Judge the lines of a table and hand over its answers."""
    from ranging.stripe._judgement import (
        OVEREXPOSED,
        OVEREXPOSED_TOGETHER,
        Limits,
        compare,
        darken,
        judge,
        part_mixed,
        stretches,
    )

    reason = np.empty(table.shape[1], np.uint8)
    threshold = _threshold(options, noise)
    most = OVEREXPOSED if view.clipped.size == 0 else OVEREXPOSED_TOGETHER
    limits = Limits(
        threshold, view.saturation, most * view.saturation, options.minimum_width, options.maximum_width,
        options.two_peaks, options.edge,
    )  # fmt: skip
    judge(table, peaks, limits, reason)
    darken(view.pixels, view.dark, view.layout, peaks, threshold, reason)
    part_mixed(table, reason)
    if options.neighbours:
        begin, end = np.empty((2, table.shape[1]), np.int32)
        count = stretches(table, reason, begin, end)
        if count < 0.2 * np.count_nonzero(reason == 0):  # else it is no stripe that goes on from line to line
            compare(table, reason, count, begin, end, options.narrowing)
    return Stripe(
        along=along,
        position=table[t.POSITION],
        sigma=table[t.SIGMA],
        width=table[t.WIDTH],
        peak=table[t.PEAK],
        reason=reason,
        floor=table[t.FLOOR],
        asymmetry=table[t.ASYMMETRY],
        noise=noise,
        speckle=contrast,
    )


def _peaks(image: Image, dark: Image, has_dark: bool, along: Along, half: int) -> NDArray[np.int32]:
    """(3, lines): place and value of the highest pixel, and the highest value farther than ``half`` from it."""
    from ranging.stripe import _peak_kernels as kernels

    if along == "columns":
        out = np.empty((3, image.shape[0]), np.int32)
        kernels.peaks_of_rows(image, dark, has_dark, half, out)
    else:
        out = np.empty((3, image.shape[1]), np.int32)
        kernels.peaks_of_columns(image, dark, has_dark, half, out)
    return out


def _camera(noise: Noise) -> t.CameraNoise:
    return t.CameraNoise(float(noise.gain_e), float(noise.read_noise**2 + 1 / 12))  # of rounding, the twelfth


def _gaussian(view: t.Lines, place: NDArray[np.int32], noise: Noise) -> Array:
    """Maximum likelihood of a Gaussian profile: at the bound of Cramer and Rao for shot and read noise."""
    from ranging.stripe._gaussian import fit_lines

    table = np.empty((t.ROWS, view.layout[0]))
    fit_lines(view, place, _camera(noise), table)
    return table


def _centroid(view: t.Lines, place: NDArray[np.int32], noise: Noise) -> Array:
    """Centre of mass, as a reference."""
    from ranging.stripe._centroid import centroid_lines

    table = _gaussian(view, place, noise)
    centroid_lines(view.pixels, view.dark, view.layout, noise.gain_e, noise.read_noise**2 + 1 / 12, table)
    return table


def _ridge(view: t.Lines, place: NDArray[np.int32], noise: Noise) -> Array:
    """Ridge of the smoothed image, across which the brightness falls fastest: for tilted and curved stripes."""
    from ranging.stripe._ridge import ridge_lines

    table = _gaussian(view, place, noise)
    width = table[t.WIDTH][np.isfinite(table[t.WIDTH])]
    scale = min(max(float(np.median(width)) if len(width) else 1.5, 0.8), 6.0)
    ridge_lines(view, scale, _camera(noise), table)
    return table


_METHODS: dict[str, Callable[[t.Lines, NDArray[np.int32], Noise], Array]] = {
    "auto": _gaussian,
    "gaussian": _gaussian,
    "centroid": _centroid,
    "ridge": _ridge,
}


def _choose(view: t.Lines, which: Which, threshold: float) -> NDArray[np.int32]:
    """Places (lines,) of the peaks that were asked for; -1 where a line has none."""
    from ranging.stripe import _candidates as stripe_peaks

    count = view.layout[0]
    places, values = np.empty((count, stripe_peaks.MOST), np.int32), np.empty((count, stripe_peaks.MOST))
    stripe_peaks.find_peaks(view.pixels, view.dark, view.layout, threshold, places, values)
    if which == "first":
        return np.ascontiguousarray(places[:, 0])
    if which == "last":
        return np.asarray(places.max(axis=1))
    chosen = np.empty(count, np.int32)
    stripe_peaks.follow(places, values, chosen)
    return chosen
