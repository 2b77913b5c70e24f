"""Scan: motion, start, stop; the cloud grows while it runs; what is rejected and why."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from scope.console.console import Console
from scope.console.pages.layout import box, figures, framed, live_image, say, table, told
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
        with framed(console, "Scan"), ui.element("div").classes("two"):
            with ui.column().classes("w-full gap-3"):
                _cloud(console)
            with ui.column().classes("w-full gap-3"):
                with box("Motion"):
                    _motion(console)
                with box("Lines without a point, and why"):
                    rejected = table()
                live_image()

        def refresh() -> None:
            counts = console.growth.rejected.most_common(8)
            rows = [(key.replace("_", " "), str(count), why_no_point(key)) for key, count in counts]
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
    with ui.element("div").classes("fields"):
        step = (
            ui.number("step, mm or degrees", value=offered.get("step", 0.5), format="%.6g")
            .props("dense outlined")
            .classes("w-36")
        )
        start = (
            ui.number("start", value=offered.get("start", 0.0), format="%.6g").props("dense outlined").classes("w-28")
        )
        frames = (
            ui.number("frames", value=None, min=1, format="%d")
            .props('dense outlined clearable hint="empty: all"')
            .classes("w-36")
        )

    def asked() -> dict[str, Any]:
        if kind.value == "fixed":
            return {"kind": "fixed"}
        told = {"kind": kind.value, "moves": moves.value, "step": step.value, "start": start.value or 0.0}
        if kind.value == "linear":
            return {**told, "direction": "rig" if stage.value else _three(direction.value)}
        if stage.value:
            return {**told, "axis": "rig"}
        return {**told, "axis_point": _three(point.value), "axis_direction": _three(direction.value)}

    def begin() -> None:
        def work() -> Any:
            return console.start_scan(
                {"motion": asked(), "frames": None if frames.value is None else int(frames.value)}
            )

        if say(work) is not None:
            ui.notify("scanning")

    with ui.element("div").classes("fields"):
        ui.button("start", on_click=begin).props("no-caps unelevated").mark("start")
        ui.button("stop", on_click=console.stop).props("no-caps outline").mark("stop")

    def fit() -> None:
        moves.set_visibility(kind.value != "fixed")
        stage.set_visibility(kind.value != "fixed")
        vectors.set_visibility(kind.value != "fixed" and not stage.value)
        point.set_visibility(kind.value == "turntable")
        step.set_visibility(kind.value != "fixed")
        start.set_visibility(kind.value != "fixed")

    kind.on_value_change(fit)
    stage.on_value_change(fit)
    fit()


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
            ui.element("img").classes("live growing").props(f'alt="the cloud so far, {side}" data-side="{side}"')
            for side in ("top", "side")
        ]
    viewer = ui.element("div").classes("w-full")
    shown: list[Any] = [None]

    def refresh() -> None:
        growth, job = console.growth, console.jobs.running
        scanning = job is not None and job.kind == "scan"
        progress.set_visibility(scanning)
        growing.set_visibility(scanning)
        if job is not None and scanning:
            progress.set_value(job.done / job.total if job.total else 0.0)
            for picture in pictures:
                picture.props(f'data-want="{growth.version}"')
            state.set_text(f"{growth.name}: {growth.frames} frames, {growth.points} points")
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
    ui.element("iframe").classes("viewer").props(f'src="/cloud/{name}" title="cloud of {name}"')
    with ui.element("div").classes("fields"):
        for file in ("cloud.ply", "report.html", "capture.toml"):
            if (console.folder.scan(name) / file).is_file():
                ui.link(file, f"/files/scans/{name}/{file}", new_tab=file.endswith("html"))
