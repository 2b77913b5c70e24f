"""Which spots of the jig the camera will see, how large, and how well their centres can be measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Ints
from scope.design.stripe import PIXEL
from scope.simulation import VirtualRig, project

_RIM = 2.0  # blurs that a spot keeps from the border of the image
_TRUST = 0.003  # of the contrast: no edge is known better


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPlane:
    """The spots of one stand-off that are in view."""

    name: str
    mark: Ints  # (n,) number of the spot
    points: Array  # (n, 2) mm in the target's frame, as stated
    world: Array  # (n, 3) mm in C, where they are
    pixels: Array  # (n, 2) px of their centres
    diameter: Array  # (n,) px, of the circle of equal area
    sigma: Array  # (n,) px, of one coordinate of a centre, all repeats together
    blurred: Bools  # (n,) whether the blur exceeds what `calibrate --check` accepts


def plan_planes(rig: VirtualRig) -> list[PlannedPlane]:
    """See the targets at all stand-offs."""
    return [_plane(rig, k) for k in range(len(rig.stated))]


def _plane(rig: VirtualRig, k: int) -> PlannedPlane:
    jig = rig.design.jig
    look = rig.look(k, np.random.default_rng(0))
    pose = rig.actual[k]
    world = pose.apply(look.marks)
    pixels = project(rig.camera, world)
    scale = _scale(rig, pose.rotation, world)
    diameter = 2.0 * look.radii * scale
    blur = np.sqrt(rig.blur_at(world) ** 2 + PIXEL)
    columns, rows = rig.camera.size
    room = diameter / 2 + _RIM * blur
    inside = (pixels > room[:, None]).all(axis=1) & (pixels < [columns - 1, rows - 1] - room[:, None]).all(axis=1)
    sigma = centre_sigma(rig, look.spot, look.ground, diameter / 2, blur) / np.sqrt(jig.images)
    use = np.flatnonzero(inside & (look.radii > 0))
    column, row = np.meshgrid(np.arange(jig.columns), np.arange(jig.rows))
    stated = np.stack([column * jig.pitches[0], row * jig.pitches[1]], axis=-1).reshape(-1, 2)
    return PlannedPlane(
        jig.names[k], use, stated[use], world[use], pixels[use], diameter[use], sigma[use],
        blur[use] > 0.3 * diameter[use],
    )  # fmt: skip


def _scale(rig: VirtualRig, rotation: Array, world: Array) -> Array:
    """Px a mm (N,) on a plane at points, the root of the ratio of areas."""
    step = 0.05
    along, down = (
        (project(rig.camera, world + step * rotation[:, k]) - project(rig.camera, world - step * rotation[:, k]))
        / (2 * step)
        for k in (0, 1)
    )
    return np.sqrt(np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0]))


def centre_sigma(rig: VirtualRig, spot: float, ground: float, radius: Array, blur: Array) -> Array:
    """Least standard deviation (N,) px of one coordinate of the centre of blurred disks in one image.

    Fisher's information of the edge: pi R times the integral over the edge of (contrast g)^2 / variance, g being the
    blur's Gaussian; half of the rim's information goes to each coordinate. An edge is trusted to 0.3 % of its contrast.
    """
    from scipy.special import ndtr

    sensor = rig.sensor
    x = np.linspace(-4.0, 4.0, 161)
    level = ground + (spot - ground) * ndtr(x)
    contrast = spot - ground
    variance = level / sensor.gain_e + sensor.read_noise**2 + 1.0 / 12.0 + (_TRUST * contrast) ** 2
    shape = float(np.sum(np.exp(-(x**2)) / (2 * np.pi) / variance) * (x[1] - x[0])) * contrast**2
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.sqrt(np.pi * radius * shape / blur))
