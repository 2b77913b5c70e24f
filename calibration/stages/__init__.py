"""calibration.stages."""

from calibration.stages.stage import Stage, fit_linear, fit_turntable

__all__ = ["Stage", "fit_linear", "fit_turntable"]
