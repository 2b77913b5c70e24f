"""The uncertainty budget of a rig against finite differences of its own rays, and what a certificate rests on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import scope
from calibration.errors import FileError
from calibration.rig import Rig
from cli.main import app
from scope.check import certify, uncertainty_budget
from scope.check.certificate import read_evidence
from scope.errors import MeasurementError


@pytest.fixture(scope="module")
def rig(session) -> Rig:  # type: ignore[no-untyped-def]
    return Rig.load(session.rig)


def test_a_pixel_moves_a_point_by_what_the_budget_says(rig: Rig) -> None:
    (budget,) = uncertainty_budget(rig)
    laser = rig.lasers[budget.laser]
    across = 1 if laser.along == "rows" else 0
    width, height = rig.camera.size
    step = max(width, height) / 48
    u, v = np.meshgrid(np.arange(step / 2, width, step), np.arange(step / 2, height, step))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    there = laser.sheet.intersect(rig.camera.rays(pixels)).points
    inside = np.isfinite(there).all(axis=1) & rig.camera.volume.contains(there)
    assert inside.sum() == budget.points
    beside = pixels[inside].copy()
    beside[:, across] += 1e-3
    moved = laser.sheet.intersect(rig.camera.rays(beside)).points
    view = rig.camera.rays(pixels[inside]).direction
    along = np.einsum("ni,ni->n", moved - there[inside], view) * 1e3
    stripe, _, _, lengths = budget.sources
    assert stripe.sensitivity == pytest.approx(np.sqrt((along**2).mean()), rel=0.02)
    distance = np.sqrt((there[inside] ** 2).sum(axis=1).mean())
    assert lengths.sensitivity == pytest.approx(0.01 * distance, rel=1e-9)


def test_calibration_and_noise_are_those_of_a_scan(rig: Rig, session) -> None:  # type: ignore[no-untyped-def]
    cloud = scope.scan(session.capture, session.rig)
    (budget,) = uncertainty_budget(rig, [cloud], lengths_percent=0.01)
    stripe, rays, sheet, _ = budget.sources
    assert stripe.contribution == pytest.approx(np.median(cloud.sigma), rel=1e-6)
    shared = np.hypot(rays.contribution, sheet.contribution)
    assert (
        0.5 < shared / np.sqrt((cloud.sigma_cal.astype(float) ** 2).mean()) < 2.0
    )  # the scan sees a part of the sheet
    assert budget.combined == pytest.approx(np.sqrt(sum(s.contribution**2 for s in budget.sources)), rel=1e-12)
    assert sum(budget.share(s) for s in budget.sources) == pytest.approx(1.0)
    assert budget.missing == ()
    assert uncertainty_budget(rig)[0].missing == ("stripe", "lengths of target and jig")
    with pytest.raises(MeasurementError, match="ranged with the rig"):
        uncertainty_budget(rig, [replace(cloud, rig_sha256="f" * 64)])
    with pytest.raises(ValueError, match="percent"):
        uncertainty_budget(rig, lengths_percent=-1.0)


CHECK = {
    "artefact": "sphere", "error_mm": 0.01, "form_mm": 0.02, "within": True, "within_claimed_uncertainty": True,
}  # fmt: skip


def test_one_result_that_speaks_against_it_is_enough(rig: Rig, tmp_path: Path) -> None:
    good, bad, doubt = tmp_path / "good.json", tmp_path / "bad.json", tmp_path / "doubt.json"
    good.write_text(json.dumps(CHECK))
    bad.write_text(json.dumps(CHECK | {"within": False}))
    doubt.write_text(json.dumps(CHECK | {"within": None, "within_claimed_uncertainty": False}))
    assert certify(rig, results=[good]).passed
    assert not certify(rig, results=[good, bad]).passed
    assert "out of tolerance" in certify(rig, results=[good, bad]).why
    assert not certify(rig, results=[doubt]).passed
    unsure = replace(rig, verification=replace(rig.verification, passed=False, why="w380 is turned"))
    assert "w380 is turned" in certify(unsure, results=[good]).why


@pytest.mark.parametrize(
    "text", ["", "[1, 2]", "{}", "3", '{"error_mm": "x", "artefact": "plane"}', '{"passed": 1}', "[" * 9000]
)
def test_what_is_no_result_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "r.json").write_text(text)
    with pytest.raises(FileError, match="scope check --json") as error:
        read_evidence(tmp_path / "r.json")
    assert len(str(error.value)) < 300 + len(str(tmp_path))


def test_the_command_files_a_page_and_refuses_in_the_end(session, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    page = tmp_path / "c.html"
    (tmp_path / "bad.json").write_text(json.dumps(CHECK | {"within": False}))
    words = ["certificate", str(session.rig), "-o", str(page), "--operator", "<A. B.>", "--lengths", "0.02", "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["passed"] is True
    assert told["budget"][0]["expanded_mm"] == pytest.approx(2 * told["budget"][0]["combined_mm"])
    html = page.read_text(encoding="utf-8")
    assert "&lt;A. B.&gt;" in html
    assert told["rig"]["sha256"] in html
    assert CliRunner().invoke(app, [*words, "--with", str(tmp_path / "bad.json")]).exit_code == 3
    assert "Must not be used" in page.read_text(encoding="utf-8")
    assert CliRunner().invoke(app, [*words, "--lengths", "-1"]).exit_code == 2
