"""A drawing as SVG 1.1, in mm."""

from __future__ import annotations

import html

from scope.printing.drawing import Disk, Drawing, Label, Line, Region, Shape


def svg_text(drawing: Drawing, title: str) -> str:
    """One SVG file: a user unit is a millimetre, on white paper."""
    w, h = _n(drawing.width), _n(drawing.height)
    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w}mm" height="{h}mm" viewBox="0 0 {w} {h}">',
        f"<title>{html.escape(title)}</title>",
        f'<rect width="{w}" height="{h}" fill="white"/>',
    ]
    body = [_shape(shape) for shape in drawing.shapes]
    if drawing.clip is not None:
        x0, y0, x1, y1 = drawing.clip
        inside = f'<rect x="{_n(x0)}" y="{_n(y0)}" width="{_n(x1 - x0)}" height="{_n(y1 - y0)}"/>'
        parts += [f'<clipPath id="page">{inside}</clipPath>', '<g clip-path="url(#page)">', *body, "</g>"]
    else:
        parts += body
    return "\n".join([*parts, *(_shape(shape) for shape in drawing.over), "</svg>"]) + "\n"


def _shape(shape: Shape) -> str:
    match shape:
        case Region():
            path = "".join("M" + "L".join(f"{_n(x)} {_n(y)}" for x, y in ring) + "Z" for ring in shape.rings)
            return f'<path d="{path}" fill="{shape.ink}"/>'
        case Disk():
            return f'<circle cx="{_n(shape.x)}" cy="{_n(shape.y)}" r="{_n(shape.radius)}" fill="{shape.ink}"/>'
        case Line():
            ends = f'x1="{_n(shape.x0)}" y1="{_n(shape.y0)}" x2="{_n(shape.x1)}" y2="{_n(shape.y1)}"'
            return f'<line {ends} stroke="black" stroke-width="{_n(shape.width)}"/>'
        case Label():
            font = f'font-family="Helvetica, Arial, sans-serif" font-size="{_n(shape.size)}"'
            return f'<text x="{_n(shape.x)}" y="{_n(shape.y)}" {font}>{html.escape(shape.text)}</text>'


def _n(value: float) -> str:
    return f"{value:.6f}".rstrip("0").rstrip(".")
