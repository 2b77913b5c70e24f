"""Laser images of the calibration planes to points of the sheet of light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from calibration.camera import Camera
from calibration.errors import CalibrationError, FileError
from calibration.geometry import Array, Bools, Plane
from calibration.rays import PlaneMarks
from calibration.sheet import Laser, StripePoints, fit_laser
from ranging.background import Image, choose_channel, clipping_level, to_gray
from ranging.stripe import Along, Stripe, StripeOptions, extract, find_along
from scope.session import CalibrationPlan, LaserPlan, PlanePlan, mean_image, read_alike, shape_text


@dataclass(frozen=True, slots=True, eq=False)
class LaserView:
    """The stripe of one laser on one plane."""

    laser: str
    plane: str
    image: Image  # gray, the channel that was read
    pixels: Array  # (n, 2) px, those used


@dataclass(frozen=True, slots=True, eq=False)
class _Shot:
    plane: PlanePlan
    marks: PlaneMarks
    images: tuple[Image, ...]  # repeats, as stored
    background: Image | None  # mean


def find_lasers(
    plan: CalibrationPlan, camera: Camera, planes: list[tuple[PlanePlan, PlaneMarks]], *, curved: bool | None
) -> tuple[dict[str, Laser], tuple[LaserView, ...]]:
    """Fit every laser that has images; a plan without any gives none.

    ``curved`` is that of `calibration.sheet.laser.fit_laser`: None where the planes' places are known and a curved sheet can be
    told; False where they were estimated, since errors of their poses look like a curved sheet.

    Raises
    ------
    FileError, CalibrationError
        Images that do not fit, a laser image without laser, too few stripes.
    """
    lasers: dict[str, Laser] = {}
    views: list[LaserView] = []
    for laser in plan.lasers:
        shots = [_shot(plane, marks, laser.name, camera.size) for plane, marks in planes if laser.name in plane.lasers]
        if shots:
            lasers[laser.name], seen = _fit(plan, laser, camera, shots, curved=curved)
            views += seen
    return lasers, tuple(views)


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
) -> tuple[Laser, list[LaserView]]:
    has_dark = all(shot.background is not None for shot in shots)
    channel = choose_channel([shot.images[0] for shot in shots], laser.channel, laser_off=has_dark)
    grays = [[to_gray(image, channel) for image in shot.images] for shot in shots]
    darks = [None if shot.background is None else to_gray(shot.background, channel) for shot in shots]
    along = _along([repeats[0] for repeats in grays], darks) if laser.along == "auto" else laser.along
    options = StripeOptions(saturation=clipping_level([image for repeats in grays for image in repeats]))
    stripes, views = [], []
    for shot, repeats, dark in zip(shots, grays, darks, strict=True):
        stripe, sigma = _averaged([extract(image, along=along, options=options, background=dark) for image in repeats])
        keep = _on_target(stripe, shot.marks)
        if not keep.any():
            lit = int(np.isfinite(stripe).all(axis=1).sum())
            raise CalibrationError(
                f"{plan.path}: plane {shot.plane.name}: laser {laser.name}: no stripe on the target ({lit} of {len(stripe)} "
                f"lines have light elsewhere); is the laser on in {shot.plane.lasers[laser.name][0].name}?"
            )
        points, across = _on_plane(camera, shot.marks, stripe[keep], sigma[keep], 1 if along == "rows" else 0)
        stripes.append(StripePoints(shot.plane.name, points, across))
        views.append(LaserView(laser.name, shot.plane.name, repeats[0], stripe[keep]))
    try:
        fit = fit_laser(laser.name, stripes, along=along, channel=channel, origin=laser.origin, curved=curved)
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error
    return fit, views


def _along(images: list[Image], darks: list[Image | None]) -> Along:
    votes = [
        find_along(image if dark is None else np.asarray(cv2.subtract(image, dark)))
        for image, dark in zip(images, darks, strict=True)
    ]
    return max(("rows", "columns"), key=votes.count)


def _averaged(repeats: list[Stripe]) -> tuple[Array, Array]:
    """Pixels (N, 2) of a stripe seen several times, and their sigma (N,): NaN where no repeat has an answer.

    Positions are averaged, not images: a mean of clipped images would be clipped and not know it.
    """
    position = np.array([stripe.position for stripe in repeats])
    weight = np.where(np.isfinite(position), 1.0 / np.array([stripe.sigma for stripe in repeats]) ** 2, 0.0)
    total = weight.sum(axis=0)
    mean = np.divide(np.nansum(weight * position, axis=0), total, out=np.full_like(total, np.nan), where=total > 0)
    sigma = np.divide(1.0, np.sqrt(total), out=np.full_like(total, np.nan), where=total > 0)
    return replace(repeats[0], position=mean).pixels, sigma


def _on_target(pixels: Array, marks: PlaneMarks) -> Bools:
    """Lines whose stripe lies on the part of the plane that the marks surround."""
    hull = cv2.convexHull(marks.pixels.astype(np.float32)).astype(np.float32)
    keep = np.asarray(np.isfinite(pixels).all(axis=1))
    for k in np.flatnonzero(keep):
        u, v = pixels[k]
        keep[k] = cv2.pointPolygonTest(hull, (float(u), float(v)), False) >= 0
    return keep


def _on_plane(camera: Camera, marks: PlaneMarks, pixels: Array, sigma: Array, across: int) -> tuple[Array, Array]:
    """Points (n, 3) mm where the pixels' rays meet the plane of the marks, and their sigma (n,) mm across the stripe."""
    plane = Plane.through(marks.c_from_plane.translation, marks.c_from_plane.rotation[:, 2])
    points = plane.intersect(camera.rays(pixels)).points
    known = np.isfinite(points).all(axis=1)
    moved = np.linalg.norm(camera.shift(pixels[known], points[known])[:, :, across], axis=1)
    return points[known], moved * sigma[known]
