"""calibration.toml, or images in memory, to a verified rig: marks, rays, lasers, stages, verification, verdict.

In: a calibration file or a `CalibrationSession`.
Out: `Calibration`: the rig, the figures of both analyses, faults, what was left out and why, passed or not.
Read: run, marks, beside, plates, reading, channels, lasers, stages, stage_scale, left_out, verdict, verifying.
"""

from scope.calibrating.left_out import small
from scope.calibrating.marks import MeasuredPlane, measure_plane
from scope.calibrating.run import Calibration, calibrate
from scope.calibrating.verifying import check_plane, verify

__all__ = ["Calibration", "MeasuredPlane", "calibrate", "check_plane", "measure_plane", "small", "verify"]
