"""The viewer in a real Chromium, from a file: what it shows, reads and measures is what the cloud holds."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scope.cloud import ScanCloud
from scope.report import Page
from scope.viewer import cloud_scene

HOSTILE = "<img src=x onerror=window.hit=1>"
STEP = 0.5  # mm of the lattice
FIRST, SECOND = 0, 1  # rows of two points that stand alone


def slope() -> ScanCloud:
    """A lattice of 20 mm x 20 mm on the slope z = 400 + x / 10, and two points above it."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-10, 10 + STEP, STEP), np.arange(-10, 10 + STEP, STEP)))
    lattice = np.stack([x, y, 400.0 + x / 10], axis=1)
    points = np.concatenate([[[-6.25, -4.25, 394.0], [5.75, 4.75, 394.0]], lattice])
    n = len(points)
    return replace(
        ScanCloud.from_points(points),
        sigma=np.linspace(0.01, 0.02, n).astype(np.float32),
        intensity=np.arange(n, dtype=np.float32),
        laser_names=(HOSTILE,),
    )


class Shown:
    """A page with one viewer, and hands."""

    def __init__(self, browser: Any, page: Path) -> None:
        from selenium.webdriver import ActionChains

        self.browser, self.chain = browser, ActionChains
        browser.get(page.as_uri())
        self.host = browser.find_element("css selector", "scope-cloud")
        self.until(lambda: self.host.get_attribute("data-ready"))
        self.root = self.host.shadow_root
        self.canvas = self.root.find_element("css selector", "canvas.over")
        browser.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", self.canvas)

    def until(self, what: Callable[[], Any], seconds: float = 30.0) -> Any:
        end = time.monotonic() + seconds
        while not (found := what()):
            assert time.monotonic() < end, "did not come"
            time.sleep(0.05)
        return found

    def ask(self, code: str) -> Any:
        """What the element answers; ``v`` is the element."""
        return self.browser.execute_script(f"const v = arguments[0]; return {code}", self.host)

    def press(self, selector: str) -> None:
        self.root.find_element("css selector", selector).click()

    def move(self, place: Any) -> Any:
        box = self.canvas.rect
        return self.chain(self.browser, duration=0).move_to_element_with_offset(
            self.canvas, round(place[0] - box["width"] / 2), round(place[1] - box["height"] / 2)
        )

    def at(self, point: Any) -> list[float]:
        """Where a point of the cloud frame stands on the canvas by the law of a parallel projection, seen along z, px."""
        middle, scale = self.ask("[v.view.target.toArray().map((x, k) => x + v.scene.centre[k]), v.view.scale]")
        box = self.canvas.rect
        return [box["width"] / 2 + scale * (point[0] - middle[0]), box["height"] / 2 + scale * (point[1] - middle[1])]

    def click(self, place: Any) -> None:
        self.move(place).click().perform()

    def reading(self) -> dict[str, list[str]]:
        rows = self.root.find_elements("css selector", ".reading tbody tr")
        cells = [[cell.text for cell in row.find_elements("css selector", "th, td")] for row in rows]
        return {first: rest for first, *rest in cells}


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    page = Page(HOSTILE)
    page.text("before")
    page.cloud(cloud_scene(slope()), f"a slope {HOSTILE}")
    for _ in range(40):
        page.text("below")
    path = tmp_path_factory.mktemp("viewer") / "slope.html"
    path.write_text(page.html(), encoding="utf-8")
    return path


@pytest.fixture
def shown(chromium: Any, page: Path) -> Any:
    found = Shown(chromium, page)
    yield found
    assert [e for e in chromium.get_log("browser") if e["level"] in {"SEVERE", "WARNING"}] == []
    assert chromium.execute_script("return window.hit") is None


