"""A laser-stripe 3-D scanner, calibrated in place by the method of two planes.

Everything public is here; each name is loaded when it is first used (PEP 562), so that ``import scope`` costs neither
SciPy nor Open3D.

In: files or arrays: images of targets, laser stripes, a mesh, a cloud.
Out: rigs, clouds, roughness, poses, checks, and the pages that show them.
Read: the rooms session, cameras, calibrating, hand_eye, scanning, cloud, merge; heightmap, roughness, model, variants, refinement, pose, check, inspection, acceptance, watch, export;
    simulation, design, printing, viewer, report, history, console, design_report, batch, demo. Tools: mesh, origin, optional, errors, version.
"""

from __future__ import annotations

import importlib
from typing import Any

from scope.version import __version__

_HOMES = {
    "ArtefactCheck": "scope.check",
    "Box": "scope.cloud",
    "Calibration": "scope.calibrating",
    "CalibrationError": "calibration.errors",
    "CalibrationSession": "scope.session",
    "Charuco": "calibration.targets",
    "Chessboard": "calibration.targets",
    "CircleGrid": "calibration.targets",
    "FileError": "calibration.errors",
    "Fixed": "ranging.motion",
    "HandEye": "scope.session",
    "HandEyeResult": "scope.hand_eye",
    "HeightMap": "scope.heightmap",
    "Linear": "ranging.motion",
    "MarkerBoard": "calibration.targets",
    "MarkerPlace": "calibration.targets",
    "MeasurementError": "scope.errors",
    "MissingLibraryError": "scope.errors",
    "Plane": "calibration.geometry",
    "PlaneView": "scope.session",
    "Polygon": "scope.cloud",
    "Pose": "calibration.geometry",
    "PointCovariance": "ranging.covariance",
    "PoseResult": "scope.pose",
    "Poses": "ranging.motion",
    "Profile": "ranging.profile",
    "Ranged": "calibration.geometry",
    "RangingError": "ranging.errors",
    "Rays": "calibration.geometry",
    "Reason": "calibration.reason",
    "Rig": "calibration.rig",
    "Roughness": "scope.roughness",
    "RoughnessOptions": "scope.roughness",
    "ScanCloud": "scope.cloud",
    "ScanOptions": "scope.scanning",
    "Scanner": "scope.scanning",
    "ScopeError": "calibration.errors",
    "SpotGrid": "calibration.targets",
    "StripeOptions": "ranging.stripe",
    "Turntable": "ranging.motion",
    "calibrate": "scope.calibrating",
    "check_artefact": "scope.check",
    "design_rig": "scope.design",
    "estimate_pose": "scope.pose",
    "hand_eye": "scope.hand_eye",
    "measure_heights": "scope.roughness",
    "measure_roughness": "scope.roughness",
    "point_covariance": "scope.scanning",
    "print_target": "scope.printing",
    "scan": "scope.scanning",
    "simulate": "scope.simulation",
    "verify": "scope.calibrating",
}

__all__ = ["__version__", *_HOMES]  # noqa: PLE0604  (the names are strings of the table above)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'scope' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
