"""Errors of a pose beside the Cramer-Rao bound of its scan and robust point-to-plane ICP, through rendered images.

    python -m benchmarks.pose_bound [--rigs 1] [--first 0] [--scans 3] [--keep FOLDER] [--store FILE] [--residuals]
    python -m benchmarks.pose_bound --summary FILE

Each rig is drawn, rendered with a plane and three of six parts, calibrated and scanned; nothing is taken from the truth but
the regions. The bound is that of least squares with the points' own sigma, all points that are ranged, at the true pose: what nobody
can beat, with no error of calibration and no edges. The peer is open3d's point-to-plane ICP with Tukey's weight (0.1 mm, from
wide to narrow) on the same points. Both begin 0.3 mm and 0.3 degrees beside the truth (SCOPE tries 64 other starts, too).
Rows "no sensor", "no sigma" and "half": the same scan with that taken away. Slices: ``--first`` and ``--rigs`` choose the rigs, ``--store``
gathers one line a scan, ``--summary`` makes the table of all that was stored; ``--residuals`` prints what is left at the true pose.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import parts, variants
from benchmarks.pose import errors
from benchmarks.shared import head, row
from calibration.geometry import Array, Ints, Pose
from scope.calibrating import calibrate
from scope.cloud import Polygon, ScanCloud
from scope.model import Model, Surface
from scope.model.model import prepare_model
from scope.optional import import_open3d
from scope.pose import PoseOptions, estimate_pose
from scope.pose.visibility import seen_of
from scope.refinement import Frame
from scope.refinement.system import rows_at
from scope.scanning import scan
from scope.simulation import read_design, simulate

SEED = 730_000
FEW = PoseOptions(starts=64, candidates=2, part_tolerance=float("inf"))  # the search is no part of this


def bracket() -> tuple[Array, Ints]:
    """A bracket of 50 mm with chamfered corner, boss, hole and two levels."""
    regions = [
        (parts.rectangle(0, 26, 48, 34), 0.0, 16.0),
        (parts.rectangle(0, 0, 10, 8), 0.0, 5.0),
        (parts.circle(16, 14, 6), 0.0, 14.0),
        (parts.circle(16, 14, 3), 0.0, 0.0),
        (parts.circle(38, 10, 4), 0.0, 0.0),
    ]
    return parts.prisms(parts.rectangle(0, 0, 48, 34), regions, 0.0, 9.0)


PARTS = (("bracket", 1.0), ("plate", 0.5), ("casting", 0.5), ("bar", 0.5), ("clip", 1.0), ("flange", 0.65))  # and size


def made(number: int) -> list[parts.Part]:
    """The three parts of a rig: the first three in rigs of even number, the others in odd ones."""
    found = []
    for name, size in PARTS[3 * (number % 2) :][:3]:
        vertices, faces = bracket() if name == "bracket" else variants.PARTS[name](variants.Change())
        found.append(parts.Part(name, size * vertices, faces))
    return found


def design(rng: np.random.Generator, solids: list[parts.Part], home: Path) -> str:
    """A rig and three parts, one nearly flat to the camera, two tilted."""
    focal, base = rng.uniform(1100, 1400), rng.uniform(150, 210)
    objects = ""
    for k, tilt in enumerate((3.0, 22.0, 28.0)):
        lean = Pose.from_rotation_vector(
            np.radians(tilt) * np.append(_unit(rng.normal(size=2)), 0.0), np.zeros(3)
        ).rotation
        spin = Pose.from_rotation_vector([0, 0, rng.uniform(-np.pi, np.pi)], np.zeros(3)).rotation
        rotation = lean @ spin @ np.diag([1.0, -1.0, -1.0])
        middle = np.array([(-75.0, 0.0, 75.0)[k] + rng.uniform(-3, 3), rng.uniform(-4, 4), 405.0])
        vertices = solids[k].vertices
        at = Pose(rotation, middle - rotation @ (0.5 * (vertices.min(axis=0) + vertices.max(axis=0)))).matrix.tolist()
        objects += f'[[object]]\nmesh = "{home / solids[k].name}.stl"\npose = {at}\n'
    return f"""format = 1
