"""How a ranged point moves when its stripe is misjudged: within the sheet of light, not along the sighting ray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints
from scope.model import Scanned

UNKNOWN_WIDTH = 0.3  # mm, one sigma of a stripe where the cloud does not tell


@dataclass(frozen=True, slots=True, eq=False)
class Stripe:
    """The sheet of light and the camera at each of N points, cloud frame."""

    sheet: Array  # (N, 3) unit normal of the sheet
    across: Array  # (N, 3) unit, the axis of the camera's image across the stripe
    laser: Array | None  # (N, 3) mm; where unknown, nothing lies in the shade
    width: float  # mm, one sigma of the stripe on the surface

    def only(self, rows: Ints) -> Stripe:
        """At some of the points."""
        laser = None if self.laser is None else self.laser[rows]
        return Stripe(self.sheet[rows], self.across[rows], laser, self.width)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Points of a part, and all that is known of how they were seen."""

    scan: Scanned  # (N), with its lines of motion where camera and sheet are known
    stripe: Stripe | None  # None without camera and sheet
    laser: Array | None  # (N, 3) mm, for each point
    stated: bool  # whether sigma was stated for any of them; else it is a guess that the residuals put right
    line: Ints | None  # (N,) line of the camera's image that each point is of; None where unknown
    width: float = UNKNOWN_WIDTH  # mm, one sigma of the stripe


def motions_of(points: Array, camera: Array, sheet: Array, across: Array) -> Array:
    """Motion (N, 3) of points for 1 mm along their sighting ray when the stripe is found elsewhere in the image.

    A pixel that moves across the stripe turns its ray, and the point runs along the ray until it is on the sheet again
    (`ranging.covariance`, dX = d - v (n . d) / (n . v)): the motion lies in the sheet. Its part along the ray is 1, the other
    part is what a surface seen at a slant feels, which is more than the cosine of its slant.

    Parameters
    ----------
    points, camera : (N, 3) mm
        And where the camera was for each.
    sheet, across : (N, 3)
        Unit normal of the sheet, and the camera's axis across the stripe.
    """
    ray = points - camera
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    aside = across - (across * ray).sum(axis=1, keepdims=True) * ray
    steep = (aside * sheet).sum(axis=1)
    steep = np.where(np.abs(steep) < 1e-3, 1e-3, steep)
    return np.asarray(aside * ((ray * sheet).sum(axis=1) / steep)[:, None] - ray)
