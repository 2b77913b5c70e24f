"""The whole path on the three shared captures, beside what a plain pipeline gets: python -m benchmarks.accuracy."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from benchmarks.shared import head, judge, require, row, twin_capture
from calibration.geometry import Array
from calibration.rig import Rig
from scope.calibrating import Calibration, calibrate
from scope.scanning import run_scan


def exact_pixels(truth: dict[str, list[float]], points: Array) -> Array:
    """Pixels of points (N, 3) by the twin's exact camera (OpenCV's projection)."""
    matrix, distortion = np.array(truth["K"]), np.array(truth["dist"])
    return np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0])


def exact_directions(truth: dict[str, list[float]], pixels: Array) -> Array:
    """Rays (N, 3) of unit depth by the twin's exact camera."""
    flat = cv2.undistortPoints(
        pixels[:, None], np.array(truth["K"]), np.array(truth["dist"]), None, None, None, (3, 200, 1e-15)
    )
    return np.column_stack([flat[:, 0], np.ones(len(flat))])


def ray_errors(truth: dict[str, list[float]], rig: Rig, *, two_plane: bool) -> Array:
    """Lengths (N,) px of the ray errors half way between the planes and near them, inside the marks."""
    errors = []
    u, v = np.meshgrid(np.linspace(20, 1000, 50), np.linspace(20, 750, 40))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    direction = exact_directions(truth, pixels)
    for z in (345.0, 355.0, 405.0, 455.0, 465.0):
        inside = (np.abs(direction[:, 0] * z) < 150) & (np.abs(direction[:, 1] * z) < 105)
        rays = rig.camera.rays(pixels[inside], near=z if two_plane else None)
        errors.append(exact_pixels(truth, rays.at_depth(z)) - pixels[inside])
    return np.asarray(np.linalg.norm(np.concatenate(errors), axis=1))


def twin() -> None:
    folder = require("twin-a")
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    found = calibrate(folder / "calibration.toml")
    errors = np.concatenate([s.marks.pixels - exact_pixels(truth, s.marks.world) for s in found.measured])
    rms = np.sqrt((errors**2).mean(axis=0))
    row("twin-a: centroid rms against truth, px an axis (u, v)", "0.012", "<= 0.010", f"{rms[0]:.4f}, {rms[1]:.4f}")
    for two_plane in (False, True):
        e = ray_errors(truth, found.rig, two_plane=two_plane)
        name = "two nearest planes" if two_plane else "joint model"
        row(f"twin-a: rays between the planes, {name}: median; 95 %, px", "0.0086; 0.0185", "<= 0.005; <= 0.012",
            f"{np.median(e):.4f}; {np.percentile(e, 95):.4f}")  # fmt: skip
    laser = found.rig.lasers["laser"].plane
    normal, offset = np.array(truth["laser"]["normal"]), float(truth["laser"]["offset"])
    sign = np.sign(normal @ laser.normal)
    angle = np.degrees(np.linalg.norm(np.cross(normal, laser.normal)))
    middle = np.array([0.0, 0.0, 405.0])
    middle = middle - (middle @ normal - offset) * normal
    row("twin-a: laser plane: angle, deg; offset, mm (in the middle of the volume, mm)", "0.0004; 0.002", "no worse",
        f"{angle:.4f}; {abs(sign * laser.offset - offset):.4f} ({abs(laser.distance(middle[None])[0]):.4f})")  # fmt: skip
    with TemporaryDirectory() as place:
        capture = twin_capture(folder, Path(place))
        result = judge().judge(folder, run_scan(capture, found.rig).cloud.points)
    steps = [result[f"step{h}"] for h in (2, 8, 16)]
    row("twin-a: steps 2, 8, 16: bias, mm", "0.005", "<= 0.004", ", ".join(f"{s['error']:+.4f}" for s in steps))
    row(
        "twin-a: steps 2, 8, 16: scatter, mm",
        "0.024 to 0.029",
        "<= 0.022 (<= 0.017)",
        ", ".join(f"{s['std']:.4f}" for s in steps),
    )
    row("twin-a: sphere: radius error; centre; rms, mm", "0.022; 0.051; 0.022", "no worse (<= 0.010; 0.020; 0.015)",
        f"{result['sphere_radius_error']:+.4f}; {result['sphere_centre_error']:.4f}; {result['sphere_rms']:.4f}")  # fmt: skip
    row("twin-a: bracket to its mesh: median; rms, mm; points", "0.027; 0.157; 7069", "<= 0.020; <= 0.13 (<= 0.017; 0.05; x 0.85)",
        f"{result['part_median']:.4f}; {result['part_rms']:.4f}; {result['part_n']}")  # fmt: skip
    row(
        "twin-a: coupon: Sq found; true, mm",
        "0.1789; 0.1808",
        "-",
        f"{result['coupon_Sq_raw']:.4f}; {result['coupon_Sq_true']:.4f}",
    )


