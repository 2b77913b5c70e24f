"""A part with known sizes, scanned by rays that know nothing of SCOPE: values within their uncertainty, decisions by the rule."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from calibration.errors import FileError
from calibration.geometry import Pose
from cli.main import app
from scope.check import decide, overall
from scope.inspection import inspect_part, read_features
from scope.model import load_model
from tests.scope.merge.test_merge import scan

FEATURES = """
format = 1
[[feature]]
name = "top"
kind = "plane"
point = [-20.0, -12.0, 10.0]
tolerance = 0.1
[[feature]]
name = "pad"
kind = "plane"
point = [18.0, 8.0, 16.0]
[[feature]]
name = "side"
kind = "plane"
point = [30.0, 0.0, 0.0]
[[feature]]
name = "step"
kind = "step"
of = ["top", "pad"]
tolerance = 0.05
[[feature]]
name = "square"
kind = "angle"
of = ["top", "side"]
tolerance = 0.5
[[feature]]
name = "bore"
kind = "hole"
point = [-12.0, 4.0, 10.0]
axis = [0.0, 0.0, 1.0]
diameter = 14.0
tolerance = 0.1
position_tolerance = 0.4
"""


def plate(*, diameter=14.0, pad=6.0, at=(-12.0, 4.0)) -> trimesh.Trimesh:
    """A block of 60 x 40 x 20, its middle the origin, with a through hole, and ``pad`` mm higher where x is above 8."""
    low, high, centre = np.array([-30.0, -20.0]), np.array([8.0, 20.0]), np.array(at)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]) - centre
    around = np.concatenate([np.linspace(-np.pi, np.pi, 96, endpoint=False), np.arctan2(corners[:, 1], corners[:, 0])])
    angles = np.unique(np.round(around, 12))
    ray = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reach = np.where(ray > 0, high - centre, low - centre) / np.where(np.abs(ray) < 1e-9, 1e-9, ray)
    away = np.abs(reach).min(axis=1)
    inner, outer, n = centre + diameter / 2 * ray, centre + away[:, None] * ray, len(angles)
    vertices = np.concatenate(
        [np.column_stack([ring, np.full(n, z)]) for z in (10.0, -10.0) for ring in (inner, outer)]
    )
    k, following = np.arange(n), (np.arange(n) + 1) % n
    open_side = (outer[k, 0] > 8 - 1e-6) & (outer[following, 0] > 8 - 1e-6)
    faces = []
    for a, b, rows in (
        (0, n, k),
        (3 * n, 2 * n, k),
        (2 * n, 0, k),
        (n, 3 * n, k[~open_side]),
    ):  # top, bottom, hole, outside
        faces += [np.stack([a + rows, b + rows, b + following[rows]], axis=1)]
        faces += [np.stack([a + rows, b + following[rows], a + following[rows]], axis=1)]
    top, seam = 10.0 + pad, np.sort(outer[outer[:, 0] > 8 - 1e-6, 1])
    up, down = [(8.0, y, 10.0) for y in seam], [(8.0, y, -10.0) for y in seam[::-1]]
    polygons = [  # anticlockwise from outside, each a fan about its first corner
        [(8, -20, top), (30, -20, top), (30, 20, top), (8, 20, top)],
        [(30, -20, -10), *down[::-1], (30, 20, -10)],
        [(30, -20, -10), (30, 20, -10), (30, 20, top), (30, -20, top)],
        [(8, 20, top), *up[::-1], (8, -20, top)],
        [(30, -20, -10), (30, -20, top), (8, -20, top), (8, -20, 10), (8, -20, -10)],
        [(30, 20, -10), (8, 20, -10), (8, 20, 10), (8, 20, top), (30, 20, top)],
    ]
    for polygon in polygons:
        count = len(vertices)
        vertices = np.concatenate([vertices, np.array(polygon, dtype=float)])
        k = np.arange(1, len(polygon) - 1)
        faces.append(np.stack([np.full(len(k), count), count + k, count + k + 1], axis=1))
    mesh = trimesh.Trimesh(vertices, np.concatenate(faces), process=True)
    mesh.merge_vertices(digits_vertex=6)
    mesh.fix_normals()
    return mesh


def seen(part, rng):
    """A slanted view that shows the top, the pad, one side and half of the hole's wall, and the part somewhere."""
    somewhere = Pose(Rotation.from_euler("xyz", [0.3, -0.2, 2.0]).as_matrix(), np.array([40.0, -25.0, 310.0]))
    views = [scan(part, view, rng, cells=190, half=40.0) for view in ((0.75, 0.1, 1.0), (-0.45, 0.3, 1.0))]
    from scope.merge import merge

    whole = merge(views, ["a", "b"], poses=[Pose.identity()] * 2).cloud
    return moved_all(whole, somewhere), somewhere


def moved_all(cloud, pose):
    sensors = replace(cloud.sensors, centre=pose.apply(cloud.sensors.centre), rotation=np.repeat(
        Rotation.from_matrix(pose.rotation).as_quat(scalar_first=True)[None], len(cloud.sensors), axis=0))  # fmt: skip
    return replace(cloud, points=pose.apply(cloud.points), sensors=sensors)


