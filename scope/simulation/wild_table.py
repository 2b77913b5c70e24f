"""A turntable in the wild: markers on its top, and a block and a ball that make a full turn through the light.

Every picture casts the camera's rays against the disc, the block and the ball in closed form. The laser stands beside the
camera in its own sheet, so that the things throw shadows into it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Bools

DICTIONARY = "DICT_4X4_50"
PLACES = ((5, 90.0, 0.0), (27, 0.0, 90.0), (42, -90.0, 0.0), (18, 0.0, -90.0))  # number, x, y in mm
MARKER = 30.0  # mm, side
RADIUS = 125.0  # mm, of the table
BLOCK = np.array([[-30.0, -22.0, 0.0], [26.0, 18.0, 32.0]])  # mm in the table's frame: least and greatest corner
BALL = (np.array([-2.0, 44.0, 18.0]), 18.0)  # mm: centre and radius
_PAPER = 0.85  # reflectance of the table's top
_TEXEL = 0.25  # mm
_COLOURS = {"block": (0.25, 0.55, 0.75), "ball": (0.75, 0.75, 0.85)}  # blue, green, red


@dataclass(frozen=True, slots=True, eq=False)
class WildTable:
    """Where the table stands: x_C = point + axes @ x_table, its z the axis."""

    point: Array  # (3,) mm, C: the middle of its top
    axes: Array  # (3, 3) columns x, y, z of the table at angle 0, C

    def turned(self, degrees: float) -> Array:
        """Axes (3, 3) after a turn about z, from x to y."""
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        return np.asarray(self.axes @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def place_table(normal: Array, offset: float, rng: np.random.Generator) -> WildTable:
    """Put a table below the middle of the view, its axis near the sheet ``normal @ x = offset`` (mm)."""
    tilt = np.radians(rng.uniform(28.0, 38.0))  # the camera looks down
    up = np.array([rng.normal(0.0, 0.02), -np.cos(tilt), -np.sin(tilt)])
    up /= np.linalg.norm(up)
    y, z = 35.0, 460.0
    x = (offset - normal[1] * y - normal[2] * z) / normal[0] + rng.uniform(-3.0, 3.0)
    first = np.cross(up, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    return WildTable(np.array([x, y, z]), np.stack([first, np.cross(up, first), up], axis=1))


def look_at_table(
    table: WildTable, degrees: float, rays: Array, source: Array, *, things: bool
) -> tuple[Array, Array, Array, Bools]:
    """What the camera sees of a table at an angle.

    Parameters
    ----------
    table : WildTable
    degrees : float
        Position of the table.
    rays : (H, W, 3) array
        Directions with z = 1, C.
    source : (3,) array, mm
        The laser, C.
    things : bool
        Whether block and ball stand on it.

    Returns
    -------
    reach, (H, W)
        Depth z in mm; infinite where there is no table.
    colour, (H, W, 3)
        Reflectance, blue green red, times the cosine of the room's light from above.
    facing, (H, W)
        Cosine between surface and laser, 0 in its shadow.
    on, (H, W)
        Whether there is something.
    """
    axes = table.turned(degrees)
    d = rays @ axes
    o = -table.point @ axes
    lamp = (source - table.point) @ axes
    reach = np.where(d[..., 2] < 0.0, -o[2] / np.minimum(d[..., 2], -1e-9), np.inf)
    flat = o[:2] + np.where(np.isfinite(reach), reach, 0.0)[..., None] * d[..., :2]
    reach[np.hypot(flat[..., 0], flat[..., 1]) > RADIUS] = np.inf
    normals = np.broadcast_to([0.0, 0.0, 1.0], d.shape).copy()
    top = _printed(flat)
    colour = np.repeat(top[..., None], 3, axis=-1)
    for name, (depth, normal) in _things(o, d).items() if things else ():
        nearer = depth < reach
        reach = np.where(nearer, depth, reach)
        normals = np.where(nearer[..., None], normal, normals)
        colour = np.where(nearer[..., None], _COLOURS[name], colour)
    on = np.isfinite(reach)
    hit = o + np.where(on, reach, 0.0)[..., None] * d
    way = lamp - hit
    way /= np.sqrt(np.einsum("...k,...k", way, way))[..., None]
    facing = np.maximum(np.einsum("...k,...k", normals, way), 0.0)
    if things:
        blocked = np.zeros(on.shape, bool)
        for depth, _ in _things(hit + 1e-3 * normals, way).values():
            blocked |= np.isfinite(depth)
        facing = np.where(blocked, 0.0, facing)
    return reach, colour * (0.55 + 0.45 * normals[..., 2:]), facing, on


def _things(o: Array, d: Array) -> dict[str, tuple[Array, Array]]:
    """Depths (H, W) along rays from ``o``, infinite where they miss, and normals (H, W, 3), of block and ball."""
    enter, leave = np.full(d.shape[:2], -np.inf), np.full(d.shape[:2], np.inf)
    side = np.zeros(d.shape[:2], int)
    for k in range(3):
        from_here = o[..., k]
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (BLOCK[0, k] - from_here) / d[..., k], (BLOCK[1, k] - from_here) / d[..., k]
        near = np.minimum(one, other)
        side[near > enter] = k
        enter, leave = np.maximum(enter, near), np.minimum(leave, np.maximum(one, other))
    hits = (enter < leave) & (enter > 0.0)
    normal = -np.sign(d) * (np.arange(3) == side[..., None])
    block = np.where(hits, enter, np.inf), normal
    centre, radius = BALL
    off = o - centre
    a, m = np.einsum("...k,...k", d, d), np.einsum("...k,...k", np.broadcast_to(off, d.shape), d)
    root = m * m - a * (np.einsum("...k,...k", off, off) - radius**2)
    near = (-m - np.sqrt(np.maximum(root, 0.0))) / a
    depth = np.where((root > 0.0) & (near > 0.0), near, np.inf)
    outward = (o + np.where(np.isfinite(depth), depth, 0.0)[..., None] * d - centre) / radius
    return {"block": block, "ball": (depth, outward)}


def _printed(flat: Array) -> Array:
    """Reflectance (H, W) of the table's top at points (H, W, 2) of it, markers printed on."""
    half = RADIUS + 2.0
    cells = round(2 * half / _TEXEL)
    sheet = np.full((cells, cells), 255, np.uint8)
    kinds = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    size = round(MARKER / _TEXEL)
    for number, x, y in PLACES:
        row, column = round((half - y) / _TEXEL) - size // 2, round((half + x) / _TEXEL) - size // 2
        sheet[row : row + size, column : column + size] = cv2.aruco.generateImageMarker(kinds, number, size)
    sheet = np.asarray(cv2.GaussianBlur(sheet, (0, 0), 0.25 / _TEXEL))
    u = ((flat[..., 0] + half) / _TEXEL - 0.5).astype(np.float32)
    v = ((half - flat[..., 1]) / _TEXEL - 0.5).astype(np.float32)
    value = cv2.remap(sheet, u, v, cv2.INTER_LINEAR, borderValue=255).astype(np.float64) / 255.0
    return np.asarray(0.06 + (_PAPER - 0.06) * value)


def positions(frames: int) -> Iterator[tuple[int, float]]:
    """Frame and angle (degrees) of a full turn."""
    for k in range(frames):
        yield k, 360.0 * k / frames


def truth_of(table: WildTable) -> dict[str, NDArray[np.float64] | list[float] | float]:
    """What truth.json tells of a table."""
    return {
        "axis_point": table.point.tolist(),
        "axis_direction": table.axes[:, 2].tolist(),
        "block": BLOCK.tolist(),
        "ball": [*BALL[0].tolist(), BALL[1]],
    }
