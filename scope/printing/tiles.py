"""A sheet that is larger than the paper: pages that are trimmed and joined."""

from __future__ import annotations

import math

from scope.printing.drawing import Drawing, Label, Line, Shape, moved

MARGIN = 12.0  # mm about what is printed of the sheet on each page, where printers often cannot print
_OVERLAP = 10.0  # mm that neighbouring pages both show


def tiled(sheet: Drawing, paper: tuple[float, float]) -> list[Drawing]:
    """Pages of a sheet on paper (width, height) mm, upright or across as fewer pages need; one page where it fits.

    Neighbouring pages both show a strip; marks in the margin say where its middle is: trim one of the two there and lay
    it on the other's marks. ``ValueError`` for paper smaller than 60 mm.
    """
    if min(paper) < 60.0:
        raise ValueError(f"paper of {paper[0]:g} x {paper[1]:g} mm is too small: 60 mm at least are needed")
    upright, across = (_pages(sheet, size) for size in (paper, paper[::-1]))
    return (
        across
        if len(across) < len(upright) or (len(across) == len(upright) and sheet.width > sheet.height)
        else upright
    )


def _pages(sheet: Drawing, paper: tuple[float, float]) -> list[Drawing]:
    width, height = paper
    if sheet.width <= width and sheet.height <= height:
        x, y = (width - sheet.width) / 2, (height - sheet.height) / 2
        return [Drawing(width, height, tuple(moved(shape, x, y) for shape in sheet.shapes))]
    room = (width - 2 * MARGIN, height - 2 * MARGIN)
    columns, rows = (
        max(1, math.ceil((size - _OVERLAP) / (free - _OVERLAP)))
        for size, free in zip((sheet.width, sheet.height), room, strict=True)
    )
    pages = []
    for row in range(rows):
        for column in range(columns):
            x, y = MARGIN - column * (room[0] - _OVERLAP), MARGIN - row * (room[1] - _OVERLAP)
            clip = (MARGIN, MARGIN, width - MARGIN, height - MARGIN)
            shapes = tuple(moved(shape, x, y) for shape in sheet.shapes)
            number = row * columns + column + 1
            name = f"page {number} of {rows * columns}: row {row + 1} of {rows}, column {column + 1} of {columns}"
            marks = [*_trims(width, height, (column > 0, column < columns - 1), (row > 0, row < rows - 1))]
            pages.append(Drawing(width, height, shapes, clip, (*marks, Label(MARGIN + 22.0, height - 5.5, name))))
    return pages


def _trims(width: float, height: float, sides: tuple[bool, bool], ends: tuple[bool, bool]) -> list[Shape]:
    """Marks in the margin at the middles of the strips that a page shares with its neighbours."""
    middle = MARGIN + _OVERLAP / 2
    shapes: list[Shape] = []
    for there, x in zip(sides, (middle, width - middle), strict=True):
        if there:
            shapes += [Line(x, 5.0, x, MARGIN - 1.0), Line(x, height - MARGIN + 1.0, x, height - 5.0)]
    for there, y in zip(ends, (middle, height - middle), strict=True):
        if there:
            shapes += [Line(5.0, y, MARGIN - 1.0, y), Line(width - MARGIN + 1.0, y, width - 5.0, y)]
    return shapes
