"""Measure: a region of the cloud for roughness, a model for pose, an artefact for accuracy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from nicegui import ui

from scope.console.console import Console
from scope.console.pages.layout import box, cloud_viewer, figures, framed, refused, say, table, told


def add_measure(console: Console) -> None:
    """Add the page."""

    @ui.page("/measure")
    def measure() -> None:
        clouds = console.folder.clouds()
        ui.add_head_html('<script src="/viewer.js" defer></script>')
        with framed(console, "Measure"):
            if not clouds:
                told("There is no cloud in the session yet: scan first.", "warn")
                return
            with ui.element("div").classes("two"):
                with ui.column().classes("w-full gap-3"):
                    scan = ui.select(clouds, value=clouds[0], label="scan").props("dense outlined").classes("w-full")
                    region = _region(scan)
                with ui.column().classes("w-full gap-3"):
                    _roughness(console, scan, region)
                    _pose(console, scan, region)
                    _check(console, scan, region)
                    with box("Answer"):
                        _answer(console)


def _region(scan: Any) -> Callable[[], str | None]:
    """The cloud, on which a rectangle is drawn; gives it as box:x0,x1,y0,y1."""
    with box("Region: draw it on the cloud (Region), or type it"):
        place = ui.element("div").classes("w-full")
        with ui.element("div").classes("fields"):
            fields = [
                ui.number(name, format="%.4g").props("dense outlined clearable").classes("w-28")
                for name in ("x from", "x to", "y from", "y to", "z from", "z to")
            ]
        ui.label("Empty: the whole cloud. mm, in the cloud's frame.").classes("muted")

    def drawn(event: Any) -> None:
        detail = event.args.get("detail") if isinstance(event.args, dict) else None
        if not isinstance(detail, dict):
            return
        try:
            values = [float(value) for axis in ("x", "y") for value in detail[axis][:2]]
        except (KeyError, TypeError, ValueError):
            return
        for field, value in zip(fields[:4], values, strict=True):
            field.set_value(round(value, 3))

    def load() -> None:
        place.clear()
        with place:
            cloud_viewer(str(scan.value), region=True).on("scope-region", drawn, ["detail"])

    scan.on_value_change(load)
    load()

    def region() -> str | None:
        values = [field.value for field in fields]
        if all(value is None for value in values):
            return None
        if values[4:] == [None, None]:
            values = values[:4]
        if any(value is None for value in values):
            raise ValueError("a region needs x and y from and to, and of z both or none")
        return "box:" + ",".join(f"{value:.10g}" for value in values)

    return region


def _roughness(console: Console, scan: Any, region: Callable[[], str | None]) -> None:
    def start() -> None:
        say(lambda: console.start_roughness(str(scan.value), region()))

    with box("Roughness of the region"):
        ui.button("measure roughness", on_click=start).props("no-caps unelevated").mark("roughness")


def _pose(console: Console, scan: Any, region: Callable[[], str | None]) -> None:
    with box("Pose of a part, in the region"):
        models = (
            ui.select(console.folder.models(), label="model in the folder models")
            .props("dense outlined")
            .classes("w-full")
        )

        def start() -> None:
            say(lambda: console.start_pose(str(scan.value), str(models.value or ""), region=region()))

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
    links = ui.element("div").classes("fields")
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
        links.clear()
        with links:
            for file in (f"{job.kind}.html", "cloud.ply"):
                name = str(job.result.get("scan", ""))
                if name and (console.folder.scan(name) / file).is_file():
                    ui.link(file, f"/files/scans/{name}/{file}", new_tab=file.endswith("html"))

    ui.timer(0.5, refresh, immediate=True)
