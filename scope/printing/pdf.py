"""Drawings as PDF 1.4: black and white regions, lines and words in Helvetica need no more of the format than this.

Source: Adobe, PDF Reference, 3rd edition (1.4): 3.4 (structure of a file), 4.4 (paths), 5.3 (text).
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from scope.printing.drawing import Disk, Drawing, Label, Line, Region, Shape

_POINTS = 72.0 / 25.4  # a millimetre
_ARCS = 8  # Bezier arcs a circle: off by 4e-6 of its radius


def pdf_bytes(pages: Sequence[Drawing], title: str) -> bytes:
    """One PDF with a page a drawing; it asks viewers not to scale when they print."""
    objects: list[bytes] = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [%s] /Count %d >>"
        % (b" ".join(b"%d 0 R" % (5 + 2 * k) for k in range(len(pages))), len(pages)),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        b"<< /Title (%s) /Producer (scope target) >>" % _escaped(title),
    ]
    for k, page in enumerate(pages):
        size = f"{page.width * _POINTS:.6f} {page.height * _POINTS:.6f}".encode()
        objects.append(
            b"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 %s] /Contents %d 0 R "
            b"/Resources << /Font << /F 3 0 R >> >> >>" % (size, 6 + 2 * k)
        )
        stream = zlib.compress(_content(page))
        objects.append(b"<< /Length %d /Filter /FlateDecode >>\nstream\n" % len(stream) + stream + b"\nendstream")
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    places = []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n" % number + body + b"\nendobj\n"
    start = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"trailer\n<< /Size %d /Root 1 0 R /Info 4 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start)
    return bytes(out)


def _content(page: Drawing) -> bytes:
    """Operators of one page; coordinates are mm from the top left, as the drawing's."""
    parts = [f"{_POINTS:.9f} 0 0 {-_POINTS:.9f} 0 {page.height * _POINTS:.6f} cm"]
    body = [_shape(shape) for shape in page.shapes]
    if page.clip is not None:
        x0, y0, x1, y1 = page.clip
        body = [f"q {_n(x0)} {_n(y0)} {_n(x1 - x0)} {_n(y1 - y0)} re W n", *body, "Q"]
    return "\n".join([*parts, *body, *(_shape(shape) for shape in page.over)]).encode("latin-1", "replace")


def _shape(shape: Shape) -> str:
    match shape:
        case Region():
            rings = (" l ".join(f"{_n(x)} {_n(y)}" for x, y in ring).replace(" l ", " m ", 1) for ring in shape.rings)
            return f"{_ink(shape.ink)} " + " ".join(f"{ring} l h" for ring in rings) + " f"
        case Disk():
            return f"{_ink(shape.ink)} {_circle(shape)} h f"
        case Line():
            return f"0 G {_n(shape.width)} w {_n(shape.x0)} {_n(shape.y0)} m {_n(shape.x1)} {_n(shape.y1)} l S"
        case Label():
            words = _escaped(shape.text).decode("latin-1")
            return f"0 g BT /F {_n(shape.size)} Tf 1 0 0 -1 {_n(shape.x)} {_n(shape.y)} Tm ({words}) Tj ET"


def _circle(disk: Disk) -> str:
    angle = 2 * np.pi * np.arange(_ARCS + 1) / _ARCS
    arm = 4 / 3 * np.tan(np.pi / (2 * _ARCS)) * disk.radius
    x, y = disk.x + disk.radius * np.cos(angle), disk.y + disk.radius * np.sin(angle)
    dx, dy = -arm * np.sin(angle), arm * np.cos(angle)
    arcs = [
        f"{_n(x[k] + dx[k])} {_n(y[k] + dy[k])} {_n(x[k + 1] - dx[k + 1])} {_n(y[k + 1] - dy[k + 1])} "
        f"{_n(x[k + 1])} {_n(y[k + 1])} c"
        for k in range(_ARCS)
    ]
    return " ".join([f"{_n(x[0])} {_n(y[0])} m", *arcs])


def _ink(ink: str) -> str:
    return "0 g" if ink == "black" else "1 g"


def _escaped(text: str) -> bytes:
    plain = text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
    return plain.encode("latin-1", "replace")


def _n(value: float) -> str:
    return f"{value:.6f}".rstrip("0").rstrip(".")