def test_points_are_read_where_they_are_seen_and_measured(shown: Shown) -> None:
    cloud = slope()
    shown.ask("v.lookAlong('along z')")
    shown.click(shown.at(cloud.points[FIRST]))
    reading = shown.until(shown.reading)
    assert [reading[f"{a}, mm"][0] for a in "xyz"] == ["-6.25000", "-4.25000", "394.00000"]
    assert float(reading["sigma, noise, mm"][0]) == pytest.approx(float(cloud.sigma[FIRST]), abs=1e-5)
    assert reading["intensity, grey levels"] == ["0"]
    assert reading["laser"] == [HOSTILE]  # as text
    shown.click(shown.at([3.0, -7.0]))  # a point of the slope
    assert [shown.reading()[f"{a}, mm"][0] for a in "xyz"] == ["3.00000", "-7.00000", "400.30000"]

    shown.press("[data-mode=distance]")
    for row in (FIRST, SECOND):
        shown.click(shown.at(cloud.points[row]))
    far = float(np.linalg.norm(cloud.points[SECOND] - cloud.points[FIRST]))
    assert shown.root.find_element("css selector", ".distance").text == f"Distance {far:.5f} mm"
    assert shown.reading()["x, mm"] == ["-6.25000", "5.75000", "12.00000"]

    # the picture itself: yellow to blue of the slope at its place, the ground beside it
    shown.ask("(v.forget(), v.showColumn(v.scene.columns.findIndex(c => c.name === 'z')), v.draw())")
    time.sleep(0.3)
    picture = cv2.imdecode(np.frombuffer(shown.canvas.screenshot_as_png, np.uint8), cv2.IMREAD_COLOR_RGB).astype(int)
    low, high, outside = (picture[round(y) - 2 : round(y) + 3, round(x) - 2 : round(x) + 3].reshape(-1, 3).mean(axis=0)
                          for x, y in (shown.at([-9.0, 0.0]), shown.at([9.0, 0.0]), shown.at([-13.0, -9.0])))  # fmt: skip
    assert high[1] > low[1] + 40  # viridis: what is larger is lighter
    assert np.ptp(outside) < 16  # the ground is grey


def test_scalars_have_a_bar_with_their_range(shown: Shown) -> None:
    cloud = slope()
    sigma = np.percentile(cloud.sigma, (2, 98))
    shown.root.find_element("css selector", "select[aria-label='colour by'] option:nth-child(3)").click()
    bar = shown.root.find_element("css selector", ".scale")
    assert (bar.get_attribute("data-column"), bar.get_attribute("data-unit")) == ("sigma", "mm")
    assert [float(bar.get_attribute(f"data-{k}")) for k in ("low", "high")] == pytest.approx(sigma, abs=1e-6)
    assert bar.text.split("\n")[0] == "sigma, noise, mm"
    ticks = [float(text) for text in bar.text.split("\n")[1:]]
    assert len(ticks) >= 3
    assert sigma[0] <= min(ticks) < max(ticks) <= sigma[1]
    names = [
        option.text for option in shown.root.find_elements("css selector", "select[aria-label='colour by'] option")
    ]
    assert {"z, mm", "intensity, grey levels", "frame", "laser", "x, mm", "y, mm"} <= set(names)


def test_a_section_is_what_lies_within_it(shown: Shown) -> None:
    points = slope().points
    shown.press("[data-mode=section]")
    for label, value in (("place of the section, mm", 4.5), ("thickness of the section, mm", 0.2)):
        field = shown.root.find_element("css selector", f"input[aria-label='{label}']")
        shown.browser.execute_script(
            "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('change'))", field, value
        )
    inside = points[np.abs(points[:, 0] - 4.5) <= 0.1]
    order = np.argsort(inside[:, 1])
    along, across = shown.ask("[[...v.profile.s], [...v.profile.t]]")
    np.testing.assert_allclose(along, inside[order, 1], atol=1e-4)
    np.testing.assert_allclose(across, inside[order, 2], atol=1e-4)
    # along a line drawn by hand, seen along z: straight up the slope, which it shows as it is
    shown.ask("v.lookAlong('along z')")
    shown.move(shown.at([-8.0, 3.0])).click_and_hold().perform()
    shown.move(shown.at([8.0, 3.0])).release().perform()
    assert shown.until(lambda: shown.ask("v.panel.across.value")) == "drawn"
    along, across = (np.array(x) for x in shown.ask("[[...v.profile.s], [...v.profile.t]]"))
    assert len(along) >= 41
    np.testing.assert_allclose(np.polyfit(along, across, 1), [0.1, 399.2], atol=1e-3)  # its 0 is where it was begun


def test_the_page_scrolls_under_the_wheel_until_the_viewer_is_clicked(shown: Shown) -> None:
    def scroll() -> tuple[float, float]:
        before = shown.ask("[scrollY, v.view.scale]")
        shown.browser.execute_cdp_cmd(
            "Input.dispatchMouseEvent",
            {"type": "mouseWheel", "x": middle[0], "y": middle[1], "deltaX": 0, "deltaY": 120},
        )
        time.sleep(0.4)
        after = shown.ask("[scrollY, v.view.scale]")
        return after[0] - before[0], after[1] / before[1]

    box = shown.browser.execute_script("return arguments[0].getBoundingClientRect().toJSON()", shown.canvas)
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    moved, zoomed = scroll()
    assert moved > 20
    assert zoomed == 1.0
    shown.click([60, 60])
    moved, zoomed = scroll()
    assert moved == 0
    assert zoomed < 0.95


