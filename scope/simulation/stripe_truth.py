"""Where a simulated stripe truly is, line by line of the image, and how well it could be ranged at best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import ndtr

from calibration.geometry import Array, Ints, Rays
from scope.simulation.optics import ExactCamera, ExactLaser, exact_rays, project
from scope.simulation.rendering import Sensor
from scope.simulation.solids import Hits, Scene

Along = Literal["rows", "columns"]


@dataclass(frozen=True, slots=True, eq=False)
class TrueStripe:
    """The middle of the sheet of light as the camera sees it: one row a line of the image.

    Lines are columns of the image where the stripe runs along rows, and rows where it runs along columns. Of several
    crossings of one line the brightest is kept.
    """

    position: Array  # (L,) px across the line, NaN where the stripe is not seen
    points: Array  # (L, 3) mm in C
    peak: Array  # (L,) of the light before any blur, of one
    sigma_px: Array  # (L,) px, Cramer-Rao bound of the position from this line alone
    sigma_mm: Array  # (L,) mm along the sighting ray: the bound times the geometry of triangulation
    crossings: Ints  # (L,) how often the stripe crosses the line


def runs_along(camera: ExactCamera, laser: ExactLaser, depth: float) -> Along:
    """Whether the stripe on a plane at z = ``depth`` mm runs along image rows or columns."""
    rays = laser.rays(np.array([-0.02, 0.02]))
    ends = project(camera, rays.at_depth(depth))
    du, dv = np.abs(ends[1] - ends[0])
    return "rows" if du > dv else "columns"


def position_bound(amplitude: Array, width_px: Array, sensor: Sensor) -> Array:
    """Least standard deviation (N,) px of the position of Gaussian stripes in one line of pixels.

    Fisher's information of the pixel-integrated profile with variance I / gain + read^2 + 1/12, summed over pixels and
    averaged over the stripe's phase. ``amplitude`` (N,) is the profile's peak before pixels, grey levels; ``width_px``
    (N,) its sigma with the lens. Levels at or above white tell nothing. inf for amplitude 0.
    """
    phase = np.array([-0.375, -0.125, 0.125, 0.375])
    reach = int(np.ceil(5.0 * np.max(width_px, initial=1.0))) + 1
    x = (np.arange(-reach, reach + 1) + phase[:, None]).ravel()[None, :]
    w, a = width_px[:, None], amplitude[:, None]
    level = a * w * np.sqrt(2.0 * np.pi) * (ndtr((x + 0.5) / w) - ndtr((x - 0.5) / w))
    slope = a * (np.exp(-0.5 * ((x + 0.5) / w) ** 2) - np.exp(-0.5 * ((x - 0.5) / w) ** 2))
    variance = level / sensor.gain_e + sensor.read_noise**2 + 1.0 / 12.0
    information = (np.where(level + sensor.black < sensor.white, slope**2 / variance, 0.0)).sum(axis=1) / len(phase)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.sqrt(information))


def true_stripe(
    camera: ExactCamera,
    laser: ExactLaser,
    scene: Scene,
    *,
    along: Along,
    sensor: Sensor,
    level: float,
    blur: Callable[[Array], Array] | None = None,
) -> TrueStripe:
    """Trace the middle of the sheet over a scene in C and find where it crosses each line of the image.

    Rays of laser light are traced finely; between neighbours on one smooth piece of surface, each crossing of a line
    is solved to 1e-9 px. ``level`` is the grey level of light one; ``blur`` gives that of the lens (px) at points, where it
    varies.
    """
    axis = 0 if along == "rows" else 1  # the whole coordinate: the line
    lines = camera.size[axis]
    angle = np.linspace(-laser.half_fan, laser.half_fan, int(6.0 * laser.half_fan * max(camera.focal)))
    hits = scene.cast(laser.rays(angle))
    pixels = project(camera, hits.points)
    seen = _seen(camera, scene, hits, pixels)
    k = np.flatnonzero(seen[:-1] & seen[1:] & (hits.part[:-1] == hits.part[1:]))
    k = k[np.einsum("ij,ij->i", hits.normal[k], hits.normal[k + 1]) > 0.9]
    first, last = pixels[k, axis], pixels[k + 1, axis]
    low = np.ceil(np.minimum(first, last)).astype(np.int64)
    count = np.maximum(np.ceil(np.maximum(first, last)).astype(np.int64) - low, 0)
    pair = np.repeat(np.arange(len(k)), count)
    line = low[pair] + np.arange(len(pair)) - np.repeat(np.cumsum(count) - count, count)
    inside = (line >= 0) & (line < lines)
    pair, line = pair[inside], line[inside]
    a, b = angle[k[pair]], angle[k[pair] + 1]
    fa, fb = first[pair] - line, last[pair] - line
    t = a - fa * (b - a) / (fb - fa)
    for _ in range(8):  # Illinois
        f = project(camera, scene.cast(laser.rays(t)).points)[:, axis] - line
        if np.nanmax(np.abs(f), initial=0.0) < 1e-9:
            break
        same = f * fb > 0.0
        a, fa = np.where(same, a, b), np.where(same, fa / 2.0, fb)
        b, fb = t, f
        with np.errstate(invalid="ignore", divide="ignore"):
            t = np.where(fb != fa, b - fb * (b - a) / (fb - fa), b)
    rays = laser.rays(t)
    hits = scene.cast(rays)
    pixels = project(camera, hits.points)
    good = hits.found & _seen(camera, scene, hits, pixels) & (np.abs(pixels[:, axis] - line) < 1e-6)
    cosine = -np.einsum("ij,ij->i", rays.direction, hits.normal) * hits.albedo * laser.strength_at(hits.points)
    lit = _Lit(line[good], pixels[good], hits.points[good], hits.normal[good], cosine[good])
    return _strongest(camera, laser, along, sensor, level, lit, blur)


def _seen(camera: ExactCamera, scene: Scene, hits: Hits, pixels: Array) -> np.typing.NDArray[np.bool_]:
    """Whether the camera sees points of the scene: in its image, turned towards it and not hidden."""
    columns, rows = camera.size
    inside = (pixels > -1.0).all(axis=1) & (pixels < [columns, rows]).all(axis=1)  # NaN compares false
    seen = np.zeros(len(pixels), dtype=bool)
    rows_in = np.flatnonzero(inside & hits.found)
    rays = exact_rays(camera, pixels[rows_in])
    facing = np.einsum("ij,ij->i", rays.direction, hits.normal[rows_in]) < 0.0
    seen[rows_in] = facing & scene.lit(rays, hits.points[rows_in])
    return seen


@dataclass(frozen=True, slots=True)
class _Lit:
    """Places that the sheet lights and the camera sees; a line of the image may have several."""

    line: Ints  # (n,)
    pixels: Array  # (n, 2)
    points: Array  # (n, 3) mm
    normal: Array  # (n, 3) unit
    peak: Array  # (n,) light that comes back, 0 to 1


def _strongest(
    camera: ExactCamera, laser: ExactLaser, along: Along, sensor: Sensor, level: float, lit: _Lit,
    blur: Callable[[Array], Array] | None,
) -> TrueStripe:  # fmt: skip
    axis = 0 if along == "rows" else 1
    line, peak = lit.line, lit.peak
    lines = camera.size[axis]
    order = np.lexsort((peak, line))
    chosen = order[np.flatnonzero(np.diff(np.append(line[order], -1)))] if len(line) else order
    line_of = line[chosen]
    pixels, points, normal, peak = lit.pixels[chosen], lit.points[chosen], lit.normal[chosen], peak[chosen]
    step = np.zeros((1, 2))
    step[0, 1 - axis] = 0.25
    before, after = exact_rays(camera, pixels - step), exact_rays(camera, pixels + step)
    # how far, per pixel across the line, the surface leaves the sheet, and the sheet moves along the ray
    leaving = laser.reach(_on_plane(after, points, normal))[1] - laser.reach(_on_plane(before, points, normal))[1]
    leaving = np.where(np.isfinite(leaving), leaving, np.inf)  # a surface that the ray grazes
    lens = np.full(len(points), sensor.blur_px) if blur is None else blur(points)
    width_px = np.hypot(laser.width_at(points) / np.maximum(np.abs(leaving) / 0.5, 1e-12), lens)
    amplitude = level * peak * np.sqrt(np.maximum(width_px**2 - lens**2, 0.0)) / width_px
    sheet = laser.sheet_normal(points)
    moved = _on_plane(after, points, sheet) - _on_plane(before, points, sheet)
    along_ray = np.abs(np.einsum("ij,ij->i", moved, exact_rays(camera, pixels).direction)) / 0.5
    sigma = position_bound(amplitude, np.minimum(width_px, 50.0), sensor)

    def fill(values: Array) -> Array:
        full = np.full((lines, *values.shape[1:]), np.nan)
        full[line_of] = values
        return full

    return TrueStripe(
        fill(pixels[:, 1 - axis]),
        fill(points),
        fill(peak),
        fill(sigma),
        fill(sigma * along_ray),
        np.bincount(line, minlength=lines).astype(np.int64),
    )


def _on_plane(rays: Rays, points: Array, normal: Array) -> Array:
    """Where rays (N) meet planes through points (N, 3) with normals (N, 3)."""
    t = np.einsum("ij,ij->i", points - rays.origin, normal) / np.einsum("ij,ij->i", rays.direction, normal)
    return rays.at(t)
