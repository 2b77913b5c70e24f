"""scope.calibrating."""

from scope.calibrating.marks import SeenPlane
from scope.calibrating.run import Calibration, calibrate
from scope.calibrating.verifying import check_plane, verify

__all__ = ["Calibration", "SeenPlane", "calibrate", "check_plane", "verify"]
