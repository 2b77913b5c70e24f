"""Look at pages as a browser and as a printer do: ``python scripts/page_checks.py FILE.html|FOLDER...``; needs Chromium and selenium.

Each page, in light and in dark: nothing on the console, a title and a language, a viewport, one main heading, words for every picture and
control, links that lead somewhere, text with a contrast of 4.5 (3 where it is large; WCAG 2.2, 1.4.3), nothing wider than a phone of 400 px, and an A4 print
on which no word leaves the paper and no dark surface wastes ink.
"""

from __future__ import annotations

import base64
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CHROMIUM, DRIVER = (shutil.which(name) for name in ("chromium", "chromedriver"))
PHONE, DESK = (400, 900), (1400, 900)
_A4 = (595.0, 842.0)  # points
_DARK = 0.45  # share of a printed page that may be darker than mid grey
_QUIET = ("favicon.ico",)  # what the console may say

FACTS = """
const name = e => (e.getAttribute('aria-label') || e.getAttribute('title') || e.getAttribute('alt') || e.innerText || '').trim()
  || [...(e.labels || [])].map(l => l.innerText.trim()).join(' ');
const at = e => e.tagName.toLowerCase() + (e.className && e.className.baseVal === undefined ? '.' + e.className : '') + ' ' + (e.innerText || e.textContent || '').trim().slice(0, 40);
const told = [];
if (!document.title.trim()) told.push('no title');
if (!document.documentElement.lang) told.push('no language');
if (!document.querySelector('meta[name=viewport][content*="width=device-width"]')) told.push('no viewport');
if (document.querySelectorAll('h1').length !== 1) told.push(document.querySelectorAll('h1').length + ' main headings');
for (const e of document.querySelectorAll('img')) if (!(e.getAttribute('alt') || '').trim()) told.push('picture without words');
for (const e of document.querySelectorAll('svg[role=img], canvas')) if (!name(e) && !e.querySelector('title') && !e.closest('[aria-label],[aria-hidden=true]')) told.push('drawing without words: ' + at(e));
for (const e of document.querySelectorAll('button, select, input:not([type=hidden]), a')) if (e.checkVisibility() && !name(e)) told.push('control without a name: ' + at(e));
for (const e of document.querySelectorAll('a[href^="#"]')) if (!document.getElementById(e.getAttribute('href').slice(1))) told.push('leads nowhere: ' + e.getAttribute('href'));
const ids = [...document.querySelectorAll('[id]')].map(e => e.id);
for (const id of new Set(ids.filter((x, k) => ids.indexOf(x) !== k))) told.push('two elements are called ' + id);
return told;
"""
CONTRAST = """
const channel = v => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
const light = c => 0.2126 * channel(c[0]) + 0.7152 * channel(c[1]) + 0.0722 * channel(c[2]);
const parse = t => { const n = (t.match(/[\\d.]+/g) || []).map(Number); return n.length < 3 ? [0, 0, 0, 0] : [n[0], n[1], n[2], n.length > 3 ? n[3] : 1]; };
const over = (a, b) => [0, 1, 2].map(k => a[k] * a[3] + b[k] * (1 - a[3])).concat(1);
const behind = e => { const layers = []; for (let n = e; n && n.nodeType === 1; n = n.parentElement) { layers.push(parse(getComputedStyle(n).backgroundColor)); if (layers.at(-1)[3] === 1) break; }
  let c = matchMedia('(prefers-color-scheme: dark)').matches ? [18, 18, 18, 1] : [255, 255, 255, 1]; for (const l of layers.reverse()) c = over(l, c); return c; };
const told = [];
for (const e of document.body.querySelectorAll('*')) {
  if (![...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim()) || ['SCRIPT', 'STYLE', 'OPTION', 'NOSCRIPT'].includes(e.tagName)) continue;
  if (e.disabled || !e.checkVisibility({checkOpacity: true, checkVisibilityCSS: true})) continue;
  const s = getComputedStyle(e), svg = e instanceof SVGElement;
  const ground = behind(e), ink = over(parse(svg ? s.fill : s.color), ground);
  const a = light(ink), b = light(ground), ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  const size = parseFloat(s.fontSize), large = size >= 24 || (size >= 18.66 && parseInt(s.fontWeight) >= 700);
  if (ratio < (large ? 3 : 4.5) - 0.01) told.push(ratio.toFixed(2) + ': ' + e.tagName.toLowerCase() + ' ' + e.textContent.trim().slice(0, 40));
}
return [...new Set(told)].slice(0, 8);
"""


