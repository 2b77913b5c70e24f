"""The light of one laser image: on whole lines, between the marks, and along a course that is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from calibration.camera import Camera
from calibration.geometry import Array, Bools, Ints
from calibration.rays import PlaneMarks
from ranging.background import Channel, Image, clipping_level, to_gray
from ranging.stripe import Along, Stripe, StripeOptions, extract, find_along
from scope.calibrating.plates import LEAST, Light, Seen, seen_on, stripes_on
from scope.session import LaserPlan, PlanePlan, Plate

_SHARE = 0.25  # of the light on the plate of a jig, that must lie between the marks for the marks to bound it
_MOST = 0.5  # of a stripe by hand, likewise
_NEAR = 6.0  # px off a stripe's line, within which the fit of the sheet judges for itself
_BAND = 8.0  # widths about a stripe's course, in which lines that showed other light are looked at again
_GROWN = 0.1  # of the marks' hull, by which a board reaches beyond them


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """The images of one laser on one plane."""

    plane: PlanePlan
    marks: PlaneMarks
    images: tuple[Image, ...]  # repeats, as stored
    background: Image | None  # mean


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """How the images of one laser are looked at."""

    camera: Camera
    channel: Channel
    along: Along
    options: StripeOptions
    by_hand: bool


def look_at(
    laser: LaserPlan,
    camera: Camera,
    shots: list[Shot],
    channel: Channel,
    *,
    by_hand: bool,
    along: Along | None = None,
) -> Look:
    """How a laser is looked at in a channel: along what most of its images say, unless that is known."""
    options = StripeOptions(saturation=clipping_level([image for shot in shots for image in shot.images]))
    if along is None and laser.along != "auto":
        along = laser.along
    if along is None:
        grays = [to_gray(shot.images[0], channel) for shot in shots]
        darks = [None if shot.background is None else to_gray(shot.background, channel) for shot in shots]
        along = _along(grays, darks)
    return Look(camera, channel, along, options, by_hand)


def _along(images: list[Image], darks: list[Image | None]) -> Along:
    votes = [
        find_along(image if dark is None else np.asarray(cv2.subtract(image, dark)))
        for image, dark in zip(images, darks, strict=True)
    ]
    return max(("rows", "columns"), key=votes.count)


def offers_of(plate: Plate, look: Look, shot: Shot) -> tuple[list[Seen], Light]:
    """Stripes that may lie on the plate, and all light of the image.

    Of a target held by hand the lines are read twice: whole, and as far as they lie between the marks. What shines brighter
    beside the target (the same sheet on a wall behind it, on which it is clipped less and looks narrower) hides a stripe from the
    first, and what lies beside the marks is not seen by the second.
    """
    dark = None if shot.background is None else to_gray(shot.background, look.channel)
    grays = [to_gray(image, look.channel) for image in shot.images]
    light = _averaged([extract(gray, along=look.along, options=look.options, background=dark) for gray in grays])
    seen = seen_on(look.camera, shot.marks, light)
    offers = stripes_on(seen, shot.marks, plate)
    if not look.by_hand:
        if plate == "auto" and seen.marked.sum() >= max(LEAST, _SHARE * len(seen.line)):
            offers = stripes_on(seen, shot.marks, "marks")  # on a jig the rays hold best where its marks are
        return offers, light
    if plate not in ("auto", "marks"):
        return offers, light
    between = seen_on(look.camera, shot.marks, _between(look, shot, grays, dark))
    inner = stripes_on(between, shot.marks, plate)
    if plate == "marks":
        return [*inner, *offers], light
    inner, offers = [_surest(between, stripe) for stripe in inner], [_surest(seen, stripe) for stripe in offers]
    return [*inner, *[stripe for stripe in offers if not any(_is_part(stripe, of) for of in inner)]], light


def _is_part(stripe: Seen, of: Seen) -> bool:
    """Whether a stripe shows no more than another one does."""
    return len(stripe.line) <= len(of.line) and len(np.setdiff1d(stripe.line, of.line)) < 0.2 * len(stripe.line)


def _between(look: Look, shot: Shot, grays: list[Image], dark: Image | None) -> Light:
    """Light between the marks; lines that do not cross them have none."""
    hull = cv2.convexHull(shot.marks.pixels.astype(np.float32))[:, 0].astype(np.float64)
    hull = hull + _GROWN * (hull - hull.mean(axis=0))
    height, width = grays[0].shape
    low = np.clip(np.floor(hull.min(axis=0)).astype(int), 0, [width - 1, height - 1])
    high = np.clip(np.ceil(hull.max(axis=0)).astype(int) + 1, 1, [width, height])
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.rint(hull - low).astype(np.int32), 1)

    def part(image: Image) -> Image:
        return _filled(image[low[1] : high[1], low[0] : high[0]], mask.astype(bool), look.along)

    found = _averaged(
        [
            extract(part(gray), along=look.along, options=look.options, background=None if dark is None else part(dark))
            for gray in grays
        ]
    )
    across, along = (1, 0) if look.along == "rows" else (0, 1)
    lines = grays[0].shape[1 - along]
    place = slice(low[along], high[along])
    pixels, sigma, wide = np.full((lines, 2), np.nan), np.full(lines, np.nan), np.full(lines, np.nan)
    pixels[place, across] = found.pixels[:, across] + low[across]
    pixels[place, along] = np.where(np.isfinite(found.sigma), np.arange(low[along], high[along]), np.nan)
    sigma[place], wide[place] = found.sigma, found.width
    return Light(pixels, sigma, wide)


def _filled(image: Image, keep: Bools, along: Along) -> Image:
    """Image with what is not kept put at the median of what is kept of its line, 0 on lines without any."""
    axis = 0 if along == "rows" else 1
    kept = keep.any(axis=axis, keepdims=True)
    middle = np.nanmedian(np.where(keep, image, np.where(kept, np.nan, 0.0)), axis=axis, keepdims=True)
    return np.ascontiguousarray(np.where(keep, image, np.rint(middle)).astype(image.dtype))


def _surest(seen: Seen, stripe: Seen) -> Seen:
    """The light between the marks along a stripe, where most of the stripe lies there: there the plate is known to be flat."""
    if stripe.marked.sum() < max(LEAST, _MOST * len(stripe.line)):
        return stripe
    middle = stripe.flat.mean(axis=0)
    across = np.linalg.svd(stripe.flat - middle, full_matrices=False)[2][1]
    return seen.select(seen.marked & (np.abs((seen.flat - middle) @ across) < _NEAR * seen.scale))


def completed(look: Look, shot: Shot, own: Seen | None, course: Seen | None) -> Seen | None:
    """A view's stripe with the lines that had other light in this channel looked at again, near the stripe's course.

    The course is that of the channel that shows most of the stripe. Lines without an answer of their own stay without.
    """
    across = 1 if look.along == "rows" else 0
    known = [stripe for stripe in (own, course) if stripe is not None]
    if not known or min(len(stripe.line) for stripe in known) < LEAST:
        return own
    line = np.concatenate([stripe.line for stripe in known])
    place = np.concatenate([stripe.pixels[:, across] for stripe in known])
    lines = np.arange(int(line.min()), int(line.max()) + 1)
    missing = lines if own is None else np.setdiff1d(lines, own.line)
    if len(missing) < 0.1 * len(lines):
        return own
    middle, half = float(lines.mean()), max(0.5 * len(lines), 1.0)
    fitted = np.polyfit((line - middle) / half, place, 2)
    expected = np.polyval(fitted, (lines - middle) / half)
    band = int(np.clip(_BAND * np.nanmedian(known[-1].width), 10, 100))
    dark = None if shot.background is None else to_gray(shot.background, look.channel)
    again = [
        extract(
            _banded(to_gray(image, look.channel), lines, expected, band, look.along),
            along=look.along,
            options=look.options,
            background=None if dark is None else _banded(dark, lines, expected, band, look.along),
        )
        for image in shot.images
    ]
    more = seen_on(look.camera, shot.marks, _averaged(again))
    off = np.abs(more.pixels[:, across] - np.polyval(fitted, (more.line - middle) / half))
    more = more.select(np.isin(more.line, missing) & (off < np.maximum(1.0, 3.0 * more.sigma)))
    if own is None:
        return more if len(more.line) >= LEAST else None
    return _joined(own, more)


def _banded(image: Image, lines: Ints, expected: Array, band: int, along: Along) -> Image:
    """Image in which each of some lines shows its own median but near the expected place; all other lines show nothing."""
    across = image.T if along == "rows" else image
    out = np.zeros_like(across)
    for line, place in zip(lines, expected, strict=True):
        low, high = max(int(place) - band, 0), max(int(place) + band + 1, 0)
        part = across[line, low:high]
        if len(part):
            out[line] = np.median(part)
            out[line, low:high] = part
    return np.ascontiguousarray(out.T if along == "rows" else out)


def _joined(first: Seen, second: Seen) -> Seen:
    order = np.argsort(np.concatenate([first.line, second.line]))
    pixels, sigma, width, line, points, direction, flat, marked = (
        np.concatenate([getattr(first, name), getattr(second, name)])[order]
        for name in ("pixels", "sigma", "width", "line", "points", "direction", "flat", "marked")
    )
    return replace(
        first,
        pixels=pixels,
        sigma=sigma,
        width=width,
        line=line,
        points=points,
        direction=direction,
        flat=flat,
        marked=marked,
    )


def _averaged(repeats: list[Stripe]) -> Light:
    """A stripe seen several times; NaN where no repeat has an answer.

    Positions are averaged, not images: a mean of clipped images would be clipped and not know it.
    """
    position = np.array([stripe.position for stripe in repeats])
    weight = np.where(np.isfinite(position), 1.0 / np.array([stripe.sigma for stripe in repeats]) ** 2, 0.0)
    total = weight.sum(axis=0)
    mean = np.divide(np.nansum(weight * position, axis=0), total, out=np.full_like(total, np.nan), where=total > 0)
    sigma = np.divide(1.0, np.sqrt(total), out=np.full_like(total, np.nan), where=total > 0)
    widths = np.where(np.isfinite(position), [stripe.width for stripe in repeats], np.nan)
    width = np.where(total > 0, widths[0] if len(repeats) == 1 else _middle(widths), np.nan)
    return Light(replace(repeats[0], position=mean).pixels, sigma, width)


def _middle(values: Array) -> Array:
    """Mean over repeats (k, N) of those that are known; NaN where none is."""
    known = np.isfinite(values).sum(axis=0)
    total = np.nansum(values, axis=0)
    return np.asarray(np.divide(total, known, out=np.full(len(total), np.nan), where=known > 0))
