"""Patches, forms, filters and files of height maps."""

import math
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from calibration.errors import FileError
from calibration.geometry import Pose
from scope.cloud import Box, Mesh, ScanCloud, Sensors, parse_region
from scope.cloud.near_mesh import NearMesh
from scope.errors import MeasurementError
from scope.heightmap import (
    HeightMap,
    gaussian,
    l_filter,
    least_s_index,
    local_roughness,
    patch_heights,
    read_heights,
    refuse_edges,
    remove_form,
    remove_model,
    s_filter,
    within,
)


def rough(shape, spread, rng, sq=0.05):
    z = gaussian_filter(rng.standard_normal(shape), spread, mode="wrap")
    return sq * z / z.std()


def scan_of(z, pitch=(0.12, 0.1), pose=None, camera=(60.0, 0.0, -300.0), sigma=0.02):
    """A scan of heights (rows, columns) above z = 0, towards the camera at -z; rows are frames."""
    rows, columns = np.indices(z.shape)
    points = np.stack([columns * pitch[1], rows * pitch[0], -z], axis=2)
    known = np.isfinite(z)
    points, rows, columns = points[known], rows[known], columns[known]
    pose = pose or Pose.identity()
    centre = pose.apply(np.array([camera]))[0]
    frames = z.shape[0]
    return replace(
        ScanCloud.from_points(pose.apply(points)),
        sigma=np.full(len(points), sigma, dtype=np.float32),
        pixels=np.stack([np.full(len(points), 310.37), columns + 40.0], axis=1).astype(np.float32),
        frame=(rows + 7).astype(np.int32),
        sensors=Sensors(
            frame=np.arange(7, 7 + frames, dtype=np.int32),
            laser=np.zeros(frames, dtype=np.uint8),
            centre=np.tile(centre, (frames, 1)),
            rotation=np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)),
            laser_origin=np.full((frames, 3), np.nan),
        ),
    )


@given(
    turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    shift=st.tuples(*[st.floats(-500.0, 500.0)] * 3),
    seed=st.integers(0, 50),
)
@settings(max_examples=15, deadline=None)
def test_a_patch_is_the_same_from_everywhere(turn, shift, seed):
    """Heights are distances from the patch's own plane: no motion of the cloud changes them."""
    rng = np.random.default_rng(seed)
    z = rough((40, 50), 3.0, rng)
    z[rng.random(z.shape) < 0.1] = np.nan
    still = patch_heights(scan_of(z))
    moved = patch_heights(scan_of(z, pose=Pose.from_rotation_vector(turn, shift)))
    np.testing.assert_allclose(moved.z, still.z, atol=1e-9)
    np.testing.assert_allclose(moved.pitch, still.pitch, atol=1e-9)
    np.testing.assert_allclose(moved.sigma, still.sigma, atol=1e-6)
    assert still.pitch == pytest.approx((0.12, 0.1), rel=1e-3)


def test_patch_heights_are_the_heights_and_gaps_stay():
    rng = np.random.default_rng(1)
    z = rough((60, 70), 4.0, rng)
    gaps = rng.random(z.shape) < 0.2
    z[gaps] = np.nan
    patch = patch_heights(scan_of(z))
    assert np.array_equal(np.isnan(patch.z), gaps)
    rows, columns = np.nonzero(~gaps)
    design = np.stack([np.ones(len(rows)), rows, columns], axis=1)
    level = z[~gaps] - design @ np.linalg.lstsq(design, z[~gaps], rcond=None)[0]
    np.testing.assert_allclose(patch.z[~gaps], level, atol=2e-4 * np.abs(level).max())  # the cosine of the tilt
    assert patch.origin == (7, 40)
    np.testing.assert_allclose(patch.points[~gaps][:, 2], -z[~gaps])


def test_sigma_is_turned_from_the_ray_to_the_normal():
    patch = patch_heights(
        scan_of(np.random.default_rng(2).standard_normal((40, 40)) * 1e-4, camera=(300.0, 0.0, -300.0))
    )
    assert patch.noise == pytest.approx(0.02 * math.cos(math.pi / 4.0), rel=0.02)


def test_frames_of_two_lasers_are_thinned():
    z = rough((40, 40), 3.0, np.random.default_rng(3))
    cloud = scan_of(z)
    cycled = replace(cloud, frame=cloud.frame * 2)
    assert patch_heights(cycled).z.shape == z.shape


