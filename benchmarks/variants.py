"""Is it this part? Scans of variants of six parts against the nominal mesh, beside the fitness of ICP.

    python -m benchmarks.variants [--seeds 2] [--first 0] [--parts bracket,plate] [--kinds 0.98,mirrored,...]

A variant is decidable where at least 1 % of the noise-free points of its scan lie further than three sigma and the tolerance
from the nominal mesh, whatever the pose (robust and plain least squares from the true one, the better of the two). The peer is
open3d's point-to-plane ICP with Tukey's weight from the true pose, which accepts where at least 99 % of the points lie within
three sigma and the tolerance; it can name nothing. Scans are made by the ray caster of `benchmarks.parts`, with noise.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass

import numpy as np
import trimesh

from benchmarks import parts
from benchmarks.parts import Part, circle, prisms, rectangle
from benchmarks.shared import head, row
from calibration.geometry import Array, Pose
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.model import Model, Scanned, Surface, Weighting, refine
from scope.model.model import prepare_model
from scope.optional import import_open3d
from scope.pose import PoseResult, estimate_pose
from scope.pose.estimate import PoseOptions

SEED = 910_000
NOISE, TOLERANCE, POINTS = 0.03, 0.1, 20_000  # mm, mm
KINDS = ("0.98", "0.99", "1.01", "1.02", "mirrored", "hole", "boss", "thickness", "within")
NAMES = {
    "0.98": {"scale"}, "0.99": {"scale"}, "1.01": {"scale"}, "1.02": {"scale"}, "mirrored": {"mirrored"}, "hole": {"hole"},
    "boss": {"missing"}, "thickness": {"dimension"},
}  # fmt: skip


@dataclass(frozen=True)
class Change:
    """What is different from nominal."""

    hole: float = 0.0  # mm
    boss: bool = True
    thick: float = 0.0  # mm


def bracket(change: Change) -> tuple[Array, Array]:
    """The bracket of `benchmarks.parts`, its foot thicker, a hole shifted, the boss gone."""
    regions = [
        (rectangle(0, 58, 100, 70), 0.0, 35.0),
        (rectangle(0, 58, 62, 70), 0.0, 58.0),
        (rectangle(20, 40, 28, 58), 0.0, 30.0),
        *([(circle(72, 30, 13), 0.0, 24.0)] if change.boss else []),
        (circle(72, 30, 7), 0.0, 0.0),
        (circle(16 + change.hole, 18, 6), 0.0, 0.0),
        (rectangle(36, 10, 44, 32), 0.0, 0.0),
        (rectangle(84, 0, 100, 16), 0.0, 5.0),
    ]
    return prisms(rectangle(0, 0, 100, 70), regions, 0.0, 12.0 + change.thick)


def plate(change: Change) -> tuple[Array, Array]:
    """A plate with holes, a pocket and a small boss."""
    holes = [(circle(x, y, 5), 0.0, 0.0) for x, y in ((15, 15), (15, 85), (85, 85))]
    holes.append((circle(85 - change.hole, 15, 5), 0.0, 0.0))
    boss = [(circle(40, 30, 9), 0.0, 18.0)] if change.boss else []
    regions = [*holes, (circle(70, 50, 3, n=32), 0.0, 0.0), (rectangle(30, 62, 46, 72), 0.0, 6.0), *boss]
    return prisms(rectangle(0, 0, 100, 100), regions, 0.0, 10.0 + change.thick)


def bar(change: Change) -> tuple[Array, Array]:
    """A bar of 120 mm with a step, a hole and a round boss."""
    boss = [(circle(92, 10, 6), 0.0, 18.0)] if change.boss else []
    regions = [(rectangle(0, 0, 30, 20), 0.0, 20.0 + change.thick), (circle(55 + change.hole, 9, 4), 0.0, 0.0), *boss]
    return prisms(rectangle(0, 0, 120, 20), regions, 0.0, 12.0)


def clip(change: Change) -> tuple[Array, Array]:
    """A clip: two legs of different height on a web, lopsided."""
    boss = [(circle(24, 22, 5), 0.0, 10.0)] if change.boss else []
    regions = [
        (rectangle(0, 0, 5, 30), 0.0, 26.0),
        (rectangle(43, 6, 48, 30), 0.0, 18.0),
        (circle(16, 10 + change.hole, 4), 0.0, 0.0),
        *boss,
    ]
    return prisms(rectangle(0, 0, 48, 30), regions, 0.0, 4.0 + change.thick)


def flange(change: Change) -> tuple[Array, Array]:
    """A round flange with a hub, three unequal holes and a key."""
    turn = change.hole / 26
    holes = [(26 * np.cos(a), 26 * np.sin(a), r) for a, r in ((0.3 + turn, 4.5), (2.2, 4.5), (4.4, 3.5))]
    hub = [(circle(0, 0, 14, n=64), 0.0, 26.0)] if change.boss else []
    regions = [
        *hub,
        (circle(0, 0, 8, n=48), 0.0, 0.0),
        *((circle(x, y, r, n=40), 0.0, 0.0) for x, y, r in holes),
        (rectangle(18, -22, 26, -14), 0.0, 14.0),
    ]
    return prisms(circle(0, 0, 38, n=96), regions, 0.0, 8.0 + change.thick)


def casting(change: Change) -> tuple[Array, Array]:
    """The casting of `benchmarks.parts` with a lump of its own in the role of the boss."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    direction = np.asarray(ball.vertices)
    radius = np.linalg.norm(parts.casting().vertices, axis=1)
    if change.boss:
        unit = np.array([0.5, -0.6, -0.6]) / np.linalg.norm([0.5, -0.6, -0.6])
        radius = radius + 7.0 * np.exp(30.0 * (direction @ unit - 1))
    return direction * radius[:, None], np.asarray(ball.faces, dtype=np.int64)


