"""Calibrate: the stand-offs as a list with traffic lights; take, redo, skip; the verdict in the end."""

from __future__ import annotations

from functools import partial
from typing import Any

from nicegui import run, ui

from scope.console.console import Console
from scope.console.pages.layout import box, figures, framed, live_image, refused, say, table, told
from scope.console.steps import Step

_WORDS = {"good": "good", "poor": "not good", "taken": "half taken", "empty": "to take", "skipped": "skipped"}


def add_calibrate(console: Console) -> None:
    """Add the page."""

    @ui.page("/calibrate")
    def calibrate() -> None:
        with framed(console, "Calibrate"), ui.element("div").classes("two"):
            with ui.column().classes("w-full gap-3"):
                with box("Stand-offs"):
                    _steps(console)
                with box("Verdict"):
                    _verdict(console)
            with ui.column().classes("w-full gap-2"):
                live_image()
                _now(console)
                ui.label(
                    "Each stand-off: put the target in its place, take; the light says whether it is good. "
                    f"Images land in {console.folder.root.name}/, as calibration.toml names them; closing this page loses nothing."
                ).classes("muted")


def _now(console: Console) -> None:
    """What the image of this moment would be judged."""
    if console.jobs.running is None:
        steps = say(partial(console.steps.all, judge=False)) or []
        waiting = [step.name for step in steps if step.light == "empty"] + [step.name for step in steps]
        say(lambda: console.show("target", waiting[0] if waiting else ""))
    advice = told("looking")
    content = table()

    def refresh() -> None:
        look = console.look
        if look is None or look.subject != "target":
            return
        expected = console.expected_marks()
        found = len(look.spots)
        shown = {**look.figures, **({"spots": f"{found}, the target has {expected}"} if expected else {})}
        content.set_content(figures(shown))
        few = expected is not None and found < 0.95 * expected
        advice.set_text(look.advice or (f"{found} of {expected} marks in view" if few else "ready to take"))
        advice.classes(replace=f"told {'warn' if look.advice or few else 'good'}")

    ui.timer(0.5, refresh)


def _steps(console: Console) -> None:
    @ui.refreshable
    def steps() -> None:
        if not console.folder.calibration.is_file():
            told(
                "There is no calibration.toml in the session folder: write one with `scope calibrate --init spots`.",
                "warn",
            )
            return
        steps_there = say(partial(console.steps.all, judge=False)) or []
        if not steps_there:
            told(
                "calibration.toml has no [[plane]]: freehand [[views]] are taken by hand, and calibrated below.", "warn"
            )
        for step in steps_there:
            with ui.element("div").classes("step").mark(step.name):
                ui.element("span").classes(f"lamp {step.light}").props(f'role="img" aria-label="{_WORDS[step.light]}"')
                with ui.element("div").classes("what"):
                    ui.label(step.name).style("font-weight:600")
                    counts = ", ".join(f"{count} {kind}" for kind, count in step.files.items() if count)
                    said = step.told if step.light == "empty" else f"{_WORDS[step.light]}: {step.told}"
                    ui.label(said + (f" ({counts})" if counts else "")).classes("muted")
                    if step.checks:
                        with ui.element("div").classes("chips"):
                            for word, good in step.checks.items():
                                ui.label(("✓ " if good else "✗ ") + word).classes(f"chip {'good' if good else 'bad'}")
                with ui.element("div").style("display:flex;gap:.4rem;margin-left:auto"):
                    _buttons(console, step, steps.refresh)

    async def judge() -> None:
        with refused():
            await run.io_bound(console.steps.all)
        steps.refresh()

    steps()
    ui.timer(0.1, judge, once=True)


def _buttons(console: Console, step: Step, refresh: Any) -> None:
    async def take(kind: str) -> None:
        if console.jobs.running is not None:
            ui.notify("a job is running; wait for its end", type="warning")
            return
        console.subject = "target"
        with refused():
            done = await run.io_bound(partial(console.steps.take, console.station, step.name, kind))
            console.show("target", step.name)
            await run.io_bound(console.steps.all)  # judged here, so that the page does not wait
            ui.notify(done, type="positive")
        refresh()

    def skip() -> None:
        say(partial(console.steps.skip, step.name, out=step.light != "skipped"))
        refresh()

    again = step.light not in {"empty", "skipped"}
    if console.steps.in_turn(console.station, step):
        kinds = [("", "redo" if again else "take")]
    else:
        kinds = [(kind, f"{kind} again" if step.files.get(kind) else f"take {kind}") for kind in step.shots]
    for kind, label in kinds:
        button = ui.button(label, on_click=partial(take, kind)).props(
            f'dense no-caps unelevated aria-label="{label} {step.name}"'
        )
        button.mark(f"take-{step.name}{'-' + kind if kind else ''}")
    ui.button("take in" if step.light == "skipped" else "skip", on_click=skip).props("dense no-caps flat")


def _report(console: Console) -> None:
    """The report with its pictures, on the page and by itself."""
    if not (console.folder.root / "calibration.html").is_file():
        return
    with ui.expansion("the report, with pictures of every stand-off").classes("w-full").props("dense"):
        ui.element("iframe").classes("viewer").props(
            'src="/files/calibration.html" title="report of the calibration" loading="lazy"'
        )
    with ui.element("div").classes("fields"):
        ui.link("the whole report", "/files/calibration.html", new_tab=True)
        ui.link("rig.json", "/files/rig.json")


def _verdict(console: Console) -> None:
    def start() -> None:
        if say(console.start_calibration) is not None:
            ui.notify("calibrating")

    ui.button("calibrate", on_click=start).props("no-caps unelevated").mark("calibrate")
    progress = ui.linear_progress(0.0, show_value=False).props('aria-label="planes done"')
    seen: list[Any] = [None]

    @ui.refreshable
    def verdict() -> None:
        job = next(
            (job for job in (console.jobs.running, console.jobs.last) if job is not None and job.kind == "calibration"),
            None,
        )
        if job is None or job.state == "running":
            rig = console.rig()
            if rig is not None:
                told(
                    ("passed: " if rig.verification.passed else "not passed: ") + rig.verification.why,
                    "good" if rig.verification.passed else "bad",
                )
                _report(console)
            return
        if job.state == "failed":
            told(job.message, "bad")
            return
        found = job.result
        told(
            ("passed: " if found["passed"] else "not passed: ") + str(found["why"]),
            "good" if found["passed"] else "bad",
        )
        for fault in found["faults"][:8]:
            told(f"{fault['plane']}: {fault['kind']}: {fault['remedy']}", "bad")
        rows = [
            (
                str(p["name"]),
                str(p["used"]),
                *(("-" if p.get(key) is None else f"{p[key]:.4f}") for key in ("fit_px", "heldout_mm")),
            )
            for p in found["planes"]
        ]
        ui.html(figures(rows, ("plane", "marks", "fit, px", "held out, mm")), sanitize=False).classes("w-full")
        _report(console)

    verdict()

    def refresh() -> None:
        job = console.jobs.running
        mine = job is not None and job.kind == "calibration"
        progress.set_visibility(mine)
        if job is not None and mine:
            progress.set_value(job.done / max(job.total, 1))
        last = console.jobs.last
        now = None if last is None else (last.id, last.state)
        if now != seen[0]:
            seen[0] = now
            verdict.refresh()

    ui.timer(0.5, refresh)
