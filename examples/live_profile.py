"""Range single frames, as a live view does: `python live_profile.py rig.json frames/*.png`."""

import sys

import cv2
import numpy as np

import scope

scanner = scope.Scanner(sys.argv[1])
for path in sys.argv[2:]:
    profile = scanner.profile(cv2.imread(path, cv2.IMREAD_UNCHANGED))
    print(f"{path}: {profile}")
    if profile.ranged:
        nearest = int(np.nanargmin(profile.points[:, 2]))
        x, y, z = profile.points[nearest]
        print(f"  nearest point: {x:.3f}, {y:.3f}, {z:.3f} mm +- {profile.sigma[nearest]:.3f} along the ray")
    for reason, lines in profile.rejected.items():
        print(f"  {lines} lines: {reason}")
