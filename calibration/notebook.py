"""Results as a prompt and a notebook show them: one short line, or a picture beside the figures."""

from __future__ import annotations

import base64
import html
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array

Picture = NDArray[np.uint8]

MOST_DOTS = 60_000  # in one picture; more are thinned evenly
_PAPER, _EMPTY = 255, 90


@dataclass(frozen=True, slots=True)
class Summary:
    """What is shown of a result."""

    title: str  # "ScanCloud: 14,274 points"
    figures: tuple[tuple[str, str], ...] = ()  # name and value with its unit


class Shown:
    """Gives `__repr__` and `_repr_html_` to a class that summarises itself."""

    __slots__ = ()

    def summary(self) -> Summary:
        """Title and figures."""
        raise NotImplementedError

    def picture(self) -> tuple[Picture | None, str]:
        """The picture (H, W, 3) BGR and its caption; asked for by a notebook only."""
        return None, ""

    def __repr__(self) -> str:
        """One line, whatever the size of the result."""
        shown = self.summary()
        figures = ", ".join(f"{name} {value}" for name, value in shown.figures)
        return f"<{shown.title}{', ' if figures else ''}{figures}>"

    def _repr_html_(self) -> str:
        """The picture and the figures."""
        return as_html(self.summary(), *self.picture())


def as_html(shown: Summary, picture: Picture | None = None, caption: str = "") -> str:
    """A summary in HTML that needs nothing else: every text escaped, the picture (H, W, 3) BGR inline."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th><td style='text-align:left'>{html.escape(value)}</td></tr>"
        for name, value in shown.figures
    )
    image = ""
    if picture is not None:
        text = html.escape(caption, quote=True)
        image = (
            f"<figure style='margin:0'><img alt='{text}' src='{_png(picture)}'><figcaption>{text}</figcaption></figure>"
        )
    table = f"<table>{rows}</table>" if rows else ""
    return (
        f"<div><strong>{html.escape(shown.title)}</strong>"
        f"<div style='display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start'>{image}{table}</div></div>"
    )


def scatter(across: Array, down: Array, values: Array, *, width: int = 420, height: int = 320) -> Picture | None:
    """Dots (N,) at ``across`` (to the right) and ``down``, to one scale in both, coloured by ``values``; None without any.

    The view spans the middle 99.6 % of the dots, so that a few strays do not shrink the rest.
    """
    known = np.isfinite(across) & np.isfinite(down)
    if not known.any():
        return None
    x, y, z = across[known], down[known], values[known]
    if len(x) > MOST_DOTS:
        chosen = np.linspace(0, len(x) - 1, MOST_DOTS).astype(np.intp)
        x, y, z = x[chosen], y[chosen], z[chosen]
    (x0, x1), (y0, y1) = np.percentile(x, [0.2, 99.8]), np.percentile(y, [0.2, 99.8])
    scale = min((width - 20) / max(x1 - x0, 1e-9), (height - 20) / max(y1 - y0, 1e-9))
    column = np.rint(width / 2 + (x - 0.5 * (x0 + x1)) * scale)
    row = np.rint(height / 2 + (y - 0.5 * (y0 + y1)) * scale)
    seen = (column >= 1) & (column < width - 1) & (row >= 1) & (row < height - 1)
    column, row = column[seen].astype(np.intp), row[seen].astype(np.intp)
    picture = np.full((height, width, 3), _PAPER, dtype=np.uint8)
    colours = coloured(z[seen])
    for i in (0, 1):
        for j in (0, 1):
            picture[row + i, column + j] = colours
    return picture


def coloured(values: Array) -> Picture:
    """Colours (..., 3) BGR of values (...), viridis from their 2nd to their 98th percentile; grey where not known."""
    import cv2

    known = np.isfinite(values)
    low, high = np.percentile(values[known], [2, 98]) if known.any() else (0.0, 1.0)
    level = np.clip((np.where(known, values, low) - low) / max(high - low, 1e-30), 0.0, 1.0)
    grey = np.rint(255 * level).astype(np.uint8).reshape(-1, 1)
    colours = np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), dtype=np.uint8).reshape(*values.shape, 3)
    colours[~known] = _EMPTY
    return colours


def enlarged(picture: Picture, least: int = 240) -> Picture:
    """A picture of few pixels (H, W, 3), each of them repeated until the longer side has ``least``."""
    times = max(1, least // max(picture.shape[:2]))
    return np.kron(picture, np.ones((times, times, 1), dtype=np.uint8))


def number(value: float, unit: str = "") -> str:
    """A figure to three digits with its unit, "not known" for NaN."""
    return f"{value:.3g}{' ' if unit else ''}{unit}" if np.isfinite(value) else "not known"


def _png(picture: Picture) -> str:
    import cv2

    _, data = cv2.imencode(".png", picture)
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode("ascii")
