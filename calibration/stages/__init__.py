"""How what carries a target or a camera moves: a linear stage, a turntable, a robot's arm.

In: the pose of the target at every position of the stage, or views of it with the poses of the arm.
Out: direction or axis in the camera frame, or where the camera is on the robot, with covariance, and the
    positions or views that contradict the rest.
Read: stage, hand_eye_start, hand_eye_system, hand_eye, hand_eye_sphere, hand_eye_planes.
"""

from calibration.stages.hand_eye import (
    HandEyeFit,
    Repeatability,
    ViewOfHandEye,
    delay_step,
    require_turns,
    solve_hand_eye,
)
from calibration.stages.hand_eye_planes import PlanesFit, solve_by_planes
from calibration.stages.hand_eye_sphere import Pass, SphereFit, solve_by_sphere
from calibration.stages.hand_eye_start import Mount, SeenTarget, Start, closed_form, consensus
from calibration.stages.stage import Stage, fit_linear, fit_turntable

__all__ = [
    "HandEyeFit",
    "Mount",
    "Pass",
    "PlanesFit",
    "Repeatability",
    "SeenTarget",
    "SphereFit",
    "Stage",
    "Start",
    "ViewOfHandEye",
    "closed_form",
    "consensus",
    "delay_step",
    "fit_linear",
    "fit_turntable",
    "require_turns",
    "solve_by_planes",
    "solve_by_sphere",
    "solve_hand_eye",
]
