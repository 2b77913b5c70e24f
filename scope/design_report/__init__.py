"""The page of a designed rig, for the meeting that decides on it.

In: a `DesignResult`, and where there are some, a brief's proposal and draws.
Out: one HTML file: the rig to scale, maps over its sheet of light, what one may expect, what else was considered.
Read: page, drawing.
"""

from scope.design_report.page import design_page

__all__ = ["design_page"]
