"""Measure: a region of the cloud for roughness, a model for pose, an artefact for accuracy."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import ui

from scope.console.console import Console
from scope.console.pages.layout import box, figures, framed, refused, say, table, told


def add_measure(console: Console) -> None:
    """Add the page."""

    @ui.page("/measure")
    def measure() -> None:
        clouds = console.folder.clouds()
        with framed(console, "Measure"):
            if not clouds:
                told("There is no cloud in the session yet: scan first.", "warn")
                return
            with ui.element("div").classes("two"):
                with ui.column().classes("w-full gap-3"):
                    scan = ui.select(clouds, value=clouds[0], label="scan").props("dense outlined").classes("w-full")
                    region = _region(console, scan)
                with ui.column().classes("w-full gap-3"):
                    _roughness(console, scan, region)
                    _pose(console, scan)
                    _check(console, scan, region)
                    with box("Answer"):
                        _answer(console)


def _region(console: Console, scan: Any) -> Callable[[], str | None]:
    """Map of the cloud on which a rectangle is drawn; gives it as box:x0,x1,y0,y1."""
    with box("Region: draw it on the map, or type it"):
        image = (
            ui.interactive_image("", cross="#3d8fd1", events=["mousedown", "mouseup"])
            .classes("w-full")
            .props('alt="map of the cloud, seen along z"')
            .mark("map")
        )
        with ui.element("div").classes("fields"):
            fields = [
                ui.number(name, format="%.4g").props("dense outlined clearable").classes("w-28")
                for name in ("x from", "x to", "y from", "y to")
            ]
        note = ui.label("Empty: the whole cloud. x runs to the right, y down; mm, cloud frame.").classes("muted")
    place: dict[str, Any] = {}
    corner: list[float] = []

    def load() -> None:
        found = say(partial(console.map_of, str(scan.value)))
        if found is None:
            return
        address, (x0, y0, scale), size = found
        place.update(x0=x0, y0=y0, scale=scale)
        image.set_source(address)
        image.content = ""
        note.set_text(f"{size}. Empty: the whole cloud. x runs to the right, y down; mm, cloud frame.")

    def mouse(event: Any) -> None:
        if not place:
            return
        if event.type == "mousedown":
            corner[:] = [event.image_x, event.image_y]
        elif event.type == "mouseup" and corner:
            (u0, u1), (v0, v1) = sorted((corner[0], event.image_x)), sorted((corner[1], event.image_y))
            corner.clear()
            if u1 - u0 < 3 or v1 - v0 < 3:
                return
            values = [place["x0"] + u0 / place["scale"], place["x0"] + u1 / place["scale"],
                      place["y0"] + v0 / place["scale"], place["y0"] + v1 / place["scale"]]  # fmt: skip
            for field, value in zip(fields, values, strict=True):
                field.set_value(round(value, 3))
            image.content = (
                f'<rect x="{u0:.0f}" y="{v0:.0f}" width="{u1 - u0:.0f}" height="{v1 - v0:.0f}" fill="#ffffff22" stroke="#ff5c5c" '
                'stroke-width="2"/>'
            )

    image.on_mouse(mouse)
    scan.on_value_change(load)
    load()

    def region() -> str | None:
        values = [field.value for field in fields]
        if all(value is None for value in values):
            return None
        if any(value is None for value in values):
            raise ValueError("a region needs all four numbers, or none")
        return "box:" + ",".join(f"{value:.10g}" for value in values)

    return region


def _roughness(console: Console, scan: Any, region: Callable[[], str | None]) -> None:
    def start() -> None:
        say(lambda: console.start_roughness(str(scan.value), region()))

    with box("Roughness of the region"):
        ui.button("measure roughness", on_click=start).props("no-caps unelevated").mark("roughness")


def _pose(console: Console, scan: Any) -> None:
    with box("Pose of a part"):
        models = (
            ui.select(console.folder.models(), label="model in the folder models")
            .props("dense outlined")
            .classes("w-full")
        )

        def start() -> None:
            say(lambda: console.start_pose(str(scan.value), str(models.value or "")))

        async def take(event: Any) -> None:
            with refused():
                name = console.keep_model(Path(event.file.name).name, await event.file.read())
                models.set_options(console.folder.models(), value=name)

        with ui.element("div").classes("fields"):
            ui.button("find the part", on_click=start).props("no-caps unelevated").mark("pose")
        ui.upload(label="add a model: STL, OBJ, PLY", on_upload=take, max_file_size=60 << 20, auto_upload=True).props(
            "flat bordered dense"
        ).classes("w-full")


def _check(console: Console, scan: Any, region: Callable[[], str | None]) -> None:
    with box("Accuracy on an artefact"), ui.element("div").classes("fields"):
        artefact = ui.input("artefact", value="sphere:d=40").props("dense outlined").classes("w-48")
        tolerance = ui.number("tolerance, mm", min=0.0).props("dense outlined clearable").classes("w-32")

        def start() -> None:
            say(lambda: console.start_check(str(scan.value), str(artefact.value), tolerance.value, region()))

        ui.label("plane, sphere:d=40, cylinder:d=20 or steps:5,10,20; mm").classes("muted")
        ui.button("check", on_click=start).props("no-caps unelevated").mark("check")


def _answer(console: Console) -> None:
    state = told("Nothing was measured yet.")
    content = table()
    seen: list[Any] = [None]

    def refresh() -> None:
        job = console.jobs.last
        if job is None or job.kind not in {"roughness", "pose", "check"}:
            return
        now = (job.id, job.state)
        if now == seen[0]:
            return
        seen[0] = now
        level = {"running": "", "failed": "bad", "done": "good" if job.result.get("good") else "bad"}[job.state]
        state.set_text(
            job.message
            if job.state == "failed"
            else f"{job.kind}: measuring"
            if job.state == "running"
            else str(job.result["told"])
        )
        state.classes(replace=f"told {level}")
        content.set_content(figures(job.result["rows"], job.result["head"]) if job.state == "done" else "")

    ui.timer(0.5, refresh, immediate=True)
