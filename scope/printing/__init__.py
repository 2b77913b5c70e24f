"""Targets to print or to drill, to scale: the very marks that a calibration.toml describes.

In: calibration.toml, or a kind of target.
Out: SVG, PDF or DXF in mm with a ruler and crosses that prove the printer's scale, and the file that fits what was printed.
Read: run, pattern, sheet, tiles, drawing, svg, pdf, dxf, correction.
"""

from scope.printing.drawing import Drawing
from scope.printing.pattern import draw_pattern
from scope.printing.run import PAPERS, PrintedTarget, print_target
from scope.printing.sheet import target_sheet

__all__ = ["PAPERS", "Drawing", "PrintedTarget", "draw_pattern", "print_target", "target_sheet"]
