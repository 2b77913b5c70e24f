"""A brief turned into a rig: lens, stand-off, baseline and angle that reach a wanted noise over a wanted volume."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.errors import CalibrationError, ScopeError
from scope.design.prediction import Surface
from scope.design.run import DesignResult, design_rig
from scope.design.stripe import look
from scope.design.troubles import THINNEST
from scope.simulation import RigDesign, VirtualRig

CATALOGUE = (4.0, 6.0, 8.0, 12.0, 16.0, 25.0, 35.0, 50.0, 75.0)  # mm, focal lengths that C-mount lenses are sold in
_ANGLES = (15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0)  # degrees between camera and laser
_STRIPE = 1.1  # px, one sigma, of the laser's own width in the middle of the volume
_LINE = 0.03  # mm, one sigma: thinner laser lines are not sold
_BROAD = 6.0  # px, one sigma, of a stripe that is still sharp
_ROOM = 1.1  # of the wanted width, that the image shows at the near end
_SAFE = 0.92  # of the wanted noise, that a proposal reaches: prediction and truth differ by some per cent
_BLURRED = 3.0  # px, one sigma, that the ends of the volume may be out of focus
_FARTHEST, _NEAREST = 5000.0, 60.0  # mm


@dataclass(frozen=True, slots=True)
class Wanted:
    """A brief."""

    sigma: float  # mm along the ray, largest over the volume
    volume: tuple[float, float, float]  # mm along the stripe, along the motion, in depth


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """One rig that was considered."""

    focal: float  # mm
    angle: float  # degrees
    stand_off: float  # mm, of the middle
    baseline: float  # mm
    sigma: float  # mm, largest over the volume
    blur: float  # px, largest
    design: RigDesign

    @property
    def row(self) -> dict[str, float]:
        """What it costs."""
        return {
            "focal_mm": self.focal,
            "angle_deg": self.angle,
            "stand_off_mm": self.stand_off,
            "baseline_mm": self.baseline,
            "sigma_mm": self.sigma,
            "blur_px": self.blur,
            "laser_width_mm": self.design.laser.width,
            "size_mm": self.stand_off + self.baseline,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """What a brief led to."""

    wanted: Wanted
    met: bool
    chosen: Choice
    predicted: DesignResult  # of the chosen rig, its calibration included
    choices: list[Choice]  # the best of each lens

    @property
    def result(self) -> dict[str, Any]:
        """What --json gives."""
        found = self.predicted.result
        return {
            "sigma_mm": self.wanted.sigma,
            "volume_mm": list(self.wanted.volume),
            "met": self.met,
            "proposed": self.chosen.row | {"sigma_cal_mm": found["sigma_cal_mm"]["max"]},
            "choices": [choice.row for choice in self.choices],
        }


def parse_want(text: str) -> Wanted:
    """Brief of ``sigma=0.02,volume=100x80x60``; ``ValueError`` for anything else."""
    parts = dict(part.split("=", 1) for part in text.split(",") if "=" in part)
    try:
        if set(parts) != {"sigma", "volume"}:
            raise ValueError
        x, y, z = (float(side) for side in parts["volume"].lower().split("x"))
        sigma = float(parts["sigma"])
    except ValueError:
        sigma = x = y = z = 0.0
    if not all(0.0 < value < 1e4 for value in (sigma, x, y, z)):
        raise ValueError(f"{text!r}: give sigma=MM,volume=XxYxZ: along the stripe, along the motion, in depth, mm")
    return Wanted(sigma, (x, y, z))


def propose(design: RigDesign, wanted: Wanted, *, surface: Surface | None = None) -> Proposal:
    """Search the smallest rig that meets a brief, or the nearest to it.

    Camera, aperture, laser light and the direction in which the laser stands are kept; focal length (of `CATALOGUE`), angle,
    stand-off and baseline are sought; focus, jig and the laser's width (unless a waist is given) follow. The near end of the volume stands where it just fills the image.

    Raises
    ------
    CalibrationError
        A design that does not tell ``camera.pixel_um``, or a volume that no lens shows.
    """
    if design.camera.pixel_um is None:
        raise CalibrationError(
            "camera.pixel_um is missing: without the size of a pixel no lens can be chosen; take it from the camera's data sheet"
        )
    surface = surface or Surface()
    tried = [
        choice for focal in CATALOGUE for angle in _ANGLES if (choice := _try(design, wanted, focal, angle, surface))
    ]
    if not tried:
        raise CalibrationError(
            f"no lens of {CATALOGUE[0]:g} to {CATALOGUE[-1]:g} mm shows {wanted.volume[0]:g} mm across and {wanted.volume[2]:g} mm in "
            f"depth between {_NEAREST:g} and {_FARTHEST:g} mm; want a smaller or less deep volume"
        )
    good = [c for c in tried if c.sigma <= _SAFE * wanted.sigma and c.blur <= _BLURRED]
    pool = good or [c for c in tried if c.blur <= _BLURRED] or tried
    order = (lambda c: c.stand_off + c.baseline) if good else (lambda c: c.sigma)
    for chosen in sorted(pool, key=order)[:6]:
        try:
            predicted = design_rig(chosen.design, surface=surface)
        except ScopeError:
            continue
        best = [
            min((c for c in pool if c.focal == focal), key=order)
            for focal in CATALOGUE
            if any(c.focal == focal for c in pool)
        ]
        return Proposal(wanted, bool(good), chosen, predicted, best)
    raise CalibrationError("none of the rigs that reach the brief can be calibrated on this jig; plan another grid")


def _try(design: RigDesign, wanted: Wanted, focal: float, angle: float, surface: Surface) -> Choice | None:
    """The rig of one lens and angle; None where it cannot stand."""
    camera, laser, jig = design.camera, design.laser, design.jig
    pixel = (camera.pixel_um or 1.0) * 1e-3
    toward = np.array(laser.origin[:2])
    if not np.linalg.norm(toward) > 0:
        return None
    toward = toward / np.linalg.norm(toward)
    across = int(abs(toward[1]) <= abs(toward[0]))  # the image axis along the stripe: 0 is u
    pixels = camera.size[across] - 2 * abs(camera.centre_px[across] - (camera.size[across] - 1) / 2)
    away = focal
    for _ in range(30):  # nearer focus moves the lens away from the sensor, and with it the volume away from the lens
        near = _ROOM * wanted.volume[0] * away / (pixel * pixels)
        far = near + wanted.volume[2]
        focus = 2 * near * far / (near + far)
        if not (focus > 1.2 * focal and max(_NEAREST, 3 * focal) <= near and far <= _FARTHEST):
            return None
        away = focal * focus / (focus - focal)
    middle = (near + far) / 2
    baseline = middle * float(np.tan(np.radians(angle)))
    count = max(len(jig.stand_offs), 3)
    pitch = jig.pitches
    shown = [0.92 * camera.size[k] * pixel / away * near / max((jig.columns, jig.rows)[k] - 1, 1) for k in (0, 1)]
    scale = min(shown[0] / pitch[0], shown[1] / pitch[1])
    scaled = replace(
        jig, stand_offs=tuple(float(z) for z in np.round(np.linspace(near, far, count), 2)),
        pitch=(round(pitch[0] * scale, 3), round(pitch[1] * scale, 3)), diameter=round(jig.diameter * scale, 3),
        fiducial_diameter=None if jig.fiducial_diameter is None else round(jig.fiducial_diameter * scale, 3),
    )  # fmt: skip
    optical = camera.f_number is not None
    trial = replace(
        design, jig=scaled, objects=(), motion=None, faults=(), tolerance=None,
        camera=replace(camera, focal_px=away / pixel, focal_mm=focal, focus=focus if optical else camera.focus),
        laser=replace(
            laser, origin=(float(baseline * toward[0]), float(baseline * toward[1]), 0.0), through=(0.0, 0.0, middle),
            width=laser.width if laser.waist is not None else round(max(_LINE, _STRIPE * middle * pixel / away), 3),
            waist_at=None if laser.waist_at is None else float(np.hypot(baseline, middle)),
        ),
    )  # fmt: skip
    try:
        rig = VirtualRig.of(trial)
    except ScopeError:
        return None
    half = wanted.volume[0] / 2
    depth, side = (grid.ravel() for grid in np.meshgrid([near, middle, far], np.linspace(-half, half, 9)))
    points = np.zeros((len(depth), 3))
    points[:, 2], points[:, across] = depth, side
    points[:, 1 - across] = 0.0
    points = _onto(rig, points, 1 - across)
    seen = look(rig, points, surface.normal, albedo=surface.albedo)
    inside = (seen.pixels > 2).all(axis=1) & (seen.pixels < np.array(camera.size) - 3).all(axis=1)
    if not (seen.stripe_px.min() > THINNEST and seen.stripe_px.max() < _BROAD):
        return None
    if not inside.all() or not np.isfinite(seen.sigma).all() or seen.clipped.any():
        return None
    return Choice(focal, angle, middle, baseline, float(seen.sigma.max()), float(seen.blur_px.max()), trial)


def _onto(rig: VirtualRig, points: np.typing.NDArray[np.float64], axis: int) -> np.typing.NDArray[np.float64]:
    """Points moved along one axis onto the sheet."""
    along = np.eye(3)[axis]
    for _ in range(6):
        off = rig.laser.reach(points)[1]
        points = points - (off / (rig.laser.sheet_normal(points) @ along))[:, None] * along
    return points
