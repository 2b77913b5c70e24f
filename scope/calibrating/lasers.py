"""Laser images of the calibration planes to points of the sheet of light."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from calibration.camera import Camera
from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array, Ints
from calibration.grouping import grouped
from calibration.rays import PlaneMarks
from calibration.sheet import Laser, StripePoints, fit_laser
from ranging.background import Channel, Image, clipping_level, to_gray
from ranging.stripe import Along, Stripe, StripeOptions, extract, find_along
from scope.calibrating.channels import Choice, candidates, choose
from scope.calibrating.left_out import LeftOut, small
from scope.calibrating.plates import LEAST, SHALLOWEST, Common, Light, Seen, common_sheet, crossing, seen_on, stripes_on
from scope.session import CalibrationPlan, LaserPlan, PlanePlan, mean_image, read_alike, shape_text

_SAMPLE = 12  # views that choose the channel
_SHARE = 0.25  # of the light on the plate of a jig, that must lie between the marks for the marks to bound it
_MOST = 0.5  # of a stripe by hand, likewise
_NEAR = 6.0  # px off a stripe's line, within which the fit of the sheet judges for itself
_AGREED = 3  # a third of the views with a stripe must share a sheet
_BAND = 8.0  # widths about a stripe's course, in which lines that showed other light are looked at again


@dataclass(frozen=True, slots=True, eq=False)
class LaserView:
    """The stripe of one laser on one plane."""

    laser: str
    plane: str
    image: Image  # gray, the channel that was read
    pixels: Array  # (n, 2) px, those used


@dataclass(frozen=True, slots=True, eq=False)
class FoundLasers:
    """The lasers of a calibration, and what they were fitted to."""

    lasers: dict[str, Laser] = field(default_factory=dict)
    views: tuple[LaserView, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    choices: dict[str, Choice] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class _Shot:
    plane: PlanePlan
    marks: PlaneMarks
    images: tuple[Image, ...]  # repeats, as stored
    background: Image | None  # mean


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """How the images of one laser are looked at."""

    camera: Camera
    channel: Channel
    along: Along
    options: StripeOptions
    by_hand: bool


def find_lasers(
    plan: CalibrationPlan, camera: Camera, planes: list[tuple[PlanePlan, PlaneMarks]], *, curved: bool | None
) -> FoundLasers:
    """Fit every laser that has images; a plan without any gives none.

    ``curved`` is that of `calibration.sheet.laser.fit_laser`: None where the planes' places are known and a curved sheet can be
    told; False where they were estimated, since errors of their poses look like a curved sheet.

    Raises
    ------
    FileError, CalibrationError
        Images that do not fit, too few stripes. Single images without a stripe are left out.
    """
    found = FoundLasers()
    for laser in plan.lasers:
        shots, unread = [], []
        for plane, marks in planes:
            if laser.name not in plane.lasers:
                continue
            try:
                shots.append(_shot(plane, marks, laser.name, camera.size))
            except FileError as error:
                if plane.c_from_target is not None:
                    raise
                unread.append(LeftOut("laser", plane.name, str(error), laser=laser.name))
        if shots:
            one = _fit(plan, laser, camera, shots, curved=curved)
            found = FoundLasers(
                found.lasers | one.lasers, found.views + one.views, (*found.left_out, *unread, *one.left_out),
                found.choices | one.choices,
            )  # fmt: skip
    return found


def _shot(plane: PlanePlan, marks: PlaneMarks, laser: str, size: tuple[int, int]) -> _Shot:
    images = read_alike(plane.lasers[laser], f"plane {plane.name}, laser {laser}")
    image = images[0]
    dark = None
    if laser in plane.backgrounds:
        dark = mean_image(read_alike(plane.backgrounds[laser], f"plane {plane.name}, background"))
    for what, other in (("laser", image), ("background", dark)):
        if other is not None and (other.shape[1], other.shape[0]) != size:
            raise FileError(
                f"{plane.lasers[laser][0]}: plane {plane.name}: its {what} image is {shape_text(other)}; the marks were seen at "
                f"{size[0]} x {size[1]} px: take both with the same settings"
            )
    if dark is not None and (dark.shape != image.shape or dark.dtype != image.dtype):
        raise FileError(
            f"{plane.backgrounds[laser][0]}: {shape_text(dark)}, the laser image has {shape_text(image)}; take both with the "
            "same settings"
        )
    return _Shot(plane, marks, tuple(images), dark)


def _fit(
    plan: CalibrationPlan, laser: LaserPlan, camera: Camera, shots: list[_Shot], *, curved: bool | None
) -> FoundLasers:
    by_hand = all(shot.plane.c_from_target is None for shot in shots)
    choice, guide = _chosen_channel(plan, laser, camera, shots, by_hand=by_hand)
    look = _look(laser, camera, shots, choice.channel, by_hand=by_hand)
    views, common = _all_views(plan, look, shots)
    courses = {} if common is None else common.chosen
    if by_hand and guide != choice.channel:
        shared = _all_views(plan, _look(laser, camera, shots, guide, by_hand=by_hand), shots)[1]
        courses = courses if shared is None else shared.chosen | courses
    _check_agreement(plan, laser, common)
    stripes, used, left_out, taken = [], [], [], []
    for shot, (offers, everything) in zip(shots, views, strict=True):
        own, reason = _kept(plan, shot, offers, everything, common, laser.name)
        kept = _completed(look, shot, own, courses.get(shot.plane.name)) if by_hand else own
        if kept is None:
            left_out.append(_picture(laser.name, shot, everything.pixels, reason))
            continue
        taken.append(kept)
        stripes.append(_points(camera, kept, look.along))
        used.append(LaserView(laser.name, shot.plane.name, to_gray(shot.images[0], look.channel), kept.pixels))
    if len(stripes) < min(2, len(shots)):
        told = grouped([(each.name, each.reason) for each in left_out], len(shots), "laser images", longest=150)
        raise CalibrationError(
            f"{plan.path}: laser {laser.name}: stripes on {len(stripes)} of {len(shots)} views: {told}"
        )
    try:
        fitted = fit_laser(
            laser.name, stripes, along=look.along, channel=look.channel, origin=laser.origin, curved=curved
        )
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error
    if float(np.median([crossing(fitted.plane, stripe) for stripe in taken])) < SHALLOWEST:
        raise CalibrationError(
            f"{plan.path}: laser {laser.name}: the light on {len(taken)} of {len(shots)} views keeps its pixels while the target moves, "
            "so it is no sheet beside the camera: it lies on something behind the target, or the laser shines along the "
            "camera's rays; shade it, give [target] plate, or move the laser aside"
        )
    return FoundLasers({laser.name: fitted}, tuple(used), tuple(left_out), {laser.name: choice})


def _all_views(
    plan: CalibrationPlan, look: _Look, shots: list[_Shot]
) -> tuple[list[tuple[list[Seen], Light]], Common | None]:
    """Stripes of all views, and the sheet that most share, where the views are held by hand."""
    views = [_stripes(plan, look, shot) for shot in shots]
    return views, common_sheet([offers for offers, _ in views]) if look.by_hand else None


def _check_agreement(plan: CalibrationPlan, laser: LaserPlan, common: Common | None) -> None:
    """Refuse a sheet that only a few views share, which some always do."""
    if common is None:
        return
    agreed, total = len(common.chosen), len(common.chosen) + len(common.apart)
    if agreed < 2 or agreed * _AGREED < total or (total > 3 and agreed < 3):
        raise CalibrationError(
            f"{plan.path}: laser {laser.name}: the stripes of {total} views lie on no common sheet of light ({agreed} agree): "
            "laser and camera must not move against each other; name the laser's `channel`, dim other light, or give [target] plate"
        )


def _look(laser: LaserPlan, camera: Camera, shots: list[_Shot], channel: Channel, *, by_hand: bool) -> _Look:
    grays = [[to_gray(image, channel) for image in shot.images] for shot in shots]
    darks = [None if shot.background is None else to_gray(shot.background, channel) for shot in shots]
    along = _along([repeats[0] for repeats in grays], darks) if laser.along == "auto" else laser.along
    options = StripeOptions(saturation=clipping_level([image for repeats in grays for image in repeats]))
    return _Look(camera, channel, along, options, by_hand)


def _chosen_channel(
    plan: CalibrationPlan, laser: LaserPlan, camera: Camera, shots: list[_Shot], *, by_hand: bool
) -> tuple[Choice, Channel]:
    """The channel of the least error on some of the views, and the one that shows the stripe on the most lines."""
    has_dark = all(shot.background is not None for shot in shots)
    images = [shot.images[0] for shot in shots]
    usual, tried = candidates(laser.channel, images, several=len(plan.lasers) > 1, laser_off=has_dark)
    if len(tried) < 2:
        return Choice(usual, {}), usual
    some = [shots[k] for k in np.unique(np.linspace(0, len(shots) - 1, _SAMPLE).astype(int))]
    some = [replace(shot, images=shot.images[:1]) for shot in some]
    looks = {channel: _look(laser, camera, some, channel, by_hand=by_hand) for channel in tried}
    found: dict[Channel, dict[str, Seen]] = {}
    for channel, look in looks.items():
        common = common_sheet([_stripes(plan, look, shot)[0] for shot in some])
        found[channel] = {} if common is None else common.chosen
    guide = max(tried, key=lambda channel: (sum(len(s.line) for s in found[channel].values()), channel == usual))
    if by_hand:
        for channel, look in looks.items():
            if look.along != looks[guide].along:
                continue
            each = {shot.plane.name: shot for shot in some}
            more = {
                name: _completed(look, each[name], found[channel].get(name), course)
                for name, course in found[guide].items()
            }
            found[channel] |= {name: stripe for name, stripe in more.items() if stripe is not None}
    return choose(usual, {channel: list(stripes.values()) for channel, stripes in found.items()}, guide), guide


def _stripes(plan: CalibrationPlan, look: _Look, shot: _Shot) -> tuple[list[Seen], Light]:
    """Stripes that may lie on the plate, and all light of the image."""
    dark = None if shot.background is None else to_gray(shot.background, look.channel)
    light = _averaged(
        [
            extract(to_gray(image, look.channel), along=look.along, options=look.options, background=dark)
            for image in shot.images
        ]
    )
    seen = seen_on(look.camera, shot.marks, light)
    offers = stripes_on(seen, shot.marks, plan.plate)
    if plan.plate == "auto" and look.by_hand:
        offers = [_surest(seen, stripe) for stripe in offers]
    elif plan.plate == "auto" and seen.marked.sum() >= max(LEAST, _SHARE * len(seen.line)):
        offers = stripes_on(seen, shot.marks, "marks")  # on a jig the rays hold best where its marks are
    return offers, light


def _surest(seen: Seen, stripe: Seen) -> Seen:
    """The light between the marks along a stripe, where most of the stripe lies there: there the plate is known to be flat."""
    if stripe.marked.sum() < max(LEAST, _MOST * len(stripe.line)):
        return stripe
    middle = stripe.flat.mean(axis=0)
    across = np.linalg.svd(stripe.flat - middle, full_matrices=False)[2][1]
    return seen.select(seen.marked & (np.abs((seen.flat - middle) @ across) < _NEAR * seen.scale))


def _kept(
    plan: CalibrationPlan, shot: _Shot, offers: list[Seen], everything: Light, common: Common | None, laser: str
) -> tuple[Seen | None, str]:
    """The stripe of a view that is used, or why there is none."""
    if not offers:
        lit = int(np.isfinite(everything.sigma).sum())
        where = "between the marks" if plan.plate == "marks" else "on the target"
        return None, (
            f"no stripe {where} ({lit} of {len(everything.sigma)} lines have light elsewhere); is the laser on in "
            f"{shot.plane.lasers[laser][0].name}?"
        )
    if common is None:
        return offers[0], ""
    if shot.plane.name in common.chosen:
        return common.chosen[shot.plane.name], ""
    return None, (
        f"its stripe lies {common.apart[shot.plane.name]:.1f} mm off the sheet that {len(common.chosen)} views share: other light, "
        "or laser or camera were moved"
    )


def _picture(laser: str, shot: _Shot, everything: Array, reason: str) -> LeftOut:
    picture, scale = small(shot.images[0])
    found = everything[np.isfinite(everything).all(axis=1)] * scale
    return LeftOut("laser", shot.plane.name, reason, laser=laser, image=picture, pixels=found)


def _completed(look: _Look, shot: _Shot, own: Seen | None, course: Seen | None) -> Seen | None:
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


def _points(camera: Camera, stripe: Seen, along: Along) -> StripePoints:
    """Points of a stripe with their sigma, mm across it."""
    across = 1 if along == "rows" else 0
    moved = np.linalg.norm(camera.shift(stripe.pixels, stripe.points)[:, :, across], axis=1)
    return StripePoints(stripe.name, stripe.points, moved * stripe.sigma)


def _along(images: list[Image], darks: list[Image | None]) -> Along:
    votes = [
        find_along(image if dark is None else np.asarray(cv2.subtract(image, dark)))
        for image, dark in zip(images, darks, strict=True)
    ]
    return max(("rows", "columns"), key=votes.count)


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
