"""Poses of three parts against Open3D's features, RANSAC and ICP, on the same scans in the same run.

    python -m benchmarks.pose                                a short run of everything
    python -m benchmarks.pose run STORE --part plate --first 0 --count 100 [--peer 20]
    python -m benchmarks.pose summary STORE...               rows for RESULTS.md from stored runs
    python -m benchmarks.pose clutter STORE --part plate --first 0 --count 50 [--peer 20]
    python -m benchmarks.pose covariance --part bracket [--repeats 100] [--within]
    python -m benchmarks.pose wrong

Right means less than 1 degree and 0.5 mm (at the middle of the part). A flagged view is undecidable where the truth shows
it: noise-free scans of the part at the true pose and at the rival lie on the other's surface, but for 1 point in 1000,
within three times the noise. Times are CPU time of one thread each; start with OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.stats import beta

from benchmarks import parts
from benchmarks.variants import within
from calibration.geometry import Array, Pose
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.model import Model, Surface, angle_between
from scope.model.model import prepare_model
from scope.optional import import_open3d
from scope.pose import estimate_pose
from scope.pose.estimate import PoseOptions

PARTS = {"bracket": parts.bracket, "plate": parts.plate, "casting": parts.casting}
SEED = 120_000
FEW = PoseOptions(starts=64, candidates=2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "work", nargs="?", default="all", choices=["all", "run", "clutter", "summary", "covariance", "wrong"]
    )
    parser.add_argument("stores", nargs="*", type=Path)
    parser.add_argument("--part", default="bracket", choices=list(PARTS))
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--peer", type=int, default=0, help="let the peer see the scans with a number below this")
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--within", action="store_true", help="covariance: parts made within 0.1 mm of their mesh")
    told = parser.parse_args()
    if told.work in ("run", "clutter"):
        for record in runs(told.part, range(told.first, told.first + told.count), told.peer, told.work == "clutter"):
            with told.stores[0].open("a") as out:
                out.write(json.dumps(record) + "\n")
    elif told.work == "summary":
        summary([json.loads(line) for store in told.stores for line in store.read_text().splitlines()])
    elif told.work == "covariance":
        covariance(told.part, told.repeats, made_within=told.within)
    elif told.work == "wrong":
        wrong_models()
    else:
        for cluttered in (False, True):
            summary([r for name in PARTS for r in runs(name, range(told.count), told.count, cluttered)])
        for name in PARTS:
            covariance(name, 30)
        wrong_models()


# --- one scan ------------------------------------------------------------------------------------------------------


def runs(name: str, numbers: range, peer: int, cluttered: bool) -> Any:
    """One record a scan: our answer and, for the first ``peer`` scans, the peer's."""
    part = PARTS[name]()
    began = time.process_time()
    model = prepare_model(part.vertices, part.faces, name=name)
    prepared = time.process_time() - began
    rival = Peer(part) if any(n < peer for n in numbers) else None
    warm = make_scan(part, SEED - 1, cluttered)[0]
    estimate_pose(warm, model)  # compiled code is loaded outside the clock
    for number in numbers:
        cloud, truth, clutter = make_scan(part, SEED + number, cluttered)
        record = {
            "part": name,
            "number": number,
            "clutter": cluttered,
            "prepare": prepared,
            **ours(part, model, cloud, truth, clutter),
        }
        if rival is not None and number < peer:
            began = time.process_time()
            pose = rival.locate(cloud)
            turn, shift = errors(part, pose, truth)
            record |= {"peer_turn": turn, "peer_shift": shift, "peer_time": time.process_time() - began}
        yield record


Clutter: TypeAlias = tuple[tuple[parts.Part, Pose], ...]


def make_scan(part: parts.Part, seed: int, cluttered: bool) -> tuple[ScanCloud, Pose, Clutter]:
    rng = np.random.default_rng(seed)
    pose = parts.random_pose(part, rng)
    clutter = parts.clutter_about(part, pose, rng) if cluttered else ()
    return parts.scan(part, pose, rng, clutter=clutter, stray=0.02 if cluttered else 0.0), pose, clutter


def ours(part: parts.Part, model: Model, cloud: ScanCloud, truth: Pose, clutter: Clutter = ()) -> dict[str, Any]:
    began = time.process_time()
    try:
        result = estimate_pose(cloud, model)
    except MeasurementError as error:
        return {"found": False, "why": str(error), "time": time.process_time() - began, "undecidable": False}
    spent = time.process_time() - began
    best = result.cloud_from_model or (result.candidates[0].cloud_from_model if result.candidates else None)
    record: dict[str, Any] = {"found": result.found, "why": result.why, "score": min(result.score, 1e9), "time": spent}
    if best is not None:
        record["turn"], record["shift"] = errors(part, best, truth)
    record["undecidable"] = False
    if not result.found:
        rivals = [c.cloud_from_model for c in result.candidates if not right(*errors(part, c.cloud_from_model, truth))]
        rivals += [truth @ likeness for likeness in model.likenesses]
        record["undecidable"] = undecidable(part, truth, rivals, clutter=clutter)
    return record


