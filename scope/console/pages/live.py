"""Live: is it in focus, is the stripe clipped, is this stand-off good."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from scope.console.console import Console
from scope.console.pages.layout import box, chart, figures, framed, live_image, say, table


def add_live(console: Console) -> None:
    """Add the page."""

    @ui.page("/")
    def live() -> None:
        if console.jobs.running is None:
            say(lambda: console.show("stripe"))
        with framed(console, "Live"), ui.element("div").classes("two"):
            with ui.column().classes("w-full gap-2"):
                image = live_image()
                advice = ui.label("looking").classes("told")
                pointed = ui.label("point at the image, or give a line, to see what was found there").classes("told")
                with ui.element("div").classes("fields"):
                    line = ui.number("line", min=0, step=1, format="%d").props("dense outlined").classes("w-28")
                    _choices(console)
            with ui.column().classes("w-full gap-3"):
                with box("What the image tells"):
                    told = table()
                with box("Profile"):
                    empty = ui.label("shown in mm once there is a rig, for the stripe").classes("muted")
                    profile = chart("scatter", "along the stripe, mm", "z, mm")
                with box("Histogram"):
                    histogram = chart("bar", "grey level", "pixels", height="9rem")
                _settings(console)

        def point(event: Any) -> None:
            look = console.look
            if look is not None and isinstance(event.args, list) and len(event.args) == 2:
                u, v = (float(x) for x in event.args)
                pointed.set_text(look.at(u * look.size[0] - 0.5, v * look.size[1] - 0.5) or "nothing was found here")

        def ask(_: Any) -> None:
            look = console.look
            if look is not None and line.value is not None:
                pointed.set_text(look.at(float(line.value), float(line.value)) or "there is no such line")

        script = "(e) => emit(e.offsetX / e.target.clientWidth, e.offsetY / e.target.clientHeight)"
        image.on("mousemove", point, js_handler=script, throttle=0.15)
        image.on("click", point, js_handler=script)
        line.on_value_change(ask)

        def refresh() -> None:
            look = console.look
            if look is None:
                return
            told.set_content(figures(look.figures))
            advice.set_text(look.advice or "exposure is right")
            advice.classes(replace=f"told {'warn' if look.advice else 'good'}")
            empty.set_visibility(not len(look.points))
            profile.set_visibility(bool(len(look.points)))
            profile.options["series"][0]["data"] = look.profile()
            profile.update()
            histogram.options["series"][0]["data"] = [
                [round((k + 0.5) * look.white / len(look.histogram)), n] for k, n in enumerate(look.histogram) if n
            ]
            histogram.update()

        ui.timer(0.5, refresh)


def _choices(console: Console) -> None:
    """What is looked at, and what a simulated camera shows."""

    def subject(event: Any) -> None:
        say(
            lambda: console.show(
                "target" if event.value == "target" else "stripe", str(plane.value or "") if plane else ""
            )
        )

    chosen = ui.toggle({"stripe": "stripe", "target": "target"}, value=console.subject, on_change=subject).props(
        "dense no-caps"
    )
    plane = None
    if console.station.simulated:
        names = [step.name for step in say(console.steps.all) or []]
        plane = ui.select(
            {"": "the object", **{n: f"stand-off {n}" for n in names}}, value="", label="before the camera"
        )
        plane.props("dense outlined").classes("w-44")
        plane.on_value_change(
            lambda event: say(
                lambda: console.show("target" if chosen.value == "target" else "stripe", str(event.value))
            )
        )
    rig = console.rig()
    if rig is not None and len(rig.lasers) > 1:
        names = list(rig.lasers)
        ui.select(
            names,
            value=console.laser or names[0],
            label="laser",
            on_change=lambda event: setattr(console, "laser", str(event.value)),
        ).props("dense outlined").classes("w-32")
    ui.checkbox(
        "overlay", value=console.overlay, on_change=lambda event: setattr(console, "overlay", bool(event.value))
    )


def _settings(console: Console) -> None:
    with box("Exposure"), ui.element("div").classes("fields"):
        settings = console.station.status.get("settings", {})
        for name, label in (("exposure_us", "exposure, µs"), ("gain", "gain")):
            value = settings.get(name)
            if value is None:
                continue
            field = ui.number(label, value=round(float(value), 2), min=0).props("dense outlined").classes("w-36")
            field.on("change", lambda _, f=field, n=name: say(lambda: console.station.set(n, float(f.value or 0))))
        if settings.get("exposure_us") is None:
            ui.label("this camera cannot be set from here").classes("muted")
