"""An artefact beside the part, in words and in JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from scope.watch.correction import Correction
from scope.watch.drift import Drift
from scope.watch.run import Watched


def watch_result(found: Watched, drift: Sequence[Drift] = ()) -> dict[str, Any]:
    """What `scope scan --watch --json` gives under ``watch``."""
    s = found.strain
    return {
        "artefact": found.plan.name, "decision": found.decision, "why": found.why, "points": len(s.points),
        "rms_mm": s.rms_mm, "rms_without_stretch_mm": s.rms_after_mm, "error_mm": s.error_mm, "uncertainty_mm": found.error_uncertainty,
        "scale_percent": {
            axis: {"value": 100 * float(s.scale[k]), "uncertainty": 100 * float(found.scale_uncertainty[k])}
            for k, axis in enumerate("xyz") if s.told[k, k]
        },
        "matrix": s.matrix.tolist(), "terms": s.terms.tolist(), "terms_sigma": s.sigma.tolist(), "determined": s.told.tolist(),
        "cloud_from_artefact": s.pose.matrix.tolist(),
        "drift": [{"figure": d.figure, "value": d.value, "low": d.low, "high": d.high, "slope": d.slope, "scans": d.scans} for d in drift],
    }  # fmt: skip


def watch_figures(found: Watched) -> dict[str, float]:
    """What is kept of each scan, to tell drift."""
    s = found.strain
    figures = {"error_mm": s.error_mm, "rms_mm": s.rms_mm}
    return figures | {f"scale_{a}_percent": 100 * float(s.scale[k]) for k, a in enumerate("xyz") if s.told[k, k]}


def watch_text(found: Watched, drift: Sequence[Drift] = ()) -> str:
    """What the terminal shows."""
    verdict = "" if found.decision is None else f"{found.decision.upper()}: "
    lines = [f"artefact: {verdict}{found.why}", *_scales(found)]
    return "\n".join([*lines, *(f"  DRIFT: {d.text}" for d in drift)])


def correction_result(found: Correction) -> dict[str, Any]:
    """What `scope correct --json` gives."""
    return {**watch_result(found.watched), "passed": found.rig.verification.passed, "cloud": found.cloud}


def correction_text(found: Correction) -> str:
    """What the terminal shows."""
    s = found.watched.strain
    lines = [
        f"{found.watched.plan.name}: rms {s.rms_mm:.4f} mm as scanned, {s.rms_after_mm:.4f} mm with the corrected rig"
    ]
    return "\n".join([*lines, *_scales(found.watched)])


def _scales(found: Watched) -> list[str]:
    s = found.strain
    told = [
        f"  lengths along {axis} of C are seen {100 * s.scale[k]:+.4f} % too long (U {100 * found.scale_uncertainty[k]:.4f}, k = 2)"
        for k, axis in enumerate("xyz") if s.told[k, k]
    ]  # fmt: skip
    for i in range(3):
        for j in range(3):
            if i != j and s.told[i, j] and abs(s.terms[i, j]) > 2 * s.sigma[i, j]:
                tilt = np.rad2deg(s.terms[i, j])
                told.append(f"  {'xyz'[i]} moves with {'xyz'[j]} by {-tilt:+.4f} degrees (U {2 * np.rad2deg(s.sigma[i, j]):.4f})")  # fmt: skip
    if not told:
        told.append("  this artefact, as it lies, determines no scale: two levels or faces that slope both ways would")
    return told
