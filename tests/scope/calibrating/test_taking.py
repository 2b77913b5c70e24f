"""Images taken by the camera of a calibration.toml: the peer is the same session rendered to files."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.small_session import DESIGN
from calibration.errors import FileError
from cli.main import app
from scope.calibrating import image_places, take_missing
from scope.simulation import planned_session

SMALL = DESIGN.replace("[300.0, 330.0, 360.0, 390.0]", "[300.0, 330.0]")


def test_a_virtual_camera_needs_nobody_at_the_jig(tmp_path: Path) -> None:
    (tmp_path / "design.toml").write_text(SMALL, encoding="utf-8")
    text, _ = planned_session(tmp_path / "design.toml")
    file = tmp_path / "calibration.toml"
    file.write_text(f'{text}\n[camera]\ndriver = "simulated"\nid = "design.toml"\n', encoding="utf-8")
    told: list[str] = []
    assert take_missing(file, lambda what: pytest.fail(what), told.append)
    assert [line.split(": ")[1] for line in told] == ["good, 165 of 165 marks"] * 2
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.png")}
    assert len(before) == 2 * (3 + 3)
    assert take_missing(file, lambda what: pytest.fail(what), lambda text: None)  # nothing is missing now
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.png")} == before


def test_a_camera_that_cannot_move_the_jig_asks_for_each_shot(session, tmp_path: Path) -> None:
    """A recording stands for the camera: w300's target, then whatever comes."""
    text = (session.folder / "calibration.toml").read_text(encoding="utf-8")
    file = tmp_path / "calibration.toml"
    file.write_text(f'{text}\n[camera]\ndriver = "replay"\nid = "{session.folder}/w300"\n', encoding="utf-8")
    asked: list[str] = []
    told: list[str] = []

    def ask(what: str) -> bool:
        asked.append(what)
        return len(asked) < 3

    assert not take_missing(file, ask, told.append)  # ended by q at the third
    assert "the target, laser off" in asked[0]
    assert "laser on" in asked[1]
    assert told[0].endswith("good, 165 of 165 marks")
    with_pipe = CliRunner().invoke(app, ["calibrate", str(file)], input="")
    assert with_pipe.exit_code == 1
    assert "no image yet, and nobody answers" in with_pipe.output


@pytest.mark.parametrize("pattern", ["/tmp/x/*.png", "../x/*.png", "a/*/b.png", "a/?.png"])  # noqa: S108
def test_images_are_named_within_the_folder_or_not_at_all(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(FileError):
        image_places(tmp_path, [pattern])
