"""Acceptance tests on artefacts whose errors are known by construction."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.errors import FileError
from calibration.geometry import Pose
from cli.main import app
from scope.acceptance import accept, acceptance_page, read_acceptance, spread
from scope.acceptance.form import representative
from scope.cloud import ScanCloud, Sensors
from scope.errors import MeasurementError

NOISE = 0.01
PLACES = [(0, 0), (30, 20), (-30, 20), (30, -20), (-30, -20), (0, 25), (0, -25), (35, 0), (-35, 0), (10, 10)]


def seen(points: np.ndarray, rng: np.random.Generator, scale: float = 1.0) -> ScanCloud:
    """Points seen by a camera at the origin of a scanner that sees all ``scale`` times as large, with noise along the rays."""
    points = points * scale
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    n = len(points)
    bare = ScanCloud.from_points(points + NOISE * rng.normal(size=(n, 1)) * ray)
    return ScanCloud(
        points=bare.points, intensity=bare.intensity, sigma=np.full(n, NOISE, np.float32), sigma_cal=np.zeros(n, np.float32),
        pixels=bare.pixels, frame=bare.frame, laser=bare.laser, camera_centre=np.zeros(3), verified=True,
        sensors=Sensors(np.zeros(1, np.int32), np.zeros(1, np.uint8), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), np.nan)),
    )  # fmt: skip


def cap(radius: float, centre: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    out = rng.normal(size=(6 * n, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    points = centre + radius * out
    facing = (out * -points).sum(axis=1) / np.linalg.norm(points, axis=1) > 0.35
    return points[facing][:n]


def bar(length: float, place: tuple[float, float], turn: list[float], rng: np.random.Generator) -> np.ndarray:
    ends = Pose.from_rotation_vector(turn, [*place, 400.0]).apply(np.array([[-length / 2, 0, 0], [length / 2, 0, 0]]))
    return np.concatenate([cap(10.0, end, 1200, rng) for end in ends])


def plate(bow: float, place: tuple[float, float], turn: list[float], rng: np.random.Generator) -> np.ndarray:
    flat = rng.uniform(-1, 1, (3000, 2)) * [50, 25]
    bent = np.column_stack([flat, bow * (flat[:, 0] / 50) ** 2])
    return Pose.from_rotation_vector(turn, [*place, 400.0]).apply(bent)


FILE = """
format = 1
standard = "{standard}"
scanner = "the simulated one"
volume = [120.0, 90.0, 80.0]
[limits]
probing_form = 0.09
probing_size = 0.05
spacing = 0.05
flatness = 0.09
[sphere]
scans = "sphere*.ply"
diameter = 20.0
uncertainty = 0.0005
[ball_bar]
scans = "bar*.ply"
distance = 80.0
diameters = [20.0, 20.0]
uncertainty = 0.001
[plane]
scans = "plane*.ply"
form = 0.001
"""


def session(folder: Path, *, scale: float = 1.0, seed: int = 0, standard: str = "vdi-2634-2", bow: float = 0.0, bars: int = 7) -> Path:  # fmt: skip
    rng = np.random.default_rng(seed)
    for k, place in enumerate(PLACES):
        seen(cap(10.0, np.array([*place, 380.0 + 4 * k]), 1500, rng), rng, scale).save(folder / f"sphere{k}.ply")
    turns = [[0, 0, 0], [0, 0, 1.5], [0, 0, 0.7], [0, 0.4, 0], [0, -0.4, 0.2], [0, 0.3, 1.2], [0, -0.3, -0.6]]
    for k, turn in enumerate(turns[:bars]):
        seen(bar(80.0, PLACES[k % 3], turn, rng), rng, scale).save(folder / f"bar{k}.ply")
    for k in range(6):
        seen(plate(bow, PLACES[k], [0.2 * (k % 3), 0.1 * k - 0.2, 0], rng), rng, scale).save(folder / f"plane{k}.ply")
    (folder / "acceptance.toml").write_text(FILE.format(standard=standard))
    return folder / "acceptance.toml"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return session(tmp_path_factory.mktemp("good"))


def test_spread_is_the_narrowest_interval() -> None:
    values = np.concatenate([np.linspace(-1, 1, 1000), [5.0, 7.0, -9.0]])
    assert spread(values, 0.0) == pytest.approx(16.0)
    assert spread(values, 0.003) == pytest.approx(2.0)  # three of 1003
    assert spread(np.linspace(0, 1, 1001), 0.05) == pytest.approx(0.95, abs=0.002)


def test_representative_points_are_means_of_their_places() -> None:
    rng = np.random.default_rng(1)
    direction = cap(1.0, np.array([0.0, 0, 400]), 5000, rng) - [0, 0, 400]
    tilt = direction @ [0.3, 0, 0]
    few = representative(direction, tilt, np.array([0.0, 0, -1]))
    assert len(few) == 25
    assert np.ptp(few) == pytest.approx(0.3 * 2 * 0.94, rel=0.08)  # to 95 % of the cap's edge, either side
    assert (
        np.ptp(representative(direction, rng.normal(size=5000), np.array([0.0, 0, -1]))) < 1.2
    )  # of seven single points


def test_a_good_scanner_passes(good: Path) -> None:
    found = accept(read_acceptance(good))
    tests = {t.symbol: t for t in found.tests}
    assert set(tests) == {"PF", "PS", "SD", "F"}
    assert found.decision == "pass", found.why
    assert [t.positions for t in found.tests] == [10, 10, 7, 6]
    assert tests["PF"].worst.value == pytest.approx(6.0 * NOISE, rel=0.25)  # 99.7 % of a normal, seven tenths across
    assert all(r.claimed is not None and abs(r.value) < 1.5 * r.claimed for t in found.tests for r in t.readings)
    page = acceptance_page(found)
    assert "VDI/VDE 2634 part 2" in page
    assert "10 of 10" in page


@pytest.mark.parametrize("scale", [1.002, 1.0006])
def test_errors_of_scale_are_those_of_size_and_spacing(tmp_path: Path, scale: float) -> None:
    """A scanner that sees all larger: PS and SD grow with the size, and only what is beyond its limit by more than U fails."""
    found = accept(read_acceptance(session(tmp_path, scale=scale)))
    tests = {t.symbol: t for t in found.tests}
    assert np.mean([r.value for r in tests["SD"].readings]) == pytest.approx(80.0 * (scale - 1), abs=0.003)
    assert np.mean([r.value for r in tests["PS"].readings]) == pytest.approx(20.0 * (scale - 1), abs=0.003)
    assert tests["PS"].decision == "pass"
    assert tests["SD"].decision == found.decision == ("fail" if scale > 1.001 else "undecided" if abs(tests["SD"].worst.value) > 0.049 else "pass")  # fmt: skip


def test_iso_takes_95_percent_and_tells_what_it_does_not_know(tmp_path: Path) -> None:
    found = accept(read_acceptance(session(tmp_path, standard="iso-10360-13", bow=0.06)))
    tests = {t.symbol: t for t in found.tests}
    assert tests["P_Form.Sph.D95%"].worst.value == pytest.approx(2 * 1.96 * 0.72 * NOISE, rel=0.25)
    assert tests["P_Form.Sph.D95%"].worst.representative < tests["P_Form.Sph.D95%"].worst.value
    assert tests["D_Form.Pla.D95%"].worst.value > 0.055  # the bow
    assert max(r.claimed for r in tests["D_Form.Pla.D95%"].readings) < 0.06  # noise alone would be less
    assert any("how many positions" in text for text in found.remarks)


def test_missing_and_repeated_positions_leave_it_undecided(tmp_path: Path) -> None:
    file = session(tmp_path, bars=5)
    (tmp_path / "bar5.ply").write_bytes((tmp_path / "bar0.ply").read_bytes())
    found = accept(read_acceptance(file))
    (sd,) = (t for t in found.tests if t.symbol == "SD")
    assert (sd.positions, sd.needed, sd.decision, found.decision) == (5, 7, "undecided", "undecided")
    assert "5 of 7 positions" in found.why


def test_uncertainty_is_that_of_the_artefact(tmp_path: Path) -> None:
    text = FILE.format(standard="vdi-2634-2").replace("uncertainty = 0.001", "uncertainty = 0.008\nexpansion = 11.5").replace("[limits]", "temperature = 23.0\ntemperature_uncertainty = 2.0\n[limits]")  # fmt: skip
    (tmp_path / "bar0.ply").write_bytes(b"x")
    for name in ("sphere0", "plane0"):
        (tmp_path / f"{name}.ply").write_bytes(b"x")
    (tmp_path / "a.toml").write_text(text)
    known = {a.kind: a for a in read_acceptance(tmp_path / "a.toml").artefacts}
    assert known["ball_bar"].size == pytest.approx(80.0 * (1 + 11.5e-6 * 3))
    assert 2 * known["ball_bar"].size_sigma == pytest.approx(np.hypot(0.008, 80 * 11.5e-6 * 2.0))
    assert 2 * known["plane"].form_sigma == pytest.approx(0.001)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("distance = 80.0", "distance = 15.0"), "touch"),
        (("uncertainty = 0.0005\n", ""), "uncertainty"),
        (('standard = "vdi-2634-2"', 'standard = "iso"'), "standard"),
        (('scans = "bar*.ply"', 'scans = "none*.ply"'), "no file matches"),
        (("flatness = 0.09", "flatness = 0.0"), "flatness"),
    ],
)
def test_wrong_files_are_refused_in_a_line(good: Path, change: tuple[str, str], told: str) -> None:
    file = good.with_name("wrong.toml")
    file.write_text(good.read_text().replace(*change))
    with pytest.raises(FileError, match=told) as caught:
        read_acceptance(file)
    assert "\n" not in str(caught.value)


def test_another_artefact_is_refused(good: Path) -> None:
    file = good.with_name("other.toml")
    file.write_text(good.read_text().replace('scans = "bar*.ply"', 'scans = "sphere*.ply"'))
    with pytest.raises(MeasurementError, match="second sphere"):
        accept(read_acceptance(file))


def test_command(good: Path, tmp_path: Path) -> None:
    page = tmp_path / "protocol.html"
    answer = CliRunner().invoke(app, ["check", "--acceptance", str(good), "--report", str(page), "--json", "--quiet", "--no-history"])  # fmt: skip
    assert answer.exit_code == 0, answer.output
    told = json.loads(answer.stdout)
    assert told["passed"]
    assert told["decision"] == "pass"
    assert [t["symbol"] for t in told["tests"]] == ["PF", "PS", "SD", "F"]
    assert page.read_text().startswith("<!doctype html>")
    strict = good.with_name("strict.toml")
    strict.write_text(good.read_text().replace("probing_form = 0.09", "probing_form = 0.02"))
    answer = CliRunner().invoke(app, ["check", "--acceptance", str(strict), "--no-history"])
    assert answer.exit_code == 3
    assert "FAIL after VDI/VDE 2634 part 2" in answer.stdout
    assert CliRunner().invoke(app, ["check", "--acceptance", str(good), "-a", "plane"]).exit_code == 2
    assert CliRunner().invoke(app, ["check"]).exit_code == 2
    made = tmp_path / "acceptance.toml"
    assert CliRunner().invoke(app, ["check", "--acceptance", str(made), "--init"]).exit_code == 0
    assert "[ball_bar]" in made.read_text()
