"""An acceptance test in words and in JSON."""

from __future__ import annotations

from typing import Any

from scope.acceptance.run import Acceptance, AcceptanceTest


def acceptance_result(found: Acceptance) -> dict[str, Any]:
    """What `scope check --acceptance --json` gives."""
    return {
        "standard": found.plan.standard.title,
        "decision": found.decision,
        "why": found.why,
        "passed": found.decision == "pass",
        "tests": [_test(t) for t in found.tests],
        "remarks": list(found.remarks),
        "rig": found.rigs[0] if found.rigs else "",
        "verified": found.verified,
        "rule": "ISO 14253-1, guard band of the expanded uncertainty of the test value, k = 2",
    }


def _test(test: AcceptanceTest) -> dict[str, Any]:
    return {
        "test": test.key, "symbol": test.symbol, "value_mm": test.worst.value, "uncertainty_mm": test.uncertainty, "limit_mm": test.limit,
        "decision": test.decision, "positions": test.positions, "needed": test.needed, "formula": test.formula,
        "readings": [
            {
                "scan": r.scan, "value_mm": r.value, "claimed_mm": r.claimed,
                "within_claimed": None if r.claimed is None else abs(r.value) <= r.claimed,
                "all_points_mm": r.everything, "representative_mm": r.representative, "points": r.points, "left_out": r.left_out,
                "decision": test.decided(r),
            }
            for r in test.readings
        ],
    }  # fmt: skip


def acceptance_figures(found: Acceptance) -> dict[str, float]:
    """What is worth to be watched over time: the worst value of each test."""
    return {t.symbol: t.worst.value for t in found.tests}


def acceptance_text(found: Acceptance) -> str:
    """What the terminal shows."""
    decision = "NOTHING DECIDED" if found.decision is None else found.decision.upper()
    lines = [f"{decision} after {found.plan.standard.title}: {found.why}"]
    for t in found.tests:
        worst, limit = t.worst, "" if t.limit is None else f", limit {t.limit:g}: {t.decision}"
        asked = f"{t.positions} positions" if t.needed is None else f"{t.positions} of {t.needed} positions"
        lines.append(
            f"  {t.symbol} ({t.name}): {worst.value:+.4f} mm at {worst.scan}, U {t.uncertainty:.4f} (k = 2){limit}; {asked}"
        )
        beyond = [r for r in t.readings if r.claimed is not None and abs(r.value) > r.claimed]
        if beyond:
            lines.append(
                f"    {len(beyond)} of {len(t.readings)} are more than the scanner's own stated uncertainty explains, e.g. {beyond[0].scan}: "
                f"{beyond[0].value:+.4f} of {beyond[0].claimed:.4f} mm"
            )
    return "\n".join([*lines, *(f"remark: {text}" for text in found.remarks)])
