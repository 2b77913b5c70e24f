"""The two pictures at the top of README.md, made by the commands that it names: ``python scripts/pictures.py [DEMO_FOLDER]``.

The rig is the drawing on the page of ``scope design examples/window-design.toml --report``, the result the cloud on the page of ``scope demo``
(made here unless a folder that holds it is given). Needs Chromium and selenium.
"""

from __future__ import annotations

import base64
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import page_checks

ROOT = Path(__file__).resolve().parents[1]
PLACE = ROOT / "docs" / "pictures"
WIDTH = 900  # px


def picture(driver: Any, page: Path, selector: str, name: str) -> None:
    """Write what a page shows of the first element of a selector."""
    metrics = {"width": 1100, "height": 1000, "deviceScaleFactor": 1.0, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    driver.get(page.resolve().as_uri())
    time.sleep(6)  # until a machine without a graphics card has drawn
    box = "const b = document.querySelector(arguments[0]).getBoundingClientRect(); return [b.x, b.y + scrollY, b.width, b.height]"
    x, y, width, height = driver.execute_script(box, selector)
    clip = {"x": x, "y": y, "width": width, "height": height, "scale": 1.0}
    shot = driver.execute_cdp_cmd("Page.captureScreenshot", {"clip": clip, "captureBeyondViewport": True})["data"]
    image = cv2.imdecode(np.frombuffer(base64.b64decode(shot), np.uint8), cv2.IMREAD_COLOR)
    scale = min(1.0, WIDTH / image.shape[1])
    image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(PLACE / name), image, [cv2.IMWRITE_JPEG_QUALITY, 88])
    print(f"wrote {PLACE / name}: {image.shape[1]} x {image.shape[0]}, {(PLACE / name).stat().st_size // 1024} KB")


def main() -> None:
    """Make both."""
    scope = [sys.executable, "-c", "from cli.main import main; main()"]
    with tempfile.TemporaryDirectory() as name, page_checks.browser() as driver:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(name) / "demo"
        if not (folder / "demo.html").is_file():
            subprocess.run([*scope, "demo", "-o", str(folder), "-q"], cwd=ROOT, check=True)
        page = Path(name) / "design.html"
        design = ROOT / "examples" / "window-design.toml"
        subprocess.run(
            [*scope, "design", str(design), "--report", str(page), "-q"],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            check=False,
        )
        picture(driver, page, "figure svg", "rig.jpg")
        picture(driver, folder / "demo.html", "figure.whole", "demo-cloud.jpg")


if __name__ == "__main__":
    main()
