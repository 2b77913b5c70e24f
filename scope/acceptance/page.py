"""An acceptance test as a protocol to be filed: conditions, tests, positions, points, and what is known of the standard."""

from __future__ import annotations

import numpy as np

from scope.acceptance.run import Acceptance, AcceptanceTest
from scope.report import Level, Page, cloud_from

_LEVELS: dict[str | None, Level] = {"pass": "good", "fail": "bad", "undecided": "warn", None: "plain"}
_SHOWN = 6  # scans whose points are drawn


def acceptance_page(found: Acceptance) -> str:
    """One self-contained HTML page."""
    plan = found.plan
    page = Page(f"Acceptance test after {plan.standard.title}")
    page.verdict(_LEVELS[found.decision], f"{found.decision or 'nothing decided'}: {found.why}")
    if not found.verified:
        page.verdict("warn", "The scans are of a rig that is not verified, or do not say so.")
    for text in found.remarks:
        page.verdict("warn", text)
    page.heading("Errors and limits")
    page.table(
        ("error", "what", "worst, mm", "U (k = 2), mm", "limit, mm", "decision", "positions"),
        [
            [t.symbol, t.name, _signed(t, t.worst.value), f"{t.uncertainty:.4f}", "-" if t.limit is None else f"{t.limit:g}", t.decision or "-",
             f"{t.positions}" if t.needed is None else f"{t.positions} of {t.needed}"]
            for t in found.tests
        ],
    )  # fmt: skip
    page.text(
        "Decision rule: ISO 14253-1. Pass where every value stays within its limit by more than U, fail where one is beyond by more than U, "
        "undecided between, and where positions are missing. U is that of the test: calibration, form and temperature of the artefact. The "
        "scanner's own uncertainty is what is tested; it is stated beside each value as claimed."
    )
    _add_conditions(page, found)
    for test in found.tests:
        _add_test(page, test)
    _add_points(page, found)
    page.heading("Of the standard")
    page.text(
        "The text of the standard is not free and was not at hand. Definitions, numbers of positions and proportions are those of public "
        "sources; docs/method.md of SCOPE names the source of each and says what could not be verified."
    )
    page.about("file", plan.path.name)
    page.about("scanner", plan.about.get("scanner", ""))
    page.about("operator", plan.about.get("operator", ""))
    page.about("rig", ", ".join(found.rigs))
    return page.html()


def _add_conditions(page: Page, found: Acceptance) -> None:
    plan = found.plan
    page.heading("Artefacts and conditions")
    rows = [
        [a.kind.replace("_", " "), "-" if a.size == 0 else f"{a.size:.4f}", " and ".join(f"{d:g}" for d in a.diameters) or "-",
         f"{2 * a.size_sigma:.4f}", f"{a.form:.4f}", a.certificate or "-", str(len(a.scans))]
        for a in plan.artefacts
    ]  # fmt: skip
    page.table(
        ("artefact", "size, mm", "spheres, mm", "U of it (k = 2), mm", "own form, mm", "certificate", "scans"), rows
    )
    volume = "not stated" if plan.diagonal is None else f"{plan.diagonal:.1f} mm"
    page.text(
        f"Temperature {plan.temperature:g} degrees Celsius; sizes are those at it. Diagonal of the measuring volume: {volume}. "
        f"Operator: {plan.about.get('operator') or '____________________'}. Date and signature: ____________________"
    )


def _add_test(page: Page, test: AcceptanceTest) -> None:
    page.heading(f"{test.symbol}: {test.name}")
    page.text(f"{test.formula[0].upper()}{test.formula[1:]}.")
    form = test.key in {"probing_form", "flatness"}
    few = any(r.representative is not None for r in test.readings)
    head = ["scan", "error, mm", "claimed, mm", "decision", "points"]
    head += ["left out", "all points, mm"] if form else []
    head += ["25 points, mm"] if few else []
    rows = []
    for r in test.readings:
        row = [r.scan, _signed(test, r.value), "-" if r.claimed is None else f"{r.claimed:.4f}", test.decided(r) or "-", str(r.points)]  # fmt: skip
        row += [str(r.left_out), f"{r.everything:.4f}"] if form else []
        row += ["-" if r.representative is None else f"{r.representative:.4f}"] if few else []
        rows.append(row)
    page.table(head, rows)
    place = np.arange(1, len(test.readings) + 1, dtype=np.float64)
    series = [("", place, np.array([r.value for r in test.readings]))]
    ends = np.array([0.5, len(place) + 0.5])
    if test.limit is not None:
        low = 0.0 if form else -test.limit
        series.append(("", np.r_[ends, np.nan, ends], np.array([low, low, np.nan, test.limit, test.limit])))
    page.plot(
        series,
        f"{test.symbol} by position (blue)" + ("" if test.limit is None else ", between its limits"),
        x_label="position",
        y_label="mm",
    )


def _add_points(page: Page, found: Acceptance) -> None:
    """Points of the worst scans, coloured by their distance from the fitted shape."""
    worst = sorted(found.seen, key=lambda s: -max(abs(r.value) for r in s.readings))[:_SHOWN]
    page.heading("Points on the artefacts")
    for seen in worst:
        reach = max(float(np.percentile(np.abs(seen.residual), 99)), 1e-6)
        axes = np.linalg.svd(seen.where - seen.where.mean(axis=0), full_matrices=False)[2]
        page.image(
            cloud_from(seen.where, np.clip(seen.residual, -reach, reach), axes[0], axes[1]),
            f"{seen.scan}: from {-reach:.4f} (dark) to {reach:.4f} mm (light) off the fitted shape",
            width=300,
        )


def _signed(test: AcceptanceTest, value: float) -> str:
    return f"{value:.4f}" if test.key in {"probing_form", "flatness"} else f"{value:+.4f}"
