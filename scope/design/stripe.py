"""What a laser stripe on a surface will look like in the image, and how well its position can be measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Rays
from scope.simulation import VirtualRig, exact_rays

PIXEL = 1.0 / 12.0  # px^2, variance of a pixel's width
_STEP = 0.25  # px, half of the central differences
_PHASES = (np.arange(4) - 1.5) / 4.0  # px, of the stripe within its pixel


@dataclass(frozen=True, slots=True, eq=False)
class StripeLook:
    """The stripe at N points of the sheet, where a surface of given normal and albedo lies."""

    pixels: Array  # (N, 2) px
    view: Array  # (N, 3) unit sighting rays
    normal: Array  # (N, 3) unit normals of the sheet
    along_ray: Array  # (N,) mm along the ray a pixel across the stripe
    across_mm: Array  # (N,) mm on the surface a pixel along the stripe
    stripe_px: Array  # (N,) px, one sigma of the stripe across, lens and pixel included
    blur_px: Array  # (N,) px, one sigma of lens and pixel across the stripe's course
    width_px: Array  # (N,) px, one sigma of the laser's own width
    signal: Array  # (N,) grey levels above black at the stripe's peak
    clipped: Bools  # (N,) whether the peak exceeds white
    sigma_px: Array  # (N,) px, of the position in one line
    sigma: Array  # (N,) mm along the ray
    skew: Array  # (N,) mm across the sheet, along its normal, by which a flat surface shows the stripe displaced


def look(rig: VirtualRig, points: Array, surface: Array, *, albedo: float, dark_images: int = 0) -> StripeLook:
    """Predict the stripe where the sheet meets a Lambertian surface.

    Parameters
    ----------
    rig : VirtualRig
        Camera, laser and sensor as designed.
    points : (N, 3) array
        mm in C, on the sheet of light.
    surface : (3,) or (N, 3) array
        Unit normals of the surface, towards camera and laser.
    albedo : float
        Light given back, of one.
    dark_images : int
        Laser-off images whose mean is subtracted; their noise is added.

    Returns
    -------
    StripeLook
        NaN where a point is not in view. ``sigma`` is the Cramer-Rao bound of one line of pixels (photon noise, read noise,
        rounding, clipped pixels telling nothing, speckle) times |n . dX/dp| / |n . d|, as ranging propagates it.
    """
    from scope.simulation import project

    pixels = project(rig.camera, points)
    axis = 1 if rig.along == "rows" else 0  # the coordinate across the stripe
    surface = np.broadcast_to(surface, points.shape)
    rays = exact_rays(rig.camera, pixels)
    moved = [_differences(rig, pixels, points, surface, k) for k in (axis, 1 - axis)]
    offset = [(rig.laser.reach(after)[1] - rig.laser.reach(before)[1]) / (2 * _STEP) for before, after in moved]
    with np.errstate(divide="ignore", invalid="ignore"):
        course = -offset[1] / offset[0]  # px across for a px along the line
        width = rig.laser.width_at(points) / np.abs(offset[0])
    lens = rig.blur_at(points)
    blur = np.sqrt((lens**2 + PIXEL) * (1.0 + course**2))
    stripe = np.hypot(width, blur)
    reached, _ = rig.laser.reach(points)
    cosine = np.clip(-np.einsum("ij,ij->i", reached.direction, surface), 0.0, None)
    seen = np.clip(-np.einsum("ij,ij->i", rays.direction, surface), 0.0, None) > 0.0
    light = rig.level * rig.laser.strength_at(points) * albedo * cosine * np.where(seen, 1.0, 0.0)
    signal = light * width / stripe
    # lens alone, for the profile that the pixel integrates
    optical = np.sqrt(np.maximum(stripe**2 - PIXEL, 1e-6))
    sigma_px = position_sigma(rig, light * width / optical, optical, dark_images)
    normal = rig.laser.sheet_normal(points)
    before, after = (_meet(each, points, normal) for each in _shifted(rig, pixels, axis))
    along = np.abs(np.einsum("ij,ij->i", after - before, rays.direction)) / (2 * _STEP)
    along_line = np.linalg.norm(moved[1][1] - moved[1][0] + course[:, None] * (moved[0][1] - moved[0][0]), axis=1)
    return StripeLook(
        pixels, rays.direction, normal, along, along_line / (2 * _STEP), stripe, blur, width, signal,
        signal + rig.sensor.black + rig.design.camera.ambient >= rig.sensor.white, sigma_px, sigma_px * along,
        _skew(rig, pixels, points, surface, axis, (offset[0], width, stripe, signal)),
    )  # fmt: skip


def _skew(
    rig: VirtualRig, pixels: Array, points: Array, surface: Array, axis: int, seen: tuple[Array, Array, Array, Array]
) -> Array:  # fmt: skip
    """Displacement (N,) mm of the middle of a profile that is not even about the middle of the sheet (docs/method.md, 11).

    Perspective bends the distance from the sheet (b), the sheet widens away from the laser (h), and its light falls off and
    meets the surface at another angle (g), and the square of the blur changes (d): s^2 (g - (3 + rho q) / 2 (b / a - 2 h)) +
    rho q d / 2 px. rho goes from 0, where photons rule
    the noise, to -3/2, where it is even. ``seen``: a, mm of distance a px; widths of laser and stripe, px; signal.
    """
    slope, width, stripe, signal = seen
    wide = 4.0  # px: the second difference of what is nearly straight
    step = np.zeros((1, 2))
    step[0, axis] = wide
    ends = [_meet(exact_rays(rig.camera, pixels + k * step), points, surface) for k in (-1.0, 0.0, 1.0)]
    rays, offset = zip(*(rig.laser.reach(end) for end in ends), strict=True)
    bend = (offset[0] - 2.0 * offset[1] + offset[2]) / wide**2
    facing = [-np.einsum("ij,ij->i", each.direction, surface) for each in rays]
    light = [f * rig.laser.strength_at(end) for f, end in zip(facing, ends, strict=True)]
    broad = [rig.laser.width_at(end) for end in ends]
    with np.errstate(divide="ignore", invalid="ignore"):
        dims = (light[2] - light[0]) / (2.0 * wide * light[1])
        widens = (broad[2] - broad[0]) / (2.0 * wide * broad[1])
        blurs = (rig.blur_at(ends[2]) ** 2 - rig.blur_at(ends[0]) ** 2) / (2.0 * wide)
    even = rig.sensor.read_noise**2 + 1.0 / 12.0
    rho = -1.5 * even / (even + 0.5 * signal / rig.sensor.gain_e)
    share = width**2 / stripe**2
    moved = width**2 * (slope * dims - (3.0 + rho * share) / 2.0 * (bend - 2.0 * slope * widens))
    return np.asarray(moved + slope * rho * share * blurs / 2.0)


def position_sigma(rig: VirtualRig, amplitude: Array, width: Array, dark_images: int) -> Array:
    """Least standard deviation (N,) px of the position of Gaussian stripes in one line of pixels.

    ``amplitude`` (N,) grey levels and ``width`` (N,) px are those of the light before the pixels integrate it. Fisher's
    information d' V^-1 d of the profile's derivative d under the covariance V of its pixels, averaged over where in a
    pixel the stripe lies; with speckle, V has its part C^2 m m rho beside the independent noise (docs/method.md, 7).
    """
    from scipy.special import ndtr

    sensor, design = rig.sensor, rig.design
    reach = int(np.ceil(np.clip(4.0 * np.nanmax(width, initial=1.0), 4.0, 60.0)))
    pixel = np.arange(-reach, reach + 1, dtype=np.float64)
    flat = sensor.read_noise**2 + 1.0 / 12.0
    dark = design.camera.ambient / sensor.gain_e
    flat = flat + dark + ((flat + dark) / dark_images if dark_images else 0.0)
    total = np.zeros(len(width))
    for phase in _PHASES:
        x = (pixel[None, :] - phase) / width[:, None]
        half = 0.5 / width[:, None]
        mean = amplitude[:, None] * width[:, None] * np.sqrt(2 * np.pi) * (ndtr(x + half) - ndtr(x - half))
        slope = amplitude[:, None] * (np.exp(-0.5 * (x - half) ** 2) - np.exp(-0.5 * (x + half) ** 2))
        lit = mean + sensor.black + design.camera.ambient < sensor.white
        variance = mean / sensor.gain_e + flat
        weight = np.where(lit, 1.0 / variance, 0.0)
        if rig.speckle[0]:
            total += _under_speckle(rig, mean, slope, weight, pixel)
        else:
            total += np.nansum(weight * slope**2, axis=1)
    with np.errstate(divide="ignore"):
        return np.where(np.isfinite(width), 1.0 / np.sqrt(total / len(_PHASES)), np.nan)


def _under_speckle(rig: VirtualRig, mean: Array, slope: Array, weight: Array, pixel: Array) -> Array:
    """Information (N,) where light is multiplied by a correlated field.

    A scale of the whole profile is fitted, too, so that what the slowest speckle does to it is no loss.
    """
    grain = max(rig.speckle[1], 1e-3)
    lag = pixel[:, None] - pixel[None, :]
    rho = np.exp(-4.0 * np.log(2.0) * (lag / grain) ** 2)
    informed = np.zeros(len(mean))
    for n in range(len(mean)):
        use = (weight[n] > 0) & (mean[n] > 1e-4 * max(float(mean[n].max()), 1e-12))
        if use.sum() < 3:
            continue
        noise = (
            np.diag(1.0 / weight[n, use])
            + rig.speckle[0] ** 2 * np.outer(mean[n, use], mean[n, use]) * (rho[np.ix_(use, use)])
        )
        informed[n] = slope[n, use] @ np.linalg.solve(noise, slope[n, use])
    return informed


def _shifted(rig: VirtualRig, pixels: Array, axis: int) -> tuple[Rays, Rays]:
    step = np.zeros((1, 2))
    step[0, axis] = _STEP
    return exact_rays(rig.camera, pixels - step), exact_rays(rig.camera, pixels + step)


def _differences(rig: VirtualRig, pixels: Array, points: Array, surface: Array, axis: int) -> tuple[Array, Array]:
    """Where rays a quarter pixel before and after meet the surface's tangent plane."""
    before, after = _shifted(rig, pixels, axis)
    return _meet(before, points, surface), _meet(after, points, surface)


def _meet(rays: Rays, points: Array, normal: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.einsum("ij,ij->i", points - rays.origin, normal) / np.einsum("ij,ij->i", rays.direction, normal)
    return rays.at(t)
