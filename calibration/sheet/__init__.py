"""Points of the laser's light to the sheet that it spreads.

In: points (N, 3) on known planes and how certain each is.
Out: a plane, or a slightly curved sheet behind a window, with its covariance and what was left out.
Read: laser, curved, coupling.
"""

from calibration.sheet.coupling import coupled, followed, moved_stripe
from calibration.sheet.curved import CurvedSheet, Sheet, SheetFrame, order_of
from calibration.sheet.laser import Laser, PlaneOfLight, StripePoints, fit_laser

__all__ = [
    "CurvedSheet",
    "Laser",
    "PlaneOfLight",
    "Sheet",
    "SheetFrame",
    "StripePoints",
    "coupled",
    "fit_laser",
    "followed",
    "moved_stripe",
    "order_of",
]
