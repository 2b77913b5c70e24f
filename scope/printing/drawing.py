"""What a drawing is made of: filled regions and disks, lines and words, in mm, x to the right and y down."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from calibration.geometry import Array

Ink = Literal["black", "white"]


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Polygons filled as one (non-zero winding), so that neighbours that share an edge leave no seam."""

    rings: tuple[Array, ...]  # each (k, 2) mm, closed
    ink: Ink = "black"
    layer: str = "TARGET"


@dataclass(frozen=True, slots=True)
class Disk:
    """A filled circle; on a drill layout, a hole."""

    x: float  # mm
    y: float  # mm
    radius: float  # mm
    ink: Ink = "black"
    layer: str = "HOLES"


@dataclass(frozen=True, slots=True)
class Line:
    """A straight black line."""

    x0: float  # mm
    y0: float
    x1: float
    y1: float
    width: float = 0.1  # mm
    layer: str = "RULER"


@dataclass(frozen=True, slots=True)
class Label:
    """Words in plain ASCII, from (x, y) on their base line to the right."""

    x: float  # mm
    y: float
    text: str
    size: float = 2.6  # mm, of the letters' em
    layer: str = "NOTES"


Shape: TypeAlias = Region | Disk | Line | Label


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """A sheet; later shapes cover earlier ones."""

    width: float  # mm
    height: float  # mm
    shapes: tuple[Shape, ...]
    clip: tuple[float, float, float, float] | None = None  # x0, y0, x1, y1 mm: what shows of ``shapes``; None: all
    over: tuple[Shape, ...] = ()  # drawn last, never clipped


def rectangle(x0: float, y0: float, x1: float, y1: float) -> Array:
    """Ring (4, 2) of a rectangle."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)


def moved(shape: Shape, x: float, y: float) -> Shape:
    """Shape shifted by (x, y) mm."""
    match shape:
        case Region():
            return Region(tuple(ring + np.array([x, y]) for ring in shape.rings), shape.ink, shape.layer)
        case Disk():
            return Disk(shape.x + x, shape.y + y, shape.radius, shape.ink, shape.layer)
        case Line():
            return Line(shape.x0 + x, shape.y0 + y, shape.x1 + x, shape.y1 + y, shape.width, shape.layer)
        case Label():
            return Label(shape.x + x, shape.y + y, shape.text, shape.size, shape.layer)
