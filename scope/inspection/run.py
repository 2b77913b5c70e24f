"""A scan and a model to an inspection: pose, deviations, features, decision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.geometry import Array, Ints, Pose
from scope.check import Decision, decide, overall, rays_of, shared_of
from scope.cloud import Region, ScanCloud
from scope.inspection.features_file import Wanted
from scope.inspection.measure import Value, measured_features
from scope.inspection.primitives import OnPart
from scope.model import Model, load_model, patches
from scope.pose import PoseResult, estimate_pose

_PATCH = 25  # of the part's diameter, a side, over which deviations are averaged
_LEAST_IN_PATCH = 10


@dataclass(frozen=True, slots=True, eq=False)
class Inspection:
    """What a scan says of a part."""

    cloud: ScanCloud
    pose: PoseResult
    tolerance: float | None  # mm
    features: tuple[Value, ...]
    surface: Value | None  # the patch that lies furthest off the model; None without a pose
    deviation: Array  # (len(pose.points),) mm, outside positive
    decision: Decision
    why: str


def inspect_part(
    cloud: ScanCloud,
    model: str | Path | Model,
    *,
    features: Sequence[Wanted] = (),
    tolerance: float | None = None,
    region: Region | None = None,
) -> Inspection:
    """Compare a scan with the model of the part.

    Parameters
    ----------
    cloud : ScanCloud
        mm.
    model : path or Model
    features : sequence of Wanted
        What is measured; without any, the surface as a whole is judged.
    tolerance : float, optional
        mm, of every length without one of its own, and of the surface: no patch (a twenty-fifth of the diameter) may lie
        further off the model on average.
    region : Region, optional
        Where the part is.

    Returns
    -------
    Inspection
        The decision is that of ISO 14253-1 on every feature; undecided where the pose is not sure.

    Raises
    ------
    MeasurementError
        A cloud in which nothing can be the part.
    """
    if tolerance is not None and not tolerance > 0:
        raise ValueError(f"the tolerance must be positive, mm; found {tolerance:g}")
    prepared = model if isinstance(model, Model) else load_model(model)
    # a part that is not as drawn is placed all the same: here its deviations are the answer
    found = estimate_pose(cloud, prepared, region=region, part_tolerance=np.inf)
    if found.cloud_from_model is None:
        return Inspection(
            cloud, found, tolerance, (), None, found.deviation, "undecided", f"the pose is not sure: {found.why}"
        )
    part = on_part(cloud, found.points, found.cloud_from_model)
    values = measured_features(part, prepared, features, tolerance, _in_model(found))
    surface = _surface(part, found.deviation, prepared.diameter, None if features else tolerance)
    decisions = [v.decision for v in (*values, surface) if v.decision is not None]
    decision = overall(decisions)
    return Inspection(
        cloud, found, tolerance, tuple(values), surface, found.deviation, decision, _why(decision, values, surface)
    )


def on_part(cloud: ScanCloud, rows: Ints, cloud_from_model: Pose) -> OnPart:
    """Points of a cloud in the frame of the model, with their errors along the sighting rays."""
    some = cloud.select(rows)
    camera, ray = rays_of(some)
    shared, local = shared_of(some, camera, ray)
    turn = cloud_from_model.rotation
    return OnPart(
        cloud_from_model.inverse.apply(some.points), None if ray is None else ray @ turn,
        np.nan_to_num(some.sigma).astype(np.float64), np.nan_to_num(some.sigma_cal).astype(np.float64), np.einsum("ij,nik->njk", turn, shared), local,
    )  # fmt: skip


def _in_model(found: PoseResult) -> Array | None:
    """Covariance (6, 6) of the pose with both vectors along the model's axes."""
    if found.covariance is None or found.cloud_from_model is None:
        return None
    back = np.kron(np.eye(2), found.cloud_from_model.rotation.T)
    return np.asarray(back @ found.covariance @ back.T)


def _surface(part: OnPart, deviation: Array, diameter: float, tolerance: float | None) -> Value:
    """The patch whose mean deviation is largest; single points far off (of a clamp, of dust) are no part of it."""
    near = np.abs(deviation) < max(0.05 * diameter, 1.0)
    points, off = part.points[near], deviation[near]
    label = patches(points, diameter / _PATCH)
    count = np.bincount(label)
    mean = np.bincount(label, weights=off) / count
    good = np.flatnonzero(count >= min(_LEAST_IN_PATCH, int(count.max())))
    worst = int(good[np.argmax(np.abs(mean[good]))])
    rows = np.flatnonzero(label == worst)
    # a patch may hold an edge, a fillet, speckle: its own scatter, half of the points taken to err alike
    scatter = float(np.std(off[rows]) / np.sqrt(max(len(rows) / 4.0, 1.0)))
    shared = float(np.median(part.sigma_cal[near][rows]))
    u = 2.0 * float(np.hypot(scatter, shared))
    value = float(mean[worst])
    return Value(
        "surface", "surface", 0.0, value, u, "mm", tolerance, decide(value, tolerance, u), len(off), scatter, shared
    )


def _why(decision: Decision, values: Sequence[Value], surface: Value) -> str:
    judged = [v for v in (*values, surface) if v.decision is not None]
    if not judged:
        return "nothing has a tolerance; give --tolerance, or tolerance in features.toml"
    count = {d: [v for v in judged if v.decision == d] for d in ("pass", "fail", "undecided")}
    text = ", ".join(f"{len(v)} {d}" for d, v in count.items() if v)
    if decision == "pass":
        return f"all {len(judged)} pass: each within its tolerance by more than its uncertainty (k = 2)"
    first = count[decision][0]
    if first.reason:
        return f"{text}; {first.name}: {first.reason}"
    return (
        f"{text}; {first.name}: {first.measured:.4g} {first.unit}, {first.deviation:+.3g} off, U {first.uncertainty:.2g} (k = 2), "
        f"tolerance {first.tolerance:g}"
    )
