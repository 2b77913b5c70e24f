"""Noise, uncertainty and verdicts: what comes out of a scan."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import typer
from scipy.ndimage import gaussian_filter, map_coordinates
from typer.testing import CliRunner

from calibration.errors import FileError
from cli import measure
from scope.cloud import Box, ScanCloud, Sensors
from scope.errors import MeasurementError
from scope.heightmap import HeightMap, patch_heights, remove_form
from scope.roughness import RoughnessOptions, measure_heights, measure_roughness, run_roughness
from scope.roughness.align import onto_lattice
from scope.roughness.estimate import raw_parameters
from scope.roughness.noise import neighbour_scatter, repeat_noise

QUICK = RoughnessOptions(uncertainty=False)


def rough(shape, length, rng, sq=0.05):
    """Gaussian surface of correlation exp(-r^2 / length^2), length in samples."""
    z = gaussian_filter(rng.standard_normal(shape), length / 2.0, mode="wrap")
    return sq * z / z.std()


def scan_of(z, rng, noise=0.05, pitch=0.1, shift=(0.0, 0.0), told=None):
    """A scan, straight from above, of heights (rows, columns) towards the camera at -z, with noise along the rays."""
    rows, columns = np.indices(z.shape)
    points = np.stack([columns * pitch + shift[1], rows * pitch + shift[0], 400.0 - z], axis=2).reshape(-1, 3)
    camera = np.array([points[:, 0].mean() + 150.0, points[:, 1].mean(), 0.0])
    ray = points - camera
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = noise / np.abs(ray[:, 2])  # so that the heights have exactly this noise
    points = points + ray * (along * rng.standard_normal(len(points)))[:, None]
    frames = z.shape[0]
    return replace(
        ScanCloud.from_points(points),
        sigma=((told or noise) / np.abs(ray[:, 2])).astype(np.float32),
        pixels=np.stack([np.full(len(points), 310.37), columns.ravel() + 40.0], axis=1).astype(np.float32),
        frame=rows.ravel().astype(np.int32),
        sensors=Sensors(
            frame=np.arange(frames, dtype=np.int32),
            laser=np.zeros(frames, dtype=np.uint8),
            centre=np.tile(camera, (frames, 1)),
            rotation=np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)),
            laser_origin=np.full((frames, 3), np.nan),
        ),
    )


def level(z, pitch=0.1):
    return remove_form(HeightMap(z, (pitch, pitch)), "plane").z


@pytest.fixture(scope="module")
def coupon():
    """400 x 400 points, correlation length 10 samples, Sq and noise 0.05 mm, with a repeat."""
    rng = np.random.default_rng(31)
    z = rough((400, 400), 10.0, rng)
    truth = raw_parameters(level(z), (0.1, 0.1)).raw
    first, second = scan_of(z, rng), scan_of(z, rng)
    return truth, measure_roughness(first, noise=second), measure_roughness(first)


def test_a_repeat_gives_the_surface_back(coupon):
    truth, found, _ = coupon
    areal = found.areal
    assert areal["Sq"].raw == pytest.approx(1.41 * truth["Sq"], rel=0.02)
    assert 0.98 < areal["Sq"].value / truth["Sq"] < 1.02
    assert areal["Sdq"].raw > 9.0 * truth["Sdq"]
    assert areal["Sdq"].value == pytest.approx(truth["Sdq"], rel=0.1)
    assert areal["Sdr"].value == pytest.approx(truth["Sdr"], rel=0.2)
    assert found.noise_floor == pytest.approx(0.05, rel=0.02)
    assert found.valid
    assert any("temporal noise only" in note for note in found.notes)


@pytest.mark.parametrize("which", [1, 2])
def test_stated_uncertainty_covers_the_truth(coupon, which):
    truth, found = coupon[0], coupon[which]
    for key, parameter in found.areal.items():
        if parameter.value is None:
            assert parameter.reason, key
            continue
        assert parameter.uncertainty > 0.0, key
        least = 1.5 if key in {"Smr1", "Smr2"} else 1.0  # k = 2 lets one in twenty out
        assert abs(parameter.value - truth[key]) <= least * parameter.uncertainty, key


def test_predicted_sigma_alone_withholds_slopes(coupon):
    truth, _, found = coupon
    assert found.noise_source == "sigma"
    assert abs(found.areal["Sq"].value - truth["Sq"]) < found.areal["Sq"].uncertainty
    assert found.areal["Sq"].uncertainty > 2.0 * 0.05 * 0.05**2 / truth["Sq"]  # 5 % of sigma costs that much
    for key in ("Sdq", "Sdr"):
        assert found.areal[key].value is None
        assert found.areal[key].reason.startswith("noise")


def test_slopes_of_long_waves_under_noise_are_withheld():
    rng = np.random.default_rng(32)
    z = rough((400, 400), 20.0, rng)
    found = measure_roughness(scan_of(z, rng), noise=scan_of(z, rng), options=QUICK)
    for key in ("Sdq", "Sdr"):
        assert found.areal[key].value is None
        assert found.areal[key].reason.startswith("noise: the measured Sdq")
    assert found.profile["along"]["Rdq"].value is None
    assert found.areal["Sq"].value == pytest.approx(np.std(level(z)), rel=0.02)


def test_a_displaced_repeat_is_found_and_used():
    """The repeat samples the surface elsewhere, once with and once without the cloud knowing of it."""
    rng = np.random.default_rng(33)
    big = rough((300, 300), 10.0, rng)
    rows, columns = np.indices((220, 220)) + 20.0
    z = big[20:240, 20:240]
    moved = map_coordinates(big, [rows + 3.4, columns + 2.7], order=5)
    first = scan_of(z, rng)
    truth = np.std(level(z))
    for shift in ((0.34, 0.27), (0.0, 0.0)):
        found = measure_roughness(first, noise=scan_of(moved, rng, shift=shift), options=QUICK)
        assert found.areal["Sq"].value == pytest.approx(truth, rel=0.02)
        assert found.noise_floor == pytest.approx(0.05, rel=0.03)
        assert "displaced by 0.4" in found.notes[0]
        assert not any("temporal" in note for note in found.notes)


def test_resampling_onto_a_displaced_lattice_is_exact_for_a_quadratic():
    rows, columns = np.indices((60, 70)).astype(float)

    def maps(di, dj):
        r, c = rows + di, columns + dj
        z = 0.001 * (r - 30.0) ** 2 - 0.002 * r * c + 0.3
        return HeightMap(z, (0.2, 0.1), points=np.stack([0.1 * c, 0.2 * r, 0.0 * c], axis=2))

    first, second = maps(0.0, 0.0), maps(2.3, -1.6)
    found = onto_lattice(first, second)
    inner = np.s_[5:-5, 5:-5]
    np.testing.assert_allclose(found[inner], first.z[inner], atol=1e-9)


def test_a_repeat_of_something_else_is_refused():
    rng = np.random.default_rng(34)
    first, other = (patch_heights(scan_of(rough((120, 120), 6.0, rng), rng, noise=0.01)) for _ in range(2))
    with pytest.raises(MeasurementError, match="another surface"):
        repeat_noise(first, other)
    far = patch_heights(scan_of(rough((120, 120), 6.0, rng), rng, shift=(50.0, 0.0)))
    with pytest.raises(MeasurementError, match="covers 0 %"):
        repeat_noise(first, far)


def test_neighbour_scatter_bounds_the_noise():
    rng = np.random.default_rng(35)
    z = rough((300, 300), 10.0, rng) + 0.02 * rng.standard_normal((300, 300))
    for every in (1, 2, 3):
        assert neighbour_scatter(z, every=every).scatter == pytest.approx((0.02, 0.02), rel=0.03)
    assert max(neighbour_scatter(rough((300, 300), 10.0, rng)).scatter) < 5e-4


def test_a_sigma_that_is_too_large_is_found_out():
    rng = np.random.default_rng(36)
    z = rough((200, 200), 10.0, rng)
    found = measure_roughness(scan_of(z, rng, noise=0.02, told=0.03), options=QUICK)
    assert found.noise_floor == pytest.approx(0.02, rel=0.03)
    assert any("neighbouring heights scatter" in note for note in found.notes)
    assert found.areal["Sq"].value == pytest.approx(np.std(level(z)), rel=0.02)


def test_noise_that_is_everything_withholds_everything():
    rng = np.random.default_rng(37)
    found = measure_roughness(scan_of(np.zeros((120, 120)), rng, noise=0.05), options=QUICK)
    assert not found.valid
    sq = found.areal["Sq"]
    assert sq.value is None or sq.value < 0.02
    nothing = measure_heights(
        HeightMap(0.05 * rng.standard_normal((120, 120)), (0.1, 0.1), sigma=np.full((120, 120), 0.0505)), options=QUICK
    )
    assert nothing.areal["Sq"].value is None
    assert all("is all of the measured Sq" in p.reason for p in nothing.areal.values())


def test_a_known_stripe_width_puts_back_what_it_averaged():
    """A stripe of one sigma 2.5 samples across the rows of a surface of correlation length 12."""
    rng = np.random.default_rng(38)
    z = rough((360, 360), 12.0, rng)
    seen = gaussian_filter(z, (2.5, 0.0), mode="wrap")
    blurred, mended = (
        measure_roughness(scan_of(seen, rng, noise=0.004), options=replace(QUICK, stripe_width=width))
        for width in (math.nan, 0.25)
    )
    truth = np.std(level(z))
    assert blurred.areal["Sq"].value < 0.97 * truth
    assert mended.areal["Sq"].value == pytest.approx(truth, rel=0.01)


def test_what_ranging_has_put_back_is_not_put_back_again():
    """Of 12 samples of correlation length a stripe of 2.5 averages (2.5 / 12)^2 = 4.3 % of Sq; half of it is the doubt."""
    rng = np.random.default_rng(46)
    cloud = scan_of(rough((200, 200), 12.0, rng), rng, noise=0.004)
    told, plain = replace(cloud, stripe_width=(0.25,), stripe_corrected=(1.0,)), RoughnessOptions()
    corrected, unknown = measure_roughness(told, options=plain), measure_roughness(cloud, options=plain)
    by_hand = measure_roughness(replace(told, stripe_corrected=(0.0,)), options=plain)
    assert corrected.bandwidth["stripe_width"] == 0.25
    assert unknown.bandwidth["stripe_width"] is None
    sq = [found.areal["Sq"] for found in (unknown, corrected, by_hand)]
    assert sq[1].value == pytest.approx(sq[0].value, rel=1e-9)
    assert sq[2].value == pytest.approx(1.043 * sq[0].value, rel=0.01)
    doubt = math.sqrt(sq[1].uncertainty ** 2 - sq[0].uncertainty ** 2) / sq[0].value
    assert doubt == pytest.approx(0.043, rel=0.2)
    assert any("the stripe" in note and "put back 100 %" in note for note in corrected.notes)


@pytest.mark.long
def test_uncertainty_covers_blocks_of_gaps():
    """Of 12 maps with a fifth missing in blocks, the full map's parameters lie within k = 2 nearly always."""
    rng = np.random.default_rng(39)
    outside, count = 0, 0
    for _ in range(12):
        z = rough((200, 200), 10.0, rng)
        gappy = z.copy()
        while np.isnan(gappy).mean() < 0.2:
            i, j = rng.integers(0, 180, 2)
            gappy[i : i + 20, j : j + 20] = np.nan
        truth = raw_parameters(level(z), (0.1, 0.1)).raw
        found = measure_heights(HeightMap(gappy, (0.1, 0.1)), options=RoughnessOptions(form="plane"))
        for key in ("Sq", "Sa", "Sku", "Sk", "Spk", "Svk", "Vmp", "Vvc", "Sdq", "Sal", "Sp", "Sv"):
            count += 1
            outside += abs(found.areal[key].value - truth[key]) > found.areal[key].uncertainty
        assert "one-sided" in found.areal["Sp"].note
        assert [key for key, p in found.areal.items() if p.to_dict().get("bound") == "lower"] == ["Sp", "Sv", "Sz"]
    assert outside <= 0.06 * count