def test_keys_and_fingers_turn_zoom_and_read(shown: Shown) -> None:
    from selenium.webdriver.common.keys import Keys

    scale, facing = "v.view.scale", "v.view.forward.toArray()"
    shown.canvas.send_keys("z")
    np.testing.assert_allclose(shown.ask(facing), [0, 0, 1], atol=1e-6)
    shown.canvas.send_keys(Keys.ENTER)  # what is under the cross, in the middle
    assert abs(float(shown.reading()["x, mm"][0])) < 1.0
    before = shown.ask(scale)
    shown.canvas.send_keys("+")
    assert shown.ask(scale) == pytest.approx(1.2 * before)
    shown.canvas.send_keys(Keys.ARROW_LEFT)
    assert shown.ask(facing)[2] < 0.999
    shown.canvas.send_keys("r")
    assert shown.ask(scale) != pytest.approx(before)

    box = shown.browser.execute_script("return arguments[0].getBoundingClientRect().toJSON()", shown.canvas)
    x, y, before = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, shown.ask(scale)
    for kind, wide in (("touchStart", 40), ("touchMove", 60), ("touchMove", 80), ("touchEnd", None)):
        fingers = [] if wide is None else [{"x": x - wide, "y": y, "id": 0}, {"x": x + wide, "y": y, "id": 1}]
        shown.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})
    assert shown.ask(scale) == pytest.approx(2.0 * before, rel=0.01)  # twice as far apart
    # double click: what is under it becomes the middle of turning
    shown.ask("(v.reset(), v.lookAlong('along z'))")
    shown.move(shown.at([5.0, 5.0])).double_click().perform()
    np.testing.assert_allclose(
        shown.ask("v.view.target.toArray().map((x, k) => x + v.scene.centre[k])"), [5.0, 5.0, 400.5], atol=1e-3
    )


def test_viewers_come_and_go_with_the_page(shown: Shown) -> None:
    """More of them than a browser has contexts for: those out of sight give theirs back, and all come again when they are seen."""
    count = 12
    shown.browser.execute_script(
        "const [v, n] = arguments; for (let k = 0; k < n; k++) { const one = document.createElement('scope-cloud'); "
        "one.bytes = v.bytes; one.className = 'more'; one.style.minHeight = '900px'; document.querySelector('main').append(one); }",
        shown.host,
        count,
    )
    alive = "return [...document.querySelectorAll('scope-cloud')].filter(v => v.renderer && !v.renderer.getContext().isContextLost()).length"
    for k in (*range(0, count, 3), 0):
        shown.browser.execute_script(
            "document.querySelectorAll('.more')[arguments[0]].scrollIntoView({behavior: 'instant'})", k
        )
        ready = "return document.querySelectorAll('.more')[arguments[0]].dataset.ready"
        shown.until(lambda k=k, ready=ready: shown.browser.execute_script(ready, k))
        assert shown.browser.execute_script(alive) <= 9
    shown.browser.execute_script("document.querySelectorAll('.more').forEach(v => v.remove())")
    shown.browser.execute_script("arguments[0].scrollIntoView({behavior: 'instant'})", shown.host)
    shown.until(lambda: shown.host.get_attribute("data-ready"))
    assert shown.browser.execute_script(alive) == 1


def test_it_fits_its_window_and_prints_and_falls_back_to_a_picture(shown: Shown, page: Path) -> None:
    browser = shown.browser
    for width in (400, 1600):
        browser.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False},
        )
        shown.until(
            lambda width=width: (
                abs(shown.canvas.rect["width"] - shown.ask("v.view.width")) < 1 and shown.ask("innerWidth") == width
            )
        )
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    still = shown.host.find_element("css selector", "img.still")
    assert not still.is_displayed()
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert still.is_displayed()
    assert still.get_attribute("alt") == f"a slope {HOSTILE}"
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    without = "const get = HTMLCanvasElement.prototype.getContext; HTMLCanvasElement.prototype.getContext = function (kind, ...rest) { return kind.startsWith('webgl') ? null : get.call(this, kind, ...rest); }"
    script = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": without})
    browser.get(page.as_uri())
    shown.until(lambda: browser.find_element("css selector", "scope-cloud").get_attribute("data-failed"))
    assert browser.find_element("css selector", "img.still").is_displayed()
    browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)
    browser.get_log("browser")  # three.js complains there, rightly
