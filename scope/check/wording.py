"""A check against an artefact, in words and in JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from scope.check.artefact import ArtefactCheck, Repeatability


def check_result(check: ArtefactCheck) -> dict[str, Any]:
    """What `scope check --json` gives of one scan."""
    return {
        "artefact": check.artefact.kind,
        "error_mm": check.error_mm,
        "form_mm": check.form_mm,
        "rms_mm": check.rms_mm,
        "linearity_percent": check.linearity_percent,
        "span_mm": check.span_mm,
        "points": check.points,
        "within": check.within,
        "within_claimed_uncertainty": check.claimed,
        "sizes": [
            {
                "name": s.name,
                "nominal": s.nominal,
                "measured": s.measured,
                "error": s.error,
                "uncertainty": s.uncertainty,
                "uncertainty_parts": {"scatter": s.scatter, "calibration": s.calibration, "slope": s.slope},
            }
            for s in check.sizes
        ],
    }


def check_text(check: ArtefactCheck) -> str:
    """One scan of an artefact for a person."""
    lines = [
        f"{s.name}: {s.measured:.4f} mm, nominal {s.nominal:g}, error {s.error:+.4f} (claimed uncertainty {s.uncertainty:.4f}, k = 2)"
        for s in check.sizes
    ]
    linearity = (
        f"{check.linearity_percent:.4f} % of {check.span_mm:.1f} mm"
        if np.isfinite(check.linearity_percent)
        else "not covered"
    )
    lines.append(
        f"error {check.error_mm:+.4f} mm, form (95 %) {check.form_mm:.4f} mm, rms {check.rms_mm:.4f} mm, linearity {linearity}, "
        f"{check.points} points"
    )
    if check.claimed is False:
        lines.append(
            "the error is larger than the claimed uncertainty: look for what neither noise nor calibration explains"
        )
    if check.within is not None:
        lines.append("within tolerance" if check.within else "OUT OF TOLERANCE")
    return "\n".join(lines)


def repeat_result(repeat: Repeatability) -> dict[str, Any]:
    """What `scope check --json` gives of several scans: the worst one's keys, all scans, and how they repeat."""
    worst = max(repeat.checks, key=lambda c: abs(c.error_mm))
    return {
        **check_result(worst),
        "scans": [check_result(c) for c in repeat.checks],
        "repeatability_mm": repeat.worst_mm,
        "deviations_mm": list(repeat.deviation_mm),
    }


def out_of_tolerance(checks: Sequence[ArtefactCheck]) -> bool:
    """Whether any scan of an artefact is out of the tolerance given."""
    return any(c.within is False for c in checks)