def test_uncertainty_is_the_spread_from_patch_to_patch():
    rng = np.random.default_rng(40)
    values, stated = [], []
    for _ in range(24):
        big = rough((300, 300), 8.0, rng)
        found = measure_heights(HeightMap(big[:120, :120], (0.1, 0.1)), options=RoughnessOptions(form="none"))
        values.append(found.areal["Sq"].value)
        stated.append(found.areal["Sq"].uncertainty)
    assert 2.0 * np.std(values) == pytest.approx(np.mean(stated), rel=0.5)


def test_warnings_and_gates_of_sampling():
    rng = np.random.default_rng(41)
    small = measure_heights(HeightMap(rough((100, 100), 10.0, rng), (0.1, 0.1)), options=QUICK)
    assert any("correlation lengths" in note for note in small.notes)
    white = measure_heights(HeightMap(0.05 * rng.standard_normal((100, 100)), (0.1, 0.1)), options=QUICK)
    assert white.areal["Sdq"].value is None
    assert white.areal["Sdq"].reason.startswith("sampling: at twice the pitch")
    assert any("too coarse" in note for note in white.notes)


def test_patches_that_cannot_be():
    rng = np.random.default_rng(42)
    z = rough((60, 60), 6.0, rng)
    for heights, told in (
        (800.0 * z, "no roughness of a patch"),
        (np.where(np.indices(z.shape)[1] > 30, z + 2.0, z), "straddles an edge"),
        (z[:20, :20], "400 heights on 20 x 20"),
        (np.zeros((60, 60)), "exactly on the form"),
    ):
        with pytest.raises(MeasurementError, match=told):
            measure_heights(HeightMap(heights, (0.1, 0.1)), options=QUICK)
    heights = HeightMap(z, (0.1, 0.1))
    with pytest.raises(MeasurementError, match="longer than the patch"):
        measure_heights(heights, options=replace(QUICK, l_filter=9.0))
    with pytest.raises(MeasurementError, match="finer than the pitch"):
        measure_heights(heights, options=replace(QUICK, s_filter=0.11))
    filtered = measure_heights(heights, options=replace(QUICK, s_filter=0.5, l_filter=2.5))
    assert filtered.areal["Sq"].value < measure_heights(heights, options=QUICK).areal["Sq"].value
    assert "S-filter Gaussian 0.5 mm" in filtered.settings["filters"]
    assert filtered.profile["along"]["Rq"].value > 0.0


