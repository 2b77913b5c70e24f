"""Pages as a browser and a printer see them (scripts/page_checks.py): every kind that a small session makes quickly; .ci/run looks at the others."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cli.main import app
from scope.batch import Day, day_page
from scope.cloud import ScanCloud
from scope.report import verification_page
from scope.report.page import Page

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))
import page_checks  # noqa: E402  (a script beside the packages)

pytest.importorskip("selenium", reason="selenium is not installed")
if page_checks.CHROMIUM is None or page_checks.DRIVER is None:
    pytest.skip("no chromium", allow_module_level=True)


@pytest.fixture(scope="module")
def pages(session, tmp_path_factory: pytest.TempPathFactory) -> Path:  # type: ignore[no-untyped-def]
    """A folder of pages."""
    folder, rng = tmp_path_factory.mktemp("pages"), np.random.default_rng(4)

    def run(*words: object) -> None:
        done = CliRunner().invoke(app, ["--operator", "A. Smith", *map(str, words), "-q"])
        assert done.exit_code in {0, 3}, done.output

    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, 12, 0.25), np.arange(0, 12, 0.25)))
    ScanCloud.from_points(np.stack([x, y, 300.0 + rng.normal(0, 0.01, len(x))], axis=1)).save(folder / "cloud.ply")
    run("check", folder / "cloud.ply", "-a", "plane", "--tolerance", "0.001", "--report", folder / "check.html")
    run("view", folder / "cloud.ply", "--no-show", "-o", folder / "cloud.html")
    run("view", session.rig, "--no-show", "-o", folder / "rig.html")
    run("certificate", session.rig, "-o", folder / "certificate.html")
    run("design", ROOT / "examples" / "window-design.toml", "--report", folder / "design.html")
    plane = {"name": "w300", "rms_px": 0.5, "rms_mm": 0.1, "bias_mm": [0.1, 0.0, 0.0]}
    fault = {"plane": "w300", "kind": "slip", "value": 0.1, "standard_error": 0.01, "unit": "mm", "remedy": "seat it"}
    found = {"passed": False, "why": "plane w300 slipped", "planes": [plane], "faults": [fault]}
    (folder / "verification.html").write_text(verification_page(found), encoding="utf-8")
    head = {"session": "line3/2026-11-28/capture.toml", "reason": "", "seconds": 1.0, "digest": "d"}
    rows = [
        {**head, "status": 3 if k == 2 else 0, "check.error_mm": float(v)} for k, v in enumerate(rng.normal(0, 0.01, 9))
    ]
    (folder / "day.html").write_text(day_page(Day(tuple(rows), 9.0, 8.8, 0, 0, 1), "SCOPE batch day"), encoding="utf-8")
    return folder


def test_nothing_is_wrong_with_any_page(pages: Path) -> None:
    with page_checks.browser() as driver:
        found = {page.name: page_checks.troubles(driver, page) for page in sorted(pages.glob("*.html"))}
    assert len(found) == 7
    assert {name: told for name, told in found.items() if told} == {}


def test_what_is_wrong_is_seen(tmp_path: Path) -> None:
    """The law of the law: a page with every fault is told of each."""
    page = Page("good")
    page.plot([("a", [0, 1], [0, 1])], "a curve", x_label="x", y_label="y")
    good = page.html()
    bad = (
        good.replace('<meta name="viewport"', '<meta name="other"')
        .replace('<html lang="en">', "<html>")
        .replace(
            "<footer>",
            '<h1>two</h1><img src="data:,"><a href="#none">x</a><p style="color:#aaa;background:#fff">pale</p><button></button>'
            '<div style="width:900px">wide</div><script>console.error("loud")</script><footer>',
        )
    )
    (tmp_path / "good.html").write_text(good, encoding="utf-8")
    (tmp_path / "bad.html").write_text(bad, encoding="utf-8")
    with page_checks.browser() as driver:
        assert page_checks.troubles(driver, tmp_path / "good.html") == []
        told = " | ".join(page_checks.troubles(driver, tmp_path / "bad.html"))
    for word in (
        "viewport",
        "language",
        "2 main headings",
        "picture without words",
        "leads nowhere",
        "contrast",
        "without a name",
        "on a phone",
        "loud",
    ):
        assert word in told