@pytest.fixture(scope="module")
def inspected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inspect")
    (folder / "features.toml").write_text(FEATURES, encoding="utf-8")
    plate().export(folder / "part.stl")
    rng = np.random.default_rng(2)
    cloud, pose = seen(plate(), rng)
    cloud.save(folder / "good.ply")
    other, _ = seen(plate(diameter=14.6, pad=6.3), rng)
    other.save(folder / "bad.ply")
    return folder, cloud, pose, other


def test_a_part_as_it_should_be(inspected):
    folder, cloud, pose, _ = inspected
    found = inspect_part(cloud, folder / "part.stl", features=read_features(folder / "features.toml"))
    assert np.abs(found.pose.cloud_from_model.matrix - pose.matrix).max() < 0.05
    value = {v.name: v for v in found.features}
    truth = {"step": 6.0, "square": 90.0, "bore": 14.0, "bore position": 0.0}
    for name, true in truth.items():
        assert not value[name].reason, value[name].reason
        assert abs(value[name].measured - true) <= value[name].uncertainty, name
    assert value["step"].nominal == pytest.approx(6.0, abs=1e-3)
    assert value["square"].nominal == pytest.approx(90.0, abs=1e-3)
    assert value["step"].uncertainty < 0.05  # mm: points of 0.02 mm, a calibration of 0.01 mm
    assert value["bore"].uncertainty < 0.1
    assert value["top"].measured < 0.06
    assert found.decision == "pass", found.why


def test_a_part_that_is_wrong_fails_by_name(inspected):
    folder, _, _, other = inspected
    found = inspect_part(other, folder / "part.stl", features=read_features(folder / "features.toml"))
    value = {v.name: v for v in found.features}
    assert abs(value["bore"].measured - 14.6) <= value["bore"].uncertainty
    assert abs(value["step"].measured - 6.3) <= value["step"].uncertainty
    assert {n for n, v in value.items() if v.decision == "fail"} >= {"bore", "step"}
    assert found.decision == "fail"


def test_the_command(inspected, tmp_path):
    folder, *_ = inspected
    run = CliRunner().invoke
    part = ["--model", str(folder / "part.stl")]
    wanted = ["--features", str(folder / "features.toml")]
    done = run(app, ["inspect", str(folder / "good.ply"), *part, *wanted, "--json", "-q", "--report", str(tmp_path / "r.html"), "--deviation", str(tmp_path / "d.ply")])  # fmt: skip
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert {"pose", "features", "deviation_mm", "decision"} <= set(told)
    assert told["decision"] == "pass"
    assert "ISO 14253-1" in (tmp_path / "r.html").read_text(encoding="utf-8")
    done = run(app, ["inspect", str(folder / "bad.ply"), *part, "--tolerance", "0.1", "--json", "-q"])
    assert done.exit_code == 3
    assert json.loads(done.stdout)["decision"] in {"fail", "undecided"}
    assert run(app, ["inspect", str(folder / "good.ply"), *part, "--tolerance", "-1"]).exit_code == 2


def test_the_rule():
    assert decide(0.05, 0.1, 0.04) == "pass"
    assert decide(-0.05, 0.1, 0.06) == "undecided"
    assert decide(0.15, 0.1, 0.06) == "undecided"
    assert decide(-0.2, 0.1, 0.06) == "fail"
    assert decide(float("nan"), 0.1, 0.01) == "undecided"
    assert decide(0.2, None, 0.01) is None
    assert overall(["pass", "undecided", "fail"]) == "fail"
    assert overall(["pass", "undecided"]) == "undecided"
    assert overall([]) == "undecided"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[[feature]]\nname = "a"\nkind = "plane"\n', "point is missing"),
        (
            '[[feature]]\nname = "a"\nkind = "hole"\npoint = [0.0, 0.0, 0.0]\naxis = [0.0, 0.0, 0.0]\ndiameter = 2.0\n',
            "axis is",
        ),
        ('[[feature]]\nname = "a"\nkind = "step"\nof = ["b", "c"]\n', "names 'b'"),
        ('[[feature]]\nname = "a"\nkind = "round"\n', "kind"),
        ("", "feature"),
    ],
)
def test_a_file_that_asks_for_nothing_is_refused(tmp_path, text, said):
    (tmp_path / "f.toml").write_text(f"format = 1\n{text}", encoding="utf-8")
    with pytest.raises(FileError, match=said):
        read_features(tmp_path / "f.toml")


def test_a_face_that_was_not_seen_is_undecided(inspected, tmp_path):
    folder, cloud, *_ = inspected
    text = 'format = 1\n[[feature]]\nname = "bottom"\nkind = "plane"\npoint = [0.0, -15.0, -10.0]\ntolerance = 0.1\n'
    (tmp_path / "f.toml").write_text(text, encoding="utf-8")
    found = inspect_part(cloud, load_model(folder / "part.stl"), features=read_features(tmp_path / "f.toml"))
    assert found.features[0].reason
    assert found.decision == "undecided"
