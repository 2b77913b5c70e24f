"""A check against an artefact, in words and in JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calibration.digits import rounded, two_digits
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


def error_text(check: ArtefactCheck) -> str:
    """The largest error, to the place that its uncertainty allows; to that of the scatter where no size has one."""
    worst = max(check.sizes, key=lambda s: abs(s.error), default=None)
    return rounded(check.error_mm, check.rms_mm / 10 if worst is None else worst.uncertainty, sign=True)


def check_text(check: ArtefactCheck) -> str:
    """One scan of an artefact for a person."""
    lines = [
        f"{s.name}: {rounded(s.measured, s.uncertainty)} mm, nominal {s.nominal:g}, error {rounded(s.error, s.uncertainty, sign=True)} "
        f"(claimed uncertainty {two_digits(s.uncertainty)}, k = 2)"
        for s in check.sizes
    ]
    linearity = (
        f"{two_digits(check.linearity_percent)} % of {check.span_mm:.1f} mm"
        if np.isfinite(check.linearity_percent)
        else "not covered"
    )
    lines.append(
        f"error {error_text(check)} mm, form (95 %) {check.form_mm:.3g} mm, rms {check.rms_mm:.3g} mm, linearity {linearity}, "
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
