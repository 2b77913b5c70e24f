"""Targets to print or to drill, to scale: the very marks that a calibration.toml describes.

In: calibration.toml, rig-design.toml, or a kind of target.
Out: SVG, PDF or DXF in mm with a ruler and crosses that prove the printer's scale, and the file that fits what was printed; the base of a jig.
Read: run, pattern, sheet, tiles, drawing, svg, pdf, dxf, correction, jig.
"""

from scope.printing.drawing import Drawing
from scope.printing.pattern import draw_pattern
from scope.printing.run import PAPERS, PrintedJig, PrintedTarget, print_jig, print_target
from scope.printing.sheet import target_sheet

__all__ = [
    "PAPERS",
    "Drawing",
    "PrintedJig",
    "PrintedTarget",
    "draw_pattern",
    "print_jig",
    "print_target",
    "target_sheet",
]