def test_a_cloud_without_order_is_gridded_and_says_so():
    rng = np.random.default_rng(4)
    z = rough((60, 60), 6.0, rng)
    cloud = scan_of(z)
    bare = ScanCloud.from_points(cloud.points[rng.permutation(len(cloud))])
    patch = patch_heights(bare)
    assert any(note.startswith("warning: the cloud has no scan order") and "Sq by" in note for note in patch.notes)
    assert np.nanstd(patch.z) == pytest.approx(z.std(), rel=0.03)
    assert math.isnan(patch.noise)


def test_patches_that_cannot_be():
    z = rough((40, 40), 3.0, np.random.default_rng(5))
    cloud = scan_of(z)
    with pytest.raises(MeasurementError, match=r"empty: the cloud spans x 0\.0"):
        patch_heights(cloud, Box(x=(900.0, 901.0)))
    with pytest.raises(MeasurementError, match=r"holds \d+ points; roughness needs 1000"):
        patch_heights(cloud, Box(x=(0.0, 1.0), y=(0.0, 1.0)))
    with pytest.raises(MeasurementError, match="single profile of 1500 points"):
        patch_heights(scan_of(np.zeros((1, 1500))))
    with pytest.raises(MeasurementError, match=r"scatter by [0-9.]+ mm rms along the sight"):
        patch_heights(scan_of(400.0 * z / z.std() * 0.1))  # deeper than wide: its plane would stand on end
    assert any(
        "are the data in mm?" in note for note in patch_heights(replace(cloud, points=1e-3 * cloud.points)).notes
    )
    line = np.stack([np.arange(2000.0), np.zeros(2000), np.zeros(2000)], axis=1)
    with pytest.raises(MeasurementError, match="on one line"):
        patch_heights(ScanCloud.from_points(line))


def coordinates(side=30.0, samples=150):
    along = (np.arange(samples) / (samples - 1) - 0.5) * side
    return np.meshgrid(along, along), side / (samples - 1)


@given(
    radius=st.floats(30.0, 300.0), kind=st.sampled_from(["sphere", "cylinder"]), sign=st.sampled_from([1.0, -1.0]),
    angle=st.floats(0.0, math.pi), tilt=st.floats(-0.2, 0.2),
)  # fmt: skip
@settings(max_examples=12, deadline=None)
def test_a_perfect_form_leaves_nothing(radius, kind, sign, angle, tilt):
    (x, y), pitch = coordinates()
    u = x * math.cos(angle) + y * math.sin(angle)
    square = radius**2 - u**2 - (y * math.cos(angle) - x * math.sin(angle)) ** 2 * (kind == "sphere")
    z = sign * (np.sqrt(square) - radius)
    normal = Pose.from_rotation_vector([tilt, 0.0, 0.0], np.zeros(3)).apply(np.stack([x, y, z], axis=2))
    from scope.heightmap.form import fit_form

    form = fit_form(normal.reshape(-1, 3), kind)
    assert np.abs(form.residual).max() < 1e-6
    assert form.radius == pytest.approx(sign * radius, rel=1e-4)
    del pitch


@given(order=st.integers(2, 6), seed=st.integers(0, 30))
@settings(max_examples=8, deadline=None)
def test_a_polynomial_is_removed_by_its_own_order(order, seed):
    rng = np.random.default_rng(seed)
    (x, y), pitch = coordinates(samples=60)
    z = sum(
        1e-3 * rng.standard_normal() * (x / 15.0) ** i * (y / 15.0) ** j
        for i in range(order + 1) for j in range(order + 1 - i)
    )  # fmt: skip
    left = remove_form(HeightMap(z, (pitch, pitch)), f"poly{order}")
    assert np.abs(left.z).max() < 1e-6  # the levelling turn bends the polynomial by slope squared


