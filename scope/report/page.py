"""Self-contained HTML pages: verdict, tables, images, line plots and a cloud that can be turned."""

from __future__ import annotations

import base64
import html
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from calibration.geometry import Array
from calibration.rig import Rig
from scope.origin import Origin
from scope.report._style import STYLE
from scope.version import __version__
from scope.viewer import Picture, Scene, viewer_element, viewer_script

Level = Literal["good", "warn", "bad", "plain"]

_CONTENTS = 4  # sections, from which a page has a table of contents
_QUALITY = 85
_FOOT = "</dl></footer>"
_COLOURS = 6  # of curves, in the style: c0 to c5


@dataclass(slots=True)
class Page:
    """A page that grows from top to bottom; ``html()`` gives one file that needs nothing else.

    Every text is escaped. Numbers are formatted by the caller, who knows how many figures are true.
    """

    title: str
    _parts: list[str] = field(default_factory=list)
    _figures: list[str] = field(default_factory=list)  # that stand side by side until something else comes
    _headings: list[str] = field(default_factory=list)
    _about: list[tuple[str, str]] = field(default_factory=list)
    _has_cloud: bool = False

    def about(self, what: str, value: str) -> None:
        """Say in the footer what the page is of: rig, camera, inputs; empty values are left out."""
        if value:
            self._about.append((what, value))

    def verdict(self, level: Level, text: str) -> None:
        """Draw the box that says pass or fail, and why, in plain words."""
        self._add(f'<p class="verdict {level}">{html.escape(text)}</p>')

    def heading(self, text: str) -> None:
        """Start a section."""
        self._headings.append(text)
        self._add(f'<h2 id="s{len(self._headings)}">{html.escape(text)}</h2>')

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._add(f"<p>{html.escape(text)}</p>")

    def table(self, headers: Sequence[str], rows: Iterable[Sequence[str]], *, marked: Collection[int] = ()) -> None:
        """Add a table; a column that holds words is set to the left, one of numbers to the right; ``marked`` rows are at fault."""
        rows = [list(row) for row in rows]
        worded = [any(len(row) > k and not _is_number(row[k]) for row in rows) for k in range(len(headers))]
        head = "".join(
            f"<th{' class=text' if text else ''}>{html.escape(cell)}</th>"
            for cell, text in zip(headers, worded, strict=True)
        )
        body = "".join(
            f"<tr{' class=off' if k in marked else ''}>"
            + "".join(_cell(cell, words=text) for cell, text in zip(row, worded, strict=True))
            + "</tr>"
            for k, row in enumerate(rows)
        )
        self._add(f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>')

    def image(self, picture: Picture, caption: str, *, width: int | None = None) -> None:
        """Add a picture (grey or BGR) of 8 bits; ``width`` is the width on the page, px.

        It is kept at twice the width at most, as WebP or PNG, whichever is smaller.
        """
        if width is not None and picture.shape[1] > 2 * width:
            scale = 2.0 * width / picture.shape[1]
            picture = np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        kind, data = _smallest(picture)
        size = f' width="{width}"' if width else ""
        source = base64.b64encode(data).decode("ascii")
        self._figure(
            f'<img{size} loading="lazy" alt="{html.escape(caption)}" src="data:image/{kind};base64,{source}">',
            caption,
            width,
        )

    def plot(
        self,
        series: Sequence[tuple[str, ArrayLike, ArrayLike]],
        caption: str,
        *,
        x_label: str,
        y_label: str,
        points: bool = False,
        log: bool = False,
    ) -> None:
        """Add a line plot (or dots) of (name, x, y) series; NaN breaks a line; ``log`` makes both axes logarithmic."""
        drawn = _plot_svg(series, x_label, y_label, points=points, log=log)
        self._figure(drawn.replace("<svg ", f'<svg aria-label="{html.escape(caption)}" ', 1), caption)

    def drawing(self, svg: str, caption: str) -> None:
        """Add a picture that is drawn: an ``<svg>`` of the caller's own making, whose words he has escaped."""
        named = f'<svg role="img" aria-label="{html.escape(caption)}" style="max-width:100%;height:auto" '
        self._figure(svg.replace("<svg ", named, 1), caption)

    def cloud(self, scene: Scene, caption: str, *, limit: int = 150_000) -> None:
        """Add the viewer with a scene: to be turned, read, measured and cut; in print, and without WebGL, a picture of it.

        At most ``limit`` points are put into the page, even over the surface, so that it stays small; the caption says so.
        """
        shown = scene.thinned(limit)
        note = (
            caption if len(shown) == len(scene) else f"{caption} ({len(shown)} of {len(scene)} points, evenly chosen)"
        )
        self._figure(viewer_element(shown, caption), note, kind=' class="whole turned"')
        self._has_cloud = True

    def about_rig(self, rig: Rig, name: str = "rig.json") -> None:
        """Say in the footer of which rig the page is: its file, when it was verified, the limits asked for, its camera."""
        self.about("rig", f"{name}, sha256 {rig.sha256}" if rig.sha256 else name)
        self.about(
            "rig verified", f"{rig.written} by {rig.software}, {'passed' if rig.verification.passed else 'not passed'}"
        )
        self.about("limits asked", ", ".join(f"{key} {value:g}" for key, value in rig.accept.items()) or "none")
        self.about("camera", rig.camera_id)

    def html(self) -> str:
        """The whole page."""
        self._close_figures()
        script = viewer_script() if self._has_cloud else ""
        title = html.escape(self.title)
        long = len(self._headings) >= _CONTENTS
        contents = "".join(f'<li><a href="#s{k}">{html.escape(h)}</a></li>' for k, h in enumerate(self._headings, 1))
        nav = f'<nav aria-label="Contents"><ol>{contents}</ol></nav>' if long else ""
        about = [
            *self._about,
            ("made", f"{datetime.now().astimezone().isoformat(timespec='seconds')} by SCOPE {__version__}"),
        ]
        told = "".join(f"<dt>{html.escape(what)}</dt><dd>{html.escape(value)}</dd>" for what, value in about)
        return (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">'
            f'<title>{title}</title><style>{STYLE}</style></head><body><div class="page{" long" if long else ""}">{nav}<main><h1>{title}</h1>'
            f"{''.join(self._parts)}<footer><dl>{told}{_FOOT}</main></div>{script}</body></html>\n"
        )

    def _add(self, content: str) -> None:
        self._close_figures()
        self._parts.append(content)

    def _close_figures(self) -> None:
        if self._figures:
            self._parts.append(f'<div class="figures">{"".join(self._figures)}</div>')
            self._figures.clear()

    def _figure(self, content: str, caption: str, width: int | None = None, *, kind: str = "") -> None:
        style = f' style="width:{width + 2}px"' if width else ""  # a long caption must not push its neighbour below
        self._figures.append(f"<figure{kind}{style}>{content}<figcaption>{html.escape(caption)}</figcaption></figure>")


def linked(page: str, links: Iterable[tuple[str, str]]) -> str:
    """A page with links (file, words) to the pages beside it, under its title."""
    told = "".join(f'<a href="{html.escape(file)}">{html.escape(words)}</a>' for file, words in links)
    return page.replace("</h1>", f'</h1><nav class="beside" aria-label="Pages beside this one">{told}</nav>', 1)


def signed(page: str, origin: Origin) -> str:
    """A page whose footer also says who made it, and of which files."""
    told = "".join(f"<dt>{html.escape(what)}</dt><dd>{html.escape(value)}</dd>" for what, value in origin.told)
    body, end, rest = page.rpartition(_FOOT)
    return f"{body}{told}{end}{rest}" if end else page


def _smallest(picture: Picture) -> tuple[str, bytes]:
    """Name and bytes of the smaller of two encodings; maps of few colours stay exact."""
    done, exact = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise ValueError("the picture is not an image of 8 bits")
    done, close = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    if done and 3 * len(close) < 2 * len(exact):
        return "webp", close.tobytes()
    return "png", exact.tobytes()


def _is_number(text: str) -> bool:
    return text.strip().lstrip("+-−±<>≤≥ ")[:1].isdigit() or text.strip() in {"", "-"}


def _cell(text: str, *, words: bool) -> str:
    return f'<td class="text">{html.escape(text)}</td>' if words else f"<td>{html.escape(text)}</td>"


def _plot_svg(
    series: Sequence[tuple[str, ArrayLike, ArrayLike]], x_label: str, y_label: str, *, points: bool, log: bool
) -> str:
    width, height, left, bottom, top, right = 620, 320, 64, 42, 12, 12
    curves = [(name, np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)) for name, x, y in series]
    if log:
        curves = [(n, np.log10(np.where(x > 0, x, np.nan)), np.log10(np.where(y > 0, y, np.nan))) for n, x, y in curves]
    everything_x = np.concatenate([x[np.isfinite(x) & np.isfinite(y)] for _, x, y in curves] or [np.zeros(0)])
    everything_y = np.concatenate([y[np.isfinite(x) & np.isfinite(y)] for _, x, y in curves] or [np.zeros(0)])
    if len(everything_x) == 0:
        return "<p>nothing to plot</p>"
    x0, x1 = _span(everything_x)
    y0, y1 = _span(everything_y)

    def at(x: Array, y: Array) -> tuple[Array, Array]:
        return (
            left + (x - x0) / (x1 - x0) * (width - left - right),
            height - bottom - (y - y0) / (y1 - y0) * (height - bottom - top),
        )

    parts = [f'<svg viewBox="0 0 {width} {height}" width="{width}" role="img">']
    for value in _ticks(x0, x1):
        tick = float(at(np.array(value), np.array(y0))[0])
        parts.append(f'<line x1="{tick:.1f}" x2="{tick:.1f}" y1="{top}" y2="{height - bottom}" class="grid"/>')
        parts.append(
            f'<text x="{tick:.1f}" y="{height - bottom + 15}" text-anchor="middle">{_label(value, log)}</text>'
        )
    for value in _ticks(y0, y1):
        tick = float(at(np.array(x0), np.array(value))[1])
        parts.append(f'<line x1="{left}" x2="{width - right}" y1="{tick:.1f}" y2="{tick:.1f}" class="grid"/>')
        parts.append(f'<text x="{left - 6}" y="{tick + 4:.1f}" text-anchor="end">{_label(value, log)}</text>')
    for k, (name, x, y) in enumerate(curves):
        colour = f"c{k % _COLOURS}"
        px, py = at(x, y)
        known = np.isfinite(px) & np.isfinite(py)
        if points:
            dots = "".join(f"M{a:.1f} {b:.1f}h.01" for a, b in zip(px[known], py[known], strict=True))
            parts.append(f'<path d="{dots}" class="{colour}" stroke-width="3" stroke-linecap="round" fill="none"/>')
        else:
            path, pen = [], "M"
            for a, b, good in zip(px, py, known, strict=True):
                if good:
                    path.append(f"{pen}{a:.1f} {b:.1f}")
                pen = "L" if good else "M"
            parts.append(f'<path d="{"".join(path)}" class="{colour}" stroke-width="1.4" fill="none"/>')
        if name:
            parts.append(f'<text x="{left + 8}" y="{top + 14 + 14 * k}" class="{colour}">{html.escape(name)}</text>')
    middle = (top + height - bottom) / 2
    parts.append(f'<text x="{(left + width) / 2}" y="{height - 8}" text-anchor="middle">{html.escape(x_label)}</text>')
    parts.append(
        f'<text x="14" y="{middle}" text-anchor="middle" transform="rotate(-90 14 {middle})">{html.escape(y_label)}</text>'
    )
    return "".join([*parts, "</svg>"])


def _span(values: Array) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = 0.04 * (high - low) or max(abs(high), 1.0) * 1e-3
    return low - margin, high + margin


def _ticks(low: float, high: float) -> list[float]:
    rough = (high - low) / 5
    power = 10.0 ** np.floor(np.log10(rough))
    step = float(power * min((1, 2, 5, 10), key=lambda m: abs(m * power - rough)))
    first = int(np.ceil(low / step))
    return [k * step for k in range(first, int(np.floor(high / step)) + 1)]


def _label(value: float, log: bool) -> str:
    return f"{10**value:.3g}" if log else f"{0.0 if abs(value) < 1e-12 else value:.5g}"
