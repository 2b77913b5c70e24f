"""calibration.sheet."""

from calibration.sheet.curved import CurvedSheet, Sheet, SheetFrame, order_of
from calibration.sheet.laser import Laser, PlaneOfLight, StripePoints, fit_laser

__all__ = ["CurvedSheet", "Laser", "PlaneOfLight", "Sheet", "SheetFrame", "StripePoints", "fit_laser", "order_of"]