def test_json_holds_what_the_contract_says():
    rng = np.random.default_rng(43)
    told = measure_roughness(scan_of(rough((80, 80), 5.0, rng), rng, noise=0.005)).to_dict()
    json.dumps(told, allow_nan=False)
    assert {"name", "areal", "profile", "noise_floor_mm", "valid", "pitch_mm"} <= set(told)
    assert {"along", "across"} == set(told["profile"])
    for table in (told["areal"], *told["profile"].values()):
        for parameter in table.values():
            assert {"value", "uncertainty", "unit"} <= set(parameter)
            assert (parameter["value"] is None) == ("reason" in parameter)


@pytest.fixture
def scan_file(tmp_path):
    rng = np.random.default_rng(44)
    z = rough((80, 100), 5.0, rng)
    scan_of(z, rng, noise=0.005).save(tmp_path / "cloud.ply")
    scan_of(z, rng, noise=0.005).save(tmp_path / "repeat.ply")
    return tmp_path / "cloud.ply"


def command(*words):
    app = typer.Typer()
    app.callback()(lambda: None)
    measure.register(app)
    return CliRunner().invoke(app, ["roughness", *map(str, words)])


def test_command(scan_file):
    folder = scan_file.parent
    done = command(
        scan_file, "--region", "left=box:0,5,0,8", "--region", "all=box:-1,20,-1,20", "--noise", folder / "repeat.ply",
        "--json", "--quiet", "--csv", folder / "t.csv", "--report", folder / "r.html",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    patches = json.loads(done.stdout)["patches"]
    assert [patch["name"] for patch in patches] == ["left", "all"]
    assert patches[1]["noise_source"] == "repeat"
    assert patches[1]["noise_floor_mm"] == pytest.approx(0.005, rel=0.1)
    with (folder / "t.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    values = {(row["patch"], row["group"], row["parameter"]): row["value"] for row in rows}
    assert float(values["all", "areal", "Sq"]) == pytest.approx(patches[1]["areal"]["Sq"]["value"])
    page = (folder / "r.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 8
    assert page.count("data:image/") == 6  # of each patch the map, the relief and what stands for it on paper
    assert "ISO 25178-2" in page
    assert "http" not in page.replace("http://www.w3.org", "")


def test_a_mesh_chooses_the_region_by_its_pose(scan_file):
    pytest.importorskip("open3d")
    trimesh = pytest.importorskip("trimesh")
    folder = scan_file.parent
    corners = [[-2.5, -3.0, 0.0], [2.5, -3.0, 0.0], [2.5, 3.0, 0.0], [-2.5, 3.0, 0.0]]
    trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]]).export(folder / "face.stl")
    pose = np.eye(4)
    pose[:3, 3] = 5.0, 4.0, 400.0
    (folder / "pose.json").write_text(json.dumps({"cloud_from_model": pose.tolist(), "score": 1.0}))
    words = (scan_file, "--region", f"face=mesh:{folder / 'face.stl'}", "--json", "--quiet")
    found = command(*words, "--pose", folder / "pose.json")
    assert found.exit_code == 0, found.output
    size = json.loads(found.stdout)["patches"][0]["bandwidth_mm"]
    assert (size["patch_along"], size["patch_across"]) == pytest.approx(
        (5.0, 6.0), abs=0.3
    )  # and nothing beside its edges
    assert command(*words).exit_code == 1  # at the origin there is nothing
    (folder / "refused.json").write_text(json.dumps({"cloud_from_model": None}))
    refused = command(*words, "--pose", folder / "refused.json")
    assert refused.exit_code == 1
    assert "no rigid 4x4" in refused.output


