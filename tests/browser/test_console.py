"""A person without hardware: live stripe, calibrated, scanned, measured, history, every step by clicks in a real Chromium."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.small_session import DESIGN

ROOT = Path(__file__).resolve().parents[2]
BALL = ("-64", "-16", "-24", "24", "400", "448")
BRACKET = ("-125", "-78", "-22", "22", "400", "449")  # mm, about the bracket of the design
KEEP = os.environ.get("SCOPE_SCREENSHOTS")  # folder for pictures of every page
WITHOUT = "is not installed; run: .venv/bin/python -m pip install -e '.[console,browser]' (make test does)"
pytest.importorskip("nicegui", reason=f"nicegui {WITHOUT}")


class Served:
    """A running console."""

    def __init__(self, folder: Path, *words: str, token: str = "") -> None:
        self.token = token
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.link = f"http://127.0.0.1:{self.port}"
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST", "SCOPE_HISTORY"))} | {
            "PYTHONPATH": str(ROOT)
        }
        command = [sys.executable, "-c", "from cli.main import main; main()", "console", "--session", str(folder), "--no-show",
                   "--port", str(self.port), *words, *(["--token", token] if token else [])]  # fmt: skip
        self.process = subprocess.Popen(
            command, cwd=folder.parent, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        until = time.monotonic() + 120
        while time.monotonic() < until and self.process.poll() is None:
            try:
                if self.get("/api/v1/status", **({"Authorization": f"Bearer {token}"} if token else {}))["camera"].get(
                    "frames"
                ):
                    return
            except (urllib.error.URLError, ConnectionError, TimeoutError, ValueError):
                pass
            time.sleep(0.2)
        self.process.kill()
        raise AssertionError(self.process.communicate()[0])

    def get(self, path: str, **headers: str) -> Any:
        return json.loads(self.raw(path, **headers)[1])

    def raw(self, path: str, data: bytes | None = None, **headers: str) -> tuple[int, bytes]:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        request = urllib.request.Request(self.link + path, data=data, headers=named)  # noqa: S310
        try:
            with urllib.request.urlopen(request, timeout=20) as answer:  # noqa: S310
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            return error.code, error.read()

    def close(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A console on examples/window-design.toml: whole with SCOPE_WHOLE=1, else with fewer stand-offs and every second frame."""
    home = tmp_path_factory.mktemp("console")
    design = home / "window-design.toml"
    text = (ROOT / "examples" / "window-design.toml").read_text(encoding="utf-8")
    if not os.environ.get("SCOPE_WHOLE"):
        for whole, less in (
            ("[340, 375, 410, 445, 480]", "[340, 410, 480]"), ("step = 0.5", "step = 1.0"), ("frames = 110", "frames = 55")
        ):  # fmt: skip
            assert whole in text
            text = text.replace(whole, less)
    design.write_text(text, encoding="utf-8")
    console = Served(home / "session", "--simulate", str(design))
    yield console
    console.close()


@pytest.fixture(scope="module")
def browser(chromium: Any) -> Any:
    return chromium


FITS = "return document.documentElement.scrollWidth <= arguments[0]"
BUTTONS = "return [...document.querySelectorAll('button')].filter(b => b.innerText.trim() === arguments[0])"


def until(what: Callable[[], Any], *, seconds: float = 180.0) -> Any:
    """Wait until something is so; elements that a page replaces meanwhile are looked for again."""
    end = time.monotonic() + seconds
    while True:
        try:
            if found := what():
                return found
        except Exception as error:
            if time.monotonic() > end:
                raise
            del error
        assert time.monotonic() < end, "did not come"
        time.sleep(0.2)


def click(browser: Any, text: str) -> None:
    until(lambda: browser.execute_script(BUTTONS, text))
    until(lambda: browser.execute_script(BUTTONS, text)[0].click() is None)


def text_of(browser: Any) -> str:
    return str(browser.execute_script("return document.body.innerText"))


