"""Artefacts whose size is known by construction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import parts
from calibration.geometry import Pose
from scope.check import Artefact, check_artefact, check_repeats
from scope.cloud import Box, ScanCloud, Sensors
from scope.errors import MeasurementError


def seen(points: np.ndarray, rng: np.random.Generator, noise: float = 0.02, sigma_cal: float = 0.0) -> ScanCloud:
    """Points seen by a camera at the origin, with noise along the rays."""
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    n = len(points)
    bare = ScanCloud.from_points(points + noise * rng.normal(size=(n, 1)) * ray)
    return ScanCloud(
        points=bare.points, intensity=bare.intensity, sigma=np.full(n, noise, np.float32),
        sigma_cal=np.full(n, sigma_cal, np.float32), pixels=bare.pixels, frame=bare.frame, laser=bare.laser,
        sensors=Sensors(np.zeros(1, np.int32), np.zeros(1, np.uint8), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]),
                        np.full((1, 3), np.nan)),
        camera_centre=np.zeros(3),
    )  # fmt: skip


def cap(radius: float, centre: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Points on the half of a sphere that faces the origin."""
    out = rng.normal(size=(3 * n, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    points = centre + radius * out
    facing = (out * -points).sum(axis=1) / np.linalg.norm(points, axis=1) > 0.3
    return points[facing][:n]


def table(z: float, n: int, rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.uniform(-60, 60, (n, 2)), np.full(n, z)])


@pytest.mark.parametrize("true_diameter", [40.0, 40.3])
def test_sphere_on_a_table(true_diameter: float) -> None:
    """The error of size is the true one, to within the claimed uncertainty; the form is the width of the noise."""
    rng = np.random.default_rng(0)
    points = np.concatenate([cap(true_diameter / 2, np.array([10.0, -5, 400]), 4000, rng), table(421.0, 6000, rng)])
    check = check_artefact(seen(points, rng), "sphere:d=40", tolerance=0.1)
    (size,) = check.sizes
    assert size.measured - true_diameter == pytest.approx(0.0, abs=3 * size.scatter)
    assert size.scatter < 0.005
    assert size.uncertainty == pytest.approx(2 * np.hypot(size.scatter, size.slope))
    assert check.error_mm == size.error
    assert check.within == (true_diameter == 40.0)
    assert check.form_mm == pytest.approx(2 * 1.96 * 0.02 * 0.7, rel=0.3)
    assert check.linearity_percent < 0.05


def test_size_error_scatters_as_claimed() -> None:
    """Noise redrawn 40 times: scatter of the diameter over its standard error, within what 40 repeats allow."""
    errors, claims = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        (size,) = check_artefact(seen(cap(20.0, np.array([0.0, 0, 400]), 1500, rng), rng), "sphere:d=40").sizes
        errors.append(size.error)
        claims.append(size.scatter)
    assert 0.65 < np.std(errors) / np.mean(claims) < 1.4
    assert abs(np.mean(errors)) < 4 * np.mean(claims) / np.sqrt(40)


def test_displacement_on_slopes_is_within_what_is_claimed_for_it() -> None:
    """Points pushed out by one sigma at grazing sight, nothing where the surface faces the camera: the claim is that size."""
    rng = np.random.default_rng(11)
    centre = np.array([0.0, 0, 400])
    points = cap(20.0, centre, 4000, rng)
    out = (points - centre) / 20.0
    facing = -(out * points).sum(axis=1) / np.linalg.norm(points, axis=1)
    (size,) = check_artefact(seen(points + 0.02 * (1 - facing)[:, None] * out, rng), "sphere:d=40").sizes
    assert size.error > 5 * size.scatter  # it shows
    assert size.error == pytest.approx(size.slope, abs=3 * size.scatter)  # and is what was foretold


def test_errors_of_a_patch_do_not_average_out() -> None:
    """Errors shared by all points of a cell of 2 mm: the claimed scatter is that which they make, many points or not."""
    errors, claims = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        points = cap(20.0, np.array([0.0, 0, 400]), 3000, rng)
        cell = np.floor(points / 2.0).astype(int) @ [1, 50, 2500]
        shared = 0.02 * rng.normal(size=len(points))[np.unique(cell, return_inverse=True)[1]]
        ray = points / np.linalg.norm(points, axis=1, keepdims=True)
        (size,) = check_artefact(seen(points + shared[:, None] * ray, rng, noise=0.005), "sphere:d=40").sizes
        errors.append(size.error)
        claims.append(size.scatter)
    assert 0.6 < np.std(errors) / np.mean(claims) < 1.5


def test_cylinder() -> None:
    rng = np.random.default_rng(1)
    angle, along = rng.uniform(0, 2 * np.pi, 12_000), rng.uniform(-30, 30, 12_000)
    out = np.column_stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)])
    turn = Pose.from_rotation_vector([0.3, 0.1, 0.4], [0.0, 0.0, 400.0])
    points = turn.apply(10.05 * out + along[:, None] * [0, 1, 0])
    facing = ((out @ turn.rotation.T) * -points).sum(axis=1) / np.linalg.norm(points, axis=1) > 0.3
    check = check_artefact(seen(points[facing], rng), "cylinder:d=20")
    assert check.sizes[0].error == pytest.approx(0.1, abs=0.004)


