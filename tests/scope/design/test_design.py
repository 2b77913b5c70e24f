"""A rig predicted: against closed forms, against rendered images, and what is said of bad designs."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr
from typer.testing import CliRunner

from benchmarks.design import judge, random_design
from calibration.errors import CalibrationError
from calibration.targets import find_spots
from cli.main import app
from ranging.stripe import StripeOptions, extract
from scope.design import Surface, design_rig
from scope.design.spots import plan_planes
from scope.design.stripe import look
from scope.design_report import design_page
from scope.simulation import RigDesign, VirtualRig
from scope.simulation.hardware_design import CameraDesign, JigDesign, LaserDesign
from scope.simulation.object_design import BoxDesign, MotionDesign, PlaneDesign
from scope.simulation.rendering import render_stripe

FOCAL, STAND_OFF, BASE = 900.0, 400.0, 150.0


def plain(**changes) -> RigDesign:
    """A pinhole without distortion; the laser stands to the left and shines through (0, 0, STAND_OFF)."""
    design = RigDesign(
        camera=CameraDesign((640, 480), FOCAL, (319.5, 239.5), blur_px=0.7),
        laser=LaserDesign((-BASE, 0.0, 0.0), (0.0, 0.0, STAND_OFF), width=0.4, peak=150.0),
        jig=JigDesign(
            (370.0, 400.0, 430.0), 13, 17, 13.0, 5.5, fiducials=((6, 8), (6, 10), (3, 8)), fiducial_diameter=8.2
        ),
    )
    return replace(design, **changes)


def test_a_facing_plate_has_the_stripe_and_the_depth_of_school_geometry():
    rig = VirtualRig.of(plain())
    seen = look(rig, np.array([[0.0, 0.0, STAND_OFF]]), np.array([0.0, 0.0, -1.0]), albedo=0.5)
    scale = FOCAL / STAND_OFF  # px a mm
    lean = np.hypot(BASE, STAND_OFF) / STAND_OFF  # the plate cuts the sheet at a slant
    assert seen.width_px[0] == pytest.approx(0.4 * lean * scale, rel=1e-3)
    assert seen.blur_px[0] == pytest.approx(np.sqrt(0.7**2 + 1 / 12), rel=1e-3)
    assert seen.stripe_px[0] == pytest.approx(np.hypot(seen.width_px[0], seen.blur_px[0]))
    assert seen.across_mm[0] == pytest.approx(1 / scale, rel=1e-3)
    assert seen.along_ray[0] == pytest.approx(STAND_OFF**2 / (FOCAL * BASE), rel=1e-3)  # dz = z^2 / (f b)
    light = 150.0 * 0.5 / lean
    assert seen.signal[0] == pytest.approx(light * seen.width_px[0] / seen.stripe_px[0], rel=1e-3)


@pytest.mark.parametrize("speckle", [0.0, 0.25])
def test_the_noise_of_a_stripe_is_the_scatter_of_rendered_ones(speckle):
    design = plain()
    rig = VirtualRig.of(replace(design, laser=replace(design.laser, speckle=speckle, grain=1.2)))
    rng = np.random.default_rng(4)
    blank = rig.blank(1)
    # speckle stays with the surface: every exposure shows a new piece of it
    images = [rig.stripe_images(blank, 1, rng)[0] for _ in range(10)] if speckle else rig.stripe_images(blank, 16, rng)
    found = np.array([extract(image, along=rig.along, options=StripeOptions()).position for image in images])
    truth = rig.truth_of(blank)
    lines = np.flatnonzero(np.isfinite(found).all(axis=0) & np.isfinite(truth.position))[5:-5]
    assert len(lines) > 200
    scatter = np.sqrt(np.mean((found[:, lines] - truth.position[lines]) ** 2))
    expected = look(rig, truth.points[lines], np.array([0.0, 0.0, -1.0]), albedo=1.0).sigma_px
    assert np.sqrt(np.mean(expected**2)) / scatter == pytest.approx(1.0, abs=0.06 if not speckle else 0.15)


def test_a_fit_with_even_weights_is_displaced_by_skewed_light_and_changing_blur():
    from scipy.optimize import least_squares

    camera = CameraDesign(
        (640, 480), FOCAL, (319.5, 239.5), blur_px=0.5, pixel_um=12.0, focal_mm=FOCAL * 0.012 * STAND_OFF / (STAND_OFF + FOCAL * 0.012), focus=STAND_OFF, f_number=2.0, tilt=(0.0, 5.0),
        read_noise=500.0,
    )  # fmt: skip
    laser = LaserDesign((-BASE, 0.0, 0.0), (0.0, 0.0, STAND_OFF), roll=2.0, waist=0.2, waist_at=420.0, divergence=5.0)
    rig = VirtualRig.of(plain(camera=camera, laser=laser))
    blank = rig.blank(0)
    truth, light = rig.truth_of(blank), render_stripe(rig.camera, rig.laser, blank, blur_px=rig.blur_at)
    lines, moved = np.arange(90, 390, 15), []
    for line in lines:
        start = truth.position[line]
        x = np.arange(int(start) - 12, int(start) + 13)
        profile = light[line, x]

        def off(p, x=x, profile=profile):
            half = 0.5 / p[2]
            return p[0] * (ndtr((x - p[1]) / p[2] + half) - ndtr((x - p[1]) / p[2] - half)) - profile

        moved.append(least_squares(off, (profile.sum(), start, 1.5), xtol=1e-12).x[1] - start)
    points = truth.points[lines]
    seen = look(rig, points, np.array([0.0, 0.0, -1.0]), albedo=1.0)
    a_px = rig.laser.reach(points + points[:, 2:] / FOCAL * [1.0, 0.0, 0.0])[1]
    assert np.mean(moved) == pytest.approx(np.mean(seen.skew / a_px), rel=0.05, abs=1e-4)
    assert abs(np.mean(moved)) > 3e-4


@pytest.mark.parametrize("divergence", [0.0, 4.0])
def test_a_stripe_is_displaced_as_the_middle_of_its_rendered_light(divergence):
    laser = LaserDesign(
        (-BASE, 0.0, 0.0),
        (0.0, 0.0, STAND_OFF),
        roll=2.0,
        peak=150.0,
        waist=0.35,
        waist_at=300.0,
        divergence=divergence,
    )
    camera = replace(plain().camera, gain_e=0.01)  # photons rule the noise: the fit is a centroid
    rig = VirtualRig.of(plain(laser=laser, camera=camera))
    across, lines = np.arange(640), np.arange(80, 400)
    for plane in (0, 2):
        blank = rig.blank(plane)
        truth, light = rig.truth_of(blank), rig.stripe_light(blank)[lines]
        middle = (light @ across) / light.sum(axis=1) - truth.position[lines]
        points = truth.points[lines]
        seen = look(rig, points, np.array([0.0, 0.0, -1.0]), albedo=1.0)
        a_px = rig.laser.reach(points + points[:, 2:] / FOCAL * [1.0, 0.0, 0.0])[1]  # mm off the sheet
        assert np.mean(middle) == pytest.approx(np.mean(seen.skew / a_px), rel=0.05, abs=3e-5)


def test_the_noise_of_a_spot_is_the_scatter_of_rendered_ones():
    rig = VirtualRig.of(plain(jig=replace(plain().jig, images=1)))
    (_, plane, _) = plan_planes(rig)
    spots = [find_spots(image) for image in rig.target_images(1, 10, np.random.default_rng(2))]
    near = [
        s.centroids[np.linalg.norm(s.centroids[None] - plane.pixels[:, None], axis=2).argmin(axis=1)] for s in spots
    ]
    scatter = np.sqrt(np.mean(np.var(near, axis=0, ddof=1)))
    assert len(plane.pixels) == 13 * 17
    assert np.sqrt(np.mean(plane.sigma**2)) / scatter == pytest.approx(1.0, abs=0.12)
    assert np.median(plane.diameter) == pytest.approx(np.median(spots[0].diameter), rel=0.03)


def test_a_rendered_calibrated_and_ranged_rig_is_as_predicted(monkeypatch):
    monkeypatch.setattr("benchmarks.design.CALIBRATIONS", 2)
    monkeypatch.setattr("benchmarks.design.EXPOSURES", 16)
    rng = np.random.default_rng(8)
    found = judge(random_design(rng, window=True), rng)
    assert np.median(found.noise) == pytest.approx(1.0, abs=0.07)
    assert 0.5 < found.calibration[0] / found.calibration[1] < 2.0  # two calibrations know their rms to a half


def test_more_light_longer_baseline_and_more_spots_are_better():
    base = design_rig(plain()).result
    design = plain()
    brighter = design_rig(plain(camera=replace(design.camera, gain_e=140.0))).result
    wider = design_rig(plain(laser=replace(design.laser, origin=(-2 * BASE, 0.0, 0.0)))).result
    repeated = design_rig(plain(jig=replace(design.jig, images=30, laser_images=20))).result
    assert brighter["sigma_mm"]["median"] < 0.85 * base["sigma_mm"]["median"]
    assert wider["sigma_mm"]["median"] < 0.75 * base["sigma_mm"]["median"]
    assert repeated["sigma_cal_mm"]["median"] < 0.65 * base["sigma_cal_mm"]["median"]  # what skews profiles stays
    assert repeated["sigma_mm"]["median"] == pytest.approx(base["sigma_mm"]["median"])
    for name in ("sphere", "step", "pose"):
        assert repeated["expected"][name]["calibration_mm"] < base["expected"][name]["calibration_mm"]
        part = base["expected"][name]
        assert 0.0 < part["constant_mm"] < part["calibration_mm"] < part["sigma_mm"]


def test_a_place_is_moved_onto_the_sheet_and_seen_unless_something_stands_before_it():
    motion = MotionDesign("linear", frames=10, direction=(2.0, 0.0, 0.0), step=0.5)
    wall = BoxDesign(size=(20.0, 40.0, 4.0), origin=(40.0, 0.0, 400.0))
    design = plain(objects=(wall,), motion=motion)
    top = design_rig(design, at=(38.0, 0.0, 398.0)).result
    assert top["visible"] is True
    assert top["at"]["on_sheet_mm"][2] == pytest.approx(398.0)
    assert top["at"]["travel_mm"] == pytest.approx(top["at"]["on_sheet_mm"][0] - 38.0)
    assert top["sigma_mm"] == pytest.approx(top["volume"]["sigma_mm"]["median"], rel=0.3)
    assert design_rig(design, at=(38.0, 0.0, 420.0)).result["visible"] is False  # below the block
    assert design_rig(plain(), at=(0.0, 0.0, 600.0)).result["visible"] is False  # beyond the jig
    assert design_rig(plain(), at=(0.0, 0.0, 400.0)).result["visible"] is True


def test_the_shadow_of_a_block_is_as_long_as_the_sheet_leans():
    motion = MotionDesign("linear", frames=161, direction=(1.0, 0.0, 0.0), step=0.5, start=-40.0)
    floor, block = (
        PlaneDesign(origin=(0.0, 0.0, 420.0)),
        BoxDesign(size=(16.0, 30.0, 20.0), origin=(0.0, 0.0, 410.0)),
    )
    found = design_rig(plain(objects=(floor, block), motion=motion))
    hidden = found.hidden
    assert hidden is not None
    row = hidden.state[np.abs(hidden.down).argmin()]  # y = 0, where light and sight run in the plane of x and z
    step = float(np.diff(hidden.across).mean())
    behind = (hidden.across > 8.0) & (hidden.across < 30.0)
    lean = BASE / STAND_OFF  # the laser stands at negative x, so that the shadow falls to positive x
    assert (np.isin(row, (1, 3)) & behind).sum() * step == pytest.approx(20.0 * lean, abs=2 * step)
    assert not np.isin(row[(hidden.across > -30.0) & (hidden.across < -9.0)], (1, 3)).any()
    assert found.result["hidden"]["seen"] > 0.5
    assert sum(found.result["hidden"].values()) == pytest.approx(1.0)
    page = design_page(found, "t")
    assert "laser does not reach it" in page


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"laser": LaserDesign((-20.0, 0.0, 0.0), (0.0, 0.0, 400.0), width=0.4)}, "triangulation angle is 2.8 degrees"),
        ({"jig": JigDesign((370.0, 400.0, 430.0), 13, 17, 8.0, 1.6)}, "spots are 3.3 px wide on plane w430"),
        ({"jig": JigDesign((370.0, 430.0), 13, 17, 13.0, 5.5)}, "2 stand-offs cannot prove each other"),
        ({"jig": JigDesign((170.0, 400.0, 430.0), 13, 17, 13.0, 5.5)}, "spots are in view on plane w170"),
        ({"laser": LaserDesign((-150.0, 0.0, 0.0), (0.0, 0.0, 400.0), width=0.4, peak=600.0)}, "the stripe clips on"),
        ({"laser": LaserDesign((-150.0, 0.0, 0.0), (0.0, 0.0, 400.0), width=0.4, peak=6.0)}, "12 at least are needed"),
    ],
)
def test_a_bad_design_gets_its_sentence(changes, said):
    sentences = design_rig(plain(**changes)).troubles
    assert any(said in sentence for sentence in sentences), sentences
    assert all(len(sentence) < 300 for sentence in sentences)


def test_a_sheet_that_misses_the_jig_is_refused():
    with pytest.raises(CalibrationError, match="aim the laser"):
        design_rig(plain(laser=LaserDesign((-150.0, 0.0, 0.0), (400.0, 0.0, 400.0), width=0.4)))
    assert design_rig(plain()).troubles == []


def test_the_command_gives_the_figures_of_the_contract(tmp_path):
    runner = CliRunner()
    file = tmp_path / "rig-design.toml"
    file.write_text(
        'format = 1\n[camera]\nsize = [640, 480]\nfocal_px = 900.0\ncentre_px = [319.5, 239.5]\n[laser]\n'
        "origin = [-150.0, 0.0, 0.0]\nthrough = [0.0, 0.0, 400.0]\n[jig]\nstand_offs = [370.0, 400.0, 430.0]\nrows = 13\n"
        "columns = 17\npitch = 13.0\ndiameter = 5.5\n"
    )  # fmt: skip
    done = runner.invoke(app, ["design", str(file), "--json"])
    result = json.loads(done.stdout)
    assert done.exit_code == 0
    assert set(result["sigma_mm"]) == set(result["sigma_cal_mm"]) == {"min", "median", "max"}
    done = runner.invoke(app, ["design", str(file), "--at", "0,5,400", "--albedo", "0.5", "--json"])
    there = json.loads(done.stdout)
    assert there["visible"] is True
    assert there["sigma_mm"] > result["sigma_mm"]["median"]
    assert there["stripe_px"] > there["blur_px"] > 0.6
    for words in (["--at", "1,2"], ["--tilt", "90,0"], ["--albedo", "0"]):
        assert runner.invoke(app, ["design", str(file), *words]).exit_code == 2
    refused = runner.invoke(app, ["design", str(tmp_path / "none.toml")])
    assert (refused.exit_code, refused.output.count("\n")) == (1, 1)


def test_a_tilted_surface_is_seen_by_its_normal():
    normal = Surface(tilt=(0.3, -0.2)).normal
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert normal[2] < -0.9
    flat, steep = (design_rig(plain(), surface=Surface(1.0, (0.0, t))).result for t in (0.0, 0.7))
    assert abs(steep["stripe_px"]["median"] - flat["stripe_px"]["median"]) > 0.1