@contextmanager
def browser() -> Iterator[Any]:
    """A Chromium without a window."""
    from selenium.webdriver import Chrome
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = str(CHROMIUM)
    for word in ("headless=new", "no-sandbox", "hide-scrollbars", "use-angle=swiftshader", "enable-unsafe-swiftshader"):
        options.add_argument(f"--{word}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = Chrome(options=options, service=Service(str(DRIVER)))
    try:
        yield driver
    finally:
        driver.quit()


def troubles(driver: Any, page: Path) -> list[str]:
    """What is wrong with a page; empty for nothing."""
    told: list[str] = []
    for scheme in ("light", "dark"):
        _emulate(driver, DESK, scheme)
        driver.get(page.resolve().as_uri())
        if scheme == "light":
            told += driver.execute_script(FACTS)
        told += [f"contrast in the {scheme} {found}" for found in driver.execute_script(CONTRAST)]
    _emulate(driver, PHONE, "light")
    wide = driver.execute_script("return document.documentElement.scrollWidth")
    if wide > PHONE[0]:
        told.append(f"{wide} px wide on a phone of {PHONE[0]}")
    told += _printed(driver)
    for entry in driver.get_log("browser"):
        if entry["level"] in {"SEVERE", "WARNING"} and not any(quiet in entry["message"] for quiet in _QUIET):
            told.append(f"console: {entry['message'][:160]}")
    return told


def _emulate(driver: Any, size: tuple[int, int], scheme: str) -> None:
    metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size == PHONE}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})


def _printed(driver: Any) -> list[str]:
    """What is wrong with the print."""
    import numpy as np
    import pymupdf

    _emulate(driver, DESK, "dark")  # a dark screen must not make a dark print
    data = driver.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True, "printBackground": True})["data"]
    told = []
    with pymupdf.open(stream=base64.b64decode(data), filetype="pdf") as paper:
        for number, sheet in enumerate(paper, start=1):
            where = f"print, page {number}:"
            if abs(sheet.rect.width - _A4[0]) > 2 or abs(sheet.rect.height - _A4[1]) > 2:
                told.append(f"{where} {sheet.rect.width:.0f} x {sheet.rect.height:.0f} points is no A4")
            lost = [word[4] for word in sheet.get_text("words") if word[2] > sheet.rect.width + 1 or word[0] < -1]
            if lost:
                told.append(f"{where} {len(lost)} words leave the paper, such as {lost[0][:20]!r}")
            grey = np.frombuffer(sheet.get_pixmap(dpi=36, colorspace="gray").samples, np.uint8)
            if (share := float((grey < 128).mean())) > _DARK:
                told.append(f"{where} {100 * share:.0f} % of it is dark")
        if driver.title.split()[0] not in paper[0].get_text():
            told.append("print: its first page does not show the title")
    return told


def main() -> int:
    """Look at the pages that were named, or all in folders."""
    names = [Path(name) for name in sys.argv[1:]]
    pages = [page for path in names for page in (sorted(path.rglob("*.html")) if path.is_dir() else [path])]
    if not pages or CHROMIUM is None or DRIVER is None:
        print("no pages, or no chromium and chromedriver", file=sys.stderr)
        return 2
    bad = 0
    with browser() as driver:
        for page in pages:
            found = troubles(driver, page)
            bad += bool(found)
            print(f"{page}: {'; '.join(found) or 'good'}", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
