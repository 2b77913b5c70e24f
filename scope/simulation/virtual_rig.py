"""A rig design turned into optics, poses and solids, and the images its camera would take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.errors import FileError
from calibration.geometry import Array, Pose
from scope.simulation.object_design import (
    BoxDesign,
    CylinderDesign,
    MeshDesign,
    ObjectDesign,
    PlaneDesign,
    RoughDesign,
    SphereDesign,
    StepsDesign,
)
from scope.simulation.optics import ExactCamera, ExactLaser, Window, exact_rays
from scope.simulation.physics import Beam, Lens
from scope.simulation.rendering import Sensor, TargetLook, expose, render_stripe, render_target, speckle
from scope.simulation.rig_design import RigDesign
from scope.simulation.solids import Box, Cylinder, HeightField, Mesh, Part, Scene, Sheet, Solid, Sphere
from scope.simulation.stripe_truth import Along, TrueStripe, runs_along, true_stripe

_RED = np.array([0.02, 0.08, 1.0])  # how blue, green and red pixels answer a red laser


@dataclass(frozen=True, slots=True, eq=False)
class VirtualRig:
    """A design turned into optics, poses and solids."""

    design: RigDesign
    camera: ExactCamera
    laser: ExactLaser
    sensor: Sensor
    level: float  # grey level of light one
    lens: Lens | None  # None: the same blur everywhere
    speckle: tuple[float, float]  # contrast, and grain in px
    stated: tuple[Pose, ...]  # camera_from_target of each plane, as calibration.toml says
    actual: tuple[Pose, ...]  # and as it is, faults included
    scene: Scene  # in the cloud frame

    @classmethod
    def of(cls, design: RigDesign) -> VirtualRig:
        """Build a rig; ``FileError`` where its parts cannot stand as designed, or a mesh cannot be read."""
        window = None
        if design.window is not None:
            w = design.window
            tilt = (float(np.radians(w.tilt[0])), float(np.radians(w.tilt[1])))
            window = Window.tilted(w.thickness, w.index, tilt, w.distance)
        c, beam = design.camera, design.laser
        camera = ExactCamera(c.size, (c.focal_px, c.focal_px), c.centre_px, c.distortion, window)
        sensor = Sensor(c.gain_e, c.read_noise, c.blur_px, c.black, c.bits)
        laser = ExactLaser.aimed(
            np.array(beam.origin),
            np.array(beam.through),
            width=beam.width,
            roll=float(np.radians(beam.roll)),
            half_fan=float(np.radians(beam.fan / 2)),
            window=window,
            beam=_beam(design),
        )
        lens = _lens(design)
        stated = _stated_poses(design, camera)
        rig = cls(
            design=design,
            camera=camera,
            laser=laser,
            sensor=sensor,
            level=_level(design, sensor, lens, laser.beam),
            lens=lens,
            speckle=_speckle(design, lens),
            stated=stated,
            actual=tuple(_faulty(design, name, pose) for name, pose in zip(design.jig.names, stated, strict=True)),
            scene=Scene(tuple(part for item in design.objects for part in _parts(item))),
        )
        rig._check()
        return rig

    def _check(self) -> None:
        """Refuse distortion that folds within the image, and planes or a laser on the wrong side of the glass."""
        columns, rows = self.camera.size
        v, u = np.mgrid[-8 : rows + 8 : 40j, -8 : columns + 8 : 40j]
        if not np.isfinite(exact_rays(self.camera, np.stack([u.ravel(), v.ravel()], axis=1)).direction).all():
            raise FileError(
                f"rig design: camera.distortion {list(self.camera.distortion)} folds within the image "
                f"(at {self.camera.fold:.3g} of the focal length off axis); make it weaker or the image smaller"
            )
        window = self.camera.window
        if window is None:
            return
        nearest = min(float(window.depth(pose.apply(self.corners)).min()) for pose in self.actual)
        if nearest <= 0.0:
            raise FileError(
                f"rig design: a target comes within {nearest:.3g} mm of the window's far face; move them apart"
            )
        beyond = float(window.depth(self.laser.origin[None])[0]) + window.thickness
        if beyond > 0.0:
            raise FileError(
                f"rig design: laser.origin lies {beyond:.3g} mm beyond the window's near face; it must stand before it"
            )

    @property
    def corners(self) -> Array:
        """Corners (4, 3) mm of the grid in the target's frame."""
        px, py = self.design.jig.pitches
        x, y = (self.design.jig.columns - 1) * px, (self.design.jig.rows - 1) * py
        return np.array([[0.0, 0.0, 0.0], [x, 0.0, 0.0], [x, y, 0.0], [0.0, y, 0.0]])

    def object_pose(self, frame: int) -> Pose:
        """C_from_cloud of the object at a frame: the inverse of what ranging does (formats: linear, turntable)."""
        motion = self.design.motion
        if motion is None or motion.kind == "fixed":
            return Pose.identity()
        s = motion.start + frame * (motion.step or 0.0)
        s = s if motion.moves == "object" else -s
        if motion.kind == "linear":
            direction = np.array(motion.direction)
            return Pose(np.eye(3), s * direction / np.linalg.norm(direction))
        axis, point = np.array(motion.axis_direction), np.array(motion.axis_point)
        turn = Pose.from_rotation_vector(np.radians(s) * axis / np.linalg.norm(axis), np.zeros(3))
        return Pose(turn.rotation, point - turn.rotation @ point)

    def blur_at(self, points: Array) -> Array:
        """Blur (N,) px of the lens for points (N, 3) in C, one sigma."""
        return np.full(len(points), self.sensor.blur_px) if self.lens is None else self.lens.blur(points)

    @property
    def _blur(self) -> float | Callable[[Array], Array]:
        return self.sensor.blur_px if self.lens is None else self.lens.blur

    def look(self, plane: int, rng: np.random.Generator) -> TargetLook:
        """Marks and brightness of one plane's target, faults included."""
        jig, name = self.design.jig, self.design.jig.names[plane]
        column, row = np.meshgrid(np.arange(jig.columns), np.arange(jig.rows))
        centre = self.corners[2] / 2
        height = np.array(jig.heights())[column]
        marks = np.stack([column * jig.pitches[0], row * jig.pitches[1], -height], axis=-1).reshape(-1, 3)
        radii = np.full((jig.rows, jig.columns), jig.diameter / 2)
        for cell in jig.fiducials:
            radii[cell] = (jig.fiducial_diameter or jig.diameter) / 2
        dirt = np.zeros((0, 3))
        for fault in self.design.faults:
            if fault.plane != name:
                continue
            marks = centre + (marks - centre) * [fault.pitch, fault.pitch, 1.0]
            for cell in fault.missing:
                radii[cell] = 0.0
            low, high = -centre[:2] * 0.05, centre[:2] * 2.05
            specks = np.column_stack(
                [rng.uniform(low, high, (fault.dirt, 2)), jig.diameter * rng.uniform(0.25, 0.5, fault.dirt)]
            )
            dirt = np.concatenate([dirt, specks])
        bright = jig.bright if jig.bright is not None else 0.7 * self.sensor.white
        dark = jig.dark if jig.dark is not None else 0.05 * self.sensor.white
        spot, ground = (bright, dark) if jig.polarity == "light" else (dark, bright)
        return TargetLook(marks, radii.ravel(), spot, ground, dirt, jig.uneven)

    def blank(self, plane: int) -> Scene:
        """A blank plate in a target's place, half a pitch larger than the grid all round, for the laser; with the target's levels."""
        jig = self.design.jig
        pose = self.actual[plane]
        heights = np.array(jig.heights())
        starts = np.flatnonzero(np.diff(heights, prepend=np.nan))
        ends = np.append(starts[1:], jig.columns)
        parts = []
        for first, last in zip(starts, ends, strict=True):
            size = ((last - first) * jig.pitches[0], jig.rows * jig.pitches[1])
            middle = np.array([0.5 * (first + last - 1) * jig.pitches[0], self.corners[2, 1] / 2, -heights[first]])
            parts.append(Part(Sheet((float(size[0]), size[1])), Pose(pose.rotation, pose.apply(middle))))
        return Scene(tuple(parts))

    def truth_of(self, scene: Scene) -> TrueStripe:
        """The true stripe on a scene in C."""
        return true_stripe(
            self.camera, self.laser, scene, along=self.along, sensor=self.sensor, level=self.level, blur=self.blur_at
        )

    @property
    def along(self) -> Along:
        """Whether the stripe runs along image "rows" or "columns"."""
        return runs_along(self.camera, self.laser, float(np.mean(self.design.jig.stand_offs)))

    def stripe_images(self, scene: Scene, count: int, rng: np.random.Generator) -> list[NDArray[Any]]:
        """Exposures of the stripe on one scene in C; speckle stays, noise does not."""
        light = self.level * render_stripe(self.camera, self.laser, scene, blur_px=self._blur)
        if self.speckle[0]:
            light *= speckle((light.shape[0], light.shape[1]), *self.speckle, rng)
        return [self._expose(light, self.design.camera.ambient, rng) for _ in range(count)]

    def target_images(self, plane: int, count: int, rng: np.random.Generator) -> list[NDArray[Any]]:
        """Exposures of a plane's target."""
        light = render_target(self.camera, self.actual[plane], self.look(plane, rng), blur_px=self._blur)
        return [self._expose(None, light, rng) for _ in range(count)]

    def stripe_light(self, scene: Scene) -> Array:
        """Light (rows, columns) of the laser on one scene in C, grey levels above black, without noise and speckle."""
        return np.asarray(self.level * render_stripe(self.camera, self.laser, scene, blur_px=self.sensor.blur_px))

    def target_light(self, plane: int) -> Array:
        """Light (rows, columns) of a plane's target, grey levels above black, without noise."""
        look = self.look(plane, np.random.default_rng(plane))
        return render_target(self.camera, self.actual[plane], look, blur_px=self.sensor.blur_px)

    def exposed(self, light: Array, rng: np.random.Generator, *, laser: bool) -> NDArray[Any]:
        """One exposure of light that is the laser's, or a back-lit target's."""
        return self._expose(light, self.design.camera.ambient, rng) if laser else self._expose(None, light, rng)

    def dark_images(self, count: int, rng: np.random.Generator) -> list[NDArray[Any]]:
        """Exposures without the laser."""
        return [self._expose(None, self.design.camera.ambient, rng) for _ in range(count)]

    def _expose(self, red: Array | None, white: Array | float, rng: np.random.Generator) -> NDArray[Any]:
        columns, rows = self.camera.size
        light = np.zeros((rows, columns)) if red is None else red
        if not self.design.camera.colour:
            return expose(light + white, self.sensor, rng)
        return np.stack([expose(k * light + white, self.sensor, rng) for k in _RED], axis=-1)


