"""Whether a designed session could be calibrated at all: what a calibration of it would refuse is not rendered."""

from __future__ import annotations

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array, Bools, Pose
from scope.simulation.optics import project
from scope.simulation.virtual_rig import VirtualRig

_SMALLEST = 2.0  # px: no spot that is narrower is found
_SOFTEST = 0.35  # blur (one sigma) over diameter, beyond which a spot has no edge
_FAINTEST = 2.0  # contrast of spots over noise, both in grey levels
_DIMMEST = 3.2  # peak of the stripe over noise
_LINES = 10  # of the image that show the stripe between the marks, on two planes at least


def check_session(rig: VirtualRig) -> None:
    """Refuse a rig whose calibration could not be: too few planes, marks that cannot be found or told apart, no stripe on them.

    Raises
    ------
    FileError
        The first thing that is wrong, in numbers, and what to do.
    """
    jig = rig.design.jig
    if len(jig.stand_offs) < 2 and not jig.levels:
        raise FileError("rig design: jig.stand_offs has one plane; a calibration needs two or more: add a stand-off")
    _check_contrast(rig)
    for k, name in enumerate(jig.names):
        _check_fiducials(rig, name, rig.actual[k])
        _check_spots(rig, k, name)
    _check_stripe(rig)


def _check_contrast(rig: VirtualRig) -> None:
    look, sensor = rig.look(0, np.random.default_rng(0)), rig.sensor
    spot, ground = (min(level + sensor.black, float(sensor.white)) for level in (look.spot, look.ground))
    contrast = spot - ground if rig.design.jig.polarity == "light" else ground - spot
    noise = float(np.sqrt(sensor.read_noise**2 + 1.0 / 12.0 + max(spot - sensor.black, 0.0) / sensor.gain_e))
    if contrast < _FAINTEST * noise:
        raise FileError(
            f"rig design: {rig.design.jig.polarity} spots of {spot:.0f} grey levels on {ground:.0f} (noise {noise:.1f}, white "
            f"{sensor.white}) would not be found; set jig.bright well above jig.dark and below white"
        )


def _check_fiducials(rig: VirtualRig, name: str, pose: Pose) -> None:
    jig = rig.design.jig
    if not jig.fiducials or jig.fiducial_diameter is None:
        return
    places = np.array([(c * jig.pitches[0], r * jig.pitches[1], 0.0) for r, c in jig.fiducials])
    inside = _wholly(rig, pose, places, np.full(len(places), 0.5 * jig.fiducial_diameter))
    if not inside.all():
        raise FileError(
            f"rig design: plane {name} shows {int(inside.sum())} of its {len(places)} jig.fiducials wholly, so that the grid could "
            "not be told from its image: choose fiducials nearer to the middle, a smaller pitch, or a larger stand-off"
        )


def _check_spots(rig: VirtualRig, k: int, name: str) -> None:
    """Spots in view, and their size and sharpness in px."""
    jig, pose = rig.design.jig, rig.actual[k]
    look = rig.look(k, np.random.default_rng(0))
    there = look.radii > 0.0
    marks, radii = look.marks[there], look.radii[there]
    inside = _wholly(rig, pose, marks, radii)
    if not (jig.fiducials or jig.levels) and not inside.all():  # marks of levels are listed
        raise FileError(
            f"rig design: plane {name} shows {int(inside.sum())} of {len(marks)} spots and there are no jig.fiducials, so that which is "
            "which could not be told: add fiducials, or a smaller pitch"
        )
    if inside.sum() < 6:
        raise FileError(
            f"rig design: plane {name} shows {int(inside.sum())} spots; six at least are needed: a smaller pitch, or a larger stand-off"
        )
    world, usual = pose.apply(marks[inside]), radii[inside]
    across = project(rig.camera, world + usual[:, None] * pose.rotation[:, 0]) - project(rig.camera, world - usual[:, None] * pose.rotation[:, 0])  # fmt: skip
    down = project(rig.camera, world + usual[:, None] * pose.rotation[:, 1]) - project(rig.camera, world - usual[:, None] * pose.rotation[:, 1])  # fmt: skip
    size = float(np.median(np.sqrt(np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]))))
    if size < _SMALLEST:
        raise FileError(
            f"rig design: spots are {size:.1f} px wide on plane {name}; {_SMALLEST:g} at least are found (5 are wanted): larger spots, a "
            "longer lens or a nearer jig"
        )
    blur = float(np.median(rig.blur_at(world)))
    if blur > _SOFTEST * size:
        raise FileError(
            f"rig design: spots of {size:.1f} px are blurred by {blur:.1f} px (one sigma) on plane {name}, and their edges would not be found: "
            "focus nearer to there, close the aperture, or take larger spots"
        )


def _check_stripe(rig: VirtualRig) -> None:
    """Light of the laser between the marks, bright enough, on two planes at least."""
    jig, sensor = rig.design.jig, rig.sensor
    noise = float(np.sqrt(sensor.read_noise**2 + 1.0 / 12.0 + rig.design.camera.ambient / sensor.gain_e))
    shown, brightest = 0, 0.0
    axis = 1 if rig.along == "rows" else 0
    for k in range(len(jig.stand_offs)):
        pose = rig.actual[k]
        truth = rig.truth_of(rig.blank(k))
        found = np.flatnonzero(np.isfinite(truth.position))
        flat = pose.inverse.apply(truth.points[found])[:, :2]
        between = (flat >= 0.0).all(axis=1) & (flat <= rig.corners[2, :2]).all(axis=1)
        lit = truth.points[found[between]]
        if len(lit) < _LINES:
            continue
        peak = float(np.max(rig.level * truth.peak[found[between]] * _kept(rig, lit, pose, axis)))
        brightest = max(brightest, peak)
        shown += peak >= _DIMMEST * noise
    if shown < 2 and not jig.levels:
        why = (
            f"(brightest {brightest:.1f} grey levels, noise {noise:.1f}): more laser power or a longer exposure"
            if brightest > 0.0
            else "between the spots: aim the laser `through` the middle of the jig, or turn it about its axis (roll)"
        )
        raise FileError(
            f"rig design: the laser's stripe shows on {shown} of {len(jig.names)} planes, and a calibration needs two {why}"
        )


def _kept(rig: VirtualRig, points: Array, pose: Pose, axis: int) -> Array:
    """Part (N,) of the stripe's peak that the blur leaves: its own width over that with lens and pixel."""
    pixels = project(rig.camera, points)
    step = 0.05
    moved = project(rig.camera, points + step * pose.rotation[:, axis])
    side = np.abs(moved[:, axis] - pixels[:, axis]) / step  # px a mm across the stripe
    width = np.maximum(rig.laser.width_at(points) * side, 1e-6)
    return np.asarray(width / np.sqrt(width**2 + rig.blur_at(points) ** 2 + 1.0 / 12.0))


def _wholly(rig: VirtualRig, pose: Pose, places: Array, radii: Array) -> Bools:
    """Whether disks (N) on a plane lie in the image with all of their rim."""
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(16)], axis=1)
    around = (places[:, None] + radii[:, None, None] * rim).reshape(-1, 3)
    pixels = project(rig.camera, pose.apply(around)).reshape(len(places), -1, 2)
    with np.errstate(invalid="ignore"):
        return np.asarray(((pixels > 0.0) & (pixels < np.array(rig.camera.size) - 1.0)).all(axis=(1, 2)))
