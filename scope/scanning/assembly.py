"""Last stage: the points of all runs of frames to one cloud that says what it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from calibration.geometry import Array, quaternion_from_rotation
from calibration.reason import see
from calibration.rig import Rig
from ranging.errors import RangingError
from ranging.robot import Robot
from scope.cloud import ScanCloud, Sensors, Systematic, filtered, lattice_normals
from scope.scanning.agreement import agreements
from scope.scanning.covariance import boxes_of, systematic_of
from scope.scanning.setup import ScanSetup
from scope.scanning.statistics import Footprint, Scan, ScanStatistics

_REMEDIES = {  # by the reason that most lines have
    "outside_calibration": "bring the object into the calibrated volume, calibrate further, or give --extrapolate",
    "saturated": "expose shorter, or close the iris",
    "two_peaks": "keep reflections away, or choose one of several peaks with --which",
    "uncertain": "give a larger --max-sigma, or expose longer",
    "too_wide": "focus camera and laser: a stripe may be 32 px wide (one sigma)",
}


def joined(parts: list[ScanCloud]) -> ScanCloud:
    """One cloud in scan order: by frame, then by laser, then along the stripe."""
    if not parts:
        return ScanCloud.from_points(np.zeros((0, 3)))
    whole = ScanCloud(
        points=np.concatenate([part.points for part in parts]),
        intensity=np.concatenate([part.intensity for part in parts]),
        sigma=np.concatenate([part.sigma for part in parts]),
        sigma_cal=np.concatenate([part.sigma_cal for part in parts]),
        pixels=np.concatenate([part.pixels for part in parts]),
        frame=np.concatenate([part.frame for part in parts]),
        laser=np.concatenate([part.laser for part in parts]),
    )
    if len(parts) == 1 or np.all(np.diff(whole.frame.astype(np.int64) * 256 + whole.laser) >= 0):
        return whole
    return whole.select(np.lexsort((whole.laser, whole.frame)))


def require_points(setup: ScanSetup, statistics: ScanStatistics, why: str = "") -> None:
    """``RangingError`` where no frame gave a point; ``why`` is what the source says of it."""
    if statistics.points:
        return
    if not statistics.frames:
        raise RangingError(f"{setup.owner}: {why or 'no frame came; check the camera or the video and scan again'}")
    reasons = ", ".join(f"{count} {reason}" for reason, count in statistics.rejected.most_common(3))
    most = statistics.rejected.most_common(1)[0][0] if statistics.rejected else ""
    raise RangingError(
        f"{setup.owner}: no point in any of {statistics.frames} frames (lines without a point: {reasons}); "
        f"{_REMEDIES.get(most, 'check that the laser is on, `channel`, exposure and focus')}"
        f"{f' (see {see(most)})' if most else ''}"
    )


def described(setup: ScanSetup, cloud: ScanCloud, why: str, statistics: ScanStatistics) -> ScanCloud:
    """Cloud with all that is known of the scan but its sensors."""
    stripes = [statistics.stripes.get(k, Footprint(np.nan, 0.0, 0)) for k in range(len(setup.lasers))]
    return replace(
        cloud,
        stripe_width=tuple(stripe.width for stripe in stripes),
        stripe_corrected=tuple(stripe.corrected for stripe in stripes),
        laser_names=tuple(laser.name for laser in setup.lasers),
        rig_sha256=setup.rig.sha256,
        verified=setup.rig.verification.passed,
        complete=not why,
        origin=(*_of_rig(setup.rig), *setup.origin),
        camera_centre=setup.centre,
    )


def _of_rig(rig: Rig) -> tuple[str, ...]:
    """Lines on the rig: when it was calibrated and verified, within which limits, and whose camera it is."""
    limits = ", ".join(f"{key} {value:g}" for key, value in rig.accept.items())
    told = {
        "rig verified": f"{rig.written} by {rig.software}" if rig.written else "",
        "limits asked": limits or "none",
        "camera": rig.camera_id,
    }
    return tuple(
        f"{what}: {value}"[:200].encode("ascii", "replace").decode("ascii") for what, value in told.items() if value
    )


def sensors_of(setup: ScanSetup, frames: list[int]) -> Sensors:
    """Where camera and lasers were in the frames of these numbers."""
    rows = [(n, k) for n in frames for k in range(len(setup.lasers))]
    poses = {n: setup.motion.cloud_from_c(n) for n in frames}
    return Sensors(
        frame=np.array([n for n, _ in rows], dtype=np.int32),
        laser=np.array([k for _, k in rows], dtype=np.uint8),
        centre=np.array([poses[n].apply(setup.centre) for n, _ in rows]).reshape(-1, 3),
        rotation=np.array([quaternion_from_rotation(poses[n].rotation) for n, _ in rows]).reshape(-1, 4),
        laser_origin=np.array([poses[n].apply(setup.lasers[k].origin) for n, k in rows]).reshape(-1, 3),
    )


def systematic_errors(setup: ScanSetup, boxes: Mapping[int, Array]) -> Systematic | None:
    """What errors of the calibration do; None on a robot, whose own errors are in ``sigma_cal`` alone."""
    return None if isinstance(setup.motion, Robot) else systematic_of(setup.rig, setup.lasers, boxes, setup.motion)


def assembled(setup: ScanSetup, cloud: ScanCloud, statistics: ScanStatistics, why: str, seconds: float) -> Scan:
    """Sensors, normals, filters and the agreement of lasers; ``RangingError`` where no frame gave a point."""
    require_points(setup, statistics, why)
    numbers = np.unique(cloud.frame).tolist()
    cloud = replace(
        described(setup, cloud, why, statistics),
        sensors=sensors_of(setup, numbers),
        systematic=systematic_errors(setup, boxes_of(cloud.laser, cloud.pixels)),
    )
    agreement = agreements(cloud)
    if setup.options.normals:
        stored = cloud.points.astype(np.float32).astype(np.float64)  # as a resumed scan finds them
        cloud = replace(cloud, normals=lattice_normals(replace(cloud, points=stored)))
    cloud, removed = filtered(cloud, setup.options.filters)
    found = scan_of(setup, lambda: cloud, len(cloud), statistics, why, seconds)
    return replace(found, filtered=removed, agreement=agreement)


def scan_of(
    setup: ScanSetup, load: Callable[[], ScanCloud], points: int, statistics: ScanStatistics, why: str, seconds: float
) -> Scan:
    """Scan of a cloud that ``load`` gives."""
    return Scan(
        load, points, statistics.frames, statistics.empty, dict(statistics.rejected), seconds, why,
        statistics.sigma.value, statistics.sigma_cal.value, setup.rig.verification.passed, table=setup.table,
    )  # fmt: skip
