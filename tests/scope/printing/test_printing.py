"""Drawn targets, seen by rasterisers, a pinhole and other programs' readers: every mark, to scale."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.targets import KINDS, raster, see, similarity
from calibration.errors import CalibrationError, FileError
from calibration.targets import Charuco, Chessboard, MarkerBoard, MarkerPlace, SpotGrid
from cli.main import app
from scope.printing import draw_pattern, print_jig, print_target, target_sheet
from scope.printing.tiles import MARGIN, tiled
from scope.session import read_target

for library in ("cairosvg", "pymupdf", "ezdxf"):
    pytest.importorskip(library)

BOARD = 'format = 1\nunits = "mm"\n\n[target]\nkind = "chessboard"\nrows = 6\ncolumns = 9\npitch = 20.0  # side\n\n[accept]\nray_mm = 0.02\n'


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ending", [".svg", ".pdf"])
def test_every_mark_is_found_and_the_scale_is_right_to_a_ten_thousandth(kind, ending, tmp_path):
    seen = see(kind, ending, tmp_path, 127.0)
    assert (seen.found, seen.remedy) == (seen.expected, "")
    assert abs(seen.scale - 1.0) < 1e-4
    assert seen.rms_mm < 0.03  # a tenth of a pixel of the camera


def test_the_sheet_has_the_size_in_millimetres_that_is_told(tmp_path):
    import ezdxf
    import pymupdf

    drawn = print_target("spots", tmp_path / "t.pdf").result
    with pymupdf.open(tmp_path / "t.pdf") as document:
        assert len(document) == drawn["pages"] == 1
        size = np.array([document[0].rect.width, document[0].rect.height]) * 25.4 / 72
    np.testing.assert_allclose(size, [drawn["width_mm"], drawn["height_mm"]], atol=1e-4)
    print_target("spots", tmp_path / "t.dxf")
    drawing = ezdxf.readfile(tmp_path / "t.dxf")
    assert drawing.audit().errors == []
    holes = [e for e in drawing.modelspace() if e.dxftype() == "CIRCLE"]
    assert sorted({e.dxf.layer for e in holes}) == ["HOLES_5", "HOLES_7-5"]
    assert (len(holes), sum(e.dxf.layer == "HOLES_7-5" for e in holes)) == (315, 3)
    centres = np.array([[e.dxf.center.x, -e.dxf.center.y] for e in holes])  # y runs up in a DXF
    scale, rms = similarity(read_target(tmp_path / "t.toml").marks[:, :2], centres)
    assert (scale, rms) == (pytest.approx(1.0, abs=1e-9), pytest.approx(0.0, abs=1e-6))


@pytest.mark.parametrize("target", [
    Charuco(5, 7, (12.0, 12.0), 9.0, "DICT_4X4_50"), Charuco(6, 7, (12.0, 12.0), 9.0, "DICT_6X6_50", legacy=True),
])  # fmt: skip
def test_a_charuco_board_is_opencvs_own_picture_of_it(target, tmp_path):
    import cv2

    sheet = target_sheet(target)
    from scope.printing.svg import svg_text

    (tmp_path / "b.svg").write_text(svg_text(sheet.drawing, ""))
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    board = cv2.aruco.CharucoBoard((target.columns, target.rows), 12.0, 9.0, words)
    board.setLegacyPattern(target.legacy)
    each = 64
    theirs = board.generateImage((each * target.columns, each * target.rows))
    x0, y0, _, _ = draw_pattern(target).area
    ours = raster(tmp_path / "b.svg", 25.4 * each / 12.0)
    column, row = (round((k - 12.0 - low) * each / 12.0) for k, low in ((15.0, x0), (8.0, y0)))
    part = ours[row : row + theirs.shape[0], column : column + theirs.shape[1]]
    assert np.mean(np.abs(part.astype(float) - theirs) > 100) < 0.01  # cell borders may round to other pixels


def test_turned_markers_are_drawn_where_their_corners_are(tmp_path):
    board = MarkerBoard(
        "DICT_4X4_50", 30.0, (MarkerPlace(3, 0.0, 0.0, np.radians(30.0)), MarkerPlace(7, 90.0, 10.0, -1.0))
    )
    import cv2

    from scope.printing.svg import svg_text

    sheet = target_sheet(board)
    (tmp_path / "m.svg").write_text(svg_text(sheet.drawing, ""))
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    corners, numbers, _ = detector.detectMarkers(raster(tmp_path / "m.svg", 254.0))
    assert sorted(np.ravel(numbers)) == [3, 7]
    found = np.concatenate([corners[k].reshape(4, 2) for k in np.argsort(np.ravel(numbers))]) / 10.0
    stated = board.marks[:, :2]
    np.testing.assert_allclose(found - found.mean(axis=0), stated - stated.mean(axis=0), atol=0.15)


def test_pages_joined_at_their_marks_are_the_sheet():
    drawing = target_sheet(SpotGrid(19, 25, 12.0, 4.0, "dark")).drawing
    pages = tiled(drawing, (210.0, 297.0))
    assert len(pages) > 1
    assert all((page.width, page.height) in {(210.0, 297.0), (297.0, 210.0)} for page in pages)
    spots = set()
    for page in pages:
        x0, y0, x1, y1 = page.clip
        assert (x0, y0) == (MARGIN, MARGIN)
        holes = [s for s in page.shapes if hasattr(s, "radius")]
        first = min(holes, key=lambda s: (s.y, s.x))
        inside = [s for s in holes if x0 <= s.x - 2 and s.x + 2 <= x1 and y0 <= s.y - 2 and s.y + 2 <= y1]
        spots |= {(round((s.x - first.x) / 12.0), round((s.y - first.y) / 12.0)) for s in inside}
    assert spots == {(c, r) for c in range(25) for r in range(19)}  # the shared strip is wider than a spot


@pytest.mark.parametrize(("measured", "pitch"), [((199.4,), 19.94), ((199.4, 100.3), [19.94, 20.06])])
def test_a_measured_print_corrects_the_pitch_and_nothing_else(measured, pitch, tmp_path):
    file = tmp_path / "calibration.toml"
    file.write_text(BOARD)
    found = print_target(file, tmp_path / "b.svg", measured=measured)
    assert found.crosses == (200.0, 100.0)
    now = tomllib.loads(file.read_text())
    assert now.pop("target") == {"kind": "chessboard", "rows": 6, "columns": 9, "pitch": pitch}
    assert now == {k: v for k, v in tomllib.loads(BOARD).items() if k != "target"}
    assert "# side" in file.read_text()
    with pytest.raises(FileError, match="corrected by --measured before"):
        print_target(file, tmp_path / "b.svg", measured=measured)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_can_be_corrected(kind, tmp_path):
    plain = print_target(kind, tmp_path / "t.svg")
    before = read_target(plain.toml).marks
    print_target(kind, tmp_path / "t.svg", measured=[0.99 * plain.crosses[0]])
    np.testing.assert_allclose(read_target(plain.toml).marks, 0.99 * before, atol=1e-5)


def test_what_cannot_be_drawn_is_refused_in_a_sentence(tmp_path):
    with pytest.raises(CalibrationError, match="diameter is missing"):
        draw_pattern(SpotGrid(5, 7, 10.0))
    with pytest.raises(CalibrationError, match="DICT_NONE"):
        draw_pattern(Charuco(5, 7, (12.0, 12.0), 9.0, "DICT_NONE"))
    with pytest.raises(CalibrationError, match="has markers 0 to 49, not 77"):
        draw_pattern(MarkerBoard("DICT_4X4_50", 30.0, (MarkerPlace(77, 0.0, 0.0),)))
    with pytest.raises(ValueError, match=r"\.svg, \.pdf or \.dxf"):
        print_target("spots", tmp_path / "t.png")
    with pytest.raises(ValueError, match="too small"):
        tiled(target_sheet(Chessboard(6, 9, 20.0)).drawing, (50.0, 297.0))
    (tmp_path / "t.toml").write_text(BOARD)
    with pytest.raises(FileError, match="describes another target"):
        print_target("spots", tmp_path / "t.svg")
    with pytest.raises(FileError, match="stand 200 mm apart"):
        print_target(tmp_path / "t.toml", tmp_path / "t.svg", measured=[99.7])
    (tmp_path / "listed.toml").write_text('format = 1\n[target]\nkind = "listed"\n')
    with pytest.raises(FileError, match="listed"):
        print_target(tmp_path / "listed.toml", tmp_path / "t.svg")
    assert not (tmp_path / "t.svg").exists()


def test_the_base_of_a_jig_has_its_seats_where_the_file_says_them(tmp_path):
    import ezdxf

    runner = CliRunner()
    file = tmp_path / "calibration.toml"
    seats = [(340.0, 0.0), (400.0, 10.0), (440.0, 0.0)]
    planes = "".join(
        f'[[plane]]\nname = "w{z:g}"\nimages = "x.png"\norigin = [-9.0, -5.0, {z / 10}]\nrotation = [0.0, {a}, 0.0]\n'
        for z, a in seats
    )
    file.write_text(BOARD.replace('"mm"', '"cm"').replace("20.0", "2.0") + planes)
    done = runner.invoke(app, ["target", str(file), "-o", str(tmp_path / "t.svg"), "--jig", str(tmp_path / "j.dxf"), "--json", "-q"])  # fmt: skip
    told = json.loads(done.stdout)["jig"]["seats"]
    assert [seat["name"] for seat in told] == ["w340", "w400", "w440"]
    assert [seat["z_mm"] for seat in told] == [340.0, 400.0, 440.0]
    assert [seat["y_mm"] for seat in told] == [-50.0] * 3
    lines = [e for e in ezdxf.readfile(tmp_path / "j.dxf").modelspace() if e.dxf.layer == "SEATS"]
    ends = np.array([[[e.dxf.start.x, e.dxf.start.y], [e.dxf.end.x, e.dxf.end.y]] for e in lines])
    assert ends[:, :, 0].mean(axis=1)[2] - ends[:, :, 0].mean(axis=1)[0] == pytest.approx(100.0)
    lean = np.degrees(np.arctan2(np.ptp(ends[:, :, 0], axis=1), np.ptp(ends[:, :, 1], axis=1)))
    np.testing.assert_allclose(lean, [0.0, 10.0, 0.0], atol=1e-6)
    assert [seat["rotation_deg"][1] for seat in told] == pytest.approx([0.0, 10.0, 0.0])
    file.write_text(BOARD + '[[plane]]\nimages = "x.png"\n')
    refused = runner.invoke(app, ["target", str(file), "-o", str(tmp_path / "t.svg"), "--jig", str(tmp_path / "j.pdf")])
    assert (refused.exit_code, "no [[plane]] has an origin" in refused.output) == (1, True)


def test_a_designed_jig_is_drawn_with_the_calibration_file_that_fits_it(tmp_path):
    from scope.session.commented import FILES

    design = tmp_path / "rig-design.toml"
    design.write_text(FILES["rig-design.toml"])
    drawn = print_target(design, tmp_path / "t.svg")
    assert drawn.toml == tmp_path / "t.toml"
    assert read_target(drawn.toml) == SpotGrid(
        15, 21, (12.0, 12.0), 4.5, "light", ((7, 10), (7, 12), (4, 10)), fiducial_diameter=6.8
    )
    jig = print_jig(design, tmp_path / "j.pdf", paper=(210.0, 297.0)).result
    assert [seat["middle_z_mm"] for seat in jig["seats"]] == [360.0, 400.0, 440.0]
    assert jig["pages"] > 1


def test_the_command_tells_marks_size_and_pages(tmp_path):
    runner = CliRunner()
    done = runner.invoke(app, ["target", "charuco", "-o", str(tmp_path / "t.pdf"), "--paper", "a4", "--json", "-q"])
    result = json.loads(done.stdout)
    assert done.exit_code == 0
    assert (result["marks"], result["pages"]) == (70, 1)
    assert result["width_mm"] <= 297.0
    for words in (["-o", "t.png"], ["-o", "t.pdf", "--paper", "b9"], ["-o", "t.svg", "--measured", "x"]):
        assert runner.invoke(app, ["target", "spots", *words]).exit_code == 2
    missing = runner.invoke(app, ["target", str(tmp_path / "none.toml"), "-o", str(tmp_path / "t.svg")])
    assert (missing.exit_code, missing.output.count("\n")) == (1, 1)
