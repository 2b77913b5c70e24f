"""A drawing as DXF R12, in mm: what drilling, milling and laser engraving machines read.

Source: Autodesk, DXF Reference, release 12: circles, closed polylines, lines and text in the section ENTITIES.
"""

from __future__ import annotations

from scope.printing.drawing import Disk, Drawing, Label, Line, Region, Shape


def dxf_text(drawing: Drawing) -> str:
    """One DXF file; y runs up there, and the target is seen from its front.

    Holes lie on layers by diameter (``HOLES_5``), the plate's outline on OUTLINE, dark regions as closed polylines on
    TARGET, ruler and crosses on RULER, words on NOTES.
    """
    layers = sorted({shape.layer for shape in drawing.shapes})
    lines = ["0", "SECTION", "2", "HEADER", "9", "$ACADVER", "1", "AC1009", "9", "$INSUNITS", "70", "4", "0", "ENDSEC"]
    lines += ["0", "SECTION", "2", "TABLES", "0", "TABLE", "2", "LAYER", "70", f"{len(layers)}"]
    for k, layer in enumerate(layers):
        lines += ["0", "LAYER", "2", layer, "70", "0", "62", f"{k % 7 + 1}", "6", "CONTINUOUS"]
    lines += ["0", "ENDTAB", "0", "ENDSEC", "0", "SECTION", "2", "ENTITIES"]
    for shape in drawing.shapes:
        lines += _entity(shape, drawing.height)
    return "\n".join([*lines, "0", "ENDSEC", "0", "EOF"]) + "\n"


def _entity(shape: Shape, height: float) -> list[str]:
    match shape:
        case Disk():
            place = ["10", _n(shape.x), "20", _n(height - shape.y), "30", "0", "40", _n(shape.radius)]
            return ["0", "CIRCLE", "8", shape.layer, *place]
        case Region():
            lines = []
            for ring in shape.rings:
                lines += ["0", "POLYLINE", "8", shape.layer, "66", "1", "10", "0", "20", "0", "30", "0", "70", "1"]
                for x, y in ring:
                    lines += ["0", "VERTEX", "8", shape.layer, "10", _n(x), "20", _n(height - y), "30", "0"]
                lines += ["0", "SEQEND", "8", shape.layer]
            return lines
        case Line():
            start = ["10", _n(shape.x0), "20", _n(height - shape.y0), "30", "0"]
            return ["0", "LINE", "8", shape.layer, *start, "11", _n(shape.x1), "21", _n(height - shape.y1), "31", "0"]
        case Label():
            place = ["10", _n(shape.x), "20", _n(height - shape.y), "30", "0", "40", _n(0.72 * shape.size)]
            return ["0", "TEXT", "8", shape.layer, *place, "1", shape.text]


def _n(value: float) -> str:
    return f"{value:.6f}"
