"""A rig predicted before it is built: how well it will range, calibrate and measure, without rendering an image.

In: rig-design.toml.
Out: noise and calibration error over the working volume, resolution, signal, the uncertainty of what one measures, and a
    sentence for everything that will not work.
Read: run, spots, stripe, planned, prediction, visibility, expected, troubles, wording.
"""

from scope.design.prediction import Surface
from scope.design.run import DesignResult, design_rig
from scope.design.wording import design_text

__all__ = ["DesignResult", "Surface", "design_rig", "design_text"]
