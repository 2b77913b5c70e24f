"""One page layout for all results: small, safe, with contents, and with the date and program in its footer."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np

from scope.report.calibration import add_faults
from scope.report.page import Page
from scope.version import __version__


def decoded(html: str) -> tuple[str, np.ndarray, int]:
    found = re.search(r'src="data:image/(\w+);base64,([^"]*)"', html)
    assert found is not None
    data = base64.b64decode(found[2])
    return found[1], cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), len(data)


def test_a_photograph_is_kept_small_and_a_map_exact() -> None:
    rng = np.random.default_rng(0)
    smooth = cv2.GaussianBlur(rng.uniform(0, 255, (960, 1280, 3)), (0, 0), 9)
    photograph = np.clip(smooth + rng.normal(0, 4, smooth.shape), 0, 255).astype(np.uint8)
    page = Page("p")
    page.image(photograph, "a photograph", width=400)
    kind, shown, size = decoded(page.html())
    assert kind == "webp"
    assert shown.shape == (600, 800, 3)  # twice the width on the page
    assert size < 0.1 * photograph.size
    blocks = np.kron(rng.integers(0, 255, (12, 16), np.uint8), np.ones((20, 20), np.uint8))
    page = Page("m")
    page.image(blocks, "a map")
    kind, shown, _ = decoded(page.html())
    assert kind == "png"
    assert np.array_equal(shown[..., 0], blocks)


def test_a_page_says_when_by_what_and_of_what_it_is_and_lets_no_markup_in() -> None:
    page = Page("<b>title</b>")
    for k in range(5):
        page.heading(f"part {k} <script>")
        page.table(("name", "value"), [["<i>", "1.0"]])
    page.about("rig", "sha256 <x>")
    page.about("camera", "")
    html = page.html()
    assert __version__ in html
    assert re.search(r"\d{4}-\d\d-\d\dT\d\d:\d\d", html)
    assert "sha256 &lt;x&gt;" in html
    assert "<dt>camera</dt>" not in html
    assert all(text not in html for text in ("<b>", "<script>", "<i>"))
    assert [f'<a href="#s{k}">' in html for k in range(1, 6)] == [True] * 5
    assert [f'<h2 id="s{k}">' in html for k in range(1, 6)] == [True] * 5
    assert "@media print" in html
    assert "prefers-color-scheme:dark" in html


def test_headings_of_words_stand_over_words_and_of_numbers_over_numbers() -> None:
    page = Page("t")
    page.table(("plane", "px", "why"), [["a", "1.0", "dirty"], ["b", "-", ""]])
    assert "<th class=text>plane</th><th>px</th><th class=text>why</th>" in page.html()


def test_a_row_at_fault_is_marked_and_its_fault_says_what_to_do_and_where_to_read() -> None:
    page = Page("x")
    page.table(("plane", "px"), [["a", "1"], ["b", "2"]], marked={1})
    fault = {
        "plane": "b",
        "kind": "slip",
        "value": 0.51234,
        "standard_error": 0.02,
        "unit": "mm",
        "remedy": "seat it",
        "mark": None,
    }
    add_faults(page, [fault, fault | {"kind": "mark", "mark": 7, "value": None, "standard_error": None}])
    html = page.html()
    assert '<tr class=off><td class="text">b</td>' in html
    assert html.count("class=off") == 2
    assert "0.512 mm ± 0.020" in html
    assert "docs/troubleshooting.md#slip" in html
    before = page.html()
    add_faults(page, [])
    assert page.html() == before
