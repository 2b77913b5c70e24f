"""A part from six poses of a robot, merged: a sphere of 40 mm, all around.

    python -m benchmarks.six_scans [--draws 10]

Each scan sees a cap of the sphere from its own side with points of 0.03 mm; the robot's pose of each scan errs by 0.02 mm and 0.005 degrees,
hand and eye by 0.02 mm and 0.005 degrees in all; both are in sigma_cal. Merged in the base's frame (`scope merge --poses same`), checked as a sphere.
"""

from __future__ import annotations

import argparse

import numpy as np

from calibration.geometry import Pose
from scope.check import check_artefact, rays_of
from scope.cloud import ScanCloud, Sensors
from scope.merge import merge

NOISE, MM, RAD, RADIUS = 0.03, 0.02, float(np.deg2rad(0.005)), 20.0


def small(rng: np.random.Generator) -> Pose:
    return Pose.from_rotation_vector(rng.normal(0, RAD, 3), rng.normal(0, MM, 3))


def scan(direction: np.ndarray, centre: np.ndarray, hand: Pose, rng: np.random.Generator) -> ScanCloud:
    """Cap seen from 200 mm away along ``direction``, in the base's frame, with what hand, eye and robot err by."""
    out = rng.normal(size=(20_000, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    camera = centre + 220.0 * direction
    points = centre + RADIUS * out
    ray = points - camera
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    on = (out * -ray).sum(axis=1) > 0.35
    points, ray = points[on][:4000], ray[on][:4000]
    n = len(points)
    turn = np.linalg.svd(direction[None])[2]
    of_c = Pose(turn[[1, 2, 0]].T * np.sign(np.linalg.det(turn[[1, 2, 0]])), camera)
    wrong = of_c @ hand @ small(rng) @ of_c.inverse  # both err in the sensor's frame
    found = wrong.apply(points + NOISE * rng.normal(size=(n, 1)) * ray)
    lever = np.cross(points - camera, ray)
    sigma_cal = np.sqrt(2.0 * (MM**2 + RAD**2 * (lever**2).sum(axis=1)))
    bare = ScanCloud.from_points(found)
    sensors = Sensors(
        np.zeros(1, np.int32), np.zeros(1, np.uint8), camera[None], np.array([[1.0, 0, 0, 0]]), np.full((1, 3), np.nan)
    )
    return ScanCloud(
        points=bare.points, intensity=bare.intensity, sigma=np.full(n, NOISE, np.float32), sigma_cal=sigma_cal.astype(np.float32),
        pixels=bare.pixels, frame=bare.frame, laser=bare.laser, sensors=sensors, camera_centre=np.zeros(3), verified=True,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=10)
    asked = parser.parse_args()
    centre = np.array([500.0, 100.0, 80.0])
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    error, claim, ratio, gap = [], [], [], []
    for seed in range(asked.draws):
        rng = np.random.default_rng(seed)
        hand = small(rng)
        scans = [scan(d, centre, hand, rng) for d in sides]
        merged = merge(scans, [f"s{k}" for k in range(6)], poses=[Pose.identity()] * 6)
        if merged.cloud is None:
            print(seed, "refused:", merged.why)
            continue
        check = check_artefact(merged.cloud, "sphere:d=40")
        (size,) = check.sizes
        arm = merged.cloud.points - centre
        length = np.linalg.norm(arm, axis=1)
        _, ray = rays_of(merged.cloud)
        across = np.abs((arm * ray).sum(axis=1)) / length
        sigma = np.hypot(
            merged.cloud.sigma * across, merged.cloud.sigma_cal
        )  # a pose moves a point across its ray, too
        off = length - length.mean()
        error.append(size.error / 2)
        claim.append(size.uncertainty / 2)
        ratio.append(float(np.sqrt(np.mean((off / sigma) ** 2))))
        gap.append(merged.disagreement_mm)
    inside = np.abs(error) <= np.array(claim)
    print(
        f"radius of a sphere of 40 mm from six merged scans, {len(error)} draws: error rms {np.sqrt(np.mean(np.square(error))):.4f} mm, stated U (k = 2) "
        f"{np.median(claim):.4f}; within stated {int(inside.sum())} of {len(inside)}; rms over sigma {np.median(ratio):.2f} (reach 0.8 to 1.25)"
    )


if __name__ == "__main__":
    main()
