"""One small simulated session that tests and benchmarks share: rendered and calibrated in seconds.

A camera of 640 x 480 px 300 to 380 mm from the jig, a laser from below, and a sphere on a plate that a linear stage carries through the
sheet of light.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

_TEXT = """
format = 1

[camera]
size = [{size[0]}, {size[1]}]
focal_px = {focal}
centre_px = [{centre[0]}, {centre[1]}]
distortion = [-0.12, 0.03, 0.0004, -0.0003, 0.0]

[laser]
origin = [0.0, -150.0, 8.0]
through = [0.0, 0.0, 340.0]
width = {width}
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
start = {start}
step = {step}
frames = {frames}
off_images = 2
"""


def design_text(
    *, size: tuple[int, int] = (640, 480), frames: int = 12, start: float = -11.0, step: float = 2.0, width: float = 0.5
) -> str:
    """The rig-design.toml, with images of ``size`` px of the same view."""
    scale = size[0] / 640.0
    centre = (322.0 * scale, 236.0 * scale)
    return _TEXT.format(
        size=size, focal=700.0 * scale, centre=centre, width=width, start=start, step=step, frames=frames
    )


DESIGN = design_text()


def small_session(home: Path, text: str = DESIGN, *, seed: int = 7, name: str = "session") -> Path:
    """Render a design into ``home/name``, calibrate it, and put rig.json beside calibration.toml; gives the folder."""
    from scope import simulation
    from scope.calibrating import calibrate

    (home / "design.toml").write_text(text, encoding="utf-8")
    folder = home / name
    simulation.simulate(simulation.read_design(home / "design.toml"), folder, np.random.default_rng(seed))
    calibrate(folder / "calibration.toml").rig.save(folder / "rig.json")
    return folder