def errors(part: parts.Part, pose: Pose, truth: Pose) -> tuple[float, float]:
    """Degrees, and mm at the middle of the part."""
    middle = 0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0))
    turn = float(np.degrees(angle_between(pose.rotation, truth.rotation)))
    return turn, float(np.linalg.norm(pose.apply(middle) - truth.apply(middle)))


def right(turn: float, shift: float) -> bool:
    return turn < 1.0 and shift < 0.5


def undecidable(
    part: parts.Part, truth: Pose, rivals: list[Pose], *, spacing: float = 0.6, clutter: Clutter = ()
) -> bool:
    """Whether, for some rival, noise-free scans from both poses lie on the other's surface but for 1 point in 1000.

    On it means within 0.3 mm, three times the noise. Clutter hides in both what it hides, and its own points do not count.
    """
    surface = Surface(part.vertices, part.faces)
    reach = 0.5 * float(np.linalg.norm(np.ptp(part.vertices, axis=0))) + 14.0

    def lies(points: Array, pose: Pose) -> bool:
        local = pose.inverse.apply(points)
        gap = np.linalg.norm(surface.nearest(local)[0] - local, axis=1)
        return len(points) > 0 and float((gap > 0.3).mean()) <= 1e-3

    def seen(pose: Pose) -> Array:
        points, _, solid = parts.sweep([(part, pose), *clutter], spacing, reach)
        own: Array = points[solid == 0]
        return own

    mine = seen(truth)
    return any(lies(mine, rival) and lies(seen(rival), truth) for rival in rivals)


class Peer:
    """Open3D as its own tutorial uses it: FPFH features, RANSAC with 100,000 trials, point-to-plane ICP."""

    voxel = 2.0  # mm

    def __init__(self, part: parts.Part) -> None:
        self.o3d = import_open3d()
        mesh = self.o3d.geometry.TriangleMesh(
            self.o3d.utility.Vector3dVector(part.vertices), self.o3d.utility.Vector3iVector(part.faces)
        )
        self.o3d.utility.random.seed(0)
        mesh.compute_triangle_normals()
        self.dense = mesh.sample_points_uniformly(200_000, use_triangle_normal=True)
        self.model = self.dense.voxel_down_sample(self.voxel)
        self.features = self._features(self.model)

    def _features(self, cloud: Any) -> Any:
        search = self.o3d.geometry.KDTreeSearchParamHybrid(radius=5 * self.voxel, max_nn=100)
        return self.o3d.pipelines.registration.compute_fpfh_feature(cloud, search)

    def locate(self, cloud: ScanCloud) -> Pose:
        """Pose cloud_from_model, right or wrong."""
        reg = self.o3d.pipelines.registration
        scan = self.o3d.geometry.PointCloud(self.o3d.utility.Vector3dVector(cloud.points))
        few = scan.voxel_down_sample(self.voxel)
        few.estimate_normals(self.o3d.geometry.KDTreeSearchParamHybrid(radius=2 * self.voxel, max_nn=30))
        few.orient_normals_towards_camera_location(np.zeros(3))
        checks = [
            reg.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            reg.CorrespondenceCheckerBasedOnDistance(1.5 * self.voxel),
        ]
        found = reg.registration_ransac_based_on_feature_matching(
            few, self.model, self._features(few), self.features, True, 1.5 * self.voxel,
            reg.TransformationEstimationPointToPoint(False), 3, checks, reg.RANSACConvergenceCriteria(100_000, 0.999),
        )  # fmt: skip
        matrix = found.transformation
        for reach in (3.0, 1.0, 0.5):
            estimate = reg.TransformationEstimationPointToPlane()
            matrix = reg.registration_icp(scan, self.dense, reach, matrix, estimate).transformation
        return Pose.from_matrix(matrix, tolerance=1e-3).inverse


# --- rows ----------------------------------------------------------------------------------------------------------


