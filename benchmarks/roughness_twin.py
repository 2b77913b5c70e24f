"""Roughness of a twin's coupon over that of its true heights: ``python -m benchmarks.roughness_twin TWIN_DIR cloud.ply``.

The truth is the coupon's height map, sampled where the cloud has points, levelled by its own plane.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from scope.cloud import ScanCloud
from scope.roughness import RoughnessOptions, measure_roughness

STRIPE = 0.35  # mm, one sigma of the twin's laser line, from its description


class Coupon:
    """The region within 2 mm of the coupon's border and 3 mm of its surface."""

    def __init__(self, camera_from_model: NDArray[np.float64], side: float) -> None:
        self.model_from_camera = np.linalg.inv(camera_from_model)
        self.side = side

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) mm in the coupon's own frame."""
        return points @ self.model_from_camera[:3, :3].T + self.model_from_camera[:3, 3]

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mask (N,) of points (N, 3) mm in the cloud frame."""
        local = self.local(points)
        inside = (local[:, :2] > 2.0) & (local[:, :2] < self.side - 2.0)
        return np.asarray(inside.all(axis=1) & (np.abs(local[:, 2]) < 3.0))


def main() -> None:
    twin, cloud = Path(sys.argv[1]), ScanCloud.load(sys.argv[2])
    truth = json.loads((twin / "truth" / "truth.json").read_text(encoding="utf-8"))
    coupon = Coupon(np.array(truth["coupon_pose"]), truth["coupon"]["side"])
    heights = np.load(twin / "truth" / "coupon_height.npy")
    per_mm = (len(heights) - 1) / coupon.side
    print(
        "| twin coupon: Sq over that of the true heights on the scanned part (goal 0.99 to 1.01) | raw | noise out | k = 2 | noise floor, mm |"
    )
    print("| --- | --- | --- | --- | --- |")
    for name, width in (("stripe as the cloud tells it", math.nan), (f"a stripe of {STRIPE} mm", STRIPE)):
        found = measure_roughness(cloud, region=coupon, options=RoughnessOptions(stripe_width=width))
        local = coupon.local(found.heights.points[found.heights.known])
        true = map_coordinates(heights, [local[:, 1] * per_mm, local[:, 0] * per_mm], order=1)
        design = np.stack([local[:, 0], local[:, 1], np.ones(len(local))], axis=1)
        sq = float(np.std(true - design @ np.linalg.lstsq(design, true, rcond=None)[0]))
        p = found.areal["Sq"]
        print(
            f"| {name} | {p.raw / sq:.4f} | {p.value / sq:.4f} | {p.uncertainty / sq:.3f} | {found.noise_floor:.4f} |"
        )


if __name__ == "__main__":
    main()
