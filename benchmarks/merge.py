"""Four scans of one part from around it, each in a frame of its own: merged by their shapes alone, beside Open3D's multiway.

    python -m benchmarks.merge [--scenes 100] [--first 0]

Parts: bracket and casting of `benchmarks.parts` and the block of the tests, turned at random; four cameras 300 mm away around it,
35 to 60 degrees above the base; noise 0.02 mm; each scan moved to a frame of its own. Wrong: a scan that is more than
0.5 mm (rms) from its true place.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np
import open3d as o3d
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.parts import bracket, casting
from calibration.geometry import Pose
from scope.merge import merge
from tests.scope.merge.test_merge import moved, part, scan

WRONG = 0.5  # mm


def scene(seed: int):
    rng = np.random.default_rng(seed)
    mesh = [lambda: bracket().mesh(), lambda: casting().mesh(), part][seed % 3]()
    mesh = trimesh.Trimesh(mesh.vertices - mesh.bounding_box.centroid, mesh.faces, process=False)
    half = 0.6 * float(np.linalg.norm(mesh.extents))
    turn = rng.uniform(0, 2 * np.pi)
    scans, away = [], []
    for k in range(4):
        about, up = turn + k * np.pi / 2 + rng.normal(0, 0.15), np.deg2rad(rng.uniform(35, 60))
        view = [np.cos(about) * np.cos(up), np.sin(about) * np.cos(up), np.sin(up)]
        away.append(Pose(Rotation.random(random_state=1000 * seed + k).as_matrix(), rng.normal(0, 100, 3)))
        scans.append(moved(scan(mesh, view, rng, cells=200, half=half), away[-1]))
    return mesh, scans, away


def off(poses, away, mesh) -> float:
    """Rms, mm, of the worst scan's place relative to the first."""
    some = mesh.vertices[:: max(1, len(mesh.vertices) // 200)]
    return max(
        float(np.sqrt((((p @ a).apply(some) - (poses[0] @ away[0]).apply(some)) ** 2).sum(axis=1).mean()))
        for p, a in zip(poses, away, strict=True)
    )


def multiway(scans) -> list[Pose]:
    """As Open3D's tutorials do it: FPFH and RANSAC a pair, point-to-plane ICP, pose graph with pruning of uncertain edges."""
    reg = o3d.pipelines.registration
    size = max(float(np.linalg.norm(np.ptp(c.points, axis=0))) for c in scans)
    voxel = size / 40
    clouds, features = [], []
    for c in scans:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(c.points)).voxel_down_sample(voxel)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2 * voxel, max_nn=30))
        cloud.orient_normals_towards_camera_location(c.sensors.centre[0])
        clouds.append(cloud)
        features.append(
            reg.compute_fpfh_feature(cloud, o3d.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100))
        )
    graph = reg.PoseGraph()
    graph.nodes.append(reg.PoseGraphNode(np.eye(4)))
    odometry = np.eye(4)
    for i in range(4):
        for j in range(i + 1, 4):
            first = reg.registration_ransac_based_on_feature_matching(
                clouds[i], clouds[j], features[i], features[j], True, 1.5 * voxel, reg.TransformationEstimationPointToPoint(False), 3,
                [reg.CorrespondenceCheckerBasedOnEdgeLength(0.9), reg.CorrespondenceCheckerBasedOnDistance(1.5 * voxel)],
                reg.RANSACConvergenceCriteria(100000, 0.999),
            ).transformation  # fmt: skip
            for reach in (1.5 * voxel, 0.4 * voxel):
                first = reg.registration_icp(
                    clouds[i], clouds[j], reach, first, reg.TransformationEstimationPointToPlane()
                ).transformation
            info = reg.get_information_matrix_from_point_clouds(clouds[i], clouds[j], 0.4 * voxel, first)
            if j == i + 1:
                odometry = first @ odometry
                graph.nodes.append(reg.PoseGraphNode(np.linalg.inv(odometry)))
            graph.edges.append(reg.PoseGraphEdge(i, j, first, info, uncertain=j != i + 1))
    option = reg.GlobalOptimizationOption(
        max_correspondence_distance=0.4 * voxel, edge_prune_threshold=0.25, reference_node=0
    )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        reg.global_optimization(
            graph, reg.GlobalOptimizationLevenbergMarquardt(), reg.GlobalOptimizationConvergenceCriteria(), option
        )
    return [Pose.from_matrix(np.asarray(n.pose), tolerance=1e-3) for n in graph.nodes]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    asked = parser.parse_args()
    count, errors, peer, seconds = Counter(), [], [], [0.0, 0.0]
    for seed in range(asked.first, asked.first + asked.scenes):
        mesh, scans, away = scene(seed)
        began = time.perf_counter()
        found = merge(scans, list("abcd"))
        seconds[0] += time.perf_counter() - began
        if found.poses is None or not found.passed:
            count["refused"] += 1
            print(seed, "refused:", found.why[:110], flush=True)
        else:
            error = off(found.poses, away, mesh)
            errors.append(error)
            count["wrong" if error > WRONG else "right"] += 1
            if error > WRONG:
                print(seed, "WRONG", error, flush=True)
        began = time.perf_counter()
        peer.append(off(multiway(scans), away, mesh))
        seconds[1] += time.perf_counter() - began
    right = [e for e in errors if e <= WRONG]
    print(
        f"{asked.scenes} scenes of four scans: {dict(count)}; error of the right ones: median {np.median(right):.4f} mm, worst {max(right):.4f} mm"
    )
    close = [e for e in peer if e <= WRONG]
    print(
        f"Open3D multiway: right {len(close)}, wrong and not flagged {len(peer) - len(close)}; median {np.median(close) if close else np.nan:.4f} mm; time ours / its {seconds[0] / seconds[1]:.1f}"
    )


if __name__ == "__main__":
    main()
