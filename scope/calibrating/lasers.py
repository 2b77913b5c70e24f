"""Laser images of the calibration planes to points of the sheet of light."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calibration.camera import Camera
from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array
from calibration.grouping import grouped
from calibration.rays import PlaneMarks
from calibration.sheet import Laser, StripePoints, coupled, fit_laser, moved_stripe
from ranging.background import Channel, Image, to_gray
from ranging.stripe import Along
from scope.calibrating.channels import Choice, candidates, choose
from scope.calibrating.left_out import LeftOut, small
from scope.calibrating.plates import SHALLOWEST, Common, Light, Seen, common_sheet, crossing, on_sheet, stands_still
from scope.calibrating.reading import Look, Shot, completed, look_at, offers_of
from scope.session import CalibrationPlan, LaserPlan, PlanePlan, mean_image, read_alike, shape_text

_SAMPLE = 12  # views that choose the channel
_AGREED = 0.5  # of the views with a stripe, that must share a sheet
_CLEARLY = 0.8  # likewise, below which the stripe may as well run along the other axis of the image
_SEEN = 0.25  # of all views, likewise
_OTHER: dict[Along, Along] = {"rows": "columns", "columns": "rows"}


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


def _shot(plane: PlanePlan, marks: PlaneMarks, laser: str, size: tuple[int, int]) -> Shot:
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
    return Shot(plane, marks, tuple(images), dark)


def _fit(
    plan: CalibrationPlan, laser: LaserPlan, camera: Camera, shots: list[Shot], *, curved: bool | None
) -> FoundLasers:
    by_hand = all(shot.plane.c_from_target is None for shot in shots)
    choice, guide, along = _chosen_channel(plan, laser, camera, shots, by_hand=by_hand)
    look = look_at(laser, camera, shots, choice.channel, by_hand=by_hand, along=along)
    views = [offers_of(plan.plate, look, shot) for shot in shots]
    common, courses = None, {}
    if by_hand:
        guided = [offers for offers, _ in views]
        if guide != choice.channel:
            seen = replace(look, channel=guide)
            guided = [offers_of(plan.plate, seen, shot)[0] for shot in shots]
        shared = common_sheet(guided)
        _check_agreement(plan, laser, shared, guided)
        if shared is not None:
            courses = shared.chosen
            common = shared if guide == choice.channel else on_sheet(shared.plane, [offers for offers, _ in views])
    stripes, used, left_out, taken = [], [], [], []
    for shot, (offers, everything) in zip(shots, views, strict=True):
        own, reason = _kept(plan, shot, offers, everything, common, laser.name)
        kept = completed(look, shot, own, courses.get(shot.plane.name)) if by_hand else own
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
    if by_hand and camera.model == "pinhole":
        fitted = coupled(fitted, stripes, [_moves(camera, shots, stripe) for stripe in taken])
    return FoundLasers({laser.name: fitted}, tuple(used), tuple(left_out), {laser.name: choice})


def _moves(camera: Camera, shots: list[Shot], stripe: Seen) -> Array:
    """How a stripe on a target held by hand moves with the camera's parameters."""
    marks = next(shot.marks for shot in shots if shot.plane.name == stripe.name)
    pose = marks.c_from_plane
    return moved_stripe(
        camera, (stripe.pixels, stripe.points), pose.rotation[:, 2], (marks.pixels, marks.world), pose.translation
    )


def _agree(common: Common | None, views: int, share: float = _AGREED) -> bool:
    """Whether so many views share a sheet that it is not by chance, which two always do and three of many may."""
    if common is None:
        return False
    agreed, total = len(common.chosen), len(common.chosen) + len(common.apart)
    return agreed >= min(3, total) and agreed >= share * total and agreed >= _SEEN * views