def test_plane_and_its_bow() -> None:
    rng = np.random.default_rng(2)
    flat = table(400.0, 20_000, rng)
    tilted = Pose.from_rotation_vector([0.2, -0.1, 0], [0.0, 0, 400]).apply(flat - np.array([0, 0, 400.0]))
    check = check_artefact(seen(tilted, rng, noise=0.01), "plane")
    assert abs(check.error_mm) < 0.005
    assert check.rms_mm == pytest.approx(0.01, rel=0.15)
    flat[:, 2] += 0.2 * (flat[:, 0] / 60) ** 2  # 0.2 mm high at the rims
    bowed = check_artefact(seen(flat, rng, noise=0.01), "plane")
    assert abs(bowed.error_mm) > 0.05


def steps(rng: np.random.Generator, heights: tuple[float, ...], scale: float = 1.0) -> np.ndarray:
    """Blocks of 12 x 12 mm in a row on a base at z = 430, their true heights stretched by ``scale``."""
    points = table(430.0, 12_000, rng)
    for k, height in enumerate(heights):
        centre = -45 + 25.0 * k
        on = (np.abs(points[:, 0] - centre) < 6) & (np.abs(points[:, 1]) < 6)
        points = points[~on]
        top = np.column_stack(
            [rng.uniform(centre - 6, centre + 6, 900), rng.uniform(-6, 6, 900), np.full(900, 430 - scale * height)]
        )
        points = np.concatenate([points, top])
    return points


def test_steps_and_linearity() -> None:
    """A scale error of 1 % shows in the heights but not in the linearity; one step that is off shows in both."""
    rng = np.random.default_rng(3)
    check = check_artefact(seen(steps(rng, (5, 10, 20), 1.01), rng), "steps:5,10,20")
    assert [s.error for s in check.sizes] == pytest.approx([0.05, 0.1, 0.2], abs=0.004)
    assert check.error_mm == pytest.approx(0.2, abs=0.004)
    assert check.linearity_percent < 0.03
    bent = steps(rng, (5, 10, 20))
    bent[bent[:, 2] == 420, 2] -= 0.1  # the middle step is 10.1 high
    check = check_artefact(seen(bent, rng), "steps:5,10,20")
    levels = np.array([0, 5, 10, 20.0])
    expected = np.abs(np.array([0, 5, 10.1, 20]) - np.polyval(np.polyfit(levels, [0, 5, 10.1, 20], 1), levels)).max()
    assert check.linearity_percent == pytest.approx(100 * expected / check.span_mm, rel=0.1)


def test_mesh_finds_its_pose_and_its_deviation(tmp_path: Path) -> None:
    made = parts.casting()
    made.mesh().export(tmp_path / "casting.stl")
    rng = np.random.default_rng(4)
    cloud = parts.scan(made, parts.random_pose(made, rng), rng, scanner=parts.Scanner(points=6000, noise=0.03))
    check = check_artefact(cloud, f"mesh:{tmp_path / 'casting.stl'}", tolerance=0.05)
    assert check.within
    assert check.rms_mm == pytest.approx(0.03 * 0.7, rel=0.4)


def test_repeats_give_the_scatter() -> None:
    rng = np.random.default_rng(5)
    clouds = [seen(cap(20.0, np.array([0.0, 0, 400]), 1500, rng), rng) for _ in range(6)]
    repeat = check_repeats(clouds, "sphere:d=40")
    assert repeat.deviation_mm[0] == pytest.approx(np.std([c.sizes[0].measured for c in repeat.checks], ddof=1))
    assert repeat.worst_mm < 0.01
    with pytest.raises(ValueError, match="two"):
        check_repeats(clouds[:1], "sphere:d=40")


@pytest.mark.parametrize(
    "text", ["ball:d=4", "sphere", "sphere:d=-1", "sphere:d=x", "steps:", "steps:1,1", "steps:0,2", "plane:1", "mesh:"]
)
def test_unknown_artefacts_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not known"):
        Artefact.parse(text)


@pytest.mark.parametrize("artefact", ["sphere:d=20", "sphere:d=30", "sphere:d=40"])
def test_what_is_no_sphere_is_none(artefact: str) -> None:
    """Somewhere on a bracket some points always lie within 6 % of a sphere's radius: filling that band, they are none."""
    made = parts.bracket()
    pose = parts.random_pose(made, np.random.default_rng(5))
    cloud = parts.scan(made, pose, np.random.default_rng(5), scanner=parts.Scanner(points=8000, noise=0.03))
    with pytest.raises(MeasurementError):
        check_artefact(cloud, artefact)


