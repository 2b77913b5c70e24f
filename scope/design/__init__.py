"""A rig predicted before it is built: how well it will range, calibrate and measure, without rendering an image.

In: rig-design.toml.
Out: noise and calibration error over the working volume, resolution, signal, the uncertainty of what one measures, and a
    sentence for everything that will not work.
Read: run, spots, stripe, planned, prediction, visibility, expected, troubles, tolerance, want, written, wording.
"""

from scope.design.prediction import Surface
from scope.design.run import DesignResult, design_rig
from scope.design.tolerance import Drawn, draw_figures, one_draw
from scope.design.visibility import HiddenMap
from scope.design.want import Proposal, Wanted, parse_want, propose
from scope.design.wording import design_text, draws_text, expected_rows, figure_name, length, proposal_text
from scope.design.written import write_design

__all__ = [
    "DesignResult",
    "Drawn",
    "HiddenMap",
    "Proposal",
    "Surface",
    "Wanted",
    "design_rig",
    "design_text",
    "draw_figures",
    "draws_text",
    "expected_rows",
    "figure_name",
    "length",
    "one_draw",
    "parse_want",
    "proposal_text",
    "propose",
    "write_design",
]