def summary(records: list[dict[str, Any]]) -> None:
    """One row a part and kind of scene."""
    print(
        "| scans | right | wrong unflagged (95 % bound) | flagged, undecidable / other | median error | peer right | peer error | time / peer |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for cluttered in (False, True):
        for name in PARTS:
            mine = {r["number"]: r for r in records if r["part"] == name and r["clutter"] == cluttered}
            if mine:
                print(row(name, cluttered, list(mine.values())))


def row(name: str, cluttered: bool, mine: list[dict[str, Any]]) -> str:
    n = len(mine)
    found = [r for r in mine if r["found"]]
    good = [r for r in found if right(r["turn"], r["shift"])]
    wrong = len(found) - len(good)
    flagged = [r for r in mine if not r["found"]]
    hopeless = sum(r["undecidable"] for r in flagged)
    upper = 1.0 if wrong == n else float(beta.ppf(0.95, wrong + 1, n - wrong))
    error = (
        f"{np.median([r['turn'] for r in good]):.4f} deg, {np.median([r['shift'] for r in good]):.4f} mm"
        if good
        else "-"
    )
    met = [r for r in mine if "peer_turn" in r]
    theirs = [r for r in met if right(r["peer_turn"], r["peer_shift"])]
    peer = f"{len(theirs)}/{len(met)}" if met else "-"
    peer_error = "-"
    if theirs:
        peer_error = f"{np.median([r['peer_turn'] for r in theirs]):.4f} deg, {np.median([r['peer_shift'] for r in theirs]):.4f} mm"
    ratio = f"{np.median([r['time'] for r in met]) / np.median([r['peer_time'] for r in met]):.2f}" if met else "-"
    scene = f"{name}, {'clutter' if cluttered else 'alone'} ({n})"
    return (
        f"| {scene} | {len(good)} | {wrong} (< {100 * upper:.2f} %) | {hopeless} / {len(flagged) - hopeless} | {error} | {peer} | "
        f"{peer_error} | {ratio} |"
    )


def covariance(name: str, repeats: int, *, made_within: bool = False) -> None:
    """Scatter of repeats with noise and calibration redrawn, over the standard deviation claimed, by direction.

    With ``made_within`` each repeat scans another part, every face of it off by up to 0.1 mm, against the nominal mesh.
    """
    part = PARTS[name]()
    model = prepare_model(part.vertices, part.faces, name=name)
    calibration = np.diag([0.02, 2e-4, 2e-4]) ** 2
    scanner = parts.Scanner(points=20_000, calibration=calibration)
    pose = parts.random_pose(part, np.random.default_rng(SEED))
    scale = np.array([1, 1, 1, *[model.diameter / 2] * 3])
    middle = pose.apply(model.centre)
    moves, claims = [], []
    for k in range(repeats):
        rng = np.random.default_rng(SEED + 1 + k)
        scanned = parts.Part(name, within(part.vertices, name, rng), part.faces) if made_within else part
        cloud = parts.scan(scanned, pose, rng, scanner=scanner)
        result = estimate_pose(cloud, model, initial=pose, options=FEW)  # the search is not what is asked about
        if result.cloud_from_model is None or result.covariance is None:
            continue
        at = about(middle - result.cloud_from_model.translation)
        step = result.cloud_from_model @ pose.inverse
        turn = 0.5 * np.array(
            [
                step.rotation[2, 1] - step.rotation[1, 2],
                step.rotation[0, 2] - step.rotation[2, 0],
                step.rotation[1, 0] - step.rotation[0, 1],
            ]
        )
        moves.append(np.concatenate([step.apply(middle) - middle, turn]) * scale)
        claims.append((at @ result.covariance @ at.T) * np.outer(scale, scale))
    claimed = np.mean(claims, axis=0)
    value, vector = np.linalg.eigh(claimed)
    along = np.array(moves) @ vector
    ratios = ", ".join(f"{s / np.sqrt(v):.2f}" for s, v in zip(along.std(axis=0, ddof=1), value, strict=True))
    truth = ", ".join(f"{s / np.sqrt(v):.2f}" for s, v in zip(np.sqrt((along**2).mean(axis=0)), value, strict=True))
    biases = ", ".join(f"{1000 * b:+.1f}" for b in along.mean(axis=0))
    sizes = ", ".join(f"{1000 * np.sqrt(v):.1f}" for v in value)
    print(
        f"| covariance, {name}{' made within 0.1 mm' if made_within else ''} ({len(moves)} repeats) | scatter / claimed by direction: {ratios} | rms about the truth / claimed: {truth} | claimed, um: {sizes} | "
        f"mean error, um: {biases} | all directions: {np.sqrt(np.mean(along**2 / value)):.2f} |"
    )


def about(arm: Array) -> Array:
    """Matrix (6, 6) from motions about the model's origin to motions about a point ``arm`` mm away."""
    m = np.eye(6)
    x, y, z = arm
    m[:3, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return m


def wrong_models() -> None:
    """Each part's scans with the other parts' meshes: all are to be refused."""
    made = {name: make() for name, make in PARTS.items()}
    models = {name: prepare_model(p.vertices, p.faces, name=name) for name, p in made.items()}
    for name, part in made.items():
        taken, tried = 0, 0
        for k in range(10):
            cloud = make_scan(part, SEED + k, False)[0]
            for other, model in models.items():
                if other != name:
                    tried += 1
                    try:
                        taken += estimate_pose(cloud, model).found
                    except MeasurementError:
                        continue
        print(f"| wrong model, scans of the {name} | {tried - taken} of {tried} refused |")


if __name__ == "__main__":
    main()