@pytest.mark.parametrize("shape", ["plane", "cylinder", "sphere"])
def test_auto_finds_the_shape_and_keeps_the_roughness(shape):
    """Radius 50 mm, patch 30 mm, Sq 0.05 mm, displaced along the normal as roughness is."""
    (x, y), pitch = coordinates(samples=300)
    r = rough(x.shape, 5.0, np.random.default_rng(6))
    reach = 50.0 + r
    if shape == "plane":
        z = 0.3 * x + r * math.sqrt(1.09)
    else:  # the height at which the radius is 50 + r
        z = np.sqrt(reach**2 - x**2 - (y**2 if shape == "sphere" else 0.0)) - 50.0
    heights = HeightMap(z, (pitch, pitch))
    left = remove_form(heights, "auto")
    assert left.form.startswith(shape)
    assert np.std(left.z) == pytest.approx(0.05, rel=0.02)
    assert not left.notes
    if shape != "plane":
        assert np.std(remove_form(heights, "plane").z) > 0.5
        high = remove_form(heights, "poly6")
        assert "poly6 has 28 terms" in high.notes[-1]
        assert shape in high.notes[-1]


def test_noise_does_not_look_like_a_shape():
    """White noise on top must not make the count of independent areas, and so the trust in a curvature, large."""
    rng = np.random.default_rng(7)
    for _ in range(5):
        z = rough((200, 200), 8.0, rng) + 0.05 * rng.standard_normal((200, 200))
        assert remove_form(HeightMap(z, (0.1, 0.1)), "auto").form == "plane"


def test_robust_plane_ignores_pits():
    rng = np.random.default_rng(8)
    (x, _), pitch = coordinates(samples=100)
    z = 0.01 * rng.standard_normal(x.shape) + 0.1 * x
    z[x > 11.0] -= 2.0
    robust = remove_form(HeightMap(z, (pitch, pitch)), "robust-plane").z
    plain = remove_form(HeightMap(z, (pitch, pitch)), "plane").z
    land = x < 10.0
    assert robust[land].std() == pytest.approx(0.01, rel=0.05)
    assert plain[land].std() > 0.1


def test_forms_that_are_not_known():
    heights = HeightMap(np.zeros((30, 30)), (1.0, 1.0))
    for name in ("poly1", "poly11", "polyx", "cone", ""):
        with pytest.raises(ValueError, match="is not known"):
            remove_form(heights, name)


@given(index=st.floats(2.0, 6.0), ratio=st.floats(0.5, 3.0))
@settings(max_examples=12, deadline=None)
def test_gaussian_transmission_is_the_standards(index, ratio):
    """ISO 16610-21: a wave of length w passes with exp(-pi (alpha index / w)^2), alpha^2 = ln 2 / pi."""
    pitch = 0.1
    wave = index * ratio
    x = np.arange(1200) * pitch
    z = np.tile(np.cos(2 * np.pi * (x - x.mean()) / wave), (3, 1))
    passed = gaussian(z, (1.0, pitch), (0.0, index)).z[:, 500:700]
    expected = math.exp(-math.log(2.0) * (index / wave) ** 2)
    np.testing.assert_allclose(passed, expected * z[:, 500:700], atol=2e-3)


def test_gaussian_over_gaps_keeps_a_constant_and_reports_support():
    rng = np.random.default_rng(9)
    z = np.where(rng.random((80, 80)) < 0.3, np.nan, 4.2)
    smooth = gaussian(z, (0.1, 0.1), (1.0, 1.0))
    np.testing.assert_allclose(smooth.z[np.isfinite(smooth.z)], 4.2)
    assert smooth.support[40, 40] == pytest.approx(0.7, abs=0.1)
    assert smooth.support[0, 0] < 0.4


def test_s_and_l_filter_share_the_surface():
    heights = HeightMap(rough((200, 200), 4.0, np.random.default_rng(10)), (0.1, 0.1))
    smooth, short = s_filter(heights, 1.0), l_filter(heights, 1.0)
    np.testing.assert_allclose(smooth.z + short.z, heights.z, atol=1e-12)
    assert "end effects on" in short.filters[0]
    assert least_s_index((0.1, 0.05)) == 0.5
    with pytest.raises(MeasurementError, match="finer than the pitch"):
        s_filter(heights, 0.15)
    with pytest.raises(MeasurementError, match="longer than the patch"):
        l_filter(heights, 25.0)


def test_local_roughness_tells_two_finishes_apart():
    rng = np.random.default_rng(11)
    z = np.concatenate([rough((200, 100), 1.5, rng, 0.02), rough((200, 100), 1.5, rng, 0.1)], axis=1)
    local = local_roughness(z, (0.1, 0.1), 3.0)
    assert np.median(local[:, 20:80]) == pytest.approx(0.02, rel=0.1)
    assert np.median(local[:, 120:180]) == pytest.approx(0.1, rel=0.1)


