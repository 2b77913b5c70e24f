"""Scan any iterable of frames: `python scan_frames.py rig.json cell`, frames taken 2 mm apart along y."""

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

import scope


def camera(folder: Path) -> Iterator[np.ndarray]:
    """Stands for a camera: frames as they come, one at a time."""
    for path in sorted(folder.glob("*.png")):
        yield cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


session = Path(sys.argv[2])
dark = list(camera(session / "off"))
scanner = scope.Scanner(scope.Rig.load(sys.argv[1]))
cloud = scanner.scan(camera(session / "frames"), scope.Linear((0.0, 1.0, 0.0), 2.0, start=-11.0), background=dark)
print(cloud)
cloud.save("cloud.ply")
