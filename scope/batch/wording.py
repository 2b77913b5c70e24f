"""A day in words, in JSON and on a page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibration.digits import rounded
from scope.batch.engine import Day
from scope.batch.statistics import GaugeStudy, capability, control_chart, gauge_study
from scope.batch.table import HEAD, Row, columns_of
from scope.errors import MeasurementError
from scope.report import Page

Limits = Mapping[str, tuple[float, float]]
_SHOWN = 24  # charts on a page
_ROWS = 500  # sessions on a page


def numbers_of(rows: Sequence[Row], name: str) -> list[float]:
    """Numbers of a column in the order of the rows; those that a row does not tell are left out."""
    found = []
    for row in rows:
        value = row.get(name)
        if value is None or isinstance(value, bool):
            continue
        try:
            number = float(value)
        except (TypeError, ValueError):
            continue
        if math.isfinite(number):
            found.append(number)
    return found


def figures_of_day(rows: Sequence[Row]) -> list[str]:
    """Columns that are figures: numbers in two rows or more, uncertainties left out."""
    names = [n for n in columns_of(rows) if n not in HEAD and not n.endswith((".u", ".sd")) and ".uncertainty" not in n]
    return [name for name in names if len(numbers_of(rows, name)) >= 2]


def gauge_of(rows: Sequence[Row], name: str, part: str = "label.part", operator: str = "label.operator") -> GaugeStudy:
    """Gauge study of a column by the labels of its rows.

    Raises
    ------
    MeasurementError
        Labels that make no crossed design: another count of repeats, a part that an operator has not measured.
    """
    cells: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        if part in row and operator in row:
            cells.setdefault((str(row[part]), str(row[operator])), []).extend(numbers_of([row], name))
    parts, operators = (list(dict.fromkeys(key[k] for key in cells)) for k in (0, 1))
    counts = {len(cells.get((p, o), [])) for p in parts for o in operators}
    if len(parts) < 2 or len(operators) < 2 or len(counts) != 1 or min(counts) < 2:
        raise MeasurementError(
            f"{name}: no gauge study: {len(parts)} parts by {len(operators)} operators with {min(counts, default=0)} to "
            f"{max(counts, default=0)} repeats; every operator must measure every part equally often, twice or more"
        )
    return gauge_study(np.array([[cells[p, o] for o in operators] for p in parts]))


def day_result(day: Day, limits: Limits | None = None) -> dict[str, Any]:
    """What --json gives."""
    overhead = None if day.own_seconds == 0.0 else day.seconds * day.workers / day.own_seconds - 1.0
    figures = {}
    for name in figures_of_day(day.rows):
        values = numbers_of(day.rows, name)
        chart = control_chart(values)
        told: dict[str, Any] = {
            "n": len(values), "mean": chart.centre, "sd": float(np.std(values, ddof=1)), "min": min(values), "max": max(values),
            "control": list(chart.limits), "outside": len(chart.outside),
        }  # fmt: skip
        if limits and name in limits:
            told["cp"], told["cpk"] = capability(values, *limits[name])
        if any("label.part" in row for row in day.rows):
            told["gauge"] = _gauge_result(day.rows, name)
        figures[name] = told
    return {
        "sessions": len(day.rows),
        "failed": day.failed,
        "not_to_be_used": day.doubtful,
        "seconds": day.seconds,
        "own_seconds": day.own_seconds,
        "overhead": overhead,
        "workers": day.workers,
        "kept": day.kept,
        "retried": day.retried,
        "figures": figures,
    }


def _gauge_result(rows: Sequence[Row], name: str) -> dict[str, float] | None:
    try:
        study = gauge_of(rows, name)
    except MeasurementError:
        return None
    names = ("repeatability", "operators", "interaction", "parts")
    return {key: float(np.sqrt(getattr(study, key))) for key in names} | {
        "gauge": study.gauge,
        "percent": study.percent,
    }


def day_text(day: Day) -> str:
    """What a person reads on the terminal: counts, and a line for each session that failed or is not to be used."""
    lines = [
        f"{len(day.rows)} sessions: {len(day.rows) - day.failed - day.doubtful} done, {day.doubtful} not to be used, {day.failed} failed; "
        f"{day.kept} kept of an earlier run; {day.seconds:.1f} s on {day.workers} worker(s)"
        + (f", {day.retried} begun again" if day.retried else "")
    ]
    lines += [f"{row['session']}: {row['reason']}" for row in day.rows if int(row["status"])]
    return "\n".join(lines)


def day_page(day: Day, title: str, limits: Limits | None = None) -> str:
    """The page of --report: verdict, sessions, figures over the day with their charts, and the gauge study where there are labels."""
    page = Page(title)
    page.verdict("good" if day.failed + day.doubtful == 0 else "warn", day_text(day).split("\n")[0] + ".")
    page.heading("Sessions")
    rows = sorted(day.rows, key=lambda row: int(row["status"]) == 0)[:_ROWS]
    if len(rows) < len(day.rows):
        page.text(
            f"The first {_ROWS} of {len(day.rows)} are shown, those that failed before the others; the table has all."
        )
    words = {0: "done", 3: "not to be used"}
    page.table(
        ("session", "exit", "answer", "reason", "time, s"),
        [(row["session"], str(row["status"]), words.get(int(row["status"]), "failed"), str(row["reason"] or ""), f"{float(row['seconds']):.2f}")
         for row in rows],
        marked={k for k, row in enumerate(rows) if int(row["status"])},
    )  # fmt: skip
    told = day_result(day, limits)["figures"]
    if not told:
        return page.html()
    page.heading("Figures of the day")
    page.text(
        "sd: standard deviation between sessions. Limits: three sigma of the mean moving range; outside them a session stands out."
    )
    judged = any("cp" in figure for figure in told.values())
    page.table(
        ("figure", "n", "mean", "sd", "least to greatest", "limits", "outside", *(("Cp", "Cpk") if judged else ())),
        [
            [name, str(f["n"]), rounded(f["mean"], f["sd"] / max(f["n"], 1) ** 0.5), f"{f['sd']:.2g}", *(f"{a:.5g} to {b:.5g}" for a, b in ((f["min"], f["max"]), f["control"])),
             str(f["outside"]), *((f"{f[k]:.2f}" if k in f else "-" for k in ("cp", "cpk")) if judged else ())]
            for name, f in told.items()
        ],
        marked={k for k, f in enumerate(told.values()) if f["outside"]},
    )  # fmt: skip
    _gauges(page, told)
    page.heading("Control charts")
    moving = {name: figure for name, figure in told.items() if figure["max"] > figure["min"]}
    page.text(f"Of {len(moving)} figures that change over the day the first {_SHOWN} at most.")
    for name, figure in list(moving.items())[:_SHOWN]:
        values = numbers_of(day.rows, name)
        at = np.arange(1.0, len(values) + 1.0)
        low, high = (np.full(len(values), y) for y in figure["control"])
        series = [(name, at, np.asarray(values)), ("lower limit", at, low), ("upper limit", at, high)]
        page.plot(series, f"{name}: {figure['outside']} of {len(values)} outside", x_label="session", y_label=name)
    return page.html()


def _gauges(page: Page, figures: Mapping[str, Any]) -> None:
    studied = {name: f["gauge"] for name, f in figures.items() if f.get("gauge")}
    if not studied:
        return
    page.heading("Gauge study")
    page.text(
        "Standard deviations by the analysis of variance of a crossed design, and the gauge's share of the total in percent."
    )
    names = ("repeatability", "operators", "interaction", "parts", "gauge")
    page.table(
        ("figure", *names, "percent"),
        [(name, *(f"{g[key]:.4g}" for key in names), f"{g['percent']:.1f}") for name, g in studied.items()],
    )
