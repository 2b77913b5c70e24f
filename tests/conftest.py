"""What several test files share: one small simulated session, rendered and calibrated once."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

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
