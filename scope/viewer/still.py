"""A still picture of a scene: for print, for browsers without WebGL, and for whoever only wants to see it."""

from __future__ import annotations

from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array
from scope.viewer.scene import Layer, Scalar, Scene

Picture: TypeAlias = NDArray[np.uint8]  # (rows, columns, 3) BGR

_WIDTH, _HEIGHT, _BAR = 860, 560, 118
_DOTS = 400_000  # points that a picture of this size can show
_INK, _UNKNOWN = (48, 36, 28), 140
_PARTS = {
    "camera": (173, 92, 11), "ray": (150, 138, 122), "volume": (58, 109, 123), "stage": (0, 92, 179), "model": (185, 178, 170),
}  # fmt: skip
_AXES = ((40, 40, 198), (54, 125, 29), (197, 87, 36))
_SHEETS = ((47, 32, 209), (58, 140, 25), (209, 59, 122), (0, 107, 179))
_STOPS = (
    (143, 63, 29),
    (194, 116, 63),
    (224, 179, 134),
    (239, 220, 201),
    (230, 239, 243),
    (180, 205, 245),
    (111, 147, 232),
    (63, 79, 201),
    (36, 21, 140),
)
_NAMED = (
    (209, 143, 61), (46, 134, 224), (85, 166, 58), (194, 92, 176), (43, 178, 201), (79, 79, 214), (183, 183, 59), (75, 109, 138), (214, 127, 124),
    (154, 154, 154),
)  # fmt: skip


def colour_bgr(values: Array, low: float | None = None, high: float | None = None) -> Picture:
    """Colours (..., 3) BGR of values (viridis between ``low`` and ``high``); NaN is dark grey.

    Without limits, the 2nd and 98th percentile are used, so that a few wild values do not hide the rest.
    """
    known = np.isfinite(values)
    if not known.any():
        return np.full((*values.shape, 3), 64, dtype=np.uint8)
    bottom = float(np.percentile(values[known], 2)) if low is None else low
    top = float(np.percentile(values[known], 98)) if high is None else high
    scaled = np.clip((np.where(known, values, bottom) - bottom) / max(top - bottom, 1e-30), 0, 1)
    grey = np.rint(scaled * 255).astype(np.uint8)
    picture = cv2.applyColorMap(grey.reshape(-1, 1), cv2.COLORMAP_VIRIDIS).reshape(*values.shape, 3)
    picture[~known] = 64
    return np.asarray(picture, dtype=np.uint8)


def scalar_bgr(scalar: Scalar) -> Picture:
    """Colours (N, 3) BGR of a scalar, as the viewer begins with; light grey where it is not known."""
    low, high = scalar.usual
    known = np.isfinite(scalar.values)
    values = np.where(known, scalar.values, low)
    if scalar.kind == "names":
        colours = np.array(_NAMED, np.uint8)[values.astype(np.int64) % len(_NAMED)]
    elif scalar.kind == "diverging":
        t = np.clip((values - low) / (high - low), 0, 1) * (len(_STOPS) - 1)
        stops = np.array(_STOPS, np.float64)
        colours = np.stack([np.interp(t, np.arange(len(_STOPS)), stops[:, k]) for k in range(3)], axis=-1).astype(
            np.uint8
        )
    else:
        colours = colour_bgr(values, low, high)
    colours[~known] = _UNKNOWN
    return np.asarray(colours, dtype=np.uint8)


