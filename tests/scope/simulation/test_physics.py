"""Lens, beam and light in the units of data sheets: closed forms, and the renderer against them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import FileError
from scope.design import design_rig
from scope.simulation import VirtualRig, read_design, render_stripe
from scope.simulation.hardware_design import CameraDesign, JigDesign, LaserDesign
from scope.simulation.physics import Beam, Lens
from scope.simulation.rig_design import RigDesign
from scope.simulation.solids import Part, Scene, Sheet

LENS = Lens(12.0, 2.0, 400.0, 0.005, 660e-6)
HEAD = "format = 1\n[camera]\nsize = [640, 480]\ncentre_px = [319.5, 239.5]\n"
TAIL = "[jig]\nstand_offs = [370.0, 400.0, 430.0]\nrows = 9\ncolumns = 13\npitch = 10.0\ndiameter = 4.0\n"
LASER = "[laser]\norigin = [-150.0, 0.0, 0.0]\nthrough = [0.0, 0.0, 400.0]\n"
SHEETS = "pixel_um = 4.8\nfocal_mm = 8.0\nf_number = 4.0\nfocus = 400.0\nexposure_us = 2000\nquantum_efficiency = 0.5\nfull_well_e = 10000.0\nread_noise_e = 20.0\n"


def design(**camera) -> RigDesign:
    return RigDesign(
        CameraDesign((640, 480), 1650.0, (319.5, 239.5), pixel_um=5.0, focal_mm=8.0, focus=400.0, **camera),
        LaserDesign((-150.0, 0.0, 0.0), (0.0, 0.0, 400.0), width=0.4),
        JigDesign((370.0, 400.0, 430.0), 9, 13, 8.0, 3.5),
    )


def test_defocus_is_the_blur_circle_of_similar_triangles():
    for z in (300.0, 380.0, 520.0):
        focused, sharp = (1.0 / (1.0 / 12.0 - 1.0 / d) for d in (400.0, z))  # image distances
        circle = (12.0 / 2.0) * abs(focused - sharp) / sharp / 0.005  # px, across
        airy = 0.42 * 660e-6 * 2.0 * focused / 12.0 / 0.005
        found = LENS.blur(np.array([[20.0, -10.0, z]]))[0]
        assert found == pytest.approx(np.hypot(circle / 4, airy), rel=1e-9)


def test_the_proposed_tilt_puts_the_whole_sheet_in_focus():
    normal = np.array([400.0, 30.0, -150.0])
    normal /= np.linalg.norm(normal)
    offset = float(normal @ [5.0, 0.0, 400.0])
    focus, tilt = LENS.in_focus(normal, offset)
    tilted = replace(LENS, focus=focus, tilt=tilt)
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-60, 60, 5), np.linspace(250, 700, 5)))
    on_sheet = np.column_stack([(offset - normal[1] * y - normal[2] * z) / normal[0], y, z])
    airy = 0.42 * 660e-6 * tilted.working_f_number / 0.005
    np.testing.assert_allclose(tilted.blur(on_sheet), airy, rtol=1e-6)
    assert LENS.blur(on_sheet).max() > 5 * airy


def test_the_renderer_blurs_each_depth_by_its_own():
    rig = VirtualRig.of(design(f_number=2.0, blur_px=0.5))
    upright = replace(rig.laser, width=0.2)
    for z in (370.0, 400.0, 430.0):
        plate = Scene((Part(Sheet(None), rig.stated[0].__class__(np.eye(3), np.array([0.0, 0.0, z]))),))
        image = render_stripe(rig.camera, upright, plate, blur_px=rig.blur_at)
        line = image[240]
        u = np.arange(len(line))
        middle = (line * u).sum() / line.sum()
        width = np.sqrt((line * (u - middle) ** 2).sum() / line.sum())
        point = np.array([[150.0 * (z - 400.0) / 400.0, 0.0, z]])
        slant = 0.2 * np.hypot(150.0, 400.0) / 400.0 * 1650.0 / z * (1 + 0.0)
        expected = np.sqrt(slant**2 + rig.blur_at(point)[0] ** 2 + 1 / 12)
        assert width == pytest.approx(expected, rel=0.01)
        sharp = render_stripe(rig.camera, upright, plate, blur_px=0.6)
        assert image[200:280].sum() == pytest.approx(sharp[200:280].sum(), rel=1e-3)


def test_a_gaussian_beam_widens_by_diffraction_and_keeps_its_light():
    beam = replace(Beam.diffracted(0.05, 400.0, 660e-6), dims=True, reference=400.0)
    rayleigh = np.pi * 0.1**2 / 660e-6  # of the 1/e^2 radius
    assert beam.width(np.array([400.0 + rayleigh]))[0] == pytest.approx(0.05 * np.sqrt(2))
    r = np.array([300.0, 400.0, 600.0])
    np.testing.assert_allclose(beam.strength(r) * beam.width(r) * r, 0.05 * 400.0)  # power through each arc
    peak = beam.irradiance(0.01, 400.0, np.radians(60.0))
    across = 2 * 400.0 * np.tan(np.radians(30.0))
    assert peak * across * np.sqrt(2 * np.pi) * 0.05 == pytest.approx(0.01)  # W


def test_power_becomes_electrons_as_counted_by_hand():
    lens = Lens(8.0, 4.0, 1e6, 0.005, 650e-6)
    # 1 mW on 1 mm^2 of white paper: 1e-3 / pi W/mm^2/sr; through f/4: times pi / 64; 25 um^2, 1 ms, 3.06e-19 J a photon
    by_hand = 1e-3 / np.pi * (np.pi / 4 / 16) * 25e-6 * 1e-3 / (6.626e-34 * 2.998e8 / 650e-9) * 0.6
    assert lens.levels(1e-3, 650e-6, 1e-3, 0.6) == pytest.approx(by_hand, rel=1e-3)


def test_speckle_is_full_where_its_grain_covers_the_pixel_and_averages_out_where_it_is_fine():
    coarse, grain = replace(LENS, f_number=64.0).speckle(660e-6)
    fine, _ = replace(LENS, f_number=1.4, pixel=0.02).speckle(660e-6)
    assert coarse > 0.9
    assert grain == pytest.approx(1.03 * 660e-6 * 64 * LENS.image_distance / 12 / 0.005)
    assert fine == pytest.approx(
        1 / np.sqrt(1 + 0.02**2 / (4 / np.pi * (660e-6 * 1.4 * LENS.image_distance / 12) ** 2))
    )


def test_data_sheets_give_what_the_pixel_keys_say(tmp_path):
    file = tmp_path / "rig-design.toml"
    light = 'wavelength_nm = 660.0\nwaist = 0.15\nwaist_at = 420.0\npower_mw = 2.0\nspeckle = "aperture"\n'
    file.write_text(HEAD + SHEETS + LASER + light + TAIL)
    rig = VirtualRig.of(read_design(file))
    assert rig.camera.focal[0] == pytest.approx(1.0 / (1.0 / 8.0 - 1.0 / 400.0) / 4.8e-3)
    assert rig.sensor.gain_e == pytest.approx(10000.0 / 255)
    assert rig.sensor.read_noise == pytest.approx(20.0 / rig.sensor.gain_e)
    assert rig.lens is not None
    assert rig.speckle[0] > 0.1
    result = design_rig(file).result
    assert result["sheet_in_focus"]["tilt_deg"][1] != 0.0


@pytest.mark.parametrize(
    ("camera", "laser", "said"),
    [
        (SHEETS.replace("focus = 400.0", "focus = 7.0"), "", "cannot focus at 7 mm"),
        ("focal_px = 900.0\nf_number = 4.0\n", "", "pixel_um is missing"),
        ("focal_px = 900.0\n", "power_mw = 2.0\n", "camera.f_number is missing"),
        (SHEETS, "waist = 0.1\n", "waist and waist_at come together"),
        (SHEETS, "power_mw = 2.0\npeak = 100.0\n", "give one"),
        ("focal_px = 900.0\n", 'speckle = "aperture"\n', "camera.f_number is missing"),
    ],
)
def test_half_a_data_sheet_is_refused_in_a_sentence(camera, laser, said, tmp_path):
    file = tmp_path / "rig-design.toml"
    file.write_text(HEAD + camera + LASER + laser + TAIL)
    with pytest.raises(FileError, match=said):
        read_design(file)


def test_a_lens_out_of_focus_gets_its_sentence():
    soft = design(f_number=1.0)
    soft = replace(soft, camera=replace(soft.camera, focus=150.0))
    assert any("out of focus" in sentence for sentence in design_rig(soft).troubles)
