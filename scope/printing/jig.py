"""The base of a jig to scale: where on it the target stands at each stand-off, and the numbers to check it by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.geometry import Array, Pose
from calibration.targets import Target
from scope.printing.drawing import Drawing, Label, Line, Region, Shape, rectangle
from scope.printing.pattern import draw_pattern
from scope.printing.sheet import cross, longest, ruler

_MARGIN = 15.0  # mm about the seats
_EDGE = 8.0  # mm about everything
_ROW = 4.2  # mm, of the table
_COLUMNS = (0.0, 26.0, 47.0, 68.0, 89.0, 110.0, 131.0, 158.0)  # mm
_HEADS = ("seat", "middle z", "from last", "mark 0: x", "y", "z", "lower edge y", "rotation, degrees")
_WIDE = 205.0  # mm that the table takes


@dataclass(frozen=True, slots=True, eq=False)
class Seat:
    """One place of the target."""

    name: str
    pose: Pose  # C_from_target


@dataclass(frozen=True, slots=True, eq=False)
class JigSheet:
    """The drawing, how far its crosses stand apart, and where the seats are."""

    drawing: Drawing
    across: float  # mm between the crosses
    rows: tuple[tuple[str, ...], ...]  # of the table


def jig_sheet(target: Target, seats: Sequence[Seat]) -> JigSheet:
    """Base plate seen from above, 1 : 1: z runs to the right, x down; the camera stands to the left.

    A seat is the line on which the front face of the target's pattern has its lowest edge (largest y in C). Seats come in the
    order of their distance. ``ValueError`` without a seat.
    """
    if not seats:
        raise ValueError("a jig has one seat at least")
    x0, y0, x1, y1 = draw_pattern(target).area
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    middle = corners.mean(axis=0)[None]
    ordered = sorted(seats, key=lambda seat: float(seat.pose.apply(middle)[0, 2]))
    edges = [_lowest_edge(seat.pose.apply(corners)) for seat in ordered]
    rows = _table(ordered, edges, middle)
    everything = np.concatenate(edges)
    low, high = everything.min(axis=0) - _MARGIN, everything.max(axis=0) + _MARGIN
    plate = (high[2] - low[2], high[0] - low[0])
    left, top = _EDGE + 14.0, 26.0
    width = max(left + plate[0] + _EDGE, _WIDE + 2 * _EDGE)
    foot = top + plate[1] + 12.0
    height = foot + 18.0 + _ROW * (len(rows) + 3)

    def at(point: Array) -> tuple[float, float]:
        return left + float(point[2] - low[2]), top + float(point[0] - low[0])

    shapes: list[Shape] = [
        Label(_EDGE, 8.0, "scope target: base of the jig, seen from above, 1 : 1", 3.0),
        Label(_EDGE, 12.5, "Lines: front face of the target at its lowest edge. Camera frame: z to the right, x down, mm.", 2.4),
        *_outline(left, top, plate),
    ]  # fmt: skip
    if low[0] < 0.0 < high[0]:
        y = top - float(low[0])
        shapes += [Line(left - 3.0, y, left + plate[0], y, 0.08), Label(left - 13.0, y + 0.8, "x = 0", 2.4)]
    last: float | None = None
    for k, (seat, edge) in enumerate(zip(ordered, edges, strict=True)):
        (xa, ya), (xb, yb) = at(edge[0]), at(edge[1])
        place = (xa + xb) / 2
        crowded = last is not None and place - last < 16.0
        level = top - 2.0 - 3.4 * (k % 2 if crowded else 0)  # names of near seats one above the other
        shapes += [Line(xa, ya, xb, yb, 0.35, "SEATS"), Label(place - 4.0, level, seat.name[:16], 2.4)]
        if last is not None:
            below = top + plate[1] + 3.0
            shapes += [Line(last, below, place, below, 0.12), *(Line(x, below - 1.2, x, below + 1.2, 0.12) for x in (last, place))]  # fmt: skip
            shapes.append(Label((last + place) / 2 - 4.0, below + 3.2, rows[k][2], 2.4))
        last = place
    shapes.append(Label(_EDGE, 17.0, f"The camera's origin (z = 0) is {low[2]:.2f} mm to the left of the plate's left edge.", 2.4))  # fmt: skip
    across = longest(width - 2 * _EDGE - 6.0)
    shapes += [*cross(_EDGE + 4.0, foot), *cross(_EDGE + 4.0 + across, foot), *ruler(_EDGE + 4.0, foot + 3.5, across)]
    shapes += _printed(rows, foot + 17.0)
    shapes.append(Label(_EDGE, height - 4.0, f"Print at 100 %; the crosses stand {across:g} mm apart.", 2.4))
    return JigSheet(Drawing(width, height, tuple(shapes)), across, rows)


def _lowest_edge(corners: Array) -> Array:
    """Ends (2, 3) of that edge of a rectangle (4, 3) in C which lies lowest: y runs down."""
    ends = [corners[[k, (k + 1) % 4]] for k in range(4)]
    return max(ends, key=lambda pair: float(pair[:, 1].mean()))


def _table(seats: Sequence[Seat], edges: Sequence[Array], middle: Array) -> tuple[tuple[str, ...], ...]:
    rows = []
    before: float | None = None
    for seat, edge in zip(seats, edges, strict=True):
        z = float(seat.pose.apply(middle)[0, 2])
        turn = np.degrees(cv2.Rodrigues(seat.pose.rotation)[0].ravel())
        rows.append((
            seat.name[:16], f"{z:.3f}", "" if before is None else f"{z - before:.3f}",
            *(f"{v:.3f}" for v in seat.pose.translation), f"{edge[:, 1].mean():.3f}", ", ".join(f"{a:.3f}" for a in turn),
        ))  # fmt: skip
        before = z
    return tuple(rows)


def _outline(left: float, top: float, plate: tuple[float, float]) -> list[Shape]:
    ring = rectangle(left, top, left + plate[0], top + plate[1])
    ends = zip(ring, np.roll(ring, -1, axis=0), strict=True)
    return [Line(float(a[0]), float(a[1]), float(b[0]), float(b[1]), 0.15, "OUTLINE") for a, b in ends]


def _printed(rows: Sequence[tuple[str, ...]], y: float) -> list[Shape]:
    shapes: list[Shape] = []
    for k, cells in enumerate((_HEADS, *rows)):
        line = y + k * _ROW
        shapes += [Label(_EDGE + x, line, cell, 2.4) for x, cell in zip(_COLUMNS, cells, strict=True) if cell]
    rule = rectangle(_EDGE, y + 1.2, _EDGE + _WIDE, y + 1.3)
    return [*shapes, Region((rule,), layer="NOTES")]
