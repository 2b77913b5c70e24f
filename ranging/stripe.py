"""A stripe image to sub-pixel positions, one a row or column."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Codes
from ranging.background import Image, Noise, check_image, saturation_level
from ranging.errors import RangingError

Along = Literal["rows", "columns"]
Layout: TypeAlias = tuple[int, int, int, int]  # lines, their length, steps to the next line and to the next pixel
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
    minimum_width: float = 0.5  # px, one sigma
    maximum_width: float = 6.0  # px, one sigma
    two_peaks: float = 0.8  # a second peak of this share of the strongest leaves the line without an answer
    edge: float = 0.15  # an asymmetry beyond this is a stripe cut by an edge
    speckle: Switch = "auto"

    def __post_init__(self) -> None:
        if not 0.0 < self.minimum_width < self.maximum_width:
            raise ValueError("0 < minimum_width < maximum_width")


def find_along(image: Image) -> Along:
    """Along which axis of the image the stripe runs.

    The peaks of all rows and of all columns are found. A stripe along the rows is crossed once by every column: the
    peaks of neighbouring columns lie close together, those of neighbouring rows are noise or a long way apart.
    """
    check_image(image)
    scores = {}
    for along in ("columns", "rows"):
        peaks = _peaks(image, image[:0], False, along, 12)  # type: ignore[arg-type]
        place, value = peaks[0].astype(np.float64), peaks[1].astype(np.float64)
        weight = np.minimum(value[1:], value[:-1])
        weight = np.maximum(weight - np.percentile(value, 5), 0.0)
        step = np.abs(np.diff(place))
        scores[along] = float(np.sum(weight * np.maximum(0.0, 1.0 - step / 3.0)))
    return "columns" if scores["columns"] > scores["rows"] else "rows"


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
    noise = Noise(options.gain_e or 30.0, 1.2 if options.read_noise is None else options.read_noise)
    peaks = _peaks(image, dark, has_dark, along, int(np.ceil(2.5 * options.maximum_width)))
    rows, columns = image.shape
    layout = (rows, columns, columns, 1) if along == "columns" else (columns, rows, 1, columns)
    saturation = saturation_level(image.dtype) if options.saturation is None else options.saturation
    table = _METHODS[options.method](image.ravel(), dark.ravel(), layout, peaks[0], noise, saturation)
    return _stripe(along, table, peaks, noise, saturation, options)


def _stripe(
    along: Along, table: Array, peaks: NDArray[np.int32], noise: Noise, saturation: int, options: StripeOptions
) -> Stripe:
    """The answers of a table, after its lines have been judged."""
    from ranging import stripe_gaussian as g
    from ranging.stripe_judge import judge

    threshold = options.threshold
    if threshold is None:
        threshold = 6.0 * math.sqrt(noise.read_noise**2 + 1 / 12)
    reason = np.empty(table.shape[1], np.uint8)
    judge(
        table, peaks, threshold, float(saturation), options.minimum_width, options.maximum_width,
        options.two_peaks, options.edge, reason,
    )  # fmt: skip
    return Stripe(
        along=along,
        position=table[g.POSITION],
        sigma=table[g.SIGMA],
        width=table[g.WIDTH],
        peak=table[g.PEAK],
        reason=reason,
        floor=table[g.FLOOR],
        asymmetry=table[g.ASYMMETRY],
    )


def _peaks(image: Image, dark: Image, has_dark: bool, along: Along, half: int) -> NDArray[np.int32]:
    """(3, lines): place and value of the highest pixel, and the highest value farther than ``half`` from it."""
    from ranging import kernels

    if along == "columns":
        out = np.empty((3, image.shape[0]), np.int32)
        kernels.peaks_of_rows(image, dark, has_dark, half, out)
    else:
        out = np.empty((3, image.shape[1]), np.int32)
        kernels.peaks_of_columns(image, dark, has_dark, half, out)
    return out


def _gaussian(
    pixels: Image, dark: Image, layout: Layout, place: NDArray[np.int32], noise: Noise, saturation: int
) -> Array:
    from ranging import stripe_gaussian

    table = np.empty((stripe_gaussian.ROWS, layout[0]))
    variance = noise.read_noise**2 + 1 / 12
    stripe_gaussian.fit_lines(pixels, dark, layout, place, noise.gain_e, variance, float(saturation), table)
    return table


_METHODS: dict[str, Callable[..., Array]] = {"auto": _gaussian, "gaussian": _gaussian}


