"""What several test files share: one small simulated session, rendered and calibrated once."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.geometry import Pose
from calibration.rays import PlaneMarks

os.environ.setdefault("SCOPE_HISTORY", "off")  # tests of records switch it on

# A camera of 640 x 480 px 300 to 380 mm from the jig, a laser from below, and a sphere and steps on a plate that a
# linear stage carries through the sheet of light.
DESIGN = """
format = 1

[camera]
size = [640, 480]
focal_px = 700.0
centre_px = [322.0, 236.0]
distortion = [-0.12, 0.03, 0.0004, -0.0003, 0.0]

[laser]
origin = [0.0, -150.0, 8.0]
through = [0.0, 0.0, 340.0]
width = 0.5
roll = 3.0

[jig]
stand_offs = [300.0, 330.0, 360.0, 390.0]
rows = 11
columns = 15
pitch = 16.0
diameter = 6.0
fiducials = [[5, 7], [5, 9], [2, 7]]
fiducial_diameter = 9.0
images = 2
laser_images = 1

[[object]]
solid = "sphere"
radius = 20.0
origin = [-35.0, 0.0, 352.0]

[[object]]
solid = "plane"
origin = [0.0, 0.0, 372.0]

[motion]
kind = "linear"
direction = [0.0, 1.0, 0.0]
start = -11.0
step = 2.0
frames = 12
off_images = 2
"""


@dataclass(frozen=True)
class Session:
    """A simulated session that has been calibrated and scanned."""

    folder: Path

    @property
    def calibration(self) -> Path:
        return self.folder / "calibration.toml"

    @property
    def capture(self) -> Path:
        return self.folder / "capture.toml"

    @property
    def rig(self) -> Path:
        return self.folder / "rig.json"


@pytest.fixture(scope="session")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """The session; nobody may change it: `copy_of_session` gives one that may be spoiled."""
    from scope import simulation
    from scope.calibrating import calibrate

    home = tmp_path_factory.mktemp("session")
    (home / "design.toml").write_text(DESIGN, encoding="utf-8")
    folder = home / "rendered"
    simulation.simulate(simulation.read_design(home / "design.toml"), folder, np.random.default_rng(7))
    made = Session(folder)
    calibrate(made.calibration).rig.save(made.rig)
    return made


@pytest.fixture
def copy_of_session(session: Session, tmp_path: Path) -> Callable[[], Session]:
    """Gives a copy of the session."""

    def copy() -> Session:
        shutil.copytree(session.folder, tmp_path / "copy")
        return Session(tmp_path / "copy")

    return copy


@dataclass(frozen=True)
class Truth:
    """OpenCV's pinhole with distortion, and the marks that it sees of a target at several stand-offs."""

    matrix: np.ndarray
    distortion: np.ndarray

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) mm in its own frame."""
        return cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.matrix, self.distortion)[0][:, 0]

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Directions (n, 3) of unit depth, by OpenCV's inverse."""
        flat = cv2.undistortPoints(
            pixels[:, None],
            self.matrix,
            self.distortion,
            criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14),
        )[:, 0]
        return np.column_stack([flat, np.ones(len(flat))])

    def marks(self, pose: Pose, name: str, *, noise: float = 0.0, rng: np.random.Generator | None = None) -> PlaneMarks:
        """Marks of a grid of 13 x 17 at 15 mm, seen at a pose (camera from grid)."""
        column, row = np.meshgrid(np.arange(17), np.arange(13))
        points = 15.0 * np.stack([column.ravel() - 8.0, row.ravel() - 6.0], axis=1)
        pixels = self.project(pose.apply(np.column_stack([points, np.zeros(len(points))])))
        if rng is not None:
            pixels = pixels + rng.normal(0, noise, pixels.shape)
        number = np.arange(len(points), dtype=np.int64)
        return PlaneMarks(name, pixels, points, pose, number, np.full((len(points), 2, 2), np.nan))

    def jig(self, *, noise: float = 0.0, rng: np.random.Generator | None = None, tilt: float = 0.0) -> list[PlaneMarks]:
        """Marks at five stand-offs from 320 to 480 mm."""
        return [
            self.marks(
                Pose.from_rotation_vector([0.0, np.deg2rad(tilt), 0.0], [0.0, 0.0, z]), f"w{z}", noise=noise, rng=rng
            )
            for z in (320, 360, 400, 440, 480)
        ]


@pytest.fixture(scope="session")
def truth() -> Truth:
    matrix = np.array([[1400.0, 0.0, 655.0], [0.0, 1400.0, 470.0], [0.0, 0.0, 1.0]])
    return Truth(matrix, np.array([-0.18, 0.05, 0.0004, -0.0003, 0.0]))
