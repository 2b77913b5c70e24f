"""calibration.toml, or images in memory, to a verified rig: marks, rays, lasers, stages, verification, verdict.

In: a calibration file, with the camera that takes its images or not, or a `CalibrationSession`.
Out: `Calibration`: the rig, the figures of both analyses, faults, what was left out and why, passed or not.
Read: taking, run, marks, beside, plates, reading, channels, lasers, stages, stage_scale, left_out, verdict,
    verifying.
"""

from scope.calibrating.left_out import small
from scope.calibrating.marks import MeasuredPlane, measure_plane
from scope.calibrating.run import Calibration, calibrate
from scope.calibrating.taking import (
    DARK,
    LASER,
    REPEATS,
    TARGET,
    image_places,
    images_there,
    keep_shots,
    shots_of,
    take_missing,
)
from scope.calibrating.verifying import check_plane, verify

__all__ = [
    "Calibration",
    "DARK",
    "LASER",
    "MeasuredPlane",
    "REPEATS",
    "TARGET",
    "calibrate",
    "check_plane",
    "image_places",
    "images_there",
    "keep_shots",
    "measure_plane",
    "shots_of",
    "small",
    "take_missing",
    "verify",
]
