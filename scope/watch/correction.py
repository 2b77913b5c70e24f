"""Scale and tilt of a rig put right by one scan of an artefact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from calibration.errors import FileError
from calibration.rays import PinholeCamera
from calibration.rig import Rig, sha256_of
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.watch.artefact_file import WatchPlan
from scope.watch.run import Watched, watch
from scope.watch.stretched import stretched


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """A rig whose lengths are those of an artefact."""

    rig: Rig
    watched: Watched
    cloud: str  # name of the scan


def correct_rig(rig: Rig, cloud: ScanCloud, plan: WatchPlan, name: str) -> Correction:
    """The rig with the stretch undone that the artefact shows.

    Planes at wrong stand-offs, a pitch that is off, an axis that is not square to the planes: all stretch what is seen by an
    affine map, under which planes stay planes, so that no analysis of planes sees it. The motion of the scan is believed; a
    linear stage keeps its direction in the corrected rig.

    Raises
    ------
    FileError
        A cloud of another rig.
    MeasurementError
        An artefact that determines no scale and no tilt.
    """
    if cloud.rig_sha256 and rig.sha256 and cloud.rig_sha256 != rig.sha256:
        raise FileError(
            f"{name}: was scanned with the rig {cloud.rig_sha256[:12]}, this one is {rig.sha256[:12]}: give that rig, or scan with this one"
        )
    pinhole = isinstance(rig.camera, PinholeCamera)
    found = watch(plan, cloud, pinhole=pinhole)
    if not found.strain.told.any():
        raise MeasurementError(
            f"{name}: {plan.name} determines no scale and no tilt of the rig: it needs two levels or more, or faces that slope both ways, "
            "over a good part of the view"
        )
    moved = stretched(rig, found.strain.matrix)
    note = f"scale and tilt from {plan.name} in {name}, {datetime.now(UTC).date().isoformat()}"
    inputs = {**rig.inputs, Path(name).name: sha256_of(Path(name)), plan.mesh.name: sha256_of(plan.mesh)}
    verdict = replace(rig.verification, why=f"{rig.verification.why}; {note}")
    written = datetime.now(UTC).isoformat(timespec="seconds")
    return Correction(replace(moved, verification=verdict, inputs=inputs, written=written, sha256="", sealed=True), found, name)  # fmt: skip


def largest_change(found: Watched) -> float:
    """Largest term of the correction, 1."""
    return float(np.abs(found.strain.matrix - np.eye(3)).max())
