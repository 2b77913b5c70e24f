"""Tolerances, briefs, commented files and the page of a design."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.errors import CalibrationError
from calibration.rays import PlaneMarks, fit_two_plane
from calibration.sheet import StripePoints, fit_laser
from cli.main import app
from ranging.triangulation import triangulate
from scope.design import design_rig, draw_figures, one_draw, parse_want, propose, write_design
from scope.design.planned import plan_calibration, stripe_on_plane
from scope.design.spots import plan_planes
from scope.design_report import design_page
from scope.session import read_capture
from scope.session.commented import FILES
from scope.simulation import RigDesign, VirtualRig, project, read_design
from scope.simulation.hardware_design import CameraDesign, FaultDesign, JigDesign, LaserDesign, ToleranceDesign

BRIEF = parse_want("sigma=0.02,volume=100x60x60")


def plain(**changes) -> RigDesign:
    design = RigDesign(
        camera=CameraDesign((640, 480), 900.0, (319.5, 239.5), blur_px=0.6, pixel_um=4.8),
        laser=LaserDesign((0.0, -150.0, 0.0), (0.0, 0.0, 400.0), width=0.4, peak=150.0),
        jig=JigDesign((370.0, 390.0, 410.0, 430.0), 13, 17, 13.0, 5.5),
    )
    return replace(design, **changes)


def test_a_misplaced_plane_does_what_it_does_to_a_calibration_of_exact_marks():
    rig = VirtualRig.of(plain(faults=(FaultDesign("w390", stand_off=0.2, slip=(0.05, -0.1), rotation=0.02),)))
    planes = plan_planes(rig)
    planned = plan_calibration(rig, planes, np.random.default_rng(0))
    marks = [
        PlaneMarks(p.name, p.pixels, p.points, pose, p.mark, np.full((len(p.mark), 2, 2), np.nan))
        for p, pose in zip(planes, rig.stated, strict=True)
    ]
    camera = fit_two_plane(marks, rig.camera.size).camera
    stripes = []
    for plane, stated, actual in zip(planes, rig.stated, rig.actual, strict=True):
        pixels = project(rig.camera, stripe_on_plane(rig, plane, actual))
        rays = camera.rays(pixels)
        away = (stated.translation - rays.origin) @ stated.rotation[:, 2] / (rays.direction @ stated.rotation[:, 2])
        noise = 0.005 * np.random.default_rng(1).standard_normal((len(pixels), 1)) * rig.laser.normal
        stripes.append(StripePoints(plane.name, rays.at(away) + noise, np.full(len(pixels), 5e-3)))
    laser = fit_laser("laser", stripes, along=rig.along, channel="gray", curved=False)
    points = np.concatenate([s.points for s in stripes])[::7]
    points = points - rig.laser.reach(points)[1][:, None] * rig.laser.normal
    pixels = project(rig.camera, points)
    found = triangulate(camera, laser, pixels, np.zeros(len(pixels)), 1, extrapolate=5.0).points - points
    along = np.einsum("ni,ni->n", found, points / np.linalg.norm(points, axis=1, keepdims=True))
    expected = planned.errors(points)[:, 0]
    assert np.abs(along).max() > 0.03
    np.testing.assert_allclose(expected, along, atol=0.2 * np.abs(along).max())


@pytest.mark.long
def test_draws_depend_on_seed_and_number_alone_and_spread_with_the_tolerance():
    loose = plain(tolerance=ToleranceDesign(stand_off=0.05, laser_angle=0.3, light=0.2))
    drawn = draw_figures(loose, 4, seed=3)
    assert (drawn.count, drawn.failed) == (4, 0)
    again = one_draw(loose, 2, seed=3)
    assert again is not None
    assert again[0]["sigma_cal_mm.median"] == drawn.figures["sigma_cal_mm.median"][2]
    told = drawn.result["figures"]
    assert told["signal.median"]["p5"] < told["signal.median"]["p95"]
    exact = design_rig(plain()).result["sigma_cal_mm"]["median"]
    assert np.all(drawn.figures["sigma_cal_mm.median"] > 3 * exact)  # planes off by 0.05 mm are worse than noise
    with pytest.raises(ValueError, match="tolerances"):
        draw_figures(plain(), 4)

    def sent(function, numbers):  # as to a worker: pickled, and out of order
        work = pickle.dumps(function)
        return [pickle.loads(work)(number) for number in reversed(numbers)][::-1]  # noqa: S301

    assert draw_figures(loose, 4, seed=3, each=sent).result == drawn.result


def test_a_proposed_rig_meets_its_brief_and_can_be_read_back(tmp_path):
    proposal = propose(plain(), BRIEF)
    result = proposal.predicted.result
    assert proposal.met
    assert result["sigma_mm"]["max"] <= 1.05 * BRIEF.sigma
    assert result["volume_mm"]["x"][1] - result["volume_mm"]["x"][0] >= 0.95 * 100.0
    assert result["volume_mm"]["z"][1] - result["volume_mm"]["z"][0] == pytest.approx(60.0, abs=0.1)
    assert all(c.sigma <= BRIEF.sigma for c in proposal.choices)
    write_design(proposal.chosen.design, tmp_path / "p.toml")
    again = design_rig(tmp_path / "p.toml").result
    assert again["sigma_mm"]["median"] == pytest.approx(result["sigma_mm"]["median"], rel=1e-6)


def test_an_impossible_brief_gets_the_nearest_rig():
    proposal = propose(plain(), parse_want("sigma=0.00001,volume=100x60x60"))
    assert not proposal.met
    assert proposal.chosen.sigma == min(choice.sigma for choice in proposal.choices)
    with pytest.raises(CalibrationError, match="no lens"):
        propose(plain(), parse_want("sigma=0.1,volume=9000x60x60"))
    with pytest.raises(CalibrationError, match="pixel_um is missing"):
        propose(replace(plain(), camera=CameraDesign((640, 480), 900.0, (319.5, 239.5))), BRIEF)
    for text in ("sigma=1", "sigma=0.1,volume=1x2", "sigma=-1,volume=1x2x3", "x"):
        with pytest.raises(ValueError, match="give sigma"):
            parse_want(text)


def test_the_page_draws_the_rig_and_its_maps():
    found = design_rig(plain(laser=LaserDesign((0.0, -20.0, 0.0), (0.0, 0.0, 400.0), width=0.4)))
    page = design_page(found, "a <b>", proposal=propose(plain(), BRIEF))
    assert page.count("<svg") == 9
    assert "a &lt;b&gt;" in page
    assert "triangulation angle is" in page
    assert "What each lens would cost" in page


def test_commented_files_are_read_as_they_are(tmp_path):
    runner = CliRunner()
    file = tmp_path / "rig-design.toml"
    assert runner.invoke(app, ["design", str(file), "--init"]).exit_code == 0
    assert design_rig(file).troubles == []
    assert read_design(file).tolerance is not None
    assert runner.invoke(app, ["simulate", str(file), "--init"]).exit_code == 1  # it is there
    capture = tmp_path / "capture.toml"
    assert runner.invoke(app, ["scan", str(capture), "--init"]).exit_code == 0
    (tmp_path / "frames").mkdir()
    for k in range(2):
        (tmp_path / "frames" / f"{k}.png").write_bytes(b"")
    assert read_capture(capture) is not None
    assert {"capture.toml", "rig-design.toml"} <= set(FILES)
    assert runner.invoke(app, ["simulate", str(file)]).exit_code == 2  # no folder is named


def test_the_command_searches_draws_and_reports(tmp_path):
    runner = CliRunner()
    file, page = tmp_path / "rig-design.toml", tmp_path / "design.html"
    file.write_text(FILES["rig-design.toml"])
    words = [
        "design",
        str(file),
        "--want",
        "sigma=0.03,volume=120x60x50",
        "--draws",
        "2",
        "--report",
        str(page),
        "--json",
    ]
    done = runner.invoke(app, [*words, "-o", str(tmp_path / "p.toml"), "-q"])
    result = json.loads(done.stdout)
    assert done.exit_code == 0
    assert result["wanted"]["met"] is True
    assert result["draws"]["draws"] == 2
    assert "<svg" in page.read_text()
    assert (tmp_path / "p.toml").exists()
    done = runner.invoke(app, ["design", str(file), "--want", "sigma=0.00001,volume=120x60x50", "--json"])
    assert done.exit_code == 3
    assert runner.invoke(app, ["design", str(file), "--want", "sigma"]).exit_code == 2
    assert runner.invoke(app, ["design", str(file), "-o", "x.toml"]).exit_code == 2
    file.write_text(file.read_text().replace("[tolerance]", "[wild]").split("[wild]")[0])
    refused = runner.invoke(app, ["design", str(file), "--draws", "2"])
    assert (refused.exit_code, "[tolerance] is missing" in refused.output) == (1, True)
