"""Drawings of a rig to scale, and maps over its sheet of light, as SVG."""

from __future__ import annotations

import base64
import html

import cv2
import numpy as np

from calibration.geometry import Array
from scope.design import DesignResult, HiddenMap
from scope.report import colour_bgr
from scope.simulation import VirtualRig, exact_rays

_INK, _LASER, _SEEN, _JIG = "currentColor", "#d0443b", "#3b7fd0", "#8793a3"
_STATES = (("seen by both", "#2f9e77"), ("laser does not reach it", "#d0443b"), ("camera does not see it", "#3b7fd0"), ("neither", "#6b4fa0"), ("never on the sheet in view", "#a7afba"))  # fmt: skip


def rig_svg(found: DesignResult, axes: tuple[int, int]) -> str:
    """Camera, laser, sheet, jig and working volume in the plane of two axes, one scale for both."""
    rig = found.rig
    points = found.area.prediction.points[found.area.prediction.inside]
    far = max(rig.design.jig.stand_offs)
    view = _view(rig, axes, far)
    targets = [pose.apply(rig.corners) for pose in rig.stated]
    everything = np.concatenate([np.zeros((1, 3)), rig.laser.origin[None], view, *targets])[:, axes]
    low, high = everything.min(axis=0) - 25.0, everything.max(axis=0) + 25.0
    scale = min(900.0 / (high[0] - low[0]), 520.0 / (high[1] - low[1]))
    width, height = (high - low) * scale

    def at(point: Array) -> str:
        x, y = (point[list(axes)] - low) * scale
        return f"{x:.1f},{y:.1f}"

    def line(ends: Array, colour: str, more: str = "") -> str:
        return f'<polyline points="{" ".join(at(p) for p in ends)}" fill="none" stroke="{colour}" {more}/>'

    parts = [f'<svg viewBox="0 0 {width:.0f} {height + 30:.0f}" width="{width:.0f}" role="img">']
    parts.append(
        f'<polygon points="{" ".join(at(p) for p in (np.zeros(3), *view))}" fill="{_SEEN}" fill-opacity="0.08"/>'
    )
    parts += [line(np.stack([np.zeros(3), end]), _SEEN) for end in view]
    parts += [line(target[[0, 1, 2, 3, 0]], _JIG, 'stroke-width="3" stroke-opacity="0.5"') for target in targets]
    order = np.linalg.norm(points - rig.laser.origin, axis=1)
    ends = points[[int(np.argmax(order)), int(np.argmin(points[:, axes[1]])), int(np.argmax(points[:, axes[1]]))]]
    parts += [line(np.stack([rig.laser.origin, end]), _LASER, 'stroke-dasharray="5 4"') for end in ends]
    hull = cv2.convexHull(np.ascontiguousarray(points[:, list(axes)], dtype=np.float32))[:, 0]
    outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in (hull - low) * scale)
    parts.append(f'<polygon points="{outline}" fill="{_LASER}" fill-opacity="0.35" stroke="{_LASER}"/>')
    if rig.camera.window is not None:
        parts.append(_window(rig, axes, low, scale, float(height)))
    for place, name, colour in ((np.zeros(3), "camera", _SEEN), (rig.laser.origin, "laser", _LASER)):
        x, y = (place[list(axes)] - low) * scale
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{colour}"/>')
        near = (
            name == "laser" and float(np.hypot(*(place[list(axes)] * scale))) < 60.0
        )  # behind the camera in this view
        tint = colour.replace(_LASER, "var(--c1)").replace(_SEEN, "var(--c0)")
        parts.append(f'<text x="{x + 8:.1f}" y="{y + (20 if near else -14):.1f}" style="fill:{tint}">{name}</text>')
    last = -np.inf
    for k, (pose, name) in enumerate(zip(rig.stated, rig.design.jig.names, strict=True)):
        x, y = (pose.apply(rig.corners).max(axis=0)[list(axes)] - low) * scale
        crowded = x - last < 8.0 * len(name)
        last, y = x, min(y + 14, height - 14) + (12 if crowded and k % 2 else 0)
        parts.append(f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="middle">{html.escape(name)}</text>')
    bar = 10.0 ** np.floor(np.log10((high[0] - low[0]) / 3))
    parts.append(
        f'<line x1="10" x2="{10 + bar * scale:.1f}" y1="{height + 14:.0f}" y2="{height + 14:.0f}" stroke="{_INK}" stroke-width="3"/>'
    )
    parts.append(f'<text x="{18 + bar * scale:.1f}" y="{height + 18:.0f}">{bar:g} mm</text></svg>')
    return "".join(parts)


def _view(rig: VirtualRig, axes: tuple[int, int], depth: float) -> Array:
    """The two ends (2, 3) of the camera's view at a depth, in a plane of two axes."""
    columns, rows = rig.camera.size
    u, v = (columns - 1) / 2, (rows - 1) / 2
    edges = np.array([[u, 0.0], [u, rows - 1.0]] if axes[1] == 1 else [[0.0, v], [columns - 1.0, v]])
    return exact_rays(rig.camera, edges).at_depth(depth)


def _window(rig: VirtualRig, axes: tuple[int, int], low: Array, scale: float, height: float) -> str:
    window = rig.camera.window
    if window is None:
        return ""
    lean = -window.normal[axes[1]] / window.normal[2]
    top, bottom = low[1], low[1] + height / scale
    corners = [
        (window.distance + shift + lean * side, side)
        for shift, side in ((0, top), (0, bottom), (window.thickness, bottom), (window.thickness, top))
    ]
    outline = " ".join(f"{(z - low[0]) * scale:.1f},{(s - low[1]) * scale:.1f}" for z, s in corners)
    return f'<polygon points="{outline}" fill="#3aa6a6" fill-opacity="0.2" stroke="#3aa6a6"/>'


def map_svg(found: DesignResult, values: Array, label: str) -> str:
    """A map of depth against place across, with axes in mm and a colour bar; what is outside the volume is left clear."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    high = high if high > low * (1 + 1e-9) + 1e-30 else low + max(abs(low), 1e-3) * 0.1
    picture = cv2.cvtColor(colour_bgr(values[::-1], low, high), cv2.COLOR_BGR2BGRA)
    picture[~np.isfinite(values[::-1])] = 0
    bar = colour_bgr(np.linspace(high, low, 64)[:, None], low, high)
    depth, across = found.area.depth, found.area.across
    beside = f'<image x="{_LEFT + _WIDTH + 16}" y="{_TOP}" width="14" height="{_HEIGHT}" {_png(bar)}/>'
    for k in range(5):
        level = _TOP + _HEIGHT * (1 - k / 4)
        beside += f'<text x="{_LEFT + _WIDTH + 35}" y="{level + 4:.0f}">{low + k / 4 * (high - low):.3g}</text>'
    axes = ((found.area.axis, across), ("z", depth))
    return _framed(picture, axes, _HEIGHT, beside, label, right=108)


def hidden_svg(hidden: HiddenMap) -> str:
    """A map of what camera and laser do not reach of the objects, seen along z, with its legend."""
    picture = np.zeros((*hidden.state.shape, 4), dtype=np.uint8)
    for k, (_, colour) in enumerate(_STATES):
        picture[hidden.state == k] = [*bytes.fromhex(colour[1:])[::-1], 255]
    height = int(np.clip(_WIDTH * np.ptp(hidden.down) / max(float(np.ptp(hidden.across)), 1e-9), 90, 420))
    legend = ""
    for k, ((name, colour), share) in enumerate(zip(_STATES, hidden.shares.values(), strict=True)):
        y = _TOP + 6 + 17 * k
        legend += f'<rect x="{_LEFT + _WIDTH + 16}" y="{y - 6}" width="11" height="11" fill="{colour}"/>'
        legend += f'<text x="{_LEFT + _WIDTH + 33}" y="{y + 4}">{name}: {share:.1%}</text>'
    return _framed(picture, (("x", hidden.across), ("y", hidden.down)), height, legend, "out of sight", right=240)


_LEFT, _TOP, _WIDTH, _HEIGHT = 58, 12, 300, 230  # px of a map


def _png(picture: np.typing.NDArray[np.uint8]) -> str:
    data = base64.b64encode(cv2.imencode(".png", picture)[1].tobytes()).decode("ascii")
    return f'preserveAspectRatio="none" style="image-rendering:pixelated" href="data:image/png;base64,{data}"'


def _framed(
    picture: np.typing.NDArray[np.uint8], axes: tuple[tuple[str, Array], tuple[str, Array]], height: int, beside: str, label: str,
    *, right: int,
) -> str:  # fmt: skip
    """A picture in axes of mm, what stands beside it, and room for that. The first row is the far end of z, the near end of y."""
    (across, x), (up, y) = axes
    first, last = (y[-1], y[0]) if up == "y" else (y[0], y[-1])  # at the foot, at the top
    size = f"{_LEFT + _WIDTH + right} {max(_TOP + height + 44, 110)}"
    parts = [
        f'<svg viewBox="0 0 {size}" width="{size.split(maxsplit=1)[0]}" role="img"><title>{html.escape(label)}</title>',
        f'<image x="{_LEFT}" y="{_TOP}" width="{_WIDTH}" height="{height}" {_png(picture)}/>',
        f'<rect x="{_LEFT}" y="{_TOP}" width="{_WIDTH}" height="{height}" fill="none" stroke="#8793a3"/>',
    ]
    for k in range(5):
        share = k / 4
        place, level = _LEFT + share * _WIDTH, _TOP + height * (1 - share)
        parts.append(
            f'<text x="{place:.0f}" y="{_TOP + height + 15}" text-anchor="middle">{x[0] + share * (x[-1] - x[0]):.0f}</text>'
            f'<text x="{_LEFT - 6}" y="{level + 4:.0f}" text-anchor="end">{first + share * (last - first):.0f}</text>'
        )
    middle = _TOP + height / 2
    parts.append(
        f'<text x="{_LEFT + _WIDTH / 2}" y="{_TOP + height + 34}" text-anchor="middle">{across}, mm</text>'
        f'<text x="14" y="{middle}" text-anchor="middle" transform="rotate(-90 14 {middle})">{up}, mm</text>'
    )
    return "".join([*parts, beside, "</svg>"])
