"""A part as a shaded surface with the points of a scan on it, coloured by how far they lie off."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.geometry import Array, Pose
from scope.model import Surface
from scope.viewer import Picture

INSIDE, ON, OUTSIDE = (190, 80, 10), (150, 235, 250), (30, 30, 190)  # BGR: blue, pale yellow, red
BACKGROUND = 250
BEHIND = 1.0  # mm: points further behind the surface than this are hidden by it
_STEPS = (1.0, 2.0, 3.0, 5.0, 10.0)


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """A parallel projection of the cloud's frame."""

    right: Array  # (3,) unit
    down: Array  # (3,) unit
    centre: Array  # (3,) mm, in the middle of the picture
    scale: float  # px/mm
    size: tuple[int, int]  # columns, rows

    @property
    def into(self) -> Array:
        """(3,) unit, away from who looks."""
        return np.asarray(np.cross(self.right, self.down))

    @staticmethod
    def along(into: Array, corners: Array, *, width: int = 440) -> Look:
        """Everything of ``corners`` (N, 3), seen along ``into`` (3,), the longer side across."""
        into = into / np.linalg.norm(into)
        flat = np.linalg.svd(np.eye(3) - np.outer(into, into))[0][:, :2]
        place = corners @ flat
        turn = np.linalg.svd(place - place.mean(axis=0), full_matrices=False)[2]
        right = flat @ turn[0]
        right *= 1.0 if right[np.argmax(np.abs(right))] > 0 else -1.0
        down = np.cross(into, right)
        across, below = corners @ right, corners @ down
        scale = width / (1.06 * max(float(np.ptp(across)), 1e-9))
        rows = int(np.clip(1.06 * float(np.ptp(below)) * scale, 0.3 * width, 1.2 * width))
        scale = min(scale, rows / (1.06 * max(float(np.ptp(below)), 1e-9)))
        middle = 0.5 * (across.min() + across.max()) * right + 0.5 * (below.min() + below.max()) * down
        return Look(right, down, middle + float((corners @ into).min()) * into, scale, (width, rows))

    def pixels(self, points: Array) -> tuple[Array, Array]:
        """Columns and rows (N, 2) of points, and their depth (N,) mm behind the nearest corner."""
        arm = points - self.centre
        middle = 0.5 * np.array(self.size)
        return np.column_stack([arm @ self.right, arm @ self.down]) * self.scale + middle, arm @ self.into


def nice_limit(deviation: Array) -> float:
    """The round number (1, 2, 3 or 5 times a power of ten), mm, that 95 % of the deviations lie within; 0.01 at least."""
    known = np.abs(deviation[np.isfinite(deviation)])
    wanted = max(float(np.percentile(known, 95)) if len(known) else 0.0, 0.01)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * next(step for step in _STEPS if step * power >= wanted * (1 - 1e-9)))


def deviation_colours(deviation: Array, limit: float) -> Picture:
    """Colours (N, 3) BGR: blue inside the mesh, yellow on it, red outside, full at ``limit`` mm."""
    part = np.clip(deviation / limit, -1, 1)[:, None]
    ends = np.where(part < 0, np.array(INSIDE, dtype=np.float64), np.array(OUTSIDE, dtype=np.float64))
    return np.asarray(np.rint(np.array(ON) + np.abs(part) * (ends - np.array(ON))), dtype=np.uint8)


def shaded(surface: Surface, pose: Pose, look: Look) -> tuple[Picture, Array]:
    """Picture (rows, columns, 3) of a mesh at a pose cloud_from_model, and the depth (rows, columns) mm of what it shows (inf: nothing)."""
    columns, rows = look.size
    v, u = np.mgrid[0:rows, 0:columns].reshape(2, -1) + 0.5
    start = look.centre + np.outer(u - columns / 2, look.right / look.scale)
    start += np.outer(v - rows / 2, look.down / look.scale)
    back = 1e3  # mm: the rays begin before the part
    inverse = pose.inverse
    way = inverse.rotation @ look.into
    origin = inverse.apply(start - back * look.into)
    hit = surface.first_hit(origin, np.broadcast_to(way, origin.shape))
    shown = np.isfinite(hit)
    light = np.full(len(hit), float(BACKGROUND))
    _, normal = surface.nearest(origin[shown] + hit[shown, None] * way)
    light[shown] = 70 + 120 * np.abs(normal @ way)
    grey = np.rint(light).astype(np.uint8).reshape(rows, columns)
    depth = np.where(shown, hit - back, np.inf).reshape(rows, columns)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8), depth


def with_scan(picture: Picture, depth: Array, look: Look, points: Array, colours: Picture) -> Picture:
    """The picture with the points (N, 3) that the surface does not hide."""
    shown = picture.copy()
    pixels, deep = look.pixels(points)
    for corner in np.ndindex(2, 2):  # a point is two pixels wide
        at = np.floor(pixels).astype(np.int64) + corner
        inside = ((at >= 0) & (at < np.array(look.size))).all(axis=1)
        column, row = at[inside].T
        seen = deep[inside] < depth[row, column] + BEHIND
        shown[row[seen], column[seen]] = colours[inside][seen]
    return shown


def ringed(picture: Picture, look: Look, place: Array, radius: float) -> Picture:
    """The picture with a ring of ``radius`` mm about a place (3,) of the cloud."""
    pixels, _ = look.pixels(place[None])
    u, v = (round(float(x)) for x in pixels[0])
    shown = np.ascontiguousarray(picture)
    cv2.circle(shown, (u, v), max(int(radius * look.scale), 6), (0, 140, 255), 2, cv2.LINE_AA)
    return shown


def colour_bar(limit: float, tolerance: float) -> str:
    """An SVG: which colour is which deviation, mm, with the tolerance of the part where it lies on the bar."""
    width, left, height = 440, 20, 54
    span = width - 2 * left
    stops = [(0, INSIDE), (50, ON), (100, OUTSIDE)]
    ramp = "".join(f'<stop offset="{at}%" stop-color="rgb({c[2]},{c[1]},{c[0]})"/>' for at, c in stops)
    parts = [
        f'<svg viewBox="0 0 {width} {height}" width="{width}" role="img" aria-label="colours of deviations">',
        f'<defs><linearGradient id="off">{ramp}</linearGradient></defs>',
        f'<rect x="{left}" y="4" width="{span}" height="16" fill="url(#off)" stroke="#888"/>',
    ]
    for k in range(-2, 3):
        x = left + span * (k + 2) / 4
        word = f"{0.5 * k * limit:+.3g}" if k else "0 mm"
        parts.append(f'<text x="{x:.0f}" y="34" text-anchor="middle">{word}</text>')
    parts.append(f'<text x="{left}" y="50">inside the mesh</text>')
    parts.append(f'<text x="{width - left}" y="50" text-anchor="end">outside</text>')
    if tolerance <= limit:
        for sign in (-1, 1):
            x = left + 0.5 * span * (1 + sign * tolerance / limit)
            parts.append(f'<path d="M{x:.1f} 1v22" stroke="#000" stroke-width="2"/>')
        parts.append(f'<text x="{width / 2}" y="50" text-anchor="middle">bars: tolerance of {tolerance:g} mm</text>')
    return "".join([*parts, "</svg>"])
