"""Rough coupons of simulated rigs, from images to Sq, over their true heights: ``python -m benchmarks.roughness_rigs [DIR]``.

Rigs of different optics, stripes, pitches and correlation lengths, simulated, calibrated and scanned as users do it; what is
in DIR already is not made again. The truth is the coupon's height map where the cloud has points, levelled by its own
plane. Nothing in the program was fitted to these figures.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from scope.calibrating import calibrate
from scope.cloud import ScanCloud
from scope.roughness import measure_roughness
from scope.scanning import scan
from scope.simulation.session import read_design, simulate

# name: camera, laser and jig; coupons: x, y, z, side, Sq, correlation (mm), tilt (degrees); base; motion
RIGS: dict[str, tuple[str, list[tuple[float, ...]], float, str]] = {
    "0.21 mm/px, stripe 0.35": (
        """[camera]
size = [1280, 960]
focal_px = 2000.0
centre_px = [633.0, 488.0]
distortion = [-0.15, 0.05, -0.0003, 0.0005, 0.0]
[laser]
origin = [0.0, -170.0, 10.0]
through = [0.0, 0.0, 420.0]
roll = 1.5
width = 0.35
[jig]
stand_offs = [370, 400, 430, 460]
pitch = 8.0
diameter = 3.0
fiducial_diameter = 4.5
""",
        [(-70, 15, 425, 30, 0.1, 1.75, 0), (-35, 15, 425, 30, 0.1, 3.5, 0), (0, 15, 425, 30, 0.1, 5.0, 0),
         (35, 15, 425, 30, 0.1, 8.0, 0)],
        432.0,
        "step = 0.2\nstart = -17.0\nframes = 170",
    ),
    "0.06 mm/px, stripe 0.08, speckle": (
        """[camera]
size = [1280, 960]
focal_px = 3500.0
centre_px = [633.0, 488.0]
distortion = [-0.15, 0.05, -0.0003, 0.0005, 0.0]
blur_px = 0.7
[laser]
origin = [0.0, -90.0, 10.0]
through = [0.0, 0.0, 200.0]
roll = 1.5
width = 0.08
speckle = 0.1
[jig]
stand_offs = [180, 193, 206, 219]
pitch = 2.4
diameter = 1.0
fiducial_diameter = 1.5
""",
        [(-22, 7, 202, 14, 0.03, 0.4, 0), (-7, 7, 202, 14, 0.03, 0.8, 0), (8, 7, 202, 14, 0.05, 1.6, 0)],
        206.0,
        "step = 0.08\nstart = -8.0\nframes = 200",
    ),
    "0.21 mm/px, stripe 0.7, tilted": (
        """[camera]
