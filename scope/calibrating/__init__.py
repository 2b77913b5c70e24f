"""scope.calibrating."""

from scope.calibrating.marks import MeasuredPlane
from scope.calibrating.run import Calibration, calibrate
from scope.calibrating.verifying import check_plane, verify

__all__ = ["Calibration", "MeasuredPlane", "calibrate", "check_plane", "verify"]
