"""Compile now what scans and calibrations compile when they first need it: ``python -m scope.demo.precompile``.

numba keeps machine code beside the files that it compiled, or in NUMBA_CACHE_DIR. Set-up calls this once, so that the
first scan of a camera of 8 or of 16 bits takes no longer than the second.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from ranging.stripe import StripeOptions, extract
from scope import simulation
from scope.calibrating import calibrate
from scope.scanning import scan

_DESIGN = """
format = 1
[camera]
size = [480, 360]
focal_px = 520.0
centre_px = [240.0, 180.0]
bits = {bits}
[laser]
origin = [0.0, -150.0, 8.0]
through = [0.0, 0.0, 340.0]
width = 0.5
[jig]
stand_offs = [310.0, 340.0, 370.0]
rows = 9
columns = 11
pitch = 20.0
diameter = 9.0
fiducials = [[4, 5], [4, 7], [1, 5]]
fiducial_diameter = 13.0
[[object]]
solid = "sphere"
radius = 20.0
origin = [0.0, 0.0, 345.0]
[[object]]
solid = "plane"
origin = [0.0, 0.0, 360.0]
[motion]
kind = "linear"
direction = [0.0, 1.0, 0.0]
start = -4.0
step = 0.4
frames = 20
off_images = 1
"""


def main() -> None:
    """Calibrate and scan a small simulated rig at both depths, and read a stripe in every way."""
    for bits, kind in ((8, np.uint8), (16, np.uint16)):
        with tempfile.TemporaryDirectory() as folder:
            home = Path(folder)
            (home / "design.toml").write_text(_DESIGN.format(bits=bits), encoding="utf-8")
            session = home / "session"
            simulation.simulate(simulation.read_design(home / "design.toml"), session, np.random.default_rng(1))
            rig = calibrate(session / "calibration.toml").rig
            scan(session / "capture.toml", rig)
        place = 60.0 + 0.1 * np.arange(200)[:, None]
        light = 120.0 * np.exp(-0.5 * ((np.arange(160) - place) / 2.0) ** 2)
        image = np.rint(light * np.random.default_rng(2).uniform(0.6, 1.4, light.shape) + 4).astype(kind)
        wide = np.rint(120.0 * np.exp(-0.5 * ((np.arange(160) - place) / 12.0) ** 2) + 4).astype(kind)
        extract(wide, along="columns")
        extract(wide, along="columns", background=np.zeros_like(wide))
        for method in ("gaussian", "centroid", "ridge"):
            extract(image, along="columns", options=StripeOptions(method=method, speckle="on"))
            extract(
                np.ascontiguousarray(image.T), along="rows", options=StripeOptions(method=method, which="continuous")
            )


if __name__ == "__main__":
    main()
