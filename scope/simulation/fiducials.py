"""Whether a designed target can be told from its own image: what a calibration of the session would refuse is not rendered."""

from __future__ import annotations

import numpy as np

from calibration.errors import FileError
from scope.simulation.optics import project
from scope.simulation.virtual_rig import VirtualRig


def check_fiducials(rig: VirtualRig) -> None:
    """Refuse a rig whose planes do not show every fiducial wholly, so that which spot is which could not be told.

    Raises
    ------
    FileError
        With the first plane and how many fiducials it shows.
    """
    jig = rig.design.jig
    if not jig.fiducials or jig.fiducial_diameter is None:
        return
    places = np.array([(c * jig.pitches[0], r * jig.pitches[1], 0.0) for r, c in jig.fiducials])
    reach = 0.5 * jig.fiducial_diameter
    rim = np.array([(reach * np.cos(a), reach * np.sin(a), 0.0) for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)])
    for name, pose in zip(jig.names, rig.actual, strict=True):
        pixels = project(rig.camera, pose.apply((places[:, None] + rim).reshape(-1, 3))).reshape(len(places), -1, 2)
        inside = ((pixels > 0.0) & (pixels < np.array(rig.camera.size) - 1.0)).all(axis=(1, 2))
        if not inside.all():
            raise FileError(
                f"rig design: plane {name} shows {int(inside.sum())} of its {len(places)} jig.fiducials wholly, so that the grid could "
                "not be told from its image: choose fiducials nearer to the middle, a smaller pitch, or a larger stand-off"
            )