def _lens(design: RigDesign) -> Lens | None:
    """The lens, where the design says enough of it for its blur to be known at every depth."""
    c = design.camera
    if c.f_number is None or c.focal_mm is None or c.focus is None or c.pixel_um is None:
        return None
    wavelength = (design.laser.wavelength_nm or 550.0) * 1e-6  # green, of the back-light, where no laser says other
    tilt = (float(np.radians(c.tilt[0])), float(np.radians(c.tilt[1])))
    return Lens(c.focal_mm, c.f_number, c.focus, c.pixel_um * 1e-3, wavelength, tilt, c.blur_px)


def _beam(design: RigDesign) -> Beam | None:
    """The beam, where width or light vary along it; its strength is one where the laser is aimed."""
    laser = design.laser
    if laser.waist is None and laser.power_mw is None:
        return None
    reference = float(np.linalg.norm(np.array(laser.through) - np.array(laser.origin)))
    waist, at = laser.waist or laser.width, laser.waist_at or reference
    if laser.divergence is not None or laser.waist is None:
        beam = Beam(waist, at, (laser.divergence or 0.0) * 1e-3)
    else:
        beam = Beam.diffracted(waist, at, (laser.wavelength_nm or 0.0) * 1e-6)
    return replace(beam, dims=laser.power_mw is not None, reference=reference)