def test_edges_are_refused_and_textures_are_not():
    rng = np.random.default_rng(12)
    (x, y), pitch = coordinates(samples=200)
    plain = rough(x.shape, 4.0, rng)
    for step in (x > 2.0, x + 0.4 * y > -3.0, y > 1.0):
        with pytest.raises(MeasurementError, match="straddles an edge: the surface steps by"):
            refuse_edges(remove_form(HeightMap(plain + 2.0 * step, (pitch, pitch))))
    occluded = np.where(np.abs(x - 2.0) < 0.5, np.nan, plain + 2.0 * (x > 2.0))
    with pytest.raises(MeasurementError, match="straddles"):
        refuse_edges(remove_form(HeightMap(occluded, (pitch, pitch))))
    grooves = -np.abs(gaussian_filter(rng.standard_normal(200), 3.0))
    for texture in (
        plain,
        np.tile(grooves, (200, 1)) + 0.01 * plain,
        0.05 * np.sin(x * 1.3) * np.sin(y),
        0.5 * ((x % 3.0) < 1.5) + plain,
        0.1 * plain - 1.0 * (np.abs(x) < 0.7),
    ):
        refuse_edges(remove_form(HeightMap(texture, (pitch, pitch))))


def test_model_as_form():
    pytest.importorskip("open3d")
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=6, radius=40.0)
    (x, y), _ = coordinates(samples=80)
    r = rough(x.shape, 4.0, np.random.default_rng(13))
    direction = np.stack([x, y, np.sqrt(1600.0 - x**2 - y**2)], axis=2) / 40.0
    points = direction * (40.0 + r)[:, :, None]
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    heights = HeightMap(points[:, :, 2], (0.38, 0.38), points=points)
    left = remove_model(heights, mesh)
    assert np.std(left.z - r) < 0.006  # the mesh's facets
    assert NearMesh(mesh).contains(np.array([[0.0, 0.0, 41.5], [0.0, 0.0, 44.0]])).tolist() == [True, False]
    with pytest.raises(MeasurementError, match="away from the patch"):
        remove_model(replace(heights, points=points + 100.0), mesh)


def test_regions_as_text(tmp_path):
    assert parse_region("top=box:0,30,-5,5")[0] == "top"
    box = parse_region("box:0,30,-5,5,1,2")[1]
    assert box.contains(np.array([[3.0, 0.0, 1.5], [3.0, 0.0, 3.0]])).tolist() == [True, False]
    corners = tmp_path / "p.csv"
    corners.write_text("x,y\n0,0\n10,0\n0,10\n")
    assert parse_region(f"polygon:{corners}")[1].contains(np.array([[2.0, 2.0, 0.0], [8.0, 8.0, 0.0]])).tolist() == [
        True,
        False,
    ]
    for text in ("box", "disc:1", "box:1,2,3", "box:a,b,c,d", "=box:0,1,0,1", "box:2,1,0,1"):
        with pytest.raises(ValueError, match="box"):
            parse_region(text)
    with pytest.raises(FileError, match="could not be read"):
        parse_region(f"polygon:{tmp_path / 'none.csv'}")
    corners.write_text("x,y\n0,0\nnan,5\n5,5\n")
    with pytest.raises(FileError, match="not finite"):
        parse_region(f"polygon:{corners}")
    corners.write_text("x,y\n0,0\n")
    with pytest.raises(FileError, match="no polygon"):
        parse_region(f"polygon:{corners}")


