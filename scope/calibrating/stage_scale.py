"""Whether a laser that shines on a stage's target agrees with where its marks put it.

The lengths of the target that is carried and of the one that calibrated the camera are stated apart; where one of them is wrong,
the stage's axis and the sheet of light are known at two scales, and what is scanned about that axis is torn. A stripe on the
carried target shows it: from the one centre of a pinhole, all its points stand nearer or farther by one factor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.camera import Camera, centre_of
from calibration.geometry import Array
from calibration.rays import PlaneMarks
from calibration.sheet import Laser
from ranging.background import Image, to_gray
from ranging.stripe import StripeOptions, extract
from scope.calibrating.plates import Light, seen_on, stripes_on

_LEAST = 3  # positions with a stripe
_SPREAD = 0.02  # of the factor, within a stripe and from position to position: more is no matter of scale
_LEAST_OFF = 0.003  # of a factor from 1, that is worth putting right
_MEANT = 0.02  # a factor farther from 1 than this is a length that was stated wrongly


@dataclass(frozen=True, slots=True)
class Scale:
    """By which factor the laser puts the target of a stage farther than its marks do."""

    factor: float
    positions: int  # at which the stripe was seen
    laser: str

    @property
    def mistaken(self) -> bool:
        """Whether it is more than what measuring and placing a target leave uncertain."""
        return abs(self.factor - 1.0) > _MEANT


def scale_by_lasers(
    camera: Camera, lasers: Mapping[str, Laser], views: Sequence[tuple[PlaneMarks, Image]]
) -> Scale | None:
    """The factor that the stripes on a stage's target tell; None where they tell none, or none but 1.

    Only for a pinhole: where planes stand at known places, these give the scale.
    """
    if camera.model != "pinhole":
        return None
    for laser in lasers.values():
        factors = [factor for marks, image in views if np.isfinite(factor := _factor(camera, laser, marks, image))]
        if len(factors) < max(_LEAST, len(views) // 2):
            continue
        middle = float(np.median(factors))
        spread = 1.4826 * float(np.median(np.abs(np.array(factors) / middle - 1.0)))
        error = 1.25 * spread / np.sqrt(len(factors))  # of a median
        if abs(middle - 1.0) > max(_LEAST_OFF, 4.0 * error) and spread < _SPREAD:
            return Scale(middle, len(factors), laser.name)
    return None


def _factor(camera: Camera, laser: Laser, marks: PlaneMarks, image: Image) -> float:
    """Distance to the sheet over that to the target's plane, along the rays of the stripe; NaN where it is not one factor."""
    along = "rows" if laser.along == "rows" else "columns"
    stripe = extract(to_gray(image, laser.channel), along=along, options=StripeOptions())  # type: ignore[arg-type]
    offers = stripes_on(seen_on(camera, marks, Light(stripe.pixels, stripe.sigma, stripe.width)), marks, "auto")
    if not offers:
        return float("nan")
    rays = camera.rays(offers[0].pixels)
    centre = centre_of(camera.rays(marks.pixels))
    ratios = _distance(laser.sheet.intersect(rays).points, centre) / _distance(offers[0].points, centre)
    ratios = ratios[np.isfinite(ratios)]
    if len(ratios) < len(offers[0].line) // 2:
        return float("nan")
    middle = float(np.median(ratios))
    return middle if 1.4826 * float(np.median(np.abs(ratios / middle - 1.0))) < _SPREAD else float("nan")


def _distance(points: Array, centre: Array) -> Array:
    return np.asarray(np.linalg.norm(points - centre, axis=1))