def test_artefact_that_is_not_there() -> None:
    rng = np.random.default_rng(6)
    flat = seen(table(420.0, 3000, rng), rng)
    with pytest.raises(MeasurementError):
        check_artefact(flat, "sphere:d=40")
    with pytest.raises(MeasurementError, match="step"):
        check_artefact(flat, "steps:5,10")
    with pytest.raises(MeasurementError, match="region"):
        check_artefact(flat, "plane", region=Box(x=(500, 600)))


class TestCommands:
    @pytest.fixture
    def app(self):  # type: ignore[no-untyped-def]
        from cli.main import app

        return app

    def test_check_tells_json_and_exits_3_out_of_tolerance(self, app, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
        import json

        rng = np.random.default_rng(7)
        seen(cap(20.0, np.array([0.0, 0, 400]), 3000, rng), rng).save(tmp_path / "c.ply")
        command = ["check", str(tmp_path / "c.ply"), "--json", "--artefact"]
        good = CliRunner().invoke(app, [*command, "sphere:d=40", "--tolerance", "0.05"])
        assert good.exit_code == 0
        assert json.loads(good.stdout)["within"] is True
        bad = CliRunner().invoke(app, [*command, "sphere:d=40.5", "--tolerance", "0.05"])
        assert bad.exit_code == 3
        assert json.loads(bad.stdout)["error_mm"] == pytest.approx(-0.5, abs=0.01)
        assert CliRunner().invoke(app, [*command, "cube:40"]).exit_code == 2
        several = CliRunner().invoke(app, ["check", *[str(tmp_path / "c.ply")] * 2, "--json", "-a", "sphere:d=40"])
        assert json.loads(several.stdout)["repeatability_mm"] == 0.0

    def test_check_has_a_page_that_says_what_it_says(self, app, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
        rng = np.random.default_rng(7)
        seen(cap(20.0, np.array([0.0, 0, 400]), 3000, rng), rng).save(tmp_path / "c.ply")
        page = tmp_path / "check.html"
        words = ["check", str(tmp_path / "c.ply"), "--report", str(page), "--tolerance", "0.05", "-a"]
        good = CliRunner().invoke(app, [*words, "sphere:d=40"])
        assert good.exit_code == 0
        html = page.read_text(encoding="utf-8")
        assert 'class="verdict good"' in html
        assert '<td class="text">diameter</td><td>40</td>' in html
        bad = CliRunner().invoke(app, [*words, "sphere:d=40.5"])
        assert bad.exit_code == 3
        assert 'class="verdict bad"' in page.read_text(encoding="utf-8")
        two = CliRunner().invoke(app, ["check", str(tmp_path / "c.ply"), *words[1:], "sphere:d=40"])
        assert two.exit_code == 0
        assert "Repeatability over 2 scans" in page.read_text(encoding="utf-8")
        nowhere = CliRunner().invoke(app, [*words[:3], str(tmp_path / "no" / "p.html"), "-a", "sphere:d=40"])
        assert nowhere.exit_code == 1

    def test_pose_writes_what_it_is_asked_for(self, app, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
        import json

        monkeypatch.setenv("SCOPE_CACHE", str(tmp_path / "cache"))
        made = parts.casting()
        made.mesh().export(tmp_path / "casting.stl")
        rng = np.random.default_rng(8)
        truth = parts.random_pose(made, rng)
        parts.scan(made, truth, rng, scanner=parts.Scanner(points=6000)).save(tmp_path / "c.ply")
        (tmp_path / "robot.json").write_text(json.dumps({"robot_from_camera": np.eye(4).tolist(), "units": "mm"}))
        asked = ["pose", str(tmp_path / "c.ply"), "--model", str(tmp_path / "casting.stl"), "--json", "--at", "first"]
        asked += ["--robot-from-camera", str(tmp_path / "robot.json"), "--report", str(tmp_path / "r.html")]
        done = CliRunner().invoke(
            app, [*asked, "--deviation", str(tmp_path / "d.ply"), "--region", "box:-200,200,-200,200"]
        )
        assert done.exit_code == 0, done.output
        told = json.loads(done.stdout)
        assert np.array(told["cloud_from_model"])[:3, 3] == pytest.approx(truth.translation, abs=0.1)
        assert told["robot_from_model"] == told["camera_from_model"]
        assert told["at"] == 0
        assert (tmp_path / "r.html").read_text().startswith("<!doctype html>")
        assert len(ScanCloud.load(tmp_path / "d.ply")) == told["points"]
        parts.bracket().mesh().export(tmp_path / "bracket.stl")
        wrong = CliRunner().invoke(
            app, ["pose", str(tmp_path / "c.ply"), "-m", str(tmp_path / "bracket.stl"), "--json"]
        )
        assert wrong.exit_code == 3
        told = json.loads(wrong.stdout)
        assert told["cloud_from_model"] is None
        assert told["camera_from_model"] is None
        assert told["why"]
