"""History: what was calibrated, verified and checked, and what drifts."""

from __future__ import annotations

import math

from nicegui import ui

from scope.console.console import Console
from scope.console.pages.layout import box, chart, figures, framed, table, told
from scope.history import Chart, Record, chart_of

_TITLES = {"heldout_mm": "Error of planes held out", "error_mm": "Error on the artefact"}


def add_history(console: Console) -> None:
    """Add the page."""

    @ui.page("/history")
    def history() -> None:
        with framed(console, "History"):
            records = console.history()
            if not records:
                told("Nothing is recorded yet: calibrations, scans and checks of this session will stand here.")
                return
            _charts(records, console.limits())
            with box("Records"):
                rows = [
                    (
                        r.when.replace("T", " ")[:16].replace("-", "\u2011").replace(" ", "\u00a0"),
                        r.kind,
                        "passed" if r.passed else "not passed",
                        _told(r),
                        r.file,
                        r.rig[:10],
                        r.camera.removeprefix("camera ").rpartition("/")[2][-40:],
                        f"{r.who}, {r.version}",
                    )
                    for r in records[:200]
                ]
                table(figures(rows, ("when", "what", "", "figures", "file", "rig", "camera", "who, version"))).classes(
                    "left"
                )
                with ui.element("div").classes("fields"):
                    ui.link("all as CSV", "/history.csv")
                    ui.label("the same by: scope history --db history.db --csv history.csv").classes("muted")


_NAMES = {"heldout_mm": "held out", "error_mm": "error", "form_mm": "form", "sigma_mm": "sigma"}


def _told(record: Record) -> str:
    known = record.figures
    parts = [f"{word} {known[name]:.4f} mm" for name, word in _NAMES.items() if name in known]
    parts += [f"{known[name]:,.0f} {name}" for name in ("points", "faults") if name in known]
    return ", ".join(parts)


def _charts(records: list[Record], limits: dict[str, float]) -> None:
    """Control charts of what drifts: the error of planes held out, how far the sheets of light moved, the artefact's error."""
    oldest = records[::-1]
    names = sorted(
        {n for r in oldest for n in r.figures if n in {"heldout_mm", "error_mm"} or n.endswith(".offset_mm")}
    )
    for name in names:
        kinds = {"error_mm": {"check"}, "heldout_mm": {"calibrate", "verify"}}.get(name, {"calibrate"})
        mine = [r for r in oldest if r.kind in kinds]
        tolerances = [r.figures["tolerance_mm"] for r in mine if "tolerance_mm" in r.figures]
        limit = {"error_mm": tolerances[-1] if tolerances else None, "heldout_mm": limits.get("ray_mm")}.get(
            name, limits.get("laser_mm")
        )
        if sum(name in r.figures for r in mine) >= 2:
            with box(f"{_TITLES.get(name, name.removesuffix('.offset_mm') + ': shift of its sheet')}, mm"):
                _chart(name, mine, limit)


def _chart(name: str, records: list[Record], limit: float | None) -> None:
    """One chart, and the limit that one may type."""
    plot = chart("scatter", "record, the oldest first", "mm", height="11rem")
    plot.options["series"][0]["symbolSize"] = 8
    with ui.element("div").classes("fields"):
        field = (
            ui.number("limit, mm", value=limit, min=0.0, format="%.6g")
            .props("dense outlined clearable")
            .classes("w-36")
        )
        words = ui.column().classes("gap-1").style("flex:1 1 14rem")

    def draw() -> None:
        shift = name.endswith(".offset_mm")
        allowed = float(field.value) if field.value else None
        found = chart_of(name, records, limit=allowed, shift=shift)
        series = plot.options["series"][0]
        series["data"] = [[k + 1, value] for k, value in enumerate(found.values)]
        series["markLine"]["data"] = [
            {"yAxis": x, "lineStyle": {"color": colour}, "label": {"formatter": word, "position": "insideEndTop", "color": "#8793a3"}}
            for x, colour, word in (
                (found.low, "#8793a3", "control"), (found.centre, "#3d8fd1", "mean"), (found.high, "#8793a3", "control"),
                (allowed, "#d9534f", "limit"), (-allowed if shift and allowed else None, "#d9534f", "limit"))
            if x is not None and math.isfinite(x)
        ]  # fmt: skip
        plot.update()
        words.clear()
        with words:
            _say(found, allowed)

    field.on_value_change(draw)
    draw()


def _say(found: Chart, limit: float | None) -> None:
    if not math.isfinite(found.centre):
        ui.label(f"{len(found.values)} records; control limits and a trend follow from five").classes("muted")
        return
    if found.outside:
        told(f"{len(found.outside)} of {len(found.values)} beyond the control limits: something changed there", "warn")
    if found.recalibrate_by:
        told(f"by its trend, recalibrate by {found.recalibrate_by}", "warn")
    elif math.isfinite(found.slope):
        more = "it moves away from the limit" if limit else "give a limit to have the day on which it is met"
        ui.label(f"a trend of {30.0 * found.slope:+.3g} mm in 30 days; {more}").classes("muted")
    else:
        told("no trend that its scatter would not explain", "good")
