"""Scan: motion, start, stop; the cloud grows while it runs; what is rejected and why."""

from __future__ import annotations

from functools import partial
from typing import Any

from nicegui import ui

from scope.console.console import Console
from scope.console.folder import frame_numbers
from scope.console.pages.layout import EMPTY, box, cloud_viewer, figures, framed, live_image, say, table, told
from scope.report import why_no_point

_GROWING = """
<script>
(() => {
  const turn = async () => {
    for (const image of document.querySelectorAll("img.growing")) {
      if (document.hidden || image.dataset.want === image.dataset.have) continue;
      const want = image.dataset.want, answer = await fetch("/growing.jpg?side=" + image.dataset.side, {cache: "no-store"}).catch(() => null);
      if (answer && answer.status === 200) {
        if (image.src.startsWith("blob:")) URL.revokeObjectURL(image.src);
        image.src = URL.createObjectURL(await answer.blob());
      }
      image.dataset.have = want;
    }
    setTimeout(turn, 400);
  };
  turn();
})();
</script>
"""


def add_scan(console: Console) -> None:
    """Add the page."""

    @ui.page("/scan")
    def scan() -> None:
        ui.add_body_html(_GROWING)
        ui.add_head_html('<script src="/viewer.js" defer></script>')
        with framed(console, "Scan"), ui.element("div").classes("two"):
            with ui.column().classes("w-full gap-3"):
                _cloud(console)
            with ui.column().classes("w-full gap-3"):
                with box("Motion"):
                    _motion(console)
                _unfinished(console)
                with box("Lines without a point, and why") as why:
                    rejected = table()
                live_image()

        def refresh() -> None:
            counts = console.growth.rejected.most_common(8)
            rows = [(key.replace("_", " "), str(count), why_no_point(key)) for key, count in counts]
            why.set_visibility(bool(rows))
            rejected.set_content(figures(rows, ("reason", "lines", "what it means")) if rows else "")

        ui.timer(0.7, refresh)


def _motion(console: Console) -> None:
    offered = console.motion
    if console.rig() is None:
        told("There is no rig in the session yet: calibrate first.", "warn")
    with ui.element("div").classes("fields"):
        kinds = {"linear": "linear", "turntable": "turntable", "fixed": "fixed"}
        kind = ui.toggle(kinds, value=offered.get("kind", "linear")).props("dense no-caps")
        sides = {"object": "object moves", "sensor": "sensor moves"}
        moves = ui.toggle(sides, value=offered.get("moves", "object")).props("dense no-caps")
    stage = ui.checkbox(
        "direction and axis of the rig's own stage",
        value=offered.get("direction") == "rig" or offered.get("axis") == "rig",
    )
    with ui.element("div").classes("fields") as vectors:
        direction = _vector(
            "direction, or axis, x y z", offered.get("direction", offered.get("axis_direction", [1, 0, 0]))
        )
        point = _vector("point on the axis, mm", offered.get("axis_point", [0, 0, 0]))
    places = {"step": "by step", "positions": "CSV by frame", "log": "log over time"}
    by = ui.toggle(places, value="step").props("dense no-caps")
    with ui.element("div").classes("fields") as even:
        step = _field("step, mm or degrees", offered.get("step", 0.5), "w-36")
        start = _field("start", offered.get("start", 0.0), "w-28")
    with ui.element("div").classes("fields") as told_elsewhere:
        file = ui.input("file in the session folder", value="stage.csv").props("dense outlined").classes("w-48")
        delay = _field("delay, s", 0.0, "w-28")
        clocks = {"first-frame": "s from the first frame", "camera": "camera's clock", "system": "Unix time"}
        clock = ui.select(clocks, value="first-frame", label="the log's clock").props("dense outlined").classes("w-48")
    with ui.element("div").classes("fields"):
        frames = _field("frames", None, "w-36", 'clearable hint="empty: all" min=1')
        lasers, turns = _lasers(console)

    def asked() -> dict[str, Any]:
        if kind.value == "fixed":
            return {"kind": "fixed"}
        told: dict[str, Any] = {"kind": kind.value, "moves": moves.value}
        if by.value == "step":
            told |= {"step": step.value, "start": start.value or 0.0}
        else:
            told[by.value] = str(file.value or "")
        if by.value == "log":
            told |= {"delay": delay.value, "clock": clock.value}
        if kind.value == "linear":
            return {**told, "direction": "rig" if stage.value else _three(direction.value)}
        if stage.value:
            return {**told, "axis": "rig"}
        return {**told, "axis_point": _three(point.value), "axis_direction": _three(direction.value)}

    def begin() -> None:
        def work() -> Any:
            more = {} if lasers is None else {"lasers": list(lasers.value), "sequence": turns.value}
            count = None if frames.value is None else int(frames.value)
            return console.start_scan({"motion": asked(), "frames": count, **more})

        if say(work) is not None:
            ui.notify("scanning")

    with ui.element("div").classes("fields"):
        ui.button("start", on_click=begin).props("no-caps unelevated").mark("start")
        ui.button("stop", on_click=console.stop).props("no-caps outline").mark("stop")

    def fit() -> None:
        moving = kind.value != "fixed"
        for part in (moves, stage, by):
            part.set_visibility(moving)
        vectors.set_visibility(moving and not stage.value)
        point.set_visibility(kind.value == "turntable")
        even.set_visibility(moving and by.value == "step")
        told_elsewhere.set_visibility(moving and by.value != "step")
        delay.set_visibility(by.value == "log")
        clock.set_visibility(by.value == "log")

    for part in (kind, stage, by):
        part.on_value_change(fit)
    fit()