PARTS = {"bracket": bracket, "plate": plate, "bar": bar, "clip": clip, "flange": flange, "casting": casting}


def made(name: str, kind: str, rng: np.random.Generator) -> Part | None:
    """A part as it was really made; None where it has no such variant."""
    if name == "casting" and kind in ("hole", "thickness"):
        return None
    change = {"hole": Change(hole=2.0), "boss": Change(boss=False), "thickness": Change(thick=1.0)}.get(kind, Change())
    vertices, faces = PARTS[name](change)
    if kind == "mirrored":
        return Part(name, vertices * [-1.0, 1.0, 1.0], faces[:, ::-1])
    if kind == "within":
        return Part(name, within(vertices, name, rng), faces)
    factor = float(kind) if kind[0].isdigit() else 1.0
    return Part(name, vertices * factor, faces)


def within(vertices: Array, name: str, rng: np.random.Generator) -> Array:
    """The part with every face off by up to the tolerance: each level of x, y and z by itself (the casting: smoothly)."""
    if name == "casting":
        unit = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
        wave = np.sin(unit @ rng.normal(size=(3, 3)) * 2 + rng.uniform(0, 6, 3)).sum(axis=1) / 3
        return vertices + TOLERANCE * wave[:, None] * unit
    moved = vertices.copy()
    for axis in range(3):
        value, count = np.unique(np.round(vertices[:, axis], 4), return_counts=True)
        levels = value[count >= (4 if axis < 2 else 2)]
        if len(levels):
            shift = rng.uniform(-TOLERANCE, TOLERANCE, len(levels))
            moved[:, axis] += np.interp(vertices[:, axis], levels, shift)
    return moved


def scan(part: Part, rng: np.random.Generator) -> tuple[ScanCloud, Pose, Array]:
    """A scan, the true pose and the noise-free points."""
    pose = parts.random_pose(part, rng)
    cloud = parts.scan(part, pose, rng, scanner=parts.Scanner(noise=NOISE, points=POINTS))
    reach = 0.5 * float(np.linalg.norm(np.ptp(part.vertices, axis=0))) + 14.0
    return cloud, pose, parts.sweep([(part, pose)], 0.8, reach)[0]


def misfit(surface: Surface, clean: Array, truth: Pose) -> float:
    """Share of noise-free points further than three sigma and the tolerance off, at the best pose that is found."""
    sigma = np.full(len(clean), NOISE)
    shares = []
    for tails in (6.0, 1e3):
        weighting = Weighting(0.05, tails, borders=True)
        fit = refine(surface, truth, Scanned(clean, sigma, None), reach=(3.0, 3.0, 2.0, 1.0, 1.0), weighting=weighting)
        local = fit.pose.inverse.apply(clean)
        gap = np.linalg.norm(local - surface.nearest(local)[0], axis=1)
        shares.append(float((gap > 3 * NOISE + TOLERANCE).mean()))
    return min(shares)


class Peer:
    """Open3D's point-to-plane ICP with Tukey's weight, from the true pose; its fitness accepts or refuses."""

    def __init__(self, vertices: Array, faces: Array) -> None:
        self.o3d = import_open3d()
        mesh = self.o3d.geometry.TriangleMesh(
            self.o3d.utility.Vector3dVector(vertices), self.o3d.utility.Vector3iVector(faces)
        )
        mesh.compute_triangle_normals()
        self.dense = mesh.sample_points_uniformly(300_000, use_triangle_normal=True)
        self.surface = Surface(vertices, faces)

    def accepts(self, cloud: ScanCloud, start: Pose) -> bool:
        """Whether all but 1 % of the points lie within three sigma and the tolerance."""
        reg = self.o3d.pipelines.registration
        points = self.o3d.geometry.PointCloud(self.o3d.utility.Vector3dVector(cloud.points))
        matrix = start.inverse.matrix
        for reach in (3.0, 1.0, 0.5):
            estimate = reg.TransformationEstimationPointToPlane(reg.TukeyLoss(k=reach))
            matrix = reg.registration_icp(points, self.dense, reach, matrix, estimate).transformation
        local = Pose.from_matrix(matrix, tolerance=1e-3).apply(cloud.points)
        gap = np.linalg.norm(local - self.surface.nearest(local)[0], axis=1)
        return bool((gap < 3 * NOISE + TOLERANCE).mean() >= 0.99)