size = [1024, 768]
focal_px = 1400.0
centre_px = [505.0, 392.0]
distortion = [-0.15, 0.05, -0.0003, 0.0005, 0.0]
[laser]
origin = [0.0, -110.0, 10.0]
through = [0.0, 0.0, 300.0]
roll = 1.5
width = 0.7
[jig]
stand_offs = [260, 285, 310, 335]
pitch = 7.0
diameter = 2.5
fiducial_diameter = 3.75
""",
        [(-52, 16, 302, 32, 0.15, 3.5, 12), (-16, 16, 302, 32, 0.15, 7.0, 0), (20, 16, 302, 32, 0.15, 12.0, -12)],
        315.0,
        "step = 0.3\nstart = -19.0\nframes = 127",
    ),
    "0.21 mm/px, stripe 0.35, steep": (
        "",
        [(-70, 15, 425, 30, 0.1, 0.9, 0), (-35, 15, 425, 30, 0.4, 1.75, 0), (0, 15, 425, 30, 0.5, 3.5, 0),
         (35, 15, 425, 30, 0.03, 1.3, 0)],
        432.0,
        "step = 0.2\nstart = -17.0\nframes = 170",
    ),
    "0.21 mm/px, stripe 0.35, speckle of 0.5": (
        "speckle = 0.5\ngrain = 1.5\n",
        [(-70, 15, 425, 30, 0.1, 1.75, 0), (-35, 15, 425, 30, 0.1, 3.5, 0), (0, 15, 425, 30, 0.05, 3.5, 0),
         (35, 15, 425, 30, 0.05, 5.0, 0)],
        432.0,
        "step = 0.2\nstart = -17.0\nframes = 170",
    ),
}  # fmt: skip
SEEDS = (1, 5, 8, 11, 15)  # of each rig's first coupon
MARGIN = 1.5  # mm from a coupon's border


class Coupon:
    """The region over a coupon, off its borders and within 1.2 mm of its surface."""

    def __init__(self, cloud_from_model: NDArray[np.float64], side: float) -> None:
        self.model_from_cloud = np.linalg.inv(cloud_from_model)
        self.side = side

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) mm in the coupon's own frame."""
        return points @ self.model_from_cloud[:3, :3].T + self.model_from_cloud[:3, 3]

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mask (N,) of points (N, 3) mm in the cloud frame."""
        local = self.local(points)
        inside = (local[:, :2] > MARGIN) & (local[:, :2] < self.side - MARGIN)
        return np.asarray(inside.all(axis=1) & (np.abs(local[:, 2]) < 2.5))


def design(name: str) -> str:
    head, coupons, base, motion = RIGS[name]
    if not head.startswith("[camera]"):  # the first rig, with something more about its laser
        head = RIGS["0.21 mm/px, stripe 0.35"][0].replace("[jig]\n", f"{head}[jig]\n")
    grid = "rows = 15\ncolumns = 21\nfiducials = [[7, 10], [7, 12], [4, 10]]\n"
    objects = "".join(
        f'[[object]]\nsolid = "rough"\nsize = [{side}, {side}]\nSq = {sq}\ncorrelation = {length}\nseed = {seed}\n'
        f"origin = [{x}, {y}, {z}]\nrotation = [{180 + tilt}, 0.0, 0.0]\n"
        for seed, (x, y, z, side, sq, length, tilt) in enumerate(coupons, SEEDS[list(RIGS).index(name)])
    )
    plane = f'[[object]]\nsolid = "plane"\norigin = [0.0, 0.0, {base}]\n'
    return f'format = 1\n{head}{grid}{objects}{plane}[motion]\nkind = "linear"\ndirection = [0, 1, 0]\n{motion}\n'


def cloud_of(name: str, folder: Path) -> ScanCloud:
    """Cloud of a rig, made if it is not there."""
    made = folder / "cloud.ply"
    if not made.exists():
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "design.toml").write_text(design(name), encoding="utf-8")
        simulate(read_design(folder / "design.toml"), folder / "session", np.random.default_rng(0))
        rig = calibrate(folder / "session" / "calibration.toml").rig
        scan(folder / "session" / "capture.toml", rig).save(made)
    return ScanCloud.load(made)


def main() -> None:
    home = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp())
    print(
        "| rig; correlation length over one sigma of the stripe | points | Sq over true | k = 2 | stripe: mm told, % put back |"
    )
    print("| --- | --- | --- | --- | --- |")
    for number, name in enumerate(RIGS):
        folder = home / f"rig{number}"
        cloud = cloud_of(name, folder)
        truth = json.loads((folder / "session" / "truth" / "truth.json").read_text(encoding="utf-8"))
        for item in truth["object"]:
            if item["solid"] != "rough":
                continue
            coupon = Coupon(np.array(item["cloud_from_model"]), item["size"][0])
            found = measure_roughness(cloud, region=coupon)
            local = coupon.local(found.heights.points[found.heights.known])
            heights = np.load(folder / "session" / "truth" / item["heights"])
            true = map_coordinates(heights, [local[:, 1] / item["spacing"], local[:, 0] / item["spacing"]], order=1)
            plane = np.stack([local[:, 0], local[:, 1], np.ones(len(local))], axis=1)
            sq = float(np.std(true - plane @ np.linalg.lstsq(plane, true, rcond=None)[0]))
            p, width = found.areal["Sq"], cloud.stripe_width[0]
            print(
                f"| {name}; {item['correlation'] / width:.1f} | {len(local)} | {p.value / sq:.4f} | {p.uncertainty / sq:.3f} | "
                f"{width:.3f}, {100.0 * cloud.stripe_corrected[0]:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