def fill(browser: Any, label: str, value: str) -> None:
    """Type into the field of a label, as from a keyboard."""
    from selenium.webdriver.common.keys import Keys

    field = until(lambda: browser.find_element("css selector", f"input[aria-label='{label}']"))
    field.send_keys(Keys.CONTROL, "a")
    field.send_keys(value, Keys.TAB)


VIEWS = (
    ("wide", 1280, 900, False),
    ("narrow-dark", 390, 844, True),
    ("wide-dark", 1280, 900, True),
    ("narrow", 390, 844, False),
)


def picture(browser: Any, name: str) -> None:
    """Keep what is on the screen as a small WebP."""
    import cv2

    image = cv2.imdecode(np.frombuffer(browser.get_screenshot_as_png(), np.uint8), cv2.IMREAD_COLOR)
    cv2.imwrite(str(Path(KEEP or ".") / f"console-{name}.webp"), image, [cv2.IMWRITE_WEBP_QUALITY, 80])


def keep(browser: Any, name: str) -> None:
    """Wide and light, narrow and dark: nothing may run out of the page, nothing may have failed in it. Pictures where asked for."""
    for view, width, height, dark in VIEWS if KEEP else VIEWS[:2]:
        browser.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600},
        )
        browser.execute_cdp_cmd(
            "Emulation.setEmulatedMedia",
            {"features": [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]},
        )
        until(lambda width=width: browser.execute_script(FITS, width), seconds=15)
        if KEEP:
            time.sleep(2.0)
            picture(browser, f"{name}-{view}")
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def shown(browser: Any) -> Any:
    """Whether a live image is there."""
    return int(browser.execute_script("return document.getElementById('live').dataset.frame || 0")) > 0


def test_a_person_without_hardware(served: Served, browser: Any) -> None:
    """The steps depend on each other: one test."""
    from selenium.webdriver.common.keys import Keys

    browser.get(served.link)
    until(lambda: int(browser.execute_script("return document.getElementById('live').dataset.frame || 0")) > 3)
    until(lambda: "lines with a point" in text_of(browser))
    fill(browser, "line", "300")  # why a line has no point, by keyboard
    until(lambda: "column 300" in text_of(browser))
    keep(browser, "live")

    for _ in range(12):  # to the next page by keyboard alone
        browser.switch_to.active_element.send_keys(Keys.TAB)
        if browser.switch_to.active_element.text == "Calibrate":
            break
    browser.switch_to.active_element.send_keys(Keys.ENTER)
    stand_offs = 5 if os.environ.get("SCOPE_WHOLE") else 3
    until(lambda: browser.current_url.endswith("/calibrate"))
    until(lambda: shown(browser))
    until(lambda: "ready to take" in text_of(browser) or "marks in view" in text_of(browser))
    click(browser, "skip")
    until(lambda: "left out of the calibration" in text_of(browser))
    click(browser, "take in")
    for left in reversed(range(stand_offs)):
        click(browser, "take")
        until(lambda left=left: len(browser.execute_script(BUTTONS, "take")) == left)
    until(lambda: text_of(browser).count("good: ") == stand_offs)
    click(browser, "calibrate")
    until(lambda: "the whole report" in text_of(browser))
    assert "passed: " in text_of(browser)
    keep(browser, "calibrate")

    browser.get(served.link + "/scan")
    click(browser, "start")
    until(lambda: browser.execute_script("return document.querySelector('img.growing[data-have]') !== null"))
    if KEEP:
        time.sleep(15)
        picture(browser, "scanning-wide")
    until(lambda: "median sigma" in text_of(browser))
    until(lambda: browser.execute_script("return document.querySelector('scope-cloud[data-ready]') !== null"))
    assert "outside calibration" in text_of(browser)
    keep(browser, "scan")

    browser.get(served.link + "/measure")
    browser.find_element("css selector", "input[type=file]").send_keys(str(ROOT / "examples" / "bracket.stl"))
    until(lambda: "bracket.stl" in str(browser.execute_script("return document.body.innerHTML")))
    for label, value in zip(("x from", "x to", "y from", "y to", "z from", "z to"), BRACKET, strict=True):
        fill(browser, label, value)
    click(browser, "find the part")
    until(lambda: "row 1 of the rotation" in text_of(browser))
    assert "pose.html" in text_of(browser)
    keep(browser, "pose")
    for label, value in zip(("x from", "x to", "y from", "y to", "z from", "z to"), BALL, strict=True):
        fill(browser, label, value)
    click(browser, "check")
    until(lambda: "measured, mm" in text_of(browser))
    assert "radius" in text_of(browser) or "diameter" in text_of(browser)
    keep(browser, "check")

    browser.get(served.link + "/history")
    until(lambda: "held out" in text_of(browser))
    assert {"calibrate", "scan", "check"} <= set(text_of(browser).replace("\t", "\n").split("\n"))
    keep(browser, "history")


