"""What a designed rig measures, over and over: ``OMP_NUM_THREADS=1 python -m benchmarks.design_repeats [REPEATS]``.

A sphere, a step, a flat patch and a cube on its corner stand in the middle of the volume. Each repeat has new images of the jig, a
calibration of its own, and new noise on the frames of each scan. Printed is the uncertainty that `scope design` predicts (without
what all calibrations have alike) over the scatter of the repeats. Everything is fitted here, by least squares as it is predicted.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from benchmarks.design import sessions
from benchmarks.shared import head, row
from calibration.geometry import Array, Pose
from ranging.motion import Linear
from scope.calibrating import calibrate
from scope.design import design_rig
from scope.scanning import Scanner
from scope.simulation import RigDesign, VirtualRig
from scope.simulation.hardware_design import CameraDesign, JigDesign, LaserDesign
from scope.simulation.object_design import MotionDesign, SphereDesign
from scope.simulation.solids import Box, Part, Scene, Sheet, Sphere

STEP = 1.0  # mm from frame to frame
STEEPEST = 0.5  # cosine, to camera and laser, as predicted
RADIUS, EDGE, PATCH, HEIGHT = 20.0, 40.0, 10.0, 10.0  # mm, as predicted


def designed() -> RigDesign:
    """A small rig whose object moves along y."""
    return RigDesign(
        camera=CameraDesign((640, 480), 900.0, (319.5, 239.5), blur_px=0.7),
        laser=LaserDesign((0.0, -170.0, 0.0), (0.0, 0.0, 400.0), width=0.35, peak=150.0),
        jig=JigDesign((360.0, 390.0, 410.0, 440.0), 13, 17, 13.0, 5.5, fiducials=((6, 8), (6, 10), (3, 8)), fiducial_diameter=8.2),
        objects=(SphereDesign(radius=RADIUS, origin=(0.0, 0.0, 400.0)),),
        motion=MotionDesign("linear", frames=2, direction=(0.0, 1.0, 0.0), step=STEP),
    )  # fmt: skip


def scenes(middle: Array) -> dict[str, Scene]:
    """Each object about the middle of the volume, at position 0."""
    at = Pose(np.eye(3), middle)
    side = PATCH / 2
    low, high = (
        Part(Box((x - side, -side, z), (x + side, side, z + 30.0)), at)
        for x, z in ((-side - 1.0, HEIGHT / 2), (side + 1.0, -HEIGHT / 2))
    )
    return {
        "sphere": Scene((Part(Sphere(RADIUS), at),)),
        "step": Scene((low, high)),
        "Sq": Scene((Part(Sheet((PATCH, PATCH)), at),)),
        "pose": Scene((Part(Box((-EDGE / 2,) * 3, (EDGE / 2,) * 3), Pose(_faces().T, middle)),)),
    }


def _faces() -> Array:
    """Normals (3, 3) of the three faces that the cube turns to the camera, as predicted; a right-handed set."""
    azimuth = 2 * np.pi * np.arange(3) / 3 + 0.3
    normals = np.column_stack(
        [np.sqrt(2 / 3) * np.cos(azimuth), np.sqrt(2 / 3) * np.sin(azimuth), -np.sqrt(1 / 3) * np.ones(3)]
    )
    return normals if np.linalg.det(normals) > 0 else normals[::-1]


def frames_of(rig: VirtualRig, scene: Scene, reach: float) -> tuple[list[Array], float]:
    """Light of every frame of a scan by +-reach mm, and the position of the first."""
    at = np.arange(-reach, reach + STEP / 2, STEP)
    return [rig.stripe_light(scene.moved(Pose(np.eye(3), np.array([0.0, s, 0.0])))) for s in at], float(at[0])


def measured(name: str, points: Array, middle: Array, toward: Array) -> Array:
    """What one measures of points (N, 3): a diameter, a height, Sq, or a small motion (6,)."""
    off = points - middle
    if name == "sphere":
        normal = off / np.linalg.norm(off, axis=1)[:, None]
        use = (normal @ toward.T < -STEEPEST).all(axis=1)
        rows = np.column_stack([normal[use], np.ones(use.sum())])
        return np.array([2 * np.linalg.lstsq(rows, np.linalg.norm(off[use], axis=1) - RADIUS, rcond=None)[0][3]])
    inner = PATCH / 2 - 0.6
    if name == "step":
        levels = [off[(np.abs(off[:, 0] - x) < inner) & (np.abs(off[:, 1]) < inner), 2].mean() for x in (-PATCH / 2 - 1.0, PATCH / 2 + 1.0)]  # fmt: skip
        return np.array([levels[0] - levels[1]])
    if name == "Sq":
        use = (np.abs(off[:, :2]) < inner).all(axis=1)
        rows = np.column_stack([off[use, :2], np.ones(use.sum())])
        return np.array([np.std(off[use, 2] - rows @ np.linalg.lstsq(rows, off[use, 2], rcond=None)[0])])
    normals = _faces()
    height = off @ normals.T
    face = np.abs(height - EDGE / 2).argmin(axis=1)
    aside = np.sort(np.abs(height), axis=1)[:, 1]  # the larger of the two other coordinates
    use = (np.abs(height[np.arange(len(off)), face] - EDGE / 2) < 0.5) & (aside < EDGE / 2 - 1.0)
    n = normals[face[use]]
    rows = np.hstack([n, np.cross(off[use], n)])
    return np.asarray(np.linalg.lstsq(rows, height[np.arange(len(off)), face][use] - EDGE / 2, rcond=None)[0])


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    rng = np.random.default_rng(140)
    design = designed()
    predicted = design_rig(design)
    rig = VirtualRig.of(replace(design, jig=replace(design.jig, images=1, laser_images=1)))
    expected = design_rig(rig.design).expected
    inside = predicted.area.prediction.inside
    middle = np.median(predicted.area.prediction.points[inside], axis=0)
    light = np.cross(rig.laser.along, rig.laser.normal)
    light = light * np.sign(light[2])
    toward = np.stack([middle / np.linalg.norm(middle), light])
    reach = {"sphere": 21.0, "step": 8.0, "Sq": 6.0, "pose": 34.0}
    rendered = {name: frames_of(rig, scene, reach[name]) for name, scene in scenes(middle).items()}
    found: dict[str, list[Array]] = {name: [] for name in rendered}
    for _ in range(count):
        scanner = Scanner(calibrate(sessions(rig, rng, 1)[0]).rig)
        for name, (lights, start) in rendered.items():
            images = [rig.exposed(each, rng, laser=True) for each in lights]
            cloud = scanner.scan(images, Linear((0.0, 1.0, 0.0), STEP, start=start))
            found[name].append(measured(name, cloud.points, middle, toward))
    head("measured", "predicted, um", f"scatter of {count}, um", "ratio", "reach", "")
    for name, values in found.items():
        part = expected[name]
        told = part["sigma_mm"]
        if "constant_mm" in part:
            told = float(np.sqrt(max(told**2 - part["constant_mm"] ** 2, 0.0)))
        scatter = float(np.sqrt(np.sum(np.var(np.array(values)[:, :3], axis=0, ddof=1))))
        ratio = told / scatter
        row(name, 1e3 * told, 1e3 * scatter, ratio, "0.8 to 1.25", "met" if 0.8 <= ratio <= 1.25 else "**missed**")


if __name__ == "__main__":
    main()