def test_files_of_heights(tmp_path):
    rng = np.random.default_rng(14)
    z = np.round(rough((20, 30), 2.0, rng), 6)
    z[3, 4:7] = np.nan
    np.save(tmp_path / "a.npy", z)
    np.savetxt(tmp_path / "a.txt", z)
    grid = "ncols 30\nnrows 20\nxllcorner 0\nyllcorner 0\ncellsize 0.25\nNODATA_value -9999\n"
    body = "\n".join(" ".join(f"{v:.6f}" for v in row) for row in np.nan_to_num(z, nan=-9999.0))
    (tmp_path / "a.asc").write_text(grid + body)
    rows, columns = np.nonzero(np.isfinite(z))
    order = rng.permutation(len(rows))
    table = np.stack([columns * 0.1, rows * 0.2, z[rows, columns]], axis=1)[order]
    np.savetxt(tmp_path / "a.xyz", table, fmt="%.6f")
    np.savetxt(tmp_path / "comma.xyz", table, fmt="%.6f", delimiter=",", header="x,y,z", comments="")
    for name, pitch, told in (
        ("a.npy", (0.2, 0.1), (0.2, 0.1)), ("a.txt", (0.2, 0.1), (0.2, 0.1)), ("a.asc", None, (0.25, 0.25)),
        ("a.xyz", None, (0.2, 0.1)), ("comma.xyz", None, (0.2, 0.1)),
    ):  # fmt: skip
        heights = read_heights(tmp_path / name, pitch=pitch)
        np.testing.assert_allclose(heights.z, z, atol=1e-9)
        assert heights.pitch == pytest.approx(told)
    cut = within(read_heights(tmp_path / "a.npy", pitch=(0.2, 0.1)), Box(x=(0.0, 1.0)))
    assert np.isfinite(cut.z[:, :11]).sum() == np.isfinite(z[:, :11]).sum()
    assert not np.isfinite(cut.z[:, 11:]).any()
    with pytest.raises(MeasurementError, match="the region is empty: the map spans x 0 to 2.9"):
        within(read_heights(tmp_path / "a.npy", pitch=(0.2, 0.1)), Box(x=(5.0, 6.0)))


@pytest.mark.skipif(find_spec("sdfio") is None or find_spec("x3pio") is None, reason="optional packages")
def test_files_of_the_standards(tmp_path):
    import sdfio
    import x3pio

    z = rough((20, 30), 2.0, np.random.default_rng(15))
    z[3, 4:7] = np.nan
    sdfio.write(tmp_path / "a.sdf", z * 1e-3, x_scale=1e-4, y_scale=2e-4)
    x3pio.write(tmp_path / "a.x3p", z * 1e-3, x_scale=1e-4, y_scale=2e-4)
    for name in ("a.sdf", "a.x3p"):
        heights = read_heights(tmp_path / name)
        np.testing.assert_allclose(heights.z, z, atol=1e-6)
        assert heights.pitch == pytest.approx((0.2, 0.1))
    (tmp_path / "b.sdf").write_bytes(b"no such thing")
    (tmp_path / "b.x3p").write_bytes(b"no such thing")
    for name in ("b.sdf", "b.x3p"):
        with pytest.raises(FileError, match="could not be read"):
            read_heights(tmp_path / name)


def test_files_that_are_no_height_maps(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((5, 5)))
    np.save(tmp_path / "line.npy", np.zeros(5))
    (tmp_path / "a.asc").write_text("ncols 3\nnrows 2\ncellsize 1\n1 2 3\n")
    (tmp_path / "b.asc").write_text("a b c\n")
    np.savetxt(tmp_path / "a.xyz", np.random.default_rng(0).random((50, 3)))
    np.save(tmp_path / "complex.npy", np.zeros((5, 5), dtype=complex))
    (tmp_path / "empty.asc").write_text("")
    for name, told in (
        ("a.npy", "does not say its pitch"), ("a.asc", "its header tells"), ("b.asc", "could not be read"),
        ("a.xyz", "no lattice"), ("none.npy", "could not be read"), ("a.stl", "is no height map"),
        ("complex.npy", "real numbers"), ("empty.asc", "holds no heights"),
    ):  # fmt: skip
        with pytest.raises(FileError, match=told):
            read_heights(tmp_path / name)
    with pytest.raises(FileError, match="an area of rows and columns"):
        read_heights(tmp_path / "line.npy", pitch=(1.0, 1.0))


def test_height_maps_that_cannot_be():
    for z, pitch in ((np.zeros(4), (1.0, 1.0)), (np.zeros((4, 4)), (0.0, 1.0)), (np.zeros((4, 4)), (1.0, math.nan))):
        with pytest.raises(ValueError, match="height map"):
            HeightMap(z, pitch)
    with pytest.raises(ValueError, match="sigma"):
        HeightMap(np.zeros((4, 4)), (1.0, 1.0), sigma=np.zeros(3))
