"""`scope hand-eye` on rendered views: the answer, the file, and every refusal in one line."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.errors import FileError
from calibration.geometry import Pose
from cli.main import app
from scope.session import HandEye
from tests.scope.hand_eye.arm import Arm, arm, marks, write_log, write_session, write_toml


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    rng = np.random.default_rng(3)
    made = arm(rng, 9)
    write_session(folder, made, rng)
    return folder, made


@pytest.fixture
def own(session, tmp_path):
    """A copy of it that may be spoiled."""
    shutil.copytree(session[0], tmp_path / "own")
    return tmp_path / "own", session[1]


def run(folder, *more):
    return CliRunner().invoke(
        app,
        [
            "hand-eye",
            str(folder / "hand-eye.toml"),
            "--rig",
            str(folder / "rig.json"),
            "-o",
            str(folder / "he.json"),
            *more,
        ],
    )


def middle(matrix):
    """Of the board, whichever end its corners were counted from."""
    return np.array(matrix)[:3] @ [*marks().mean(axis=0), 1.0]


def told(done):
    return json.loads(done.stdout)


def test_answer_file_and_page(own):
    folder, made = own
    done = run(folder, "--json", "-q", "--report", str(folder / "he.html"))
    assert done.exit_code == 0, done.output
    result = told(done)
    assert result["passed"]
    assert not result["dropped"]
    found, sigma = np.array(result["flange_from_camera"]), np.sqrt(np.diag(result["covariance"]))
    assert (np.abs(found[:3, 3] - made.sensor.translation) < 4 * sigma[:3]).all()
    assert sigma[:3].max() < 0.1  # mm
    assert result["loo_mm"] < 0.3
    back = HandEye.load(folder / "he.json")
    assert np.allclose(back.sensor.matrix, found)
    assert np.abs(middle(result["base_from_target"]) - made.target.apply(marks().mean(axis=0))).max() < 0.2
    page = (folder / "he.html").read_text(encoding="utf-8")
    assert "Each view left out in turn" in page
    assert "im04" in page
    text = (folder / "he.json").read_text(encoding="utf-8")
    (folder / "he.json").write_text(text.replace('"mount": "hand"', '"mount": "fixed"'), encoding="utf-8")
    with pytest.raises(FileError, match="altered.*mount"):
        HandEye.load(folder / "he.json")


def test_a_wrong_pose_and_a_view_without_a_board_are_left_out_by_name(own):
    folder, made = own
    said = list(made.said)
    said[4] = Pose(said[4].rotation, said[4].translation + np.array([3.0, -4.0, 0.0]))
    write_log(folder / "poses.csv", said)
    image = cv2.imread(str(folder / "views" / "im07.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(folder / "views" / "im07.png"), np.full_like(image, 90))
    result = told(run(folder, "--json", "-q"))
    assert result["passed"]
    assert sorted(d["name"] for d in result["dropped"]) == ["im04", "im07"]
    assert "5 mm" in next(d["reason"] for d in result["dropped"] if d["name"] == "im04")


@pytest.mark.parametrize(
    ("log", "toml", "named"),
    [
        ({"mm": 1.0}, {}, 'units = "mm"'),
        ({"inverse": True}, {}, 'gives = "flange_from_base"'),
        ({"notation": "quaternion-wxyz", "header": "quaternion-xyzw"}, {}, 'notation = "quaternion-wxyz"'),
    ],
)
def test_a_wrong_convention_is_named_and_nothing_written(own, log, toml, named):
    folder, made = own
    write_log(folder / "poses.csv", made.said, **log)
    write_toml(folder, **toml)
    done = run(folder, "--json")
    assert done.exit_code == 3
    result = json.loads(done.stdout)
    assert named in result["why"]
    assert result["flange_from_camera"] is None
    assert not (folder / "he.json").exists()
    assert len(result["why"]) <= 300


def test_poses_about_one_axis_are_refused(tmp_path):
    rng = np.random.default_rng(5)
    write_session(tmp_path, arm(rng, 4, axes=(0.0, 0.0, 0.5)), rng)
    done = run(tmp_path, "--json")
    assert done.exit_code == 3
    assert "about one axis only" in json.loads(done.stdout)["why"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('units = "m"\n', ""), "robot.units: missing"),
        (('gives = "base_from_flange"\n', ""), "robot.gives: missing"),
        (('mount = "hand"\n', ""), "mount: missing"),
        (('"quaternion-xyzw"', '"quaternion-wxyz"'), "those of notation 'quaternion-xyzw'"),
        (('"quaternion-xyzw"', '"ur"'), "those of notation 'quaternion-xyzw'"),
        (('"quaternion-xyzw"', '"euler"'), "robot.notation: found 'euler'"),
        (("views/*.png", "none/*.png"), "no file matches"),
        (("[robot]\n", "[robot]\nrepeatability_mm = 0.1\n"), "belong together"),
    ],
)
def test_a_file_that_does_not_say_it_all_is_refused(own, change, said):
    folder, _ = own
    path = folder / "hand-eye.toml"
    path.write_text(path.read_text(encoding="utf-8").replace(*change), encoding="utf-8")
    done = run(folder)
    assert done.exit_code == 1
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("im03.png", "im02.png", "has 2 rows"),
        ("im03.png", "", "im03"),
        ("im03.png,", "im03.png,nan,", "row 5 has 9 values"),
    ],
)
def test_a_log_that_is_wrong_is_refused_or_told(own, old, new, said):
    folder, _ = own
    path = folder / "poses.csv"
    path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    done = run(folder)
    assert said in done.output


def test_a_camera_beside_the_arm(tmp_path):
    rng = np.random.default_rng(9)
    made: Arm = arm(rng, 8, mount="fixed")
    write_session(tmp_path, made, rng)
    write_toml(
        tmp_path, mount="fixed", more="repeatability_mm = 0.03\nrepeatability_deg = 0.01\n[accept]\nloo_mm = 0.5\n"
    )
    done = run(tmp_path, "--json", "-q")
    assert done.exit_code == 0, done.output
    result = told(done)
    assert np.abs(np.array(result["base_from_camera"])[:3, 3] - made.sensor.translation).max() < 0.2
    assert np.abs(middle(result["flange_from_target"]) - made.target.apply(marks().mean(axis=0))).max() < 0.2
    assert result["repeatability"] == "stated"