def _field(label: str, value: float | None, width: str, more: str = "") -> Any:
    return ui.number(label, value=value, format="%.6g").props(f"dense outlined {more}").classes(width)


def _lasers(console: Console) -> tuple[Any, Any]:
    """Which lasers shine, and how; nothing where the rig has one."""
    rig = console.rig()
    names = [] if rig is None else list(rig.lasers)
    if len(names) < 2:
        return None, None
    lasers = ui.select(names, value=names, multiple=True, label="lasers").props("dense outlined").classes("w-48")
    turns = ui.toggle({"together": "together", "cycle": "in turn"}, value="together").props("dense no-caps")
    return lasers, turns


def _unfinished(console: Console) -> None:
    """Scans that broke off: range what is there, or go on behind it."""

    def resume(name: str, *, camera: bool) -> None:
        if say(lambda: console.resume_scan(name, camera=camera)) is not None:
            ui.notify(f"{name}: going on")

    @ui.refreshable
    def names() -> None:
        for name in console.folder.unfinished()[:5]:
            with ui.element("div").classes("step"):
                with ui.element("div").classes("what"):
                    ui.label(name).style("font-weight:600")
                    count = len(frame_numbers(console.folder.scan(name)))
                    ui.label(f"broke off; {count} frames are kept").classes("muted")
                ui.button("finish", on_click=partial(resume, name, camera=False)).props("dense no-caps unelevated")
                if console.can_go_on(name):
                    ui.button("resume", on_click=partial(resume, name, camera=True)).props("dense no-caps outline")

    with box("Unfinished scans") as part:
        names()
        ui.label(
            "finish ranges the frames that are kept; resume takes the camera's next frames behind them, the stage being where it stopped"
        ).classes("muted")
    seen: list[Any] = [None]

    def refresh() -> None:
        there = [] if console.jobs.running is not None else console.folder.unfinished()
        part.set_visibility(bool(there))
        if there != seen[0]:
            seen[0] = there
            names.refresh()

    refresh()
    ui.timer(1.0, refresh)


def _vector(label: str, value: Any) -> Any:
    text = " ".join(f"{x:g}" for x in value) if isinstance(value, list | tuple) else "1 0 0"
    return ui.input(label, value=text).props("dense outlined").classes("w-48")


def _three(text: str) -> list[float]:
    try:
        return [float(part) for part in str(text).replace(",", " ").split()]
    except ValueError as error:
        raise ValueError(f"{str(text)[:40]!r} is not three numbers") from error


def _cloud(console: Console) -> None:
    progress = ui.linear_progress(0.0, show_value=False).props('aria-label="frames done"')
    state = told("No scan yet.")
    with ui.element("div").classes("two") as growing:
        pictures = [
            ui.element("img")
            .classes("seen growing")
            .props(f'alt="the cloud so far, {side}" data-side="{side}" src="{EMPTY}"')
            for side in ("top", "side")
        ]
    viewer = ui.element("div").classes("w-full")
    shown: list[Any] = [None]

    def refresh() -> None:
        growth, job = console.growth, console.jobs.running
        scanning = job is not None and job.kind == "scan"
        progress.set_visibility(scanning)
        growing.set_visibility(scanning and growth.points > 0)
        if job is not None and scanning:
            progress.set_value(job.done / job.total if job.total else 0.0)
            for picture in pictures:
                picture.props(f'data-want="{growth.version}"')
            lost = console.station.status.get("dropped", 0)
            state.set_text(f"{growth.name}: {growth.frames} frames, {growth.points} points, {lost} frames dropped")
            state.classes(replace="told")
        last = console.jobs.last
        name = "" if scanning else next(iter(console.folder.clouds()), "")
        now = (name, None if last is None else (last.id, last.state))
        if scanning or now == shown[0]:
            return
        shown[0] = now
        if last is not None and last.kind == "scan" and last.state == "failed":
            state.set_text(last.message)
            state.classes(replace="told bad")
        elif last is not None and last.kind == "scan" and last.state == "done":
            _tell(state, last.result)
        elif name:
            state.set_text(f"{name}: the newest scan of this session")
        viewer.clear()
        with viewer:
            if name:
                _finished(console, name)

    ui.timer(0.6, refresh, immediate=True)


def _tell(state: Any, found: dict[str, Any]) -> None:
    good = found["complete"] and found["verified"] and not found["troubles"]
    text = f"{found['scan']}: {found['points']} points from {found['frames']} frames, median sigma {found['sigma_mm']:.4f} mm"
    for trouble in (
        found["why_incomplete"],
        *found["troubles"],
        "" if found["verified"] else "the rig is not verified: do not use this cloud",
    ):
        text += f"; {trouble}" if trouble else ""
    state.set_text(text)
    state.classes(replace=f"told {'good' if good else 'bad'}")


def _finished(console: Console, name: str) -> None:
    cloud_viewer(name)
    with ui.element("div").classes("fields"):
        ui.label("downloads").classes("muted")
        for file in ("cloud.ply", "report.html", "capture.toml"):
            if (console.folder.scan(name) / file).is_file():
                ui.link(file, f"/files/scans/{name}/{file}", new_tab=file.endswith("html"))