def test_command_refuses(scan_file):
    for words, status, told in (
        (("--region", "disc:3"), 2, "disc:3"),
        (("--form", "cone"), 2, "cone"),
        (("--region", "box:90,91,0,1"), 1, "the region is empty"),
        (("--csv", "/nowhere/t.csv"), 1, "does not exist"),
        (("--l-filter", "50"), 1, "longer than the patch"),
        (("--s-filter", "2", "--l-filter", "1"), 2, "L-filter"),
        (("--s-filter", "0"), 2, "S-filter"),
        (("--pitch", "0.1"), 1, "a pitch of its own"),
        (("--region", "a=box:0,5,0,8", "--region", "a=box:0,4,0,8"), 2, "called"),
        (("--noise", scan_file), 1, "very same scan"),
    ):
        done = command(scan_file, *words)
        assert done.exit_code == status, (words, done.output)
        assert told in done.output


def test_height_map_files_are_measured(tmp_path):
    rng = np.random.default_rng(45)
    z = rough((90, 90), 5.0, rng)
    np.save(tmp_path / "a.npy", z)
    found = run_roughness(tmp_path / "a.npy", [("part", Box(x=(0.0, 6.0)))], QUICK, pitch=(0.1, 0.1))
    assert found[0].name == "part"
    assert found[0].heights.z.shape == (90, 61)
    assert found[0].noise_source == "unknown"
    assert math.isnan(found[0].noise_floor)
    assert found[0].to_dict()["noise_floor_mm"] is None
    with pytest.raises(FileError, match="need a cloud"):
        run_roughness(tmp_path / "a.npy", [], QUICK, noise=tmp_path / "b.ply", pitch=(0.1, 0.1))
