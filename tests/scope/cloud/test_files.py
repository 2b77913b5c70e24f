"""Clouds in files: every scalar as other readers see it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import FileError
from calibration.geometry import quaternion_from_rotation, rotation_from_quaternion
from scope.cloud import ScanCloud, Sensors
from scope.errors import MeasurementError

SCALARS = ("intensity", "sigma", "sigma_cal", "u", "v", "frame", "laser", "nx", "ny", "nz")


def cloud(n: int = 60) -> ScanCloud:
    """A lattice of 6 frames by 10 columns with a value of its own in every field."""
    rng = np.random.default_rng(0)
    frame, column = (part.ravel() for part in np.mgrid[0 : n // 10, 0:10])
    normals = rng.normal(size=(n, 3))
    points = np.stack([column * 1.0, frame * 1.0, 400 + 0.1 * column], axis=1).astype(np.float32).astype(np.float64)
    return ScanCloud(
        points=points,
        intensity=rng.uniform(0, 255, n).astype(np.float32),
        sigma=rng.uniform(0, 0.1, n).astype(np.float32),
        sigma_cal=rng.uniform(0, 0.1, n).astype(np.float32),
        pixels=np.stack([100 + column, rng.uniform(0, 480, n)], axis=1).astype(np.float32),
        frame=frame.astype(np.int32),
        laser=np.zeros(n, np.uint8),
        sensors=Sensors(
            np.arange(n // 10, dtype=np.int32), np.zeros(n // 10, np.uint8), rng.normal(size=(n // 10, 3)),
            np.tile([1.0, 0, 0, 0], (n // 10, 1)), np.full((n // 10, 3), np.nan),
        ),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        laser_names=("deep red",),
        rig_sha256="ab" * 32,
        verified=True,
        complete=False,
        stripe_width=(0.25,),
        stripe_corrected=(0.75,),
        camera_centre=np.array([0.25, -0.5, 1.0]),
    )  # fmt: skip


def scalars(c: ScanCloud) -> dict[str, np.ndarray]:
    assert c.normals is not None
    values = {name: getattr(c, name) for name in ("intensity", "sigma", "sigma_cal", "frame", "laser")}
    return (
        values
        | {"u": c.pixels[:, 0], "v": c.pixels[:, 1]}
        | dict(zip(("nx", "ny", "nz"), c.normals.T.astype(np.float32), strict=True))
    )


@pytest.fixture
def written(tmp_path: Path) -> Path:
    cloud().save(tmp_path / "cloud.ply")
    return tmp_path / "cloud.ply"


def test_it_comes_back_whole(written: Path) -> None:
    mine, back = cloud(), ScanCloud.load(written)
    assert np.array_equal(back.points, mine.points)
    for name, value in scalars(mine).items():
        assert np.array_equal(scalars(back)[name].astype(np.float32), value.astype(np.float32)), name
    assert (back.laser_names, back.rig_sha256, back.verified, back.complete) == (("deep red",), "ab" * 32, True, False)
    assert np.array_equal(back.camera_centre, mine.camera_centre)
    assert (back.stripe_width, back.stripe_corrected) == ((0.25,), (0.75,))
    assert back.sensors is not None
    assert mine.sensors is not None
    assert np.array_equal(back.sensors.centre, mine.sensors.centre.astype(np.float32))
    assert np.isnan(back.sensors.laser_origin).all()


def test_a_stripe_that_is_not_told_is_not_known(written: Path, tmp_path: Path) -> None:
    content = written.read_bytes()
    for line, told in ((b"", ()), (b"comment stripe 0 wide\n", ()), (b"comment stripe 0 nan 0\n", (np.nan,))):
        (tmp_path / "other.ply").write_bytes(content.replace(b"comment stripe 0 0.25 0.75\n", line))
        back = ScanCloud.load(tmp_path / "other.ply")
        assert np.array_equal(back.stripe_width, told, equal_nan=True)
        assert len(back) == len(cloud())


def test_plyfile_reads_every_scalar(written: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    content = plyfile.PlyData.read(str(written))
    vertex = content["vertex"]
    assert np.array_equal(np.stack([vertex["x"], vertex["y"], vertex["z"]], axis=1), cloud().points)
    for name, value in scalars(cloud()).items():
        assert np.array_equal(vertex[name], value), name
    assert len(content["sensor"]["qw"]) == 6
    assert "units mm" in content.comments


def test_trimesh_reads_every_scalar(written: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    read = trimesh.load(str(written))
    assert np.array_equal(np.asarray(read.vertices), cloud().points)
    raw = read.metadata["_ply_raw"]["vertex"]["data"]
    for name, value in scalars(cloud()).items():
        assert np.array_equal(np.ravel(raw[name]), value), name


def test_open3d_reads_every_scalar(written: Path) -> None:
    open3d = pytest.importorskip("open3d")
    legacy = open3d.io.read_point_cloud(str(written))
    assert np.array_equal(np.asarray(legacy.points), cloud().points)
    assert np.allclose(np.asarray(legacy.normals), cloud().normals, atol=1e-7)
    tensor = open3d.t.io.read_point_cloud(str(written))
    assert np.array_equal(tensor.point.positions.numpy(), cloud().points.astype(np.float32))
    for name, value in scalars(cloud()).items():
        if name not in ("nx", "ny", "nz"):
            assert np.array_equal(np.ravel(tensor.point[name].numpy()), value), name


def test_open3d_reads_pcd(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    cloud().save(tmp_path / "cloud.pcd")
    assert np.array_equal(np.asarray(open3d.io.read_point_cloud(str(tmp_path / "cloud.pcd")).points), cloud().points)


def test_xyz_and_stl(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    cloud().save(tmp_path / "cloud.xyz")
    assert np.abs(np.loadtxt(tmp_path / "cloud.xyz") - cloud().points).max() < 1e-5
    cloud().save(tmp_path / "cloud.stl")
    mesh = trimesh.load(str(tmp_path / "cloud.stl"))
    assert len(mesh.faces) == 2 * 5 * 9  # two a square of the lattice
    assert mesh.area == pytest.approx(5 * 9 * np.hypot(1.0, 0.1), rel=1e-5)


def test_a_cloud_that_is_no_surface_gives_no_stl(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match="no triangle"):
        ScanCloud.from_points(cloud().points).save(tmp_path / "cloud.stl")
    assert list(tmp_path.iterdir()) == []


def test_an_empty_cloud_is_a_cloud(tmp_path: Path) -> None:
    ScanCloud.from_points(np.zeros((0, 3))).save(tmp_path / "cloud.ply")
    assert len(ScanCloud.load(tmp_path / "cloud.ply")) == 0


def test_every_cut_of_a_file_is_refused(written: Path) -> None:
    whole = written.read_bytes()
    for share in np.linspace(0, 0.999, 40):
        written.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(FileError, match=r"cloud\.ply"):
            ScanCloud.load(written)


@pytest.mark.parametrize("order", ["ascii", "binary_big_endian"])
def test_other_encodings(tmp_path: Path, order: str) -> None:
    head = f"ply\nformat {order} 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty float z\nproperty uchar q\nend_header\n"
    rows = np.array(
        [(1.5, 2.5, 3.5, 7), (-1.0, 0.0, 1e3, 255)], dtype=[("x", ">f8"), ("y", ">f8"), ("z", ">f4"), ("q", "u1")]
    )
    body = rows.tobytes() if order != "ascii" else b"1.5 2.5 3.5 7\n-1 0 1e3 255\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    assert ScanCloud.load(tmp_path / "a.ply").points.tolist() == [[1.5, 2.5, 3.5], [-1.0, 0.0, 1000.0]]


def test_quaternions_are_rotations() -> None:
    rng = np.random.default_rng(1)
    for q in rng.normal(size=(50, 4)):
        rotation = rotation_from_quaternion(q)
        again = quaternion_from_rotation(rotation)
        assert np.abs(rotation_from_quaternion(again) - rotation).max() < 1e-12
        assert again[0] >= 0
    for axis in np.eye(3):
        half = 2 * np.outer(axis, axis) - np.eye(3)
        assert np.abs(rotation_from_quaternion(quaternion_from_rotation(half)) - half).max() < 1e-12


def test_selection_keeps_rows_together() -> None:
    some = cloud().select(np.array([5, 17]))
    assert some.points.tolist() == cloud().points[[5, 17]].tolist()
    assert some.sigma.tolist() == cloud().sigma[[5, 17]].tolist()
    with pytest.raises(ValueError, match="finite"):
        ScanCloud.from_points(np.array([[np.nan, 0, 0]]))
    with pytest.raises(ValueError, match="no frame 99"):
        replace(cloud()).cloud_from_camera(99)
