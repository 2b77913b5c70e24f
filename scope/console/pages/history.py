"""History: what was calibrated, verified and checked, and what drifts."""

from __future__ import annotations

import math

from nicegui import ui

from scope.console.console import Console
from scope.console.pages.layout import box, chart, figures, framed, table, told
from scope.history import Record, chart_of


def add_history(console: Console) -> None:
    """Add the page."""

    @ui.page("/history")
    def history() -> None:
        with framed(console, "History"):
            records = console.history()
            if not records:
                told("Nothing is recorded yet: calibrations, scans and checks of this session will stand here.")
                return
            _charts(records)
            with box("Records"):
                rows = [
                    (
                        r.when.replace("T", " ")[:16].replace("-", "\u2011").replace(" ", "\u00a0"),
                        r.kind,
                        "passed" if r.passed else "not passed",
                        _told(r),
                        r.file,
                        r.rig[:10],
                    )
                    for r in records[:200]
                ]
                table(figures(rows, ("when", "what", "", "figures", "file", "rig")))
                ui.link("all as CSV", "/history.csv")


def _told(record: Record) -> str:
    shown = [
        name for name in ("heldout_mm", "error_mm", "form_mm", "sigma_mm", "points", "faults") if name in record.figures
    ]
    return ", ".join(f"{name} {record.figures[name]:.4g}" for name in shown)


def _charts(records: list[Record]) -> None:
    """Control charts of what drifts: the error of planes held out, where the sheets of light lie, the artefact's error."""
    oldest = records[::-1]
    names = sorted(
        {n for r in oldest for n in r.figures if n in {"heldout_mm", "error_mm"} or n.endswith(".offset_mm")}
    )
    for name in names:
        kinds = {"error_mm": {"check"}, "heldout_mm": {"calibrate"}}.get(name, {"calibrate"})
        found = chart_of(name, [r for r in oldest if r.kind in kinds])
        if len(found.values) < 2:
            continue
        with box(f"{name} over time"):
            plot = chart("scatter", "record", name, height="11rem")
            plot.options["series"][0]["data"] = [[k + 1, value] for k, value in enumerate(found.values)]
            plot.options["series"][0]["symbolSize"] = 8
            lines = [x for x in (found.low, found.centre, found.high) if math.isfinite(x)]
            plot.options["series"][0]["markLine"]["data"] = [{"yAxis": x} for x in lines]
            if not lines:
                ui.label("limits follow from five records").classes("muted")
            if found.outside:
                told(f"{len(found.outside)} of {len(found.values)} beyond the limits: something changed there", "warn")
            if found.recalibrate_by:
                told(f"by its trend, calibrate again by {found.recalibrate_by}", "warn")
