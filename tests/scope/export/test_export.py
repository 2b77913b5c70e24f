"""Exports in the readers of others: every scalar that a program takes comes back as the number that was written."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.exports import EXPORTS, NORMALS, PLACES, READERS, SCALARS, cloud, columns, equal, installed, write
from cli.main import app
from scope.cloud import ScanCloud
from scope.export import PROGRAMS, export_for, require_program

ALL = {*PLACES, *NORMALS, *SCALARS}
TAKEN = {  # by program, ending and reader: what it takes, where that is not all
    ("", ".xyz", "numpy"): {*PLACES},
    ("", ".xyz", "SCOPE"): {*PLACES},
    ("meshlab", ".ply", "pymeshlab"): {*PLACES, *NORMALS, "sigma", "u", "v"},
}
CASES = [(program, ending, name) for program, ending in EXPORTS for name in READERS if ending in READERS[name][1]]


@pytest.mark.parametrize(("program", "ending", "reader"), CASES)
def test_every_scalar_that_can_be_carried_is(tmp_path: Path, program: str, ending: str, reader: str) -> None:
    if not installed(reader):
        pytest.skip(f"{reader} is not installed")
    for needed in {".las": ("laspy",), ".laz": ("laspy", "lazrs"), ".e57": ("pye57",), ".mcap": ("mcap_ros2",)}.get(
        ending, ()
    ):
        pytest.importorskip(needed)
    made = cloud()
    write(made, tmp_path / f"c{ending}", program)
    same = equal(made, READERS[reader][2](tmp_path / f"c{ending}"))
    usual = {".e57": {*PLACES, "intensity"}}.get(ending, ALL)
    if (ending, reader) == (".e57", "pye57"):
        usual = {*usual, "frame"}  # as row
    if ending == ".ply" and reader in {"pymeshlab", "pyvista"}:
        usual = {*PLACES, *NORMALS}
    assert same == TAKEN.get((program, ending, reader), usual)


def test_meshlab_shows_intensity_as_a_grey(tmp_path: Path) -> None:
    pytest.importorskip("pymeshlab")
    made = cloud()
    for factor in (1.0, 16.0):  # 8 bits as they are, 12 bits scaled so that the brightest is white
        bright = replace(made, intensity=(made.intensity * factor).astype(np.float32))
        export_for(bright, tmp_path / "c.ply", "meshlab")
        grey = READERS["pymeshlab"][2](tmp_path / "c.ply")["grey"]
        expected = bright.intensity * (1.0 if factor == 1.0 else 255.0 / bright.intensity.max())
        assert np.abs(grey - expected).max() <= 1.0


def test_e57_tells_frame_and_line_as_row_and_column(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    made = cloud()
    made.save(tmp_path / "c.e57")
    read = READERS["pye57"][2](tmp_path / "c.e57")
    assert np.array_equal(read["frame"], made.frame)
    assert np.array_equal(read["line"], made.pixels[:, 0])


def test_pyvista_holds_the_places_of_the_sensor(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    made = cloud()
    export_for(made, tmp_path / "c.vtp", "pyvista")
    read = pyvista.read(tmp_path / "c.vtp")
    assert read.n_verts == len(made)  # a point that is no cell is not drawn
    assert read.active_scalars_name == "sigma"
    assert made.sensors is not None
    for name in ("frame", "laser", "centre", "rotation", "laser_origin"):
        assert np.array_equal(read.field_data[f"sensor_{name}"], getattr(made.sensors, name)), name
    assert "verified yes" in list(read.field_data["comments"])


def test_ros2_moves_the_camera_as_the_cloud_tells(tmp_path: Path) -> None:
    """In metres; quaternions x y z w of scipy are the oracle."""
    reader = pytest.importorskip("mcap_ros2.reader")
    from scipy.spatial.transform import Rotation

    made = cloud()
    assert made.sensors is not None
    export_for(made, tmp_path / "c.mcap", "ros2")
    messages = list(reader.read_ros2_messages(str(tmp_path / "c.mcap"), topics=["/tf"]))
    assert len(messages) == 6
    for k, message in enumerate(messages):
        assert message.log_time_ns == 1_000_000_000 + k * 100_000_000
        camera, *lasers = message.ros_msg.transforms
        stamp = camera.header.stamp
        assert stamp.sec * 1_000_000_000 + stamp.nanosec == message.log_time_ns
        assert (camera.header.frame_id, camera.child_frame_id) == ("scope_cloud", "scope_camera")
        pose, turn, place = made.cloud_from_camera(300 + k), camera.transform.rotation, camera.transform.translation
        assert Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix() == pytest.approx(
            pose.rotation, abs=1e-9
        )
        assert [place.x, place.y, place.z] == pytest.approx(1e-3 * pose.translation, abs=1e-12)
        assert [laser.child_frame_id for laser in lasers] == ["scope_laser_0", "scope_laser_1"]
        origin = lasers[1].transform.translation
        assert [origin.x, origin.y, origin.z] == pytest.approx(1e-3 * made.sensors.laser_origin[2 * k + 1])


def test_mcap_tells_the_verification(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    pytest.importorskip("mcap_ros2")
    export_for(cloud(), tmp_path / "c.mcap", "ros2")
    with (tmp_path / "c.mcap").open("rb") as stream:
        (told,) = [record.metadata for record in reader.make_reader(stream).iter_metadata() if record.name == "scope"]
    assert (told["verified"], told["rig_sha256"], told["lengths"]) == ("yes", "ef" * 32, "m")


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_bare_cloud_and_an_empty_one_are_written_without_inventions(tmp_path: Path, program: str) -> None:
    ending = PROGRAMS[program].endings[0]
    if ending == ".mcap":
        pytest.importorskip("mcap_ros2")
    bare = ScanCloud.from_points(cloud().points)
    for made, name in ((bare, "bare"), (bare.select(np.zeros(0, dtype=np.int64)), "empty")):
        lost = export_for(made, tmp_path / f"{name}{ending}", program)
        assert " takes no " not in lost
    for name, (_, endings, read) in READERS.items():
        if ending in endings and installed(name):
            found = read(tmp_path / f"bare{ending}")
            assert np.abs(np.stack([found[axis] for axis in PLACES], axis=1) - bare.points).max() < 1e-4
            known = {key for key, value in found.items() if value is not None and np.isfinite(value).all()}
            assert not known & {"intensity", "sigma", "scalar_sigma", "quality", "u"}, name


def test_what_is_lost_is_told_in_one_line(tmp_path: Path) -> None:
    made = cloud()
    assert export_for(made, tmp_path / "c.ply", "open3d") == "c.ply: Open3D takes no places of the sensor, verification"
    assert export_for(made, tmp_path / "c.vtp", "pyvista") == ""
    told = export_for(made, tmp_path / "c.ply", "meshlab")
    assert "quality" in told
    assert len(told) < 300
    far = replace(made, frame=(made.frame + (1 << 24)).astype(np.int32), sensors=None)
    assert "rounded" in export_for(far, tmp_path / "c.ply", "cloudcompare")


@pytest.mark.parametrize(("program", "name"), [("cloud", "c.ply"), ("pcl", "c.las"), ("ros2", "c.bag")])
def test_a_wrong_program_or_ending_is_a_matter_of_usage(tmp_path: Path, program: str, name: str) -> None:
    with pytest.raises(ValueError, match="cloudcompare" if program == "cloud" else "written as"):
        require_program(tmp_path / name, program)
    done = CliRunner().invoke(app, ["export", str(tmp_path / "none.ply"), str(tmp_path / name), "--for", program])
    assert done.exit_code == 2


def test_the_command_writes_and_tells(tmp_path: Path) -> None:
    cloud().save(tmp_path / "c.ply")
    done = CliRunner().invoke(app, ["export", str(tmp_path / "c.ply"), str(tmp_path / "d.vtp"), "--json", "-q"])
    assert done.exit_code == 0, done.output
    assert '"for": "pyvista"' in done.stdout
    assert (tmp_path / "d.vtp").stat().st_size > 1000


def test_text_comes_back_with_its_columns(tmp_path: Path) -> None:
    made = cloud()
    export_for(made, tmp_path / "c.xyz", "cloudcompare")
    back = ScanCloud.load(tmp_path / "c.xyz")
    for name in SCALARS:
        assert columns(back)[name] == pytest.approx(columns(made)[name], rel=1e-6), name


def test_cloudcompare_itself_reads_every_scalar(tmp_path: Path) -> None:
    """Where the program is installed: it writes text with a title again, which numpy reads."""
    if shutil.which("CloudCompare") is None:
        pytest.skip("CloudCompare is not installed")
    made = cloud()
    export_for(made, tmp_path / "c.ply", "cloudcompare")
    words = [
        "CloudCompare",
        "-SILENT",
        "-AUTO_SAVE",
        "OFF",
        "-O",
        "c.ply",
        "-C_EXPORT_FMT",
        "ASC",
        "-PREC",
        "9",
        "-ADD_HEADER",
    ]
    subprocess.run(
        [*words, "-NO_TIMESTAMP", "-SAVE_CLOUDS"],
        cwd=tmp_path,
        check=True,
        timeout=60,
        env={"QT_QPA_PLATFORM": "offscreen"},
    )
    (written,) = [path for path in tmp_path.iterdir() if path.suffix != ".ply"]
    assert set(SCALARS) <= equal(made, READERS["numpy"][2](written))
