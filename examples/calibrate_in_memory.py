"""Calibrate from images in memory: `python calibrate_in_memory.py cell` on the folder of a jig session."""

import sys
from pathlib import Path

import cv2

import scope

folder = Path(sys.argv[1])
STAND_OFFS = (300, 330, 360, 390)  # mm, as the jig holds them


def images(name: str) -> list:
    """Images of one folder, as the camera gave them."""
    return [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((folder / name).glob("*.png"))]


target = scope.SpotGrid(11, 15, 16.0, 6.0, fiducials=((5, 7), (5, 9), (2, 7)), fiducial_diameter=9.0)
planes = [scope.PlaneView(images(f"w{z}"), origin=(-113.0, -78.5, z), laser=images(f"w{z}-laser")) for z in STAND_OFFS]
result = scope.calibrate(scope.CalibrationSession(target, planes))
result.rig.save("rig.json")
print(result)
