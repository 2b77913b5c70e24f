"""A target on its sheet: ruler, crosses that tell the printer's scale, and what it is."""

from __future__ import annotations

from dataclasses import dataclass

from calibration.targets import Target
from scope.printing.drawing import Drawing, Label, Line, Shape, moved
from scope.printing.pattern import draw_pattern

_LEFT, _TOP, _RIGHT, _BOTTOM = 15.0, 8.0, 6.0, 25.0  # mm about the pattern
_ARM = 3.0  # mm, half a cross
_DISTANCES = (200.0, 100.0, 50.0, 20.0)  # mm between crosses; the largest that fits


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """The drawing, and how far its crosses stand apart."""

    drawing: Drawing
    across: float  # mm between the crosses from left to right
    down: float  # mm between those from top to bottom
    title: str


def target_sheet(target: Target) -> Sheet:
    """Sheet of a target with its ruler and crosses.

    Three crosses form an L: two along the ruler below the pattern, one above the left of them, so that a printer that
    scales both directions differently is found out.
    """
    pattern = draw_pattern(target)
    x0, y0, x1, y1 = pattern.area
    width, height = x1 - x0 + _LEFT + _RIGHT, y1 - y0 + _TOP + _BOTTOM
    shapes: list[Shape] = [moved(shape, _LEFT - x0, _TOP - y0) for shape in pattern.shapes]
    left, foot = _LEFT / 2, height - 17.0
    across = longest(width - left - _ARM - 2.0)
    down = longest(foot - _ARM - 2.0)
    for x, y in ((left, foot), (left + across, foot), (left, foot - down)):
        shapes += cross(x, y)
    shapes += ruler(left, foot + 3.5, across)
    shapes.append(Label(_LEFT + 32.0, 6.4, f"scope target: {pattern.title}", 2.4))
    shapes.append(Label(left, height - 4.5, _advice(across, down), 2.4))
    shapes += _axes(_LEFT, 5.5)
    return Sheet(Drawing(width, height, tuple(shapes)), across, down, pattern.title)


def _advice(across: float, down: float) -> str:
    return f"Print at 100 %. Crosses: {across:g} mm across, {down:g} mm down; measure, then --measured {across:g}"


def cross(x: float, y: float) -> list[Shape]:
    """A cross to measure from."""
    return [Line(x - _ARM, y, x + _ARM, y), Line(x, y - _ARM, x, y + _ARM)]


def longest(room: float) -> float:
    """Largest usual distance, mm, of two crosses that fits into ``room``."""
    return next((d for d in _DISTANCES if d <= room), _DISTANCES[-1])


def ruler(x: float, y: float, length: float) -> list[Shape]:
    """A ruler from (x, y) to the right: ticks a millimetre, numbers every 10 (20 on the long one)."""
    shapes: list[Shape] = [Line(x, y, x + length, y)]
    every = 20 if length > 100 else 10
    for k in range(round(length) + 1):
        tick = 3.0 if k % 10 == 0 else 2.2 if k % 5 == 0 else 1.4
        shapes.append(Line(x + k, y, x + k, y + tick))
        if k % every == 0:
            shapes.append(Label(x + k + 0.4, y + 5.0, f"{k}", 2.2))
    return shapes


def _axes(x: float, y: float) -> list[Shape]:
    """Which way the target's x and y run, at its top left corner."""
    return [
        Line(x, y, x + 8.0, y, 0.2),
        Line(x + 8.0, y, x + 6.5, y - 0.8, 0.2),
        Line(x + 8.0, y, x + 6.5, y + 0.8, 0.2),
        Label(x + 9.0, y + 0.9, "x; y runs down", 2.4),
    ]
