"""What a rig by hand leaves uncertain, of points and of a ball's diameter: python -m benchmarks.by_hand --draws 60.

Whole calibrations are drawn, with an independent pinhole and noise on corners and stripes, and a ball is ranged with each. Its peer is
what would be said if camera and sheet had been found apart, and if a diameter erred as its points do.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from calibration.geometry import Array, Pose
from calibration.rays import FreehandFit, PlaneMarks, fit_freehand
from calibration.rig import Rig, Verification
from calibration.sheet import Laser, StripePoints, coupled, fit_laser, moved_stripe
from ranging.triangulation import triangulate
from scope.check import Size, check_artefact
from scope.cloud import ScanCloud, Sensors
from scope.scanning import boxes_of, systematic_of

SIZE = (640, 480)
MATRIX = np.array([[640.0, 0.0, 325.0], [0.0, 640.0, 236.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.1, 0.02, 0.0, 0.0, 0.0])
NORMAL = np.array([np.cos(0.5), 0.02, np.sin(0.5)]) / np.linalg.norm([np.cos(0.5), 0.02, np.sin(0.5)])
OFFSET = float(NORMAL[2] * 430.0)
BOARD = np.stack(np.meshgrid(np.arange(8) - 3.5, np.arange(6) - 2.5), axis=-1).reshape(-1, 2) * 20.0
NOISE = 0.1  # px, of a corner and of the stripe
RADIUS = 20.0


def seen(points: Array) -> Array:
    return np.asarray(
        cv2.projectPoints(np.ascontiguousarray(points), np.zeros(3), np.zeros(3), MATRIX, DISTORTION)[0][:, 0]
    )


def views(rng: np.random.Generator) -> tuple[list[PlaneMarks], list[Array | None]]:
    """Eight views of a board, and ten with the stripe on it."""
    boards: list[PlaneMarks] = []
    stripes: list[Array | None] = []
    while len(boards) < 18:
        turn = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0]
        middle = np.array([rng.uniform(-90, 90), rng.uniform(-60, 60), rng.uniform(350, 520)])
        lit = len(boards) >= 8
        if lit:
            middle[0] = (OFFSET - middle[1:] @ NORMAL[1:]) / NORMAL[0] + rng.uniform(-30, 30)
        pixels = seen(np.column_stack([BOARD, np.zeros(48)]) @ turn.T + middle)
        if (pixels < 5).any() or (pixels > np.array(SIZE) - 6).any():
            continue
        y = np.linspace(-50, 50, 80)
        x = (OFFSET - NORMAL @ middle - (turn.T @ NORMAL)[1] * y) / (turn.T @ NORMAL)[0]
        on = np.abs(x) < 75
        if lit and on.sum() < 30:
            continue
        clean = seen(np.column_stack([x, y, 0 * y])[on] @ turn.T + middle) if lit else np.zeros((0, 2))
        stripe = clean + np.array([1.0, 0.0]) * rng.normal(0, NOISE, clean.shape)
        unknown = np.full((48, 2, 2), np.nan)
        noisy = pixels + rng.normal(0, NOISE, pixels.shape)
        boards.append(PlaneMarks(f"v{len(boards)}", noisy, BOARD, Pose.identity(), np.arange(48), unknown))
        stripes.append(stripe if lit else None)
    return boards, stripes


def calibrated(rng: np.random.Generator) -> tuple[FreehandFit, Laser]:
    boards, stripes = views(rng)
    fit = fit_freehand(boards, SIZE)
    placed = {view.name: view for view in fit.views}
    found, moved = [], []
    for board, pixels in zip(boards, stripes, strict=True):
        if pixels is None or board.name not in placed:
            continue
        view = placed[board.name]
        pose = view.c_from_plane
        normal, direction = pose.rotation[:, 2], fit.camera.rays(pixels).direction
        points = direction * ((normal @ pose.translation) / (direction @ normal))[:, None]
        across = NOISE * np.linalg.norm(fit.camera.shift(pixels, points)[:, :, 0], axis=1)
        found.append(StripePoints(board.name, points, across))
        moved.append(moved_stripe(fit.camera, (pixels, points), normal, (view.pixels, view.world), pose.translation))
    return fit, coupled(fit_laser("laser", found, along="columns", channel="gray", curved=False), found, moved)


@cache
def ball() -> tuple[Array, Array]:
    """Where the sheet cuts a ball that is carried along x, and the frame of each point."""
    middle = np.array([(OFFSET - NORMAL[2] * 430) / NORMAL[0], 5.0, 430.0])
    first = np.cross(NORMAL, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    angle = np.linspace(0, 2 * np.pi, 200)
    ring = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(NORMAL, first)
    points, frames = [], []
    for frame in range(15):
        centre = middle + np.array([2.0 * frame - 14.0, 0.0, 0.0])
        height = OFFSET - NORMAL @ centre
        lit = centre + height * NORMAL + np.sqrt(max(RADIUS**2 - height**2, 0.0)) * ring
        facing = -np.einsum("ni,ni->n", lit - centre, lit) / np.linalg.norm(lit, axis=1) / RADIUS > 0.3
        points.append(lit[facing])
        frames.append(np.full(int(facing.sum()), frame))
    return np.concatenate(points), np.concatenate(frames)


def scanned(fit: FreehandFit, laser: Laser) -> tuple[Rig, ScanCloud, Array, Array]:
    """The ball as this rig ranges it, without noise of the stripe; errors along the ray and their sigma."""
    truth, frame = ball()
    pixels = seen(truth)
    found = triangulate(fit.camera, laser, pixels, np.full(len(pixels), 0.02), 0, extrapolate=1e4)
    rig = Rig(fit.camera, {"laser": laser}, (), Verification(True, ""), sha256="1" * 64)
    travel = np.column_stack([2.0 * np.arange(15) - 14.0, np.zeros(15), np.zeros(15)])
    sensors = Sensors(
        np.arange(15, dtype=np.int32), np.zeros(15, dtype=np.uint8), -travel, np.tile([1.0, 0.0, 0.0, 0.0], (15, 1)),
        np.full((15, 3), np.nan),
    )  # fmt: skip
    cloud = replace(
        ScanCloud.from_points(found.points - travel[frame]), pixels=pixels.astype(np.float32), frame=frame.astype(np.int32),
        sigma=found.sigma.astype(np.float32), sigma_cal=found.sigma_cal.astype(np.float32), sensors=sensors,
        camera_centre=np.zeros(3), rig_sha256="1" * 64,
        systematic=systematic_of(rig, [laser], boxes_of(np.zeros(len(pixels), dtype=np.uint8), pixels)),
    )  # fmt: skip
    return rig, cloud, np.einsum("ni,ni->n", found.points - truth, found.view), found.sigma_cal


def drawn(rng: np.random.Generator) -> tuple[Rig, ScanCloud, float, float, Size]:
    """Draw a calibration: its rig, the scan, rms of error over sigma along the rays, that sigma over the one of parts found apart, the size."""
    fit, laser = calibrated(rng)
    rig, cloud, error, sigma = scanned(fit, laser)
    alone = triangulate(
        fit.camera,
        replace(laser, coupling=np.zeros((0, 0))),
        cloud.pixels.astype(np.float64),
        np.full(len(cloud), 0.02),
        0,
    )
    size = check_artefact(cloud, f"sphere:d={2 * RADIUS}").sizes[0]
    apart = float(np.nanmedian(alone.sigma_cal) / np.median(sigma))
    return rig, cloud, float(np.sqrt(np.mean((error / sigma) ** 2))), apart, size


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--draws", type=int, default=60)
    asked.add_argument("--seed", type=int, default=5)
    options = asked.parse_args()
    rng = np.random.default_rng(options.seed)
    found = [drawn(rng) for _ in range(options.draws)]
    along = np.array([each[2] for each in found])
    sizes = [each[4] for each in found]
    off = np.array([size.error / np.hypot(size.calibration, size.scatter) for size in sizes])
    errors, claims = np.array([size.error for size in sizes]), np.array([size.uncertainty for size in sizes])
    sigma = np.array([np.median(each[1].sigma_cal) for each in found])
    print(f"points along the ray: rms of error over sigma_cal {np.sqrt(np.mean(along**2)):.2f}; median sigma_cal {np.median(sigma):.3f} mm, "
          f"{np.median([each[3] for each in found]):.2f} times as much if camera and sheet were found apart")  # fmt: skip
    print(f"diameter: rms error {np.sqrt(np.mean(errors**2)):.3f} mm, over its sigma {np.sqrt(np.mean(off**2)):.2f}; "
          f"median of the claim (k = 2) {np.median(claims):.3f} mm; within it {np.mean(np.abs(errors) <= claims):.0%}")  # fmt: skip


if __name__ == "__main__":
    main()
