"""Images of spot targets and laser stripes as an ideal sensor integrates them, and the noise of a real one.

An image is (rows, columns), grey levels above the black level. A pixel integrates light over its unit square after a
Gaussian lens blur, so it answers a point of light at distance x (px) along each axis with
Phi((x + 1/2) / s) - Phi((x - 1/2) / s), s the blur; both renderers use that answer and not a filtered picture of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from calibration.geometry import Array, Bools, Ints, Pose, Rays
from scope.simulation.optics import ExactCamera, ExactLaser, exact_rays, project
from scope.simulation.solids import Scene

Blur = float | Callable[[Array], Array]  # px, one sigma; or of points (N, 3) in C
_FINER = 1.12  # between blurs that are rendered where it varies; in between, two share the light
_REACH = 4.5  # standard deviations of light or blur, beyond which there is none
# where a cell beside an edge is sampled: no two samples share a row or a column, so that upright edges fall between all
_ROOKS = (np.stack([np.arange(16), 7 * np.arange(16) % 16], axis=1) + 0.5) / 16


@dataclass(frozen=True, slots=True)
class Sensor:
    """How light becomes grey levels."""

    gain_e: float  # electrons a grey level
    read_noise: float  # grey levels, one sigma
    blur_px: float  # px, sigma of the lens
    black: float = 4.0  # grey levels without light
    bits: int = 8

    @property
    def white(self) -> int:
        """Largest grey level."""
        return int(2**self.bits - 1)


@dataclass(frozen=True, slots=True, eq=False)
class TargetLook:
    """Round marks on a plane, and how bright they and it are."""

    marks: Array  # (N, 3) mm, in the target's frame, z = 0
    radii: Array  # (N,) mm; 0 for a mark that is missing
    spot: float  # grey levels above black
    ground: float  # grey levels above black
    dirt: Array  # (M, 3): x, y, radius, mm: opaque specks
    uneven: float = 0.0  # loss of illumination at the image's corners, as a part of one


def _answer(x: Array, blur: float) -> Array:
    """A pixel's answer to a point of light at ``x`` px from its centre along one axis."""
    return np.asarray(ndtr((x + 0.5) / blur) - ndtr((x - 0.5) / blur))