[camera]
size = [1280, 800]
focal_px = {focal:.1f}
centre_px = [645.0, 398.0]
distortion = [{rng.uniform(-0.2, 0):.3f}, 0.03, 0.0004, -0.0003, 0.0]
[laser]
origin = [0.0, {-base:.1f}, 8.0]
through = [0.0, 0.0, 400.0]
width = {rng.uniform(0.2, 0.35):.3f}
roll = {rng.uniform(-3, 3):.2f}
[jig]
stand_offs = [340.0, 385.0, 435.0]
rows = 13
columns = 19
pitch = 16.0
diameter = 6.0
fiducials = [[6, 9], [6, 11], [3, 9]]
fiducial_diameter = 9.0
images = 2
laser_images = 1
{objects}
[[object]]
solid = "plane"
origin = [0.0, 0.0, 436.0]
[motion]
kind = "linear"
direction = [0.0, 1.0, 0.0]
start = -33.0
step = 0.6
frames = 110
"""


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True)
class Scan:
    """One part of one rig."""

    name: str  # rig and part
    part: parts.Part
    cloud: ScanCloud  # of all three parts
    truth: Pose  # cloud_from_model


def scans(numbers: range, keep: Path | None, most: int) -> Iterator[Scan]:
    """The parts of the rigs, each with the cloud of its rig."""
    for number in numbers:
        with tempfile.TemporaryDirectory() as scratch:
            home = (keep or Path(scratch)) / f"rig{number}"
            home.mkdir(parents=True, exist_ok=True)
            cloud_file, solids = home / "cloud.ply", made(number)
            if not cloud_file.is_file():
                rng = np.random.default_rng(SEED + number)
                for part in solids:
                    part.mesh().export(home / f"{part.name}.stl")
                (home / "design.toml").write_text(design(rng, solids, home), encoding="utf-8")
                simulate(read_design(home / "design.toml"), home / "session", rng)
                calibrate(home / "session" / "calibration.toml").rig.save(home / "rig.json")
                scan(home / "session" / "capture.toml", home / "rig.json").save(cloud_file)
            truth = json.loads((home / "session" / "truth" / "truth.json").read_text(encoding="utf-8"))
            poses = [Pose.from_matrix(o["cloud_from_model"]) for o in truth["object"] if o.get("mesh")]
            cloud = ScanCloud.load(cloud_file)
            for part, pose in list(zip(solids, poses, strict=True))[:most]:
                yield Scan(f"{number}.{part.name}", part, cloud, pose)


def bound(surface: Surface, cloud: ScanCloud, truth: Pose, centre: Array) -> tuple[float, float]:
    """Cramer-Rao bound: rms turn in degrees and rms shift of the middle in mm.

    Every point counts with its own sigma along the way that its stripe moves it, as if it stood on the face it is nearest to.
    """
    seen = seen_of(cloud, np.arange(len(cloud)), cloud.sigma.astype(np.float64))
    rows = rows_at(surface, truth, seen, Frame(centre, 1.0), 0.5)
    spread = seen.scan.sigma * rows.across
    covariance = np.linalg.inv((rows.jacobian[rows.used].T / spread[rows.used] ** 2) @ rows.jacobian[rows.used])
    return float(np.degrees(np.sqrt(np.trace(covariance[3:, 3:])))), float(np.sqrt(np.trace(covariance[:3, :3])))


def icp(part: parts.Part, points: Array, start: Pose) -> Pose:
    """The peer."""
    o3d = import_open3d()
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(part.vertices), o3d.utility.Vector3iVector(part.faces))
    mesh.compute_triangle_normals()
    o3d.utility.random.seed(0)
    dense = mesh.sample_points_uniformly(300_000, use_triangle_normal=True)
    reg, matrix = o3d.pipelines.registration, start.inverse.matrix
    seen = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    for reach, tail in ((2.0, 1.0), (1.0, 0.5), (0.5, 0.2), (0.5, 0.1), (0.5, 0.1)):
        estimate = reg.TransformationEstimationPointToPlane(reg.TukeyLoss(k=tail))
        matrix = reg.registration_icp(seen, dense, reach, matrix, estimate).transformation
    return Pose.from_matrix(matrix, tolerance=1e-3).inverse


def less(cloud: ScanCloud) -> dict[str, ScanCloud]:
    """The scan, and what is left when something is taken away."""
    n = len(cloud)
    return {
        "all": cloud,
        "no sensor": replace(cloud, sensors=None),
        "no sigma": replace(cloud, sigma=np.full(n, np.nan, dtype=np.float32)),
        "half": cloud.select(np.random.default_rng(0).permutation(n) < n // 2),
    }


def one(which: Scan, model: Model, rng: np.random.Generator) -> dict[str, tuple[float, float, str]]:
    """Errors (degrees, mm, remark) by estimator, and the bound."""
    part, cloud, truth = which.part, which.cloud, which.truth
    corners = truth.apply(part.vertices)
    low, high = corners.min(axis=0) - 3, corners.max(axis=0) + 3
    within = Polygon(np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]))
    surface = Surface(part.vertices, part.faces)
    mine = within.contains(cloud.points) & (cloud.points[:, 2] < high[2])
    local = truth.inverse.apply(cloud.points)
    own = mine & (np.linalg.norm(surface.nearest(local)[0] - local, axis=1) < 3.0)
    taken = cloud.select(own)
    told = {"bound": (*bound(surface, taken, truth, model.centre), f"{int(own.sum())} points")}
    turn = Pose.from_rotation_vector(np.radians(0.3) * _unit(rng.normal(size=3)), np.zeros(3)).rotation
    middle = truth.apply(model.centre)
    start = Pose(turn @ truth.rotation, middle + turn @ (truth.translation - middle) + 0.3 * _unit(rng.normal(size=3)))
    told["ICP, Tukey"] = (*errors(part, icp(part, taken.points, start), truth), "")
    for name, left in less(taken).items():
        found = estimate_pose(left, model, initial=start, options=FEW)
        best = found.cloud_from_model or found.candidates[0].cloud_from_model
        remark = "" if found.found else f"refused: {found.why[:60]}"
        told[name] = (*errors(part, best, truth), "by its borders" if "borders" in found.why else remark)
    return told


def residuals(which: Scan) -> None:
    """Residuals at the true pose by the cosine to the camera and the distance from sharp edges in widths of the stripe."""
    part, cloud, truth = which.part, which.cloud, which.truth
    surface = Surface(part.vertices, part.faces)
    local = truth.inverse.apply(cloud.points)
    taken = cloud.select(np.linalg.norm(surface.nearest(local)[0] - local, axis=1) < 1.0)
    seen = seen_of(taken, np.arange(len(taken)), taken.sigma.astype(np.float64))
    rows = rows_at(surface, truth, seen, Frame(part.vertices.mean(axis=0), 1.0), 0.5)
    stated = seen.scan.sigma * rows.across
    for low, high in ((0.1, 0.3), (0.3, 0.6), (0.6, 0.85), (0.85, 1.01)):
        for near, far in ((0.0, 1.0), (1.0, 2.5), (2.5, 99.0)):
            edge = rows.edge / seen.width
            mine = rows.used & (rows.slope >= low) & (rows.slope < high) & (edge >= near) & (edge < far)
            if mine.sum() >= 20:
                off = rows.residual[mine]
                spread = 1.4826 * float(np.median(np.abs(off - np.median(off))))
                cells = (int(mine.sum()), f"{np.median(off):+.4f}", spread, float(np.median(stated[mine])))
                row(which.name, f"{low:g} to {min(high, 1):g}", f"{near:g} to {far:g}", *cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scans", type=int, default=3, help="of each rig, the first ones")
    parser.add_argument("--keep", type=Path, help="folder in which sessions and clouds are kept for the next time")
    parser.add_argument("--store", type=Path, help="file to which each scan adds a line")
    parser.add_argument("--summary", type=Path, nargs="+", help="no scans: the table of what these files hold")
    parser.add_argument("--residuals", action="store_true", help="no poses: residuals at the truth by slant and edge")
    told = parser.parse_args()
    if told.residuals:
        head(
            "scan",
            "cosine to camera",
            "widths from an edge",
            "points",
            "median, mm",
            "robust scatter, mm",
            "stated, mm",
        )
        for which in scans(range(told.first, told.first + told.rigs), told.keep, told.scans):
            residuals(which)
        return None
    if told.summary:
        return summary([json.loads(line) for file in told.summary for line in file.read_text().splitlines()])
    results: list[dict[str, tuple[float, float, str]]] = []
    head("scan", "estimator", "degrees", "mm", "remark")
    for number in range(told.first, told.first + told.rigs):
        for k, which in enumerate(scans(range(number, number + 1), told.keep, told.scans)):
            model = prepare_model(which.part.vertices, which.part.faces, name=which.part.name)
            results.append(one(which, model, np.random.default_rng(SEED + 10 * number + k)))
            for name, (turn, shift, remark) in results[-1].items():
                row(which.name, name, turn, shift, remark)
            if told.store:
                with told.store.open("a", encoding="utf-8") as out:
                    out.write(json.dumps(results[-1]) + "\n")
    return summary(results)


def summary(results: list[dict[str, tuple[float, float, str]]]) -> None:
    """Medians of ratios over all scans."""
    print(f"\n{len(results)} scans")
    head("estimator", "median error over the bound: turn, shift", "over ICP: turn, shift")
    for name in results[0]:
        if name != "bound":
            cells = [[r[name][i] / r[other][i] for r in results] for other in ("bound", "ICP, Tukey") for i in (0, 1)]
            a, b, c, d = (f"{np.median(v):.2f}" for v in cells)
            row(name, f"{a}, {b}", f"{c}, {d}")


if __name__ == "__main__":
    main()