def test_the_api_says_what_the_contract_says(served: Served) -> None:
    status = served.get("/api/v1/status")
    assert status["state"] in {"ready", "error", "scan", "calibration", "check"}
    assert {"driver", "id", "model", "size"} <= set(status["camera"])
    assert "rig" in status
    described = served.get("/api/v1/openapi.json")["paths"]
    assert {"/api/v1/status", "/api/v1/scan", "/api/v1/result", "/api/v1/pose", "/api/v1/job/{job}"} <= set(described)


@pytest.mark.parametrize(
    ("path", "data", "headers", "code"),
    [
        ("/api/v1/status", None, {"Host": "rebound.example"}, 421),
        ("/api/v1/scan", b"{}", {"Origin": "https://evil.example", "Content_Type": "application/json"}, 403),
        ("/api/v1/scan", b'{"frames": 0}', {"Content_Type": "application/json"}, 422),
        ("/api/v1/scan", b'{"job": "<script>"}', {"Content_Type": "application/json"}, 422),
        ("/api/v1/scan", b'{"motion": {"kind": "linear", "step": NaN}}', {"Content_Type": "application/json"}, 422),
        ("/api/v1/scan", b"[" * 30000, {"Content_Type": "application/json"}, 400),
        ("/api/v1/pose", b'{"model": "../../etc/passwd"}', {"Content_Type": "application/json"}, 400),
        ("/files/scans/%2e%2e/rig.json", None, {}, 400),
        ("/files/scans/..%2f..%2fetc/passwd", None, {}, 400),
        ("/files/history.db", None, {}, 422),
        ("/files/scans/none/.live.toml", None, {}, 400),
        ("/cloud/%3Cimg%20src=x%3E.bin", None, {}, 400),
    ],
)
def test_what_must_not_be_answered_is_not(
    served: Served, path: str, data: bytes | None, headers: dict[str, str], code: int
) -> None:
    status, body = served.raw(path, data, **headers)
    assert status == code, body
    assert b"Traceback" not in body
    assert b"<script>" not in body


def test_a_console_open_to_others_asks_for_its_token(tmp_path: Path) -> None:
    design = tmp_path / "design.toml"
    design.write_text(DESIGN, encoding="utf-8")
    token = "0123456789abcdef-token"  # noqa: S105
    console = Served(tmp_path / "session", "--simulate", str(design), token=token)
    try:
        for path in (
            "/",
            "/scan",
            "/frame.jpg",
            "/api/v1/status",
            "/files/calibration.toml",
            "/_nicegui_ws/socket.io/?EIO=4&transport=polling",
        ):
            assert console.raw(path)[0] == 401
            assert console.raw(path, Authorization=f"Bearer {token[:-1]}")[0] == 401
        assert console.raw("/api/v1/status", Cookie=f"scope_token={token}")[0] == 200
    finally:
        console.close()


def test_addresses_open_to_others_have_a_token_that_nobody_guesses() -> None:
    from scope.console import Address

    assert Address.of("127.0.0.1", 8765, None).token is None
    assert len(Address.of("192.168.7.20", 8765, None).token or "") > 40
    with pytest.raises(ValueError, match="16 characters"):
        Address.of("192.168.7.20", 8765, "short")