def contours(camera: ExactCamera, pose: Pose, centres: Array, radii: Array, points: int) -> tuple[Array, Array]:
    """Images (N, points, 2) px of circles (centres (N, 3), radii (N,) mm) on a plane, and their derivatives by angle.

    The points are even in angle; derivatives are spectral (the contour is a smooth periodic function of it).
    """
    angle = 2.0 * np.pi * np.arange(points) / points
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(points)], axis=1)
    outline = project(camera, pose.apply((centres[:, None, :] + radii[:, None, None] * ring).reshape(-1, 3)))
    outline = outline.reshape(len(centres), points, 2)
    order = 1j * np.arange(points // 2 + 1)
    order[-1] = 0.0
    return outline, np.fft.irfft(order[None, :, None] * np.fft.rfft(outline, axis=1), n=points, axis=1)


def disk_centroids(camera: ExactCamera, pose: Pose, centres: Array, radii: Array) -> Array:
    """Centroids (N, 2) px of the areas of imaged circles: what an ideal centroid measures, eccentricity included."""
    outline, slope = contours(camera, pose, centres, radii, 128)
    middle = outline.mean(axis=1, keepdims=True)
    u, v = np.moveaxis(outline - middle, -1, 0)
    du, dv = np.moveaxis(slope, -1, 0)
    area = (u * dv - v * du).mean(axis=1) / 2.0
    moment = np.stack([(u * u * dv).mean(axis=1), -(v * v * du).mean(axis=1)], axis=1) / 2.0
    return np.asarray(middle[:, 0] + moment / area[:, None])


def _disks(camera: ExactCamera, pose: Pose, centres: Array, radii: Array, blurs: Array) -> Array:
    """Image of the part of each pixel that disks cover, each with its blur (N,), exact for disks that do not overlap.

    The double integral of the pixel's answer over a disk is turned into one around its contour by Green's theorem; the
    trapezoid rule on a smooth periodic integrand converges exponentially.
    """
    columns, rows = camera.size
    image = np.zeros((rows, columns))
    if len(centres) == 0:
        return image
    extent = np.nan_to_num(np.ptp(contours(camera, pose, centres, radii, 16)[0], axis=1).max(axis=1))
    pad = int(np.ceil(_REACH * float(blurs.max()) + 1.0))
    points = int(2 ** np.ceil(np.log2(max(32.0, 1.2 * np.pi * extent.max() / float(blurs.min())))))
    outline, slope = contours(camera, pose, centres, radii, points)
    low, high = outline.min(axis=1) - pad, outline.max(axis=1) + pad
    seen = np.flatnonzero(
        np.isfinite(low).all(axis=1) & (high >= 0.0).all(axis=1) & (low <= [columns - 1, rows - 1]).all(axis=1)
    )
    width = int(np.ceil(np.max((high - low)[seen], initial=1.0))) + 1
    borders = np.arange(width + 1) - 0.5  # between pixels
    for batch in np.array_split(seen, max(1, len(seen) * points * width // 300_000)):
        if len(batch) == 0:
            continue
        first = np.floor(low[batch]).astype(np.int64)
        blur = blurs[batch, None, None]
        x = (outline[batch, :, :1] - (first[:, None, :1] + borders)) / blur
        y = (outline[batch, :, 1:] - (first[:, None, 1:] + borders)) / blur
        across = -np.diff(blur * (x * ndtr(x) + np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)), axis=-1)
        along = -np.diff(ndtr(y), axis=-1) * slope[batch, :, 1:] * (2.0 * np.pi / points)
        patches = np.swapaxes(along, 1, 2) @ across
        patches *= np.sign(patches.sum(axis=(1, 2)))[:, None, None]
        for (u, v), patch in zip(first, patches, strict=True):
            top, left = max(v, 0), max(u, 0)
            bottom, right = min(v + width, rows), min(u + width, columns)
            image[top:bottom, left:right] += patch[top - v : bottom - v, left - u : right - u]
    return image


def render_target(camera: ExactCamera, pose: Pose, look: TargetLook, *, blur_px: Blur) -> Array:
    """Image (rows, columns) of a spot target, grey levels above black, without noise.

    Parameters
    ----------
    pose : Pose
        camera_from_target, mm.
    look : TargetLook
        Marks, their sizes and brightness. Specks of dirt hide what lies under them; where they cut a spot, the cut is
        exact to first order in the blur only (coverages are multiplied).
    blur_px : float or callable
        Sigma of the lens, px, at least 0.2; or of points in C, each mark having that of its middle.

    Raises
    ------
    ValueError
        For a smaller blur, with which contour integrals would not converge.
    """
    present = look.radii > 0.0
    blurs = _blurs(blur_px, pose.apply(look.marks[present]))
    spots = _disks(camera, pose, look.marks[present], look.radii[present], blurs)
    image = look.ground + (look.spot - look.ground) * spots
    if len(look.dirt):
        specks = look.dirt * [1.0, 1.0, 0.0]
        image = image * (
            1.0 - np.minimum(_disks(camera, pose, specks, look.dirt[:, 2], _blurs(blur_px, pose.apply(specks))), 1.0)
        )
    if look.uneven:
        columns, rows = camera.size
        v, u = np.ogrid[0:rows, 0:columns]
        square = ((u - (columns - 1) / 2) ** 2 + (v - (rows - 1) / 2) ** 2) / ((columns**2 + rows**2) / 4)
        image = image * (1.0 - look.uneven * square)
    return np.asarray(image)


def _radiance(camera: ExactCamera, laser: ExactLaser, scene: Scene, pixels: Array) -> tuple[Array, Ints, Array, Array]:
    """Laser light (N,) seen at points of the image (N, 2), of one; and, to find edges, the part lit, its normal, its place."""
    hits = scene.cast(exact_rays(camera, pixels))
    light = np.zeros(len(pixels))
    part = hits.part.copy()
    rows = np.flatnonzero(hits.found)
    rays, offset = laser.reach(hits.points[rows])
    cosine = -np.einsum("ij,ij->i", rays.direction, hits.normal[rows])
    angle = np.arctan2(rays.direction @ laser.along, rays.direction @ laser.axis)
    width = laser.width_at(hits.points[rows])
    bright = (np.abs(offset) < _REACH * width) & (cosine > 0.0) & (np.abs(angle) < laser.half_fan)
    rows, offset, cosine, width = rows[bright], offset[bright], cosine[bright], width[bright]
    reached = scene.lit(Rays(rays.origin[bright], rays.direction[bright]), hits.points[rows])
    value = np.exp(-0.5 * (offset / width) ** 2) * cosine * hits.albedo[rows] * laser.strength_at(hits.points[rows])
    light[rows] = np.where(reached, value, 0.0)
    part[rows[~reached]] = -2
    return light, part, hits.normal, hits.points


def _lit_pixels(camera: ExactCamera, laser: ExactLaser, scene: Scene, pad: int) -> Bools:
    """Mask (rows + 2 pad, columns + 2 pad) of the pixels that laser light may reach: the sheet, traced as rays."""
    columns, rows = camera.size
    shape = (rows + 2 * pad, columns + 2 * pad)
    count = int(3.0 * laser.half_fan * max(camera.focal))
    angle = np.linspace(-laser.half_fan, laser.half_fan, count)
    across = np.linspace(-_REACH, _REACH, 11) * _widest(laser, scene, angle)
    angles, offsets = (grid.ravel() for grid in np.meshgrid(angle, across, indexing="ij"))
    points = scene.cast(laser.rays(angles, offsets)).points
    pixels = project(camera, points).reshape(count, len(across), 2) + pad
    inside = (
        np.isfinite(pixels).all(axis=2)
        & (pixels > -0.5).all(axis=2)
        & (pixels < [shape[1] - 0.5, shape[0] - 0.5]).all(axis=2)
    )
    u, v = np.rint(pixels[inside]).astype(np.int64).T
    mask = np.zeros(shape, dtype=np.uint8)
    mask[v, u] = 1
    # lines between neighbours across the sheet, for surfaces on which the stripe is stretched
    for before, after in ((pixels[:, :-1], pixels[:, 1:]), (pixels[:-1], pixels[1:])):
        apart = np.abs(after - before).max(axis=2)
        for start, stop in zip(*(p[(apart > 1.0) & (apart < 60.0)] for p in (before, after)), strict=True):
            cv2.line(mask, (int(start[0]), int(start[1])), (int(stop[0]), int(stop[1])), 1)
    return np.asarray(cv2.dilate(mask, np.ones((3, 3), np.uint8)) > 0)


def _widest(laser: ExactLaser, scene: Scene, angle: Array) -> float:
    """Largest width, mm, of the light where it meets the scene."""
    if laser.beam is None:
        return laser.width
    points = scene.cast(laser.rays(angle)).points
    points = points[np.isfinite(points).all(axis=1)]
    return float(np.max(laser.width_at(points), initial=laser.beam.waist))


def _samples(camera: ExactCamera, laser: ExactLaser, depth: float, blur: float) -> int:
    """Cells a pixel and axis with which the lattice's aliasing stays under 1e-5 of the stripe's light."""
    narrow = laser.width if laser.beam is None else laser.beam.waist
    stripe = max(narrow * min(camera.focal) / depth, 1e-3)
    together = 1.0 / np.sqrt(1.0 / stripe**2 + 1.0 / blur**2)
    return int(np.clip(np.ceil(0.763 / together), 2, 8))


def render_stripe(camera: ExactCamera, laser: ExactLaser, scene: Scene, *, blur_px: Blur) -> Array:
    """Image (rows, columns) of a laser stripe on a scene in C, without noise.

    One is the radiance of a surface of albedo one that faces the laser, in the middle of its sheet, before any blur.
    Surfaces are Lambertian and opaque; light that falls on them twice is left out.

    Light is sampled on a lattice over the pixels that the sheet reaches and nowhere else, at the middle of each cell;
    cells beside edges of parts, creases and shadows are sampled sixteen times, and their light is put in
    their middle: there pixels err by up to 2 % of the peak, elsewhere by less than 0.1 %. ``blur_px`` may be a function
    of the points (N, 3) that are seen. ``ValueError`` for a blur under 0.2 px.
    """
    columns, rows = camera.size
    image = np.zeros((rows, columns))
    least, most = _range_of(blur_px, laser, scene)
    pad = int(np.ceil(_REACH * most + 1.0))
    mask = _lit_pixels(camera, laser, scene, pad)
    if not mask.any():
        return image
    top, bottom = _span(np.asarray(mask.any(axis=1)))
    left, right = _span(np.asarray(mask.any(axis=0)))
    mask = mask[top:bottom, left:right]
    v0, u0 = top - pad, left - pad  # the pixel of the mask's first row and column
    far = _depth(camera, scene, mask, u0, v0)
    m = _samples(camera, laser, far, least)
    cells = np.repeat(np.repeat(mask, m, axis=0), m, axis=1)
    j, i = np.nonzero(cells)
    centre = np.stack([u0 + (i + 0.5) / m - 0.5, v0 + (j + 0.5) / m - 0.5], axis=1)
    values, part, normal, seen = _radiance(camera, laser, scene, centre)
    lattice = np.zeros(cells.shape)
    edge = _edges(cells.shape, j, i, part, normal, values)
    lattice[j[~edge], i[~edge]] = values[~edge]
    if edge.any():
        fine = centre[edge][:, None, :] + (_ROOKS - 0.5) / m
        light = _radiance(camera, laser, scene, fine.reshape(-1, 2))[0].reshape(-1, len(_ROOKS))
        lattice[j[edge], i[edge]] = light.mean(axis=1)
    if callable(blur_px):
        blurs = np.zeros(cells.shape)
        lit = lattice[j, i] > 0.0
        blurs[j[lit], i[lit]] = _blurs(blur_px, seen[lit])
        found = _varying(lattice, blurs, (least, most), m, pad)
    else:
        found = _integrate(lattice, m, pad, blur_px)  # starts pad pixels before the mask
    v1, u1 = v0 - pad, u0 - pad
    t, s = max(v1, 0), max(u1, 0)
    b, r = min(v1 + found.shape[0], rows), min(u1 + found.shape[1], columns)
    if b > t and r > s:
        image[t:b, s:r] = found[t - v1 : b - v1, s - u1 : r - u1]
    return image


def _blurs(blur: Blur, points: Array) -> Array:
    """Blur (N,) px at points (N, 3); ``ValueError`` under 0.2 px."""
    found = np.asarray(blur(points)) if callable(blur) else np.full(len(points), float(blur))
    if len(found):
        _check_blur(float(np.nanmin(found)))
    return np.where(np.isfinite(found), found, 0.2)


def _range_of(blur: Blur, laser: ExactLaser, scene: Scene) -> tuple[float, float]:
    """Least and largest blur, px, where the sheet meets the scene."""
    if not callable(blur):
        _check_blur(blur)
        return blur, blur
    angle = np.linspace(-laser.half_fan, laser.half_fan, 2001)
    points = scene.cast(laser.rays(angle)).points
    found = _blurs(blur, points[np.isfinite(points).all(axis=1)])
    if not len(found):
        return 0.2, 0.2
    return max(0.2, float(found.min()) / _FINER), float(found.max()) * _FINER


def _varying(lattice: Array, blurs: Array, limits: tuple[float, float], m: int, pad: int) -> Array:
    """Pixels from light on a lattice whose cells have blurs of their own.

    Each cell's light is shared between the two nearest of a row of blurs, so that the mixture has the cell's variance.
    """
    least, most = limits
    count = max(2, int(np.ceil(np.log(most / least) / np.log(_FINER))) + 1)
    steps = np.geomspace(least, most, count)
    lit = lattice > 0.0
    square = np.clip(blurs, least, most) ** 2
    total: Array | None = None
    low = np.clip(np.searchsorted(steps**2, square, side="right") - 1, 0, count - 2)
    share = (square - steps[low] ** 2) / (steps[low + 1] ** 2 - steps[low] ** 2)
    for k, step in enumerate(steps):
        part = np.where(lit & (low == k), 1.0 - share, 0.0) + np.where(lit & (low == k - 1), share, 0.0)
        if part.any():
            image = _integrate(lattice * part, m, pad, float(step))
            total = image if total is None else total + image
    return _integrate(lattice, m, pad, least) if total is None else total


def _depth(camera: ExactCamera, scene: Scene, mask: Bools, u0: int, v0: int) -> float:
    """Largest depth z, mm, of the scene in a handful of the mask's pixels."""
    v, u = np.nonzero(mask)
    some = np.linspace(0, len(u) - 1, min(len(u), 200)).astype(np.int64)
    hits = scene.cast(exact_rays(camera, np.stack([u[some] + u0, v[some] + v0], axis=1).astype(np.float64)))
    return float(np.max(hits.points[hits.found, 2], initial=1.0))


def _integrate(lattice: Array, m: int, pad: int, blur: float) -> Array:
    """Pixels from light on a lattice of m cells a pixel, ``pad`` pixels larger on every side."""
    kernel = _answer((np.arange(-pad * m, pad * m + m) - (m - 1) / 2) / m, blur) / m
    filtered = cv2.sepFilter2D(
        np.pad(lattice, pad * m), cv2.CV_64F, kernel, kernel, anchor=(pad * m,) * 2, borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(filtered[::m, ::m])


def _edges(
    shape: tuple[int, ...], j: NDArray[np.intp], i: NDArray[np.intp], part: Ints, normal: Array, light: Array
) -> Bools:
    """Cells (N,) beside a change of part, of shadow, or of the surface's direction by more than about 15 degrees."""
    index = np.full((shape[0] + 1, shape[1] + 1), -1, dtype=np.int64)
    index[j, i] = np.arange(len(j))
    edge = np.zeros(len(j), dtype=bool)
    for dj, di in ((0, 1), (1, 0)):
        other = index[j + dj, i + di]
        here = np.flatnonzero(other >= 0)
        there = other[here]
        differ = (part[here] != part[there]) | (np.einsum("ij,ij->i", normal[here], normal[there]) < 0.966)
        differ &= np.maximum(light[here], light[there]) > 1e-5
        edge[here[differ]] = True
        edge[there[differ]] = True
    return edge


def _span(used: Bools) -> tuple[int, int]:
    where = np.flatnonzero(used)
    return int(where[0]), int(where[-1]) + 1


def _check_blur(blur_px: float) -> None:
    if not blur_px >= 0.2:
        raise ValueError("blur_px must be at least 0.2: no lens is sharper, and the integrals need it")


def speckle(shape: tuple[int, int], contrast: float, grain: float, rng: np.random.Generator) -> Array:
    """Factors (rows, columns) of mean one, standard deviation ``contrast`` and grains of ``grain`` px.

    Log-normal with a Gaussian autocorrelation of its logarithm, ``grain`` wide at half height: close to the gamma
    distribution of averaged speckle for contrasts up to about a half. ``grain`` = 0 is white.
    """
    # the kernel of one axis whose autocorrelation is the grain's: the root of its spectrum
    size = 32 * (int(np.ceil(grain)) + 1)
    lag = np.fft.fftfreq(size, 1.0 / size)
    peak = np.exp(-4.0 * np.log(2.0) * (lag / grain) ** 2) if grain > 0.0 else (lag == 0.0).astype(np.float64)
    kernel = np.fft.fftshift(np.fft.ifft(np.sqrt(np.maximum(np.fft.fft(peak).real, 0.0))).real)
    reach = int(np.ceil(2.0 * grain)) + 3
    kernel = kernel[size // 2 - reach : size // 2 + reach + 1]
    kernel /= np.linalg.norm(kernel)  # keeps the variance
    white = rng.standard_normal((shape[0] + 2 * reach, shape[1] + 2 * reach), dtype=np.float32)
    field = cv2.sepFilter2D(white, cv2.CV_32F, kernel, kernel)[reach:-reach, reach:-reach].astype(np.float64)
    spread = np.log1p(contrast**2)
    return np.asarray(np.exp(np.sqrt(spread) * field - spread / 2.0))


def expose(image: Array, sensor: Sensor, rng: np.random.Generator) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """One exposure of an ideal image (..., rows, columns; grey levels above black) by a noisy sensor.

    Electrons are Poisson with mean ``gain_e`` times the light; read noise is Gaussian and the black level has none of
    its own. Rounded to whole levels and clipped at zero and at white; 16-bit words for more than eight bits.
    """
    level = np.full(image.shape, sensor.black)
    bright = image > 0.0
    level[bright] += rng.poisson(image[bright] * sensor.gain_e) / sensor.gain_e
    level += sensor.read_noise * rng.standard_normal(image.shape, dtype=np.float32)
    whole = np.clip(np.rint(level), 0, sensor.white)
    return np.asarray(whole, dtype=np.uint8) if sensor.bits <= 8 else np.asarray(whole, dtype=np.uint16)