def still(scene: Scene) -> Picture:
    """The scene as the viewer first shows it, on white, with the colour bar; (rows, columns, 3) BGR."""
    scene = scene.thinned(_DOTS)
    places = np.concatenate([scene.points, *(layer.places for layer in scene.layers)])
    picture = np.full((_HEIGHT, _WIDTH, 3), 255, dtype=np.uint8)
    if len(places) == 0:
        return picture
    right, down = (v / np.linalg.norm(v) for v in scene.look)
    stretch, centre = np.array(scene.stretch), (places.min(axis=0) + places.max(axis=0)) / 2
    wide = _WIDTH - (_BAR if scene.scalars and len(scene) else 0)
    flat = ((places - centre) * stretch) @ np.stack([right, down], axis=1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    scale = min((wide - 40) / max(high[0] - low[0], 1e-9), (_HEIGHT - 40) / max(high[1] - low[1], 1e-9))

    def at(points: Array) -> Array:
        seen = ((points - centre) * stretch) @ np.stack([right, down], axis=1)
        return np.asarray((seen - (low + high) / 2) * scale + np.array([wide / 2, _HEIGHT / 2]))

    for layer in scene.layers:
        colour = _SHEETS[layer.number % len(_SHEETS)] if layer.role == "sheet" else _PARTS.get(layer.role, _INK)
        if layer.faces is not None and layer.vertices is not None:
            picture = _shaded(
                picture,
                at(layer.vertices)[layer.faces],
                scale * (layer.vertices @ np.cross(right, down))[layer.faces],
                layer,
                colour,
            )
        elif layer.lines is not None:
            ends = at(layer.lines.reshape(-1, 3)).reshape(-1, 2, 2)
            for k, line in enumerate(np.rint(ends).astype(np.int32)):
                tint = _AXES[k % 3] if layer.role == "axes" else colour
                cv2.polylines(picture, [line], False, tint, 2 if layer.bold else 1, cv2.LINE_AA)
    if len(scene):
        depth = ((scene.points - centre) * stretch) @ np.cross(right, down)
        scalar = scene.scalars[0] if scene.scalars else Scalar("z", scene.points[:, 2])
        _dots(picture, at(scene.points), depth, scalar_bgr(scalar))
        if scene.scalars:
            _bar(picture, scalar)
    return picture


def _shaded(picture: Picture, at: Array, depth: Array, layer: Layer, colour: tuple[int, int, int]) -> Picture:
    """A mesh over a picture: corners of its faces ``at`` (F, 3, 2) px and ``depth`` (F, 3) px; furthest first, steep ones darker."""
    first, second = (np.column_stack([at[:, k] - at[:, 0], depth[:, k] - depth[:, 0]]) for k in (1, 2))
    normal = np.cross(first, second)
    facing = np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    over = picture.copy()
    for k in np.argsort(-depth.mean(axis=1)):
        shade = (0.55 + 0.45 * facing[k]) * np.array(colour)
        cv2.fillConvexPoly(over, np.rint(at[k]).astype(np.int32), tuple(int(c) for c in shade), cv2.LINE_AA)
    share = 0.85 if layer.role == "model" else 0.4
    return np.asarray(cv2.addWeighted(picture, 1.0 - share, over, share, 0), dtype=np.uint8)


def cloud_from(points: Array, values: Array, right: Array, down: Array, *, width: int = 700) -> Picture:
    """Orthographic picture of points (N, 3) coloured by values (N,), seen along right x down; the nearest lies on top."""
    x, y = points @ right, points @ down
    depth = points @ np.cross(right, down)
    low_x, high_x = np.percentile(x, [0.2, 99.8])
    low_y, high_y = np.percentile(y, [0.2, 99.8])
    scale = (width - 20) / max(high_x - low_x, 1e-9)
    height = int(min(max((high_y - low_y) * scale, 60), 1.4 * width)) + 20
    scale = min(scale, (height - 20) / max(high_y - low_y, 1e-9))
    picture = np.full((height, width, 3), 24, dtype=np.uint8)
    _dots(picture, np.stack([10 + (x - low_x) * scale, 10 + (y - low_y) * scale], axis=1), depth, colour_bgr(values))
    return picture


def _dots(picture: Picture, at: Array, depth: Array, colours: Picture) -> None:
    """Set points (N, 2) px as dots of 2 x 2, the nearest on top."""
    height, width = picture.shape[:2]
    order = np.argsort(-depth)
    column, row = np.rint(at).astype(int)[order].T
    colours = colours[order]
    for dx in (0, 1):
        for dy in (0, 1):
            inside = (column + dx >= 0) & (column + dx < width) & (row + dy >= 0) & (row + dy < height)
            picture[row[inside] + dy, column[inside] + dx] = colours[inside]


def _bar(picture: Picture, scalar: Scalar) -> None:
    low, high = scalar.usual
    x, top, bottom = _WIDTH - _BAR + 8, 60, _HEIGHT - 60

    def write(text: str, y: int, left: int = x) -> None:
        cv2.putText(
            picture,
            text.encode("ascii", "replace").decode(),
            (left, y),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.42,
            _INK,
            1,
            cv2.LINE_AA,
        )

    write(f"{scalar.label or scalar.name}{f', {scalar.unit}' if scalar.unit else ''}"[:16], top - 20)
    if scalar.kind == "names":
        for k, name in enumerate(scalar.names[:16]):
            cv2.rectangle(picture, (x, top + 24 * k), (x + 12, top + 12 + 24 * k), _NAMED[k % len(_NAMED)], -1)
            write(name[:11], top + 11 + 24 * k, x + 20)
        return
    ramp = Scalar("", np.linspace(high, low, bottom - top), kind=scalar.kind, limits=(low, high))
    picture[top:bottom, x : x + 16] = scalar_bgr(ramp)[:, None]
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        y = round(bottom - share * (bottom - top))
        write(f"{low + share * (high - low):.4g}", y + 4, x + 22)
