"""The viewer with millions of points beside Plotly's scatter3d: time to the first picture, and of a point picked, in Chromium.

python -m benchmarks.view [--points 3000000] [--alone]. Software rendering (SwiftShader) where there is no graphics card: what counts is the ratio.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from calibration.geometry import Array

_PICKS = 25
_WAIT = 400.0  # s for a page


def surface(n: int) -> Array:
    """Points (n, 3) mm of a wavy plate of 100 mm in scan order, with 5 um of noise."""
    rows = round(n**0.5)
    x, y = np.meshgrid(np.linspace(0, 100, -(-n // rows)), np.linspace(0, 100, rows))
    points = np.stack([x.ravel(), y.ravel(), 400 + 4 * np.sin(x.ravel() / 9) * np.cos(y.ravel() / 7)], axis=1)[:n]
    points[:, 2] += np.random.default_rng(0).normal(0.0, 0.005, n)
    return points


def browser() -> Any:
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for word in ("--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
                 "--window-size=1280,900"):  # fmt: skip
        options.add_argument(word)
    found = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    found.set_page_load_timeout(_WAIT)
    found.set_script_timeout(_WAIT)
    return found


def wait(chromium: Any, code: str) -> float:
    """What a page says, as soon as it does."""
    end = time.monotonic() + _WAIT
    while time.monotonic() < end:
        if (answer := chromium.execute_script(f"return {code}")) is not None:
            return float(answer)
        time.sleep(0.05)
    raise TimeoutError(code)


def ours(points: Array, folder: Path) -> dict[str, Any]:
    from dataclasses import replace

    from scope.cloud import ScanCloud
    from scope.viewer import cloud_scene, viewer_page

    from_ = time.perf_counter()
    page = folder / "ours.html"
    n, rng = len(points), np.random.default_rng(1)
    frame, line = np.divmod(np.arange(n), round(n**0.5))
    cloud = replace(
        ScanCloud.from_points(points), frame=frame.astype(np.int32), sigma=rng.lognormal(-5.3, 0.2, n).astype(np.float32),
        sigma_cal=rng.lognormal(-6.0, 0.1, n).astype(np.float32), intensity=rng.normal(180, 12, n).astype(np.float32),
        pixels=np.stack([line, 400 + 9 * points[:, 2] - 3600], axis=1).astype(np.float32),
    )  # fmt: skip
    page.write_text(viewer_page(cloud_scene(cloud), "bench"), encoding="utf-8")
    written = time.perf_counter() - from_
    chromium = browser()
    try:
        chromium.get(page.as_uri())
        first = wait(chromium, "document.querySelector('scope-cloud')?.dataset.ready ?? null")
        chromium.execute_script("window.v = document.querySelector('scope-cloud')")
        time.sleep(3.0)
        picks = [chromium.execute_script("const from = performance.now(); const row = v.pickAt(...arguments); v.choose(row); "
                                         "return [performance.now() - from, row]", *place) for place in places(_PICKS)]  # fmt: skip
        turn = chromium.execute_async_script("""
            const done = arguments[0], times = []; let last = performance.now();
            const step = now => { times.push(now - last); last = now; v.view.turn(0.02, 0.01); v.draw(true);
              if (times.length < 40) requestAnimationFrame(step); else done(times.slice(15).sort((a, b) => a - b)[12]); };
            requestAnimationFrame(step);""")
        stopped = float(chromium.execute_script("return performance.now()"))
        whole = wait(chromium, "v.dataset.drawn === v.dataset.within ? performance.now() : null") - stopped
    finally:
        chromium.quit()
    hit = sum(row is not None for _, row in picks)
    return {"written": written, "size": page.stat().st_size, "first": first, "pick": median(t for t, _ in picks), "hit": hit,
            "turn": turn, "whole": whole}  # fmt: skip


def plotly(points: Array, folder: Path) -> dict[str, Any]:
    import plotly.graph_objects as go

    x, y, z = points.astype(np.float32).T
    page = folder / "plotly.html"
    from_ = time.perf_counter()
    figure = go.Figure(go.Scatter3d(x=x, y=y, z=z, mode="markers", marker={"size": 1, "color": z}))
    figure.write_html(page, include_plotlyjs=True, div_id="plot",
                      post_script="requestAnimationFrame(() => requestAnimationFrame(() => { window.ready = performance.now(); }));")  # fmt: skip
    written = time.perf_counter() - from_
    chromium = browser()
    try:
        chromium.get(page.as_uri())
        first = wait(chromium, "window.ready ?? null")
        time.sleep(3.0)
        times = []
        for u, v in places(8):
            chromium.execute_script("""
                const plot = document.getElementById("plot"); window.took = null;
                plot.addEventListener("mousemove", () => { window.from ??= performance.now(); }, {capture: true}); window.from = undefined;
                plot.on("plotly_hover", () => { window.took ??= performance.now() - window.from; });""")
            chromium.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mouseMoved", "x": u, "y": v})
            end = time.monotonic() + 8.0
            while time.monotonic() < end and (took := chromium.execute_script("return window.took")) is None:
                time.sleep(0.05)
            times += [] if took is None else [float(took)]
    finally:
        chromium.quit()
    return {
        "written": written,
        "size": page.stat().st_size,
        "first": first,
        "pick": median(times) if times else float("nan"),
        "hit": len(times),
    }


def places(n: int) -> list[tuple[float, float]]:
    rng = np.random.default_rng(3)
    return [(float(u), float(v)) for u, v in rng.uniform([330, 330], [560, 520], (n, 2))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=3_000_000)
    parser.add_argument("--alone", action="store_true", help="without Plotly")
    asked = parser.parse_args()
    points = surface(asked.points)
    with tempfile.TemporaryDirectory() as name:
        own = ours(points, Path(name))
        print(
            f"{len(points)} points; first picture from the opening of the page, ms; a pick from click to readings, ms (median)"
        )
        print(f"SCOPE   page {own['size'] / 1e6:6.1f} MB in {own['written']:5.1f} s; first {own['first']:8.0f}; pick {own['pick']:8.2f} "
              f"({own['hit']} of {_PICKS} hit); turning {own['turn']:.0f} ms a picture; all points {own['whole']:.0f} ms after it stands")  # fmt: skip
        if asked.alone:
            return
        try:
            peer = plotly(points, Path(name))
        except Exception as error:  # noqa: BLE001  (a browser that gave up is an answer)
            print(f"Plotly  gave no picture within {_WAIT:.0f} s ({type(error).__name__})")
            return
    print(
        f"Plotly  page {peer['size'] / 1e6:6.1f} MB in {peer['written']:5.1f} s; first {peer['first']:8.0f}; pick {peer['pick']:8.2f} ({peer['hit']} of 8 hit)"
    )
    print(f"ratio   first {own['first'] / peer['first']:.3f}; pick {own['pick'] / peer['pick']:.4f}")


if __name__ == "__main__":
    main()
