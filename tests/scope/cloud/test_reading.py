"""Clouds of any maker: what a format can carry comes back, what it cannot is told, what no scan has is refused."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import FileError
from scope.cloud import ScanCloud, Sensors, not_carried, refuse_sheet, unknown
from scope.errors import MeasurementError

KEPT = {  # by format: absolute error of a coordinate mm, and the columns that come back
    "ply": (0.0, ("intensity", "sigma", "sigma_cal", "pixels", "frame", "laser", "normals")),
    "pcd": (0.0, ("intensity", "sigma", "sigma_cal", "pixels", "frame", "laser", "normals")),
    "las": (5.1e-5, ("intensity", "sigma", "sigma_cal", "pixels", "frame", "laser", "normals")),
    "e57": (2e-5, ("intensity",)),  # its writer keeps single precision, in metres
    "xyz": (5.1e-6, ()),
}


def scan(frames: int = 8, lines: int = 12, step: float = 0.5) -> ScanCloud:
    """A wavy surface under a sheet of light that moves by ``step`` a frame."""
    rng = np.random.default_rng(5)
    frame, line = (part.ravel() for part in np.mgrid[0:frames, 0:lines])
    n = len(frame)
    points = np.stack([step * frame, 0.7 * line, 300.0 + np.sin(line) + step * 0.2 * frame], axis=1)
    normals = rng.normal(size=(n, 3))
    shift = np.stack([step * np.arange(frames), np.zeros(frames), np.zeros(frames)], axis=1)
    return ScanCloud(
        points=points.astype(np.float32).astype(np.float64),
        intensity=rng.uniform(1, 255, n).astype(np.float32),
        sigma=rng.uniform(0.001, 0.1, n).astype(np.float32),
        sigma_cal=rng.uniform(0.001, 0.1, n).astype(np.float32),
        pixels=np.stack([40.0 + line, rng.uniform(0, 480, n)], axis=1).astype(np.float32),
        frame=frame.astype(np.int32),
        laser=np.zeros(n, np.uint8),
        sensors=Sensors(np.arange(frames, dtype=np.int32), np.zeros(frames, np.uint8), shift, np.tile([1.0, 0, 0, 0], (frames, 1)), shift + 9),
        normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32).astype(np.float64),
        laser_names=("red",),
        rig_sha256="cd" * 32,
        verified=True,
        camera_centre=np.zeros(3),
    )  # fmt: skip


@pytest.mark.parametrize("ending", list(KEPT))
def test_a_round_trip_keeps_all_that_the_format_carries_and_tells_the_rest(tmp_path: Path, ending: str) -> None:
    pytest.importorskip({"las": "laspy", "e57": "pye57"}.get(ending, "numpy"))
    mine, (error, kept) = scan(), KEPT[ending]
    mine.save(tmp_path / f"c.{ending}")
    back = ScanCloud.load(tmp_path / f"c.{ending}")
    assert np.abs(back.points - mine.points).max() <= error
    for name in ("intensity", "sigma", "sigma_cal", "pixels", "frame", "laser", "normals"):
        value = getattr(back, name)
        if name in kept:
            assert np.array_equal(value, getattr(mine, name).astype(np.float32)), name
        elif name not in ("frame", "laser"):
            assert value is None or np.isnan(value).all(), name
    lost, told = not_carried(mine, tmp_path / f"c.{ending}"), unknown(back, "c")
    assert (lost == "") == (ending == "ply")
    assert (told == "") == (ending == "ply")
    for column, word in (("sigma", "sigma"), ("pixels", "pixels and frames"), ("intensity", "intensity")):
        assert (column in kept) == (word not in lost), lost
        assert (column in kept) == (word not in told), told
    assert (back.rig_sha256, back.verified) == ((mine.rig_sha256, True) if "sigma" in kept else ("", False))


def test_laz_needs_its_own_library(tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    scan().save(tmp_path / "c.laz")
    assert np.abs(ScanCloud.load(tmp_path / "c.laz").points - scan().points).max() < 1e-4


def lzf(data: bytes) -> bytes:
    """A simple compressor: runs of one byte as references to the byte before, the rest as literals."""
    out, at = bytearray(), 0
    while at < len(data):
        run = 1
        while at + run < len(data) and data[at + run] == data[at] and run < 260:
            run += 1
        if run >= 4:
            length = run - 1 - 2  # the first byte is literal
            out += bytes([0, data[at]])
            out += bytes([(min(length, 7) << 5), *([length - 7] if length >= 7 else []), 0])
            at += run
        else:
            out += bytes([0, data[at]])
            at += 1
    return bytes(out)


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_pcd_of_any_maker(tmp_path: Path, kind: str) -> None:
    rows = np.zeros(50, dtype=[("x", "<f8"), ("pad", "<u1", (3,)), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
    rng = np.random.default_rng(2)
    for name in "xyz":
        rows[name] = rng.normal(size=50).astype(np.float32)
    rows["z"][7] = np.nan  # a gap of an organised cloud
    header = (
        "# .PCD v.7\nVERSION .7\nFIELDS x _ y z intensity\nSIZE 8 1 4 4 4\nTYPE F U F F F\nCOUNT 1 3 1 1 1\nWIDTH 10\nHEIGHT 5\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 50\nDATA {kind}\n"
    )
    if kind == "ascii":
        body = "\n".join(
            " ".join(str(v) for v in (r["x"], 0, 0, 0, r["y"], r["z"], r["intensity"])) for r in rows
        ).encode()
    elif kind == "binary":
        body = rows.tobytes()
    else:
        plain = b"".join(rows[name].tobytes() for name in rows.dtype.names or ())
        packed = lzf(plain)
        assert len(packed) < 2 * len(plain)
        body = struct.pack("<II", len(packed), len(plain)) + packed
    (tmp_path / "a.pcd").write_bytes(header.encode() + body)
    found = ScanCloud.load(tmp_path / "a.pcd")
    good = np.isfinite(rows["z"])
    assert np.allclose(found.points, np.stack([rows[n][good] for n in "xyz"], axis=1), atol=1e-6)
    assert "1 of 50 rows had no coordinates" in unknown(found, "a.pcd")
    for cut in (0.3, 0.6, 0.9):
        (tmp_path / "b.pcd").write_bytes((header.encode() + body)[: int(cut * (len(header) + len(body)))])
        with pytest.raises(FileError, match=r"b\.pcd"):
            ScanCloud.load(tmp_path / "b.pcd")


def test_open3d_compresses_and_scope_reads(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scan().points))
    assert open3d.io.write_point_cloud(str(tmp_path / "o.pcd"), cloud, compressed=True)
    assert np.allclose(ScanCloud.load(tmp_path / "o.pcd").points, scan().points, atol=1e-4)


@pytest.mark.parametrize("text", ["x,y,z,r\n1,2,3,255\n4;5;6;0\n", "2\n1 2 3\n4 5 6\n", "# a\n// b\n1\t2\t3\n\n4 5 6"])
def test_text_of_any_maker(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.txt").write_text(text, encoding="utf-8")
    assert ScanCloud.load(tmp_path / "a.txt").points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_cloudcompare_keeps_the_columns_behind_its_prefix(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\ncomment Created by CloudCompare\nelement vertex 2\n"
    names = ["x", "y", "z", *(f"scalar_{n}" for n in ("intensity", "sigma", "sigma_cal", "u", "v", "frame", "laser"))]
    head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    (tmp_path / "a.ply").write_text(
        head + "1 2 3 9 0.01 0.02 5 7.5 3 0\n4 5 6 9 0.01 0.02 6 7.5 3 0\n", encoding="utf-8"
    )
    found = ScanCloud.load(tmp_path / "a.ply")
    assert found.sigma.tolist() == pytest.approx([0.01, 0.01])
    assert found.frame.tolist() == [3, 3]


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [("sigma", -1.0, "negative"), ("sigma_cal", np.inf, "infinite"), ("frame", 2**31 - 1, "frame"), ("frame", -5, "frame"),
     ("u", 1e30, "pixel"), ("laser", 3, "laser"), ("x", 3e30, "1000 km"), ("intensity", np.inf, "intensity")],
)  # fmt: skip
def test_what_no_scan_has_is_refused_before_anything_is_made_of_it(
    tmp_path: Path, column: str, value: float, said: str
) -> None:
    scan().save(tmp_path / "c.ply")
    whole = (tmp_path / "c.ply").read_bytes()
    start = whole.index(b"end_header\n") + 11
    dtype = np.dtype([(n, "<f4") for n in ("x", "y", "z", "intensity", "sigma", "sigma_cal", "u", "v")] + [("frame", "<i4"), ("laser", "u1")] + [(n, "<f4") for n in ("nx", "ny", "nz")])  # fmt: skip
    rows = np.frombuffer(whole, dtype=dtype, count=96, offset=start).copy()
    rows[column][17] = value
    (tmp_path / "c.ply").write_bytes(whole[:start] + rows.tobytes() + whole[start + rows.nbytes :])
    with pytest.raises(FileError, match=said) as caught:
        ScanCloud.load(tmp_path / "c.ply")
    assert "number 17" in str(caught.value) or column == "frame"


@pytest.mark.parametrize(("step", "along", "refused"), [(0.0, 0, True), (0.5, 0, False), (0.5, 1, True)])
def test_a_cloud_in_one_sheet_of_light_is_refused(step: float, along: int, refused: bool) -> None:
    """Sheet x = 0: still, moved across itself, and moved along itself only."""
    cloud = scan(step=0.0)
    assert cloud.sensors is not None
    local = cloud.points + np.array([0.0, 0.0, 2.0]) * np.sin(cloud.frame)[:, None]  # x = 0
    pixels = 900.0 * np.stack([local[:, 1], local[:, 0] + 100.0], axis=1) / local[:, 2:]  # of a camera at (-100, 0, 0)
    shift = np.zeros((8, 3))
    shift[:, along] = step * np.arange(8)
    centre = shift + np.array([-100.0, 0.0, 0.0])
    points = local + shift[cloud.frame]
    moved = replace(
        cloud, points=points, pixels=pixels.astype(np.float32), sensors=replace(cloud.sensors, centre=centre)
    )
    if not refused:
        refuse_sheet(moved)
        return
    with pytest.raises(MeasurementError, match="sheet of light"):
        refuse_sheet(moved)


def test_a_plane_that_is_scanned_is_no_sheet_of_light() -> None:
    cloud = scan()
    flat = cloud.points.copy()
    flat[:, 2] = 300.0 + 0.3 * flat[:, 0]
    refuse_sheet(replace(cloud, points=flat))
    refuse_sheet(replace(cloud, points=flat, sensors=None))