def _check_agreement(plan: CalibrationPlan, laser: LaserPlan, common: Common | None, views: list[list[Seen]]) -> None:
    """Refuse light that keeps its pixels, and a sheet that only a few views share."""
    lit = [offers for offers in views if offers]
    if len(lit) < 2 or _agree(common, len(views)):
        return
    if stands_still(views):
        raise CalibrationError(
            f"{plan.path}: laser {laser.name}: the light on {len(lit)} of {len(views)} views keeps its pixels while the target moves, "
            "so it is no sheet beside the camera: it lies on something behind the target, or the laser shines along the "
            "camera's rays; shade it, give [target] plate, or move the laser aside"
        )
    agreed = 0 if common is None else len(common.chosen)
    raise CalibrationError(
        f"{plan.path}: laser {laser.name}: the stripes of {len(lit)} views lie on no common sheet of light ({agreed} agree): "
        "laser and camera must not move against each other; name the laser's `channel`, dim other light, or give [target] plate"
    )


def _chosen_channel(
    plan: CalibrationPlan, laser: LaserPlan, camera: Camera, shots: list[Shot], *, by_hand: bool
) -> tuple[Choice, Channel, Along]:
    """The channel of the least error on some of the views, the one that shows the stripe on the most lines, and its run."""
    has_dark = all(shot.background is not None for shot in shots)
    images = [shot.images[0] for shot in shots]
    usual, tried = candidates(laser.channel, images, several=len(plan.lasers) > 1, laser_off=has_dark)
    if len(tried) < 2:
        return Choice(usual, {}), usual, look_at(laser, camera, shots, usual, by_hand=by_hand).along
    some = [shots[k] for k in np.unique(np.linspace(0, len(shots) - 1, _SAMPLE).astype(int))]
    some = [replace(shot, images=shot.images[:1]) for shot in some]
    looks = {channel: look_at(laser, camera, some, channel, by_hand=by_hand) for channel in tried}
    shared = {channel: _shared(plan, look, some) for channel, look in looks.items()}
    guide = max(tried, key=lambda channel: (*_shown(shared[channel], some), channel == usual))
    if by_hand and laser.along == "auto" and not _agree(shared[guide], len(some), _CLEARLY):
        turned = {channel: replace(look, along=_OTHER[look.along]) for channel, look in looks.items()}
        again = {channel: _shared(plan, look, some) for channel, look in turned.items()}
        other = max(tried, key=lambda channel: (*_shown(again[channel], some), channel == usual))
        if _shown(again[other], some) > _shown(shared[guide], some):
            looks, shared, guide = turned, again, other
    along, sheet = looks[guide].along, shared[guide]
    found = {channel: {} if common is None else dict(common.chosen) for channel, common in shared.items()}
    if by_hand and sheet is not None:
        each = {shot.plane.name: shot for shot in some}
        for channel, look in looks.items():
            right = {} if look.along != along else found[channel]
            right = on_sheet(sheet.plane, [[stripe] for stripe in right.values()]).chosen
            more = {
                name: completed(replace(look, along=along), each[name], right.get(name), course)
                for name, course in sheet.chosen.items()
            }
            found[channel] = right | {name: stripe for name, stripe in more.items() if stripe is not None}
    return choose(usual, {channel: list(stripes.values()) for channel, stripes in found.items()}, guide), guide, along


def _shared(plan: CalibrationPlan, look: Look, shots: list[Shot]) -> Common | None:
    return common_sheet([offers_of(plan.plate, look, shot)[0] for shot in shots])


def _shown(common: Common | None, shots: list[Shot]) -> tuple[bool, int]:
    """How much of a laser a channel shows: whether the views agree, and on how many lines."""
    return _agree(common, len(shots)), 0 if common is None else sum(len(s.line) for s in common.chosen.values())


def _kept(
    plan: CalibrationPlan, shot: Shot, offers: list[Seen], everything: Light, common: Common | None, laser: str
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


def _picture(laser: str, shot: Shot, everything: Array, reason: str) -> LeftOut:
    picture, scale = small(shot.images[0])
    found = everything[np.isfinite(everything).all(axis=1)] * scale
    return LeftOut("laser", shot.plane.name, reason, laser=laser, image=picture, pixels=found)


def _points(camera: Camera, stripe: Seen, along: Along) -> StripePoints:
    """Points of a stripe with their sigma, mm across it."""
    across = 1 if along == "rows" else 0
    moved = np.linalg.norm(camera.shift(stripe.pixels, stripe.points)[:, :, across], axis=1)
    return StripePoints(stripe.name, stripe.points, moved * stripe.sigma)
