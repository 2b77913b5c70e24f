"""Figures only where marks support them: stepped plates, few marks, and what is withheld, against an independent pinhole."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.few_marks import SIZE, draw
from benchmarks.sessions import session
from calibration.geometry import Pose
from calibration.rays import PlaneMarks, fit_two_plane
from calibration.verification import expected_interplane_px, find_faults, held_out, interplane, ray_bound
from calibration.verification.support import surrounded
from cli.main import app

MATRIX = np.array([[1600.0, 0, 645.0], [0, 1600.0, 470.0], [0, 0, 1.0]])
LENS = np.array([-0.12, 0.03, 3e-4, -2e-4, 0.0])


def stepped(noise: float = 0.03, levels: int = 3) -> list[PlaneMarks]:
    """Levels 20 mm apart, each on its own columns of one image."""
    rng = np.random.default_rng(4)
    planes = []
    for k in range(levels):
        x, y = np.meshgrid(
            np.linspace(-150, 150, 27)[27 * k // levels : 27 * (k + 1) // levels], np.linspace(-110, 110, 16)
        )
        flat = np.stack([x.ravel(), y.ravel()], axis=1)
        pose = Pose(np.eye(3), np.array([0.0, 0.0, 400.0 + 20.0 * (k % 3)]))
        world = pose.apply(np.column_stack([flat, np.zeros(len(flat))]))
        seen = cv2.projectPoints(world, np.zeros(3), np.zeros(3), MATRIX, LENS)[0][:, 0]
        seen = seen + rng.normal(0, noise, seen.shape)
        known = np.broadcast_to(noise**2 * np.eye(2), (len(flat), 2, 2)).copy()
        planes.append(PlaneMarks(f"level{k}", seen, flat, pose, np.arange(len(flat), dtype=np.int64), known))
    return planes


@pytest.mark.parametrize("levels", [2, 3])
def test_levels_that_share_no_pixels_withhold_what_they_cannot_test_and_bound_the_rays(levels: int) -> None:
    fit = fit_two_plane(stepped(levels=levels), SIZE)
    held = held_out(fit)
    assert all(np.isnan(h.rms_mm) and "two other planes have marks around" in h.why for h in held)
    assert (held == ()) is (levels == 2)
    assert np.isnan(interplane(fit.camera, fit.marks).interplane_px)
    bound = ray_bound(fit, untested=True)
    worst = 0.0
    for marks in fit.marks:
        rays = fit.camera.rays(marks.pixels)
        flat = cv2.undistortPoints(marks.pixels[:, None], MATRIX, LENS, None, None, None, (3, 100, 1e-13))[:, 0]
        for depth in (400.0, 420.0, 440.0):
            true = np.column_stack([flat * depth, np.full(len(flat), depth)])
            off = rays.distance_to(true)[fit.camera.volume.contains(true)]  # where anything is ranged
            worst = max(worst, float(off.max(initial=0.0)))
    assert 0.0 < worst < 3 * np.sqrt(2) * bound.mm
    assert bound.px < 1.0


def test_planes_that_share_their_pixels_are_held_out_as_ever() -> None:
    fit = fit_two_plane(session(np.random.default_rng(1)), SIZE)
    held = held_out(fit)
    assert all(not h.why for h in held)
    assert sum(h.n for h in held) > 0.95 * sum(len(m) for m in fit.marks)
    with_marks, without = interplane(fit.camera, fit.marks), interplane(fit.camera)
    assert with_marks.interplane_px == pytest.approx(without.interplane_px, rel=0.1)
    assert with_marks.interplane_px == pytest.approx(expected_interplane_px(fit, with_marks), rel=0.25)


def test_what_is_surrounded_is_told_by_opencv_too() -> None:
    rng = np.random.default_rng(2)
    marks, pixels = rng.uniform(100, 500, (20, 2)), rng.uniform(0, 600, (500, 2))
    hull = cv2.convexHull(marks.astype(np.float32))
    inside = [cv2.pointPolygonTest(hull, (float(u), float(v)), False) >= 0 for u, v in pixels]
    assert surrounded(pixels, marks).tolist() == inside
    assert surrounded(pixels, marks, enlarged=1.3).sum() > sum(inside)
    assert not surrounded(pixels, np.column_stack([marks[:, 0], marks[:, 0]])).any()


@pytest.mark.parametrize("seed", [7, 20, 25, 36, 61])  # in which earlier versions named faults
def test_a_plate_that_is_not_exact_is_no_fault(seed: int) -> None:
    made = draw(np.random.default_rng(seed))
    fit = fit_two_plane(made.planes, SIZE)
    assert find_faults(fit.marks, field=fit.joint.field) == ()


def test_a_fault_among_few_marks_is_named_still() -> None:
    made = draw(np.random.default_rng(10))
    slipped = made.planes[2].c_from_plane
    mm = 20.0 * made.sigma_mm  # 6 px
    planes = [*made.planes]
    planes[2] = replace(planes[2], c_from_plane=Pose(slipped.rotation, slipped.translation + np.array([mm, 0, 0])))
    assert [(f.plane, f.kind) for f in find_faults(planes)] == [("w2", "slip")]
    pixels = made.planes[1].pixels.copy()
    pixels[3] += [8.0, 0.0]
    planes = [*made.planes]
    planes[1] = replace(planes[1], pixels=pixels)
    assert [(f.plane, f.kind, f.mark) for f in find_faults(planes)] == [("w1", "mark", 3)]


def test_the_terms_of_few_marks_are_the_best_that_may_be_asked_for() -> None:
    for seed in range(4):
        made = draw(np.random.default_rng(seed))
        fit = fit_two_plane(made.planes, SIZE)
        own = sum(f.loo_px**2 for f in fit.planes)
        for order in ("linear", "paper", 2, 3):
            if len(made.planes[0]) > 11:
                other = fit_two_plane(made.planes, SIZE, order=order)
                assert own <= 1.05 * sum(f.loo_px**2 for f in other.planes)


def test_as_many_terms_as_marks_foretell_nothing() -> None:
    made = draw(np.random.default_rng(0))
    few = [p.select(np.arange(len(p)) < 11) for p in made.planes]
    assert np.isnan(fit_two_plane(few, SIZE, order="paper").planes[0].loo_px)


def listed(folder: Path, planes: list[PlaneMarks]) -> Path:
    """A session of one plane a table, its marks listed and not measured again."""
    text = 'format = 1\nunits = "mm"\n[target]\nkind = "listed"\npolarity = "light"\n'
    for plane in planes:
        cv2.imwrite(str(folder / f"{plane.name}.png"), np.zeros(SIZE[::-1], np.uint8))
        with (folder / f"{plane.name}.csv").open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(["x", "y", "z", "u", "v"])
            writer.writerows([*p, 0.0, *q] for p, q in zip(plane.points, plane.pixels, strict=True))
        text += (
            f'[[plane]]\nname = "{plane.name}"\nimages = "{plane.name}.png"\npoints = "{plane.name}.csv"\nrefine = false\n'
            f"origin = {plane.c_from_plane.translation.tolist()}\n"
        )
    (folder / "calibration.toml").write_text(text, encoding="utf-8")
    return folder / "calibration.toml"


def calibrated(file: Path) -> tuple[int, dict, str]:
    done = CliRunner().invoke(
        app,
        [
            "calibrate",
            str(file),
            "-o",
            str(file.parent / "rig.json"),
            "--report",
            str(file.parent / "r.html"),
            "--json",
        ],
    )
    return done.exit_code, json.loads(done.stdout), (file.parent / "r.html").read_text(encoding="utf-8")


def test_a_stepped_plate_prints_no_figure_that_nothing_supports(tmp_path: Path) -> None:
    status, result, page = calibrated(listed(tmp_path, stepped()))
    assert status == 0
    assert [p["heldout_mm"] for p in result["planes"]] == [None] * 3
    assert all("two other planes have marks around" in p["heldout_why"] for p in result["planes"])
    assert result["ray_mm"] is None
    assert result["interplane_px"] is None
    assert "held-out errors withheld: 3 of 3 planes" in result["why"]
    assert 0 < result["ray_sigma_mm"] < 0.5
    assert "withheld: two other planes" in page


def test_marks_that_are_missed_by_pixels_do_not_pass_without_limits(tmp_path: Path) -> None:
    made = draw(np.random.default_rng(3))
    rng = np.random.default_rng(5)
    wrong = rng.normal(0, 2.0, made.planes[0].pixels.shape)  # the plate is not the one that is listed
    planes = [replace(p, pixels=p.pixels + wrong) for p in made.planes[:3]]
    status, result, _ = calibrated(listed(tmp_path, planes))
    assert status == 3
    assert "marks that are left out are off by" in result["why"]
