"""An artefact in a scan: found, measured, judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scope.check import Decision, decide, overall
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.model import load_model
from scope.pose import PoseResult, estimate_pose
from scope.watch.artefact_file import WatchPlan
from scope.watch.strain import Strain, find_strain

_EXPLAINED = 0.4  # share of the points looked at that must lie on the artefact


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """What the artefact says of one scan."""

    plan: WatchPlan
    strain: Strain
    scale_uncertainty: np.typing.NDArray[np.float64]  # (3,) k = 2: of the points and of the artefact's own lengths
    error_uncertainty: float  # mm, k = 2
    decision: Decision | None  # None without limits
    why: str


def watch(plan: WatchPlan, cloud: ScanCloud, *, pinhole: bool = False) -> Watched:
    """Check a scan by the artefact in it.

    Parameters
    ----------
    plan : WatchPlan
    cloud : ScanCloud
        As `scope scan` wrote it.
    pinhole : bool
        Whether the rig's camera is one (freehand calibration): its lengths err by one scale only.

    Raises
    ------
    MeasurementError
        The artefact is not found, or is not the mesh.
    """
    rows = np.arange(len(cloud)) if plan.region is None else np.flatnonzero(plan.region.contains(cloud.points))
    model = load_model(plan.mesh)
    found = estimate_pose(cloud, model, region=plan.region, part_tolerance=np.inf)
    if not found.candidates:
        raise MeasurementError(f"{plan.path.name}: {plan.name} is not in the scan: {found.why}")
    best = found.candidates[0]
    if best.explained < _EXPLAINED:
        raise MeasurementError(
            f"{plan.path.name}: {100 * best.explained:.0f} % of the points there lie on {plan.name}: give its region, or correct the mesh"
        )
    strain = find_strain(cloud, model, best.cloud_from_model, rows=_near(found, rows), pinhole=pinhole)
    own = plan.uncertainty / model.diameter
    scale_uncertainty = 2.0 * np.sqrt(np.diag(strain.sigma) ** 2 + (0.5 * own) ** 2)
    error_uncertainty = 2.0 * float(np.hypot(strain.error_sigma, 0.5 * plan.uncertainty))
    decisions: list[Decision] = []
    words = [f"{plan.name} is off its mesh by {strain.error_mm:+.4f} mm (U {error_uncertainty:.4f}, k = 2) at most"]
    if (d := decide(strain.error_mm, plan.error, error_uncertainty)) is not None:
        decisions.append(d)
        words.append(f"{plan.error:g} allowed: {d}")
    for k, axis in enumerate("xyz"):
        if plan.scale is not None and strain.told[k, k]:
            d = decide(float(strain.scale[k]), plan.scale, float(scale_uncertainty[k])) or "undecided"
            decisions.append(d)
            if d != "pass":
                words.append(f"lengths along {axis} {100 * strain.scale[k]:+.3f} % (U {100 * scale_uncertainty[k]:.3f}), {100 * plan.scale:g} % allowed: {d}")  # fmt: skip
    return Watched(
        plan, strain, scale_uncertainty, error_uncertainty, overall(decisions) if decisions else None, "; ".join(words)
    )


def _near(found: PoseResult, rows: np.typing.NDArray[np.int64]) -> np.typing.NDArray[np.int64]:
    """Rows that pose estimation took for the artefact, or all that were looked at where it took none."""
    return found.points if len(found.points) else rows
