"""Drawings of a rig to scale, and maps over its sheet of light, as SVG."""

from __future__ import annotations

import base64
import html

import cv2
import numpy as np

from calibration.geometry import Array
from scope.design import DesignResult
from scope.report import colour_bgr
from scope.simulation import VirtualRig, exact_rays

_INK, _LASER, _SEEN, _JIG = "#1c2430", "#c0342c", "#1f5fa8", "#8793a3"


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
        parts.append(
            f'<text x="{x + 8:.1f}" y="{y + (18 if near else -8):.1f}" style="fill:{colour.replace(_LASER, "var(--c1)").replace(_SEEN, "var(--c0)")}">{name}</text>'
        )
    for pose, name in zip(rig.stated, rig.design.jig.names, strict=True):
        x, y = (pose.apply(rig.corners).max(axis=0)[list(axes)] - low) * scale
        parts.append(
            f'<text x="{x:.1f}" y="{min(y + 14, height - 2):.1f}" text-anchor="middle">{html.escape(name)}</text>'
        )
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
    """A map of depth against place across, with axes in mm and a colour bar."""
    left, top, width, height, gap = 58, 12, 300, 230, 16
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    high = high if high > low * (1 + 1e-9) + 1e-30 else low + max(abs(low), 1e-3) * 0.1
    picture = colour_bgr(values[::-1], low, high)
    picture[~np.isfinite(values[::-1])] = 236
    bar = colour_bgr(np.linspace(high, low, 64)[:, None], low, high)
    depth, across = found.area.depth, found.area.across
    parts = [
        f'<svg viewBox="0 0 {left + width + gap + 92} {top + height + 44}" width="{left + width + gap + 92}" role="img">'
    ]
    for begin, wide, image in ((left, width, picture), (left + width + gap, 14, bar)):
        data = base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode("ascii")
        parts.append(
            f'<image x="{begin}" y="{top}" width="{wide}" height="{height}" preserveAspectRatio="none" '
            f'style="image-rendering:pixelated" href="data:image/png;base64,{data}"/>'
        )
    parts.append(f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="none" stroke="#8793a3"/>')
    for k in range(5):
        share = k / 4
        x, level = left + share * width, top + height - share * height
        parts.append(
            f'<text x="{x:.0f}" y="{top + height + 15}" text-anchor="middle">{across[0] + share * np.ptp(across):.0f}</text>'
        )
        parts.append(
            f'<text x="{left - 6}" y="{level + 4:.0f}" text-anchor="end">{depth[0] + share * np.ptp(depth):.0f}</text>'
        )
        parts.append(f'<text x="{left + width + gap + 19}" y="{level + 4:.0f}">{low + share * (high - low):.3g}</text>')
    middle = top + height / 2
    parts.append(
        f'<text x="{left + width / 2}" y="{top + height + 34}" text-anchor="middle">{found.area.axis}, mm</text>'
    )
    parts.append(f'<text x="14" y="{middle}" text-anchor="middle" transform="rotate(-90 14 {middle})">z, mm</text>')
    parts.append(f"<title>{html.escape(label)}</title></svg>")
    return "".join(parts)
