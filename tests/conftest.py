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
from hypothesis import settings

from benchmarks.small_session import small_session
from calibration.geometry import Pose
from calibration.rays import PlaneMarks

settings.register_profile("no timing", deadline=None)
settings.load_profile("no timing")
os.environ.setdefault("SCOPE_HISTORY", "off")  # tests of records switch it on


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What needs a browser is long."""
    for item in items:
        if Path(__file__).parent / "browser" in item.path.parents:
            item.add_marker(pytest.mark.long)


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
    return Session(small_session(tmp_path_factory.mktemp("session"), name="rendered"))


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