FEW = PoseOptions(starts=64, candidates=3)


def asked(cloud: ScanCloud, model: Model, near: Pose | None) -> PoseResult | str:
    """The answer, or why there is none; the search may be spared by a pose near the right one."""
    try:
        if near is not None:
            return estimate_pose(cloud, model, initial=near, part_tolerance=TOLERANCE, options=FEW)
        return estimate_pose(cloud, model, part_tolerance=TOLERANCE)
    except MeasurementError as error:
        return str(error)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--talk", action="store_true", help="one line a scan")
    parser.add_argument("--near", action="store_true", help="start at the true pose (not the mirrored ones): quicker")
    told = parser.parse_args()
    count: Counter[tuple[str, str]] = Counter()
    spent: list[float] = []
    for name in told.parts.split(","):
        vertices, faces = PARTS[name](Change())
        model, surface, peer = (
            prepare_model(vertices, faces, name=name),
            Surface(vertices, faces),
            Peer(vertices, faces),
        )
        for kind in told.kinds.split(","):
            for seed in range(told.first, told.first + told.seeds):
                one(name, kind, seed, (model, surface, peer), count, spent, told)
    table(told.kinds.split(","), count)
    print(f"\nseconds a scan, median: {np.median(spent):.2f}")


def one(
    name: str, kind: str, seed: int, known: tuple[Model, Surface, Peer], count: Counter[tuple[str, str]],
    spent: list[float], told: argparse.Namespace,
) -> None:  # fmt: skip
    model, surface, peer = known
    rng = np.random.default_rng(SEED + 1000 * list(PARTS).index(name) + 100 * list(KINDS).index(kind) + seed)
    part = made(name, kind, rng)
    if part is None:
        return
    cloud, truth, clean = scan(part, rng)
    share = min(misfit(surface, clean, start) for start in starts(kind, part, model, truth))
    began = time.perf_counter()
    result = asked(cloud, model, truth if told.near and kind != "mirrored" else None)
    spent.append(time.perf_counter() - began)
    found = not isinstance(result, str) and result.found
    variant = None if isinstance(result, str) else result.variant
    right = variant is not None and variant.kind in NAMES.get(kind, set())
    decidable = share >= 0.01
    count[kind, "scans"] += 1
    count[kind, "decidable"] += decidable
    count[kind, "accepted"] += decidable and found
    count[kind, "named"] += decidable and right
    count[kind, "kept"] += found
    count[kind, "peer"] += decidable and peer.accepts(cloud, truth)
    count[kind, "peer kept"] += peer.accepts(cloud, truth) if kind == "within" else 0
    if told.talk:
        why = result if isinstance(result, str) else result.why
        word = f"{variant.kind} {variant.size:.3g}+-{variant.standard_error:.2g}" if variant else "-"
        print(
            f"{name:8} {kind:9} {seed} off {100 * share:5.1f} % {'found' if found else 'refused':8} {word:26} {why[:110]}"
        )


def starts(kind: str, part: Part, model: Model, truth: Pose) -> list[Pose]:
    """True poses of the nominal part in a variant's scan; the mirror image has none, so that the likenesses are tried."""
    if kind != "mirrored":
        return [truth]
    middle = 0.5 * (model.vertices.min(axis=0) + model.vertices.max(axis=0))
    own = 0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0))
    turns = [np.eye(3)] + [2 * np.outer(a, a) - np.eye(3) for a in np.eye(3)]
    return [Pose(truth.rotation @ t, truth.apply(own) - truth.rotation @ t @ middle) for t in turns]


def table(kinds: list[str], count: Counter[tuple[str, str]]) -> None:
    head("variant", "scans", "decidable", "accepted though decidable", "named rightly", "ICP fitness accepts", "kept")
    for kind in kinds:
        n = {k: count[kind, k] for k in ("scans", "decidable", "accepted", "named", "peer", "kept", "peer kept")}
        if kind == "within":
            row("within 0.1 mm", n["scans"], "-", "-", "-", f"{n['peer kept']} kept", f"{n['kept']} of {n['scans']}")
        else:
            row(kind, n["scans"], n["decidable"], n["accepted"], n["named"], n["peer"], n["kept"])


if __name__ == "__main__":
    main()