def _level(design: RigDesign, sensor: Sensor, lens: Lens | None, beam: Beam | None) -> float:
    """Grey level of white that faces the laser where it is aimed."""
    laser, camera = design.laser, design.camera
    if laser.power_mw is None or lens is None or beam is None:
        return laser.peak if laser.peak is not None else 0.75 * sensor.white
    lit = beam.irradiance(laser.power_mw * 1e-3, beam.reference, float(np.radians(laser.fan)))
    exposure, efficiency = (camera.exposure_us or 0.0) * 1e-6, camera.quantum_efficiency or 0.0
    return lens.levels(lit, (laser.wavelength_nm or 0.0) * 1e-6, exposure, efficiency) / sensor.gain_e


def _speckle(design: RigDesign, lens: Lens | None) -> tuple[float, float]:
    laser = design.laser
    if laser.speckle == "aperture":
        return (0.0, 1.0) if lens is None else lens.speckle((laser.wavelength_nm or 0.0) * 1e-6)
    return laser.speckle, laser.grain


def _stated_poses(design: RigDesign, camera: ExactCamera) -> tuple[Pose, ...]:
    """Planes at the stand-offs, all with one x and y of the grid's centre: the middle of the view, to half a mm."""
    jig = design.jig
    columns, rows = camera.size
    middle = exact_rays(camera, np.array([[(columns - 1) / 2, (rows - 1) / 2]])).at_depth(
        float(np.mean(jig.stand_offs))
    )[0]
    turned = Pose.from_rotation_vector(np.radians(jig.rotation), np.zeros(3)).rotation
    half = np.array([(jig.columns - 1) * jig.pitches[0] / 2, (jig.rows - 1) * jig.pitches[1] / 2, 0.0])
    shift = np.round(2.0 * (middle[:2] - (turned @ half)[:2])) / 2.0
    return tuple(Pose(turned, np.array([*shift, z - (turned @ half)[2]])) for z in jig.stand_offs)


