"""An inspection in words and in JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.digits import rounded, two_digits
from scope.inspection.measure import Value
from scope.inspection.run import Inspection
from scope.pose import CONVENTION


def inspection_result(found: Inspection) -> dict[str, Any]:
    """What --json gives."""
    pose = found.pose.cloud_from_model
    off = found.deviation[np.isfinite(found.deviation)]
    known = pose is not None and len(off) > 0
    return {
        "pose": None if pose is None else pose.matrix.tolist(),
        "covariance": None if found.pose.covariance is None or pose is None else found.pose.covariance.tolist(),
        "features": [_value(v) for v in found.features],
        "surface": None if found.surface is None else _value(found.surface),
        "deviation_mm": None if not known else {
            "rms": float(np.sqrt(np.mean(off**2))), "mean": float(off.mean()), "p95": float(np.percentile(np.abs(off), 95)),
            "min": float(off.min()), "max": float(off.max()),
            "within": None if found.tolerance is None else float((np.abs(off) <= found.tolerance).mean()),
        },
        "tolerance_mm": found.tolerance,
        "decision": found.decision,
        "why": found.why,
        "rule": "ISO 14253-1, guard band of the expanded uncertainty, k = 2",
        "convention": CONVENTION,
    }  # fmt: skip


def _value(v: Value) -> dict[str, Any]:
    return {
        "name": v.name, "kind": v.kind, "nominal": v.nominal, "measured": v.measured, "deviation": v.deviation,
        "uncertainty": v.uncertainty, "unit": v.unit, "tolerance": v.tolerance, "decision": v.decision, "points": v.points,
        "scatter": v.scatter, "calibration": v.calibration, "reason": v.reason,
    }  # fmt: skip


def inspection_text(found: Inspection) -> str:
    """What the terminal shows."""
    lines = [f"{found.decision.upper()}: {found.why}"]
    if found.pose.cloud_from_model is not None:
        off = found.deviation[np.isfinite(found.deviation)]
        lines.append(
            f"{len(off):,} points, deviation rms {np.sqrt(np.mean(off**2)):.4f} mm, 95 % within {np.percentile(np.abs(off), 95):.4f} mm"
        )
    for v in (*found.features, *((found.surface,) if found.surface is not None else ())):
        if v.reason:
            lines.append(f"  {v.name} ({v.kind}): not measured: {v.reason}")
            continue
        limit = "" if v.tolerance is None else f", tolerance {v.tolerance:g}: {v.decision}"
        lines.append(
            f"  {v.name} ({v.kind}): {rounded(v.measured, v.uncertainty)} {v.unit} of {v.nominal:g}, "
            f"off {rounded(v.deviation, v.uncertainty, sign=True)}, U {two_digits(v.uncertainty)} (k = 2){limit}"
        )
    return "\n".join(lines)
