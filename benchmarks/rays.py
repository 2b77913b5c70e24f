"""Sighting rays against the exact camera, with and without a window: python -m benchmarks.rays.

Marks of five planes are projected by the independent witness (`scope.simulation.optics`), noise is added, and the rays of SCOPE and
of OpenCV's calibrateCamera, fed the same 3-D points, are compared with the exact rays at depths between the planes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.shared import head, row
from calibration.geometry import Array, Pose, Rays
from calibration.rays import PlaneMarks, fit_two_plane
from scope.simulation.optics import ExactCamera, Window, exact_rays, project

SIZE = (1280, 960)
STAND_OFFS = (320.0, 360.0, 400.0, 440.0, 480.0)
NOISE = 0.01  # px
SESSIONS = 10


@dataclass(frozen=True)
class OpenCv:
    """Rays of a pinhole that cv2.calibrateCamera fitted to all marks as one rigid object."""

    matrix: Array
    distortion: Array
    rotation: Array
    translation: Array

    @classmethod
    def fit(
        cls, marks: list[PlaneMarks], flags: int, *, start: Array | None = None, size: tuple[int, int] = SIZE
    ) -> OpenCv:
        """Fit to marks with OpenCV's flags."""
        points = np.concatenate([m.world for m in marks]).astype(np.float32)
        pixels = np.concatenate([m.pixels for m in marks]).astype(np.float32)
        start = np.array([[1300.0, 0, 640], [0, 1300, 480], [0, 0, 1]]) if start is None else start
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
        _, k, d, r, t = cv2.calibrateCamera(
            [points], [pixels], size, start, None, flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS, criteria=criteria
        )[:5]
        return cls(k, d, cv2.Rodrigues(r[0])[0], t[0].ravel())

    def rays(self, pixels: Array) -> Rays:
        """Rays in C of pixels (N, 2)."""
        flat = cv2.undistortPoints(pixels[:, None], self.matrix, self.distortion, None, None, None, (3, 200, 1e-15))[
            :, 0
        ]
        direction = np.column_stack([flat, np.ones(len(flat))]) @ self.rotation
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return Rays(np.broadcast_to(-self.rotation.T @ self.translation, direction.shape), direction)


def camera(window: Window | None, k1: float = -0.18) -> ExactCamera:
    return ExactCamera(SIZE, (1400.0, 1400.0), (655.0, 470.0), (k1, 0.05, 0.0004, -0.0003, 0.0), window)


def session(
    exact: ExactCamera, rng: np.random.Generator, *, tilt: float = 0.0, noise: float = NOISE
) -> list[PlaneMarks]:
    """Marks of 19 x 25 spots, 12 mm apart, on every plane; those out of view are left out."""
    r, c = np.mgrid[0:19, 0:25]
    flat = np.column_stack([c.ravel(), r.ravel()]) * 12.0
    found = []
    for z in STAND_OFFS:
        turn = np.deg2rad([*rng.uniform(-tilt, tilt, 2), 0.0])
        turned = Pose.from_rotation_vector(turn, np.zeros(3))
        middle = np.array([144.0, 108.0, 0.0])
        pose = Pose(turned.rotation, np.array([0.0, 0.0, z]) - turned.rotation @ middle)
        world = pose.apply(np.column_stack([flat, np.zeros(len(flat))]))
        pixels = project(exact, world)
        pixels = pixels + rng.normal(0, noise, pixels.shape)
        keep = ((pixels > 5) & (pixels < np.array(SIZE) - 6)).all(axis=1)
        number = np.arange(len(flat))
        unknown = np.full((int(keep.sum()), 2, 2), np.nan)
        found.append(PlaneMarks(f"w{z:g}", pixels[keep], flat[keep], pose, number[keep], unknown))
    return found


def ray_error(rays: Rays, exact: Rays) -> Array:
    """Distances (N,) mm across depth between rays and exact rays at depths half way between the planes."""
    errors = []
    for z in (340.0, 380.0, 420.0, 460.0):
        true = exact.at_depth(z)
        inside = (np.abs(true[:, 0]) < 140) & (np.abs(true[:, 1]) < 104)
        errors.append(np.linalg.norm(rays.at_depth(z) - true, axis=1)[inside])
    return np.concatenate(errors)


def main() -> None:
    u, v = np.meshgrid(np.linspace(60, 1220, 40), np.linspace(60, 900, 30))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    scenes = (
        ("OpenCV's own lens model", None, "0.41 / 0.12", "<= 4"),
        ("behind a straight 10 mm pane", Window.tilted(10.0, 1.52, (0.0, 0.0), 60.0), "0.40 / 1.29", "<= 0.35"),
        (
            "behind the pane tilted by 20 degrees",
            Window.tilted(10.0, 1.52, (np.deg2rad(20.0), 0.0), 60.0),
            "0.41 / 56",
            "<= 0.01",
        ),
    )
    head(
        "rays between five planes, median um",
        "trial",
        "reach (ratio)",
        "SCOPE",
        "OpenCV 5 coefficients",
        "8 coefficients",
        "ratio to the better",
    )
    for name, window, trial, reach in scenes:
        exact = camera(window)
        truth = exact_rays(exact, pixels)
        ours, five, eight = [], [], []
        for seed in range(SESSIONS):
            marks = session(exact, np.random.default_rng(seed))
            ours.append(np.median(ray_error(fit_two_plane(marks, SIZE).camera.rays(pixels), truth)))
            five.append(np.median(ray_error(OpenCv.fit(marks, 0).rays(pixels), truth)))
            eight.append(np.median(ray_error(OpenCv.fit(marks, cv2.CALIB_RATIONAL_MODEL).rays(pixels), truth)))
        a, b, c = (1000 * float(np.median(values)) for values in (ours, five, eight))
        row(name, trial, reach, f"{a:.3f}", f"{b:.3f}", f"{c:.3f}", f"{a / min(b, c):.4f}")
    print()
    head(
        "lens k1 = -0.22, planes tilted by up to 15 degrees, no noise: ray error, median; 95 %, px",
        "trial",
        "reach",
        "SCOPE",
    )
    exact = camera(None, -0.22)
    truth = exact_rays(exact, pixels)
    marks = session(exact, np.random.default_rng(7), tilt=15.0, noise=0.0)
    error = ray_error(fit_two_plane(marks, SIZE).camera.rays(pixels), truth) * 1400.0 / 400.0
    row(
        "all five planes",
        "paper's terms 0.97; order 7 0.007",
        "<= 0.007",
        f"{np.median(error):.5f}; {np.percentile(error, 95):.5f}",
    )
    held = _held_out_px(marks)
    row("each inner plane left out, rms", "paper's terms 0.97; order 7 0.007", "<= 0.007", f"{held:.5f}")


def _held_out_px(marks: list[PlaneMarks]) -> float:
    from calibration.verification import held_out

    out = held_out(fit_two_plane(marks, SIZE))
    return float(np.sqrt(np.mean([h.rms_px**2 for h in out if h.between])))


if __name__ == "__main__":
    main()