def _faulty(design: RigDesign, name: str, pose: Pose) -> Pose:
    """Where a plane stands that calibration.toml places at ``pose``."""
    jig = design.jig
    centre = np.array([(jig.columns - 1) * jig.pitches[0] / 2, (jig.rows - 1) * jig.pitches[1] / 2, 0.0])
    for fault in (f for f in design.faults if f.plane == name):
        for point, degrees in (
            (np.array([*fault.about, 0.0]) if fault.about is not None else centre, (0.0, 0.0, fault.rotation)),
            (centre, (fault.tilt[0], 0.0, 0.0)),
            (centre, (0.0, fault.tilt[1], 0.0)),
        ):
            turn = Pose.from_rotation_vector(np.radians(degrees), np.zeros(3)).rotation
            pose = pose @ Pose(turn, point - turn @ point)
        pose = pose @ Pose(np.eye(3), np.array([*fault.slip, 0.0]))
        pose = Pose(pose.rotation, pose.translation + np.array([0.0, 0.0, fault.stand_off]))
    return pose


def placed(item: ObjectDesign) -> Pose:
    """cloud_from_model of an object."""
    if item.pose is not None:
        return Pose.from_matrix(item.pose)
    return Pose.from_rotation_vector(np.radians(item.rotation), item.origin)


def rough_field(item: RoughDesign) -> HeightField:
    """The surface of a rough coupon: its own seed makes it, so that it is the same in every rig."""
    return HeightField.rough(item.size, item.Sq, item.correlation, np.random.default_rng(item.seed))


def _parts(item: ObjectDesign) -> list[Part]:
    """Solids of one object of the design, in the cloud frame."""
    solids: list[Solid]
    match item:
        case PlaneDesign():
            solids = [Sheet(item.size)]
        case SphereDesign():
            solids = [Sphere(item.radius)]
        case CylinderDesign():
            solids = [Cylinder(item.radius, item.length)]
        case BoxDesign():
            x, y, z = (side / 2 for side in item.size)
            solids = [Box((-x, -y, -z), (x, y, z))]
        case StepsDesign():
            x, y = item.tread
            starts = [k * (x + item.gap) for k in range(len(item.heights))]
            solids = [Box((s, 0.0, -item.base), (s + x, y, h)) for s, h in zip(starts, item.heights, strict=True)]
        case RoughDesign():
            field = rough_field(item)
            low = float(field.heights.min())
            solids = [field, Box((0.0, 0.0, low - item.thickness), (*field.extent, low))]
        case MeshDesign():
            solids = [Mesh.load(Path(item.mesh))]
    return [Part(solid, placed(item), item.albedo) for solid in solids]
