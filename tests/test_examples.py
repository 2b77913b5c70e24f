"""The programs of examples/ run as they are, and stay short; results show themselves in one line and in a notebook."""

from __future__ import annotations

import html.parser
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import scope
from benchmarks import parts

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
PROGRAMS = sorted(EXAMPLES.glob("*.py"))


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs an example in an empty folder and gives what it printed."""

    def run(name: str, *words: object) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_there_are_five_and_each_is_short() -> None:
    assert len(PROGRAMS) == 5
    assert {path.name: n for path in PROGRAMS if not 10 <= (n := len(path.read_text().splitlines())) <= 25} == {}


def test_calibration_in_memory_is_that_of_the_files(run, session, tmp_path: Path) -> None:
    assert "Calibration passed" in run("calibrate_in_memory.py", session.folder)
    here, there = scope.Rig.load(tmp_path / "rig.json"), scope.Rig.load(session.rig)
    assert np.allclose(here.lasers["laser"].plane.normal, there.lasers["laser"].plane.normal, atol=1e-12)


def test_a_profile(run, session) -> None:
    told = run("live_profile.py", session.rig, session.folder / "frames" / "05.png")
    assert "lines have a point" in told
    assert "nearest point" in told


def test_frames_to_a_cloud_and_its_roughness(run, session, tmp_path: Path) -> None:
    run("scan_frames.py", session.rig, session.folder)
    dark = scope.scan(session.capture, session.rig)
    assert np.array_equal(scope.ScanCloud.load(tmp_path / "cloud.ply").points, dark.points.astype(np.float32))
    assert "Sq" in run("roughness_of_a_patch.py", "cloud.ply", 0, 110, -40, 40)
    with pytest.raises(SystemExit, match="region"):
        run("roughness_of_a_patch.py", "cloud.ply", 0, 1, 0, 1)


def test_pose_for_a_robot(run, tmp_path: Path) -> None:
    import trimesh

    part = parts.bracket()
    trimesh.Trimesh(part.vertices, part.faces, process=False).export(tmp_path / "part.stl")
    rng = np.random.default_rng(7003)
    pose = parts.random_pose(part, rng)
    cloud = parts.scan(part, pose, rng, scanner=parts.Scanner(points=6000))
    cloud.save(tmp_path / "cloud.ply")
    rows = [
        [float(x) for x in row.strip("[ ]").split()]
        for row in run("pose_for_a_robot.py", "cloud.ply", "part.stl").splitlines()[:4]
    ]
    assert np.allclose(np.array(rows)[:3, 3] - [400.0, 0.0, 250.0], pose.translation, atol=0.1)


class _Balanced(html.parser.HTMLParser):
    """Counts what was opened and not closed, and what could run."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def shown(session) -> list[object]:
    cloud = scope.scan(session.capture, session.rig)
    rig = scope.Rig.load(session.rig)
    roughness = scope.measure_roughness(cloud, region=scope.Box(x=(0, 110)))
    sphere = scope.check_artefact(
        cloud.select(scope.Box(x=(-50, -20), z=(0, 360)).contains(cloud.points)), "sphere:d=40"
    )
    return [cloud, rig, roughness, roughness.heights, sphere, scope.Scanner(rig), scope.calibrate(session.calibration)]


def test_results_print_short_and_draw_themselves(session) -> None:
    for result in shown(session):
        assert type(result).__name__ in repr(result)
        assert len(repr(result)) < 500
        assert "\n" not in repr(result)
        page = _Balanced()
        page.feed(result._repr_html_())
        assert page.open == []
        assert set(page.seen) <= {"div", "strong", "table", "tr", "th", "td", "figure", "img", "figcaption"}
        assert ("img" in page.seen) == (type(result).__name__ != "ArtefactCheck")
        assert len(result._repr_html_()) < 300_000


def test_names_from_files_never_become_markup() -> None:
    from calibration.notebook import Summary, as_html

    page = as_html(
        Summary("<script>a</script>", (("<b>", "'\"><img src=x onerror=y>"),)), np.zeros((2, 2, 3), np.uint8), "'><i>"
    )
    assert "<script" not in page
    assert "<b>" not in page
    assert "onerror=y>" not in page.replace("onerror=y&gt;", "")
    assert "<i>" not in page


def test_an_empty_cloud_shows_itself() -> None:
    empty = scope.ScanCloud.from_points(np.zeros((0, 3)))
    assert repr(empty) == "<ScanCloud: no points>"
    assert "<img" not in empty._repr_html_()


@pytest.mark.parametrize("pitch", [0.0, -1.0, np.nan, (1.0, 2.0, 3.0), (1.0, 0.0)])
def test_a_target_without_a_pitch_is_refused(pitch: object) -> None:
    with pytest.raises(ValueError, match="positive number in mm"):
        scope.SpotGrid(5, 5, pitch)  # type: ignore[arg-type]
    assert scope.SpotGrid(5, 5, 2.0) == scope.SpotGrid(5, 5, (2.0, 2.0))  # type: ignore[arg-type]