def piv() -> None:
    folder = require("piv-e")
    found = calibrate(folder / "calibration.toml", order=2)
    planes = found.result["planes"]
    for key, name, peer in (("fit_px", "fit", "0.090"), ("loo_px", "leave-one-out", "0.107")):
        value = float(np.sqrt(np.mean([p[key] ** 2 for p in planes])))
        row(f"piv-e: quadratic, {name}, px", peer, "no worse", value)
    row("piv-e: seven-plane collinearity, px", "0.012", "no worse", float(found.result["interplane_px"]))
    outer = _outer_two(found)
    row("piv-e: planes between, from -3 and +3 only, um", "15 to 21", "no worse", ", ".join(f"{e:.1f}" for e in outer))


def _outer_two(found: Calibration) -> list[float]:
    from calibration.rays import fit_two_plane, rms

    if found.two_plane is None:
        return []
    marks = list(found.two_plane.marks)
    camera = fit_two_plane([marks[0], marks[-1]], found.rig.camera.size, order=2).camera
    errors = []
    for middle in marks[1:-1]:
        world = middle.world
        rays = camera.rays(middle.pixels, near=float(world[:, 2].mean()))
        errors.append(1000 * rms((rays.at_depth(world[:, 2]) - world)[:, :2]))
    return errors


def pot() -> None:
    folder = require("taubin-pot")
    found = calibrate(folder / "calibration.toml")
    laser = found.rig.lasers["laser"]
    row("taubin-pot: laser plane rms, mm", "0.174", "no worse", laser.rms_mm)
    left_out = [p.loo_mm for p in laser.planes]
    row(
        "taubin-pot: leave-one-board-out, median; worst, mm",
        "0.165; 0.266",
        "no worse",
        f"{np.median(left_out):.3f}; {max(left_out):.3f}",
    )
    points = run_scan(folder / "capture.toml", found.rig).cloud.points
    near = np.linalg.norm(points[:, :2] - np.median(points[:, :2], axis=0), axis=1) < 250
    z = points[near & (np.abs(points[:, 2]) < 4), 2]
    row(
        "taubin-pot: marker board under the pot, mean z; rms, mm (points)",
        "0.2; 0.44",
        "<= 0.3; <= 0.45",
        f"{z.mean():+.3f}; {z.std():.3f} ({len(z)})",
    )
    ring = points[np.abs(points[:, 2] - 40) < 3, :2]
    rows = np.column_stack([2 * ring, np.ones(len(ring))])
    centre = np.linalg.lstsq(rows, (ring**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(centre[2] + centre[:2] @ centre[:2]))
    off = np.linalg.norm(ring - centre[:2], axis=1) - radius
    row("taubin-pot: belly at z = 40: radius; rms, mm", "57; 1.3", "-", f"{radius:.2f}; {off.std():.2f}")


def main() -> None:
    head("figure", "a plain pipeline", "reach", "SCOPE")
    twin()
    piv()
    pot()


if __name__ == "__main__":
    main()
