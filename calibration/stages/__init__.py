"""How a stage moves what stands on it: the direction of a linear stage, the axis of a turntable.

In: the pose of the target at every position of the stage.
Out: direction or axis in the camera frame, with covariance, and the positions that contradict the rest.
Read: stage.
"""

from calibration.stages.stage import Stage, fit_linear, fit_turntable

__all__ = ["Stage", "fit_linear", "fit_turntable"]
