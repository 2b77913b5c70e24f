"""A design is rendered where its session can be labelled, and refused for the reason that a calibration would give."""

from __future__ import annotations

from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from calibration.errors import CalibrationError, FileError
from calibration.targets import SpotGrid
from scope import simulation
from scope.calibrating import check_plane
from scope.simulation.hardware_design import JigDesign, unlike_itself

DESIGN = """
format = 1
[camera]
size = [640, 480]
focal_px = 700.0
centre_px = [322.0, 236.0]
distortion = [-0.12, 0.03, 0.0004, -0.0003, 0.0]
[laser]
origin = [0.0, -150.0, 8.0]
through = [0.0, 0.0, 340.0]
[jig]
stand_offs = [{near}, 390.0]
rows = 11
columns = 15
pitch = 16.0
diameter = 5.0
fiducials = {fiducials}
fiducial_diameter = {large}
images = 1
laser_images = 1
"""


def simulated(folder: Path, fiducials: str, large: float = 7.5, near: float = 300.0) -> Path:
    (folder / "design.toml").write_text(DESIGN.format(fiducials=fiducials, large=large, near=near), encoding="utf-8")
    simulation.simulate(simulation.read_design(folder / "design.toml"), folder / "out", 1, threads=1)
    return folder / "out/calibration.toml"


@pytest.mark.parametrize(
    ("fiducials", "large"), [("[[5, 7], [5, 9], [2, 7]]", 5.6), ("[[0, 0], [0, 2], [3, 0], [9, 4]]", 7.5)]
)
def test_what_is_rendered_can_be_labelled(fiducials: str, large: float, tmp_path: Path) -> None:
    file = simulated(tmp_path, fiducials, large, near=340.0)
    for name in ("w340", "w390"):
        told = check_plane(file, name)
        assert told["remedy"] == ""
        assert told["used"] == 165


@pytest.mark.parametrize(
    ("fiducials", "large", "near", "why"),
    [
        ("[[5, 5], [5, 9]]", 7.5, 300.0, "look the same after a turn or a reflection"),
        ("[[5, 5], [5, 7], [3, 5]]", 7.5, 300.0, "look the same after a turn or a reflection"),
        ("[[5, 7], [5, 9], [2, 7]]", 5.4, 300.0, "must exceed diameter 5 by more than 10 %"),
        ("[[0, 0], [0, 2], [3, 0]]", 7.5, 200.0, "plane w200 shows 0 of its 3 jig.fiducials wholly"),
    ],
)
def test_what_could_not_be_told_is_refused(fiducials: str, large: float, near: float, why: str, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=why):
        simulated(tmp_path, fiducials, large, near)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("stand_offs = [300.0, 390.0]", "stand_offs = [300.0]", "has one plane"),
        ("pitch = 16.0\ndiameter = 5.0\nfiducials = [[5, 7], [5, 9], [2, 7]]\nfiducial_diameter = 7.5", "pitch = 26.0\ndiameter = 5.0", "plane w300 shows [0-9]+ of 165 spots and there are no"),
        ("diameter = 5.0\n", "diameter = 1.0\n", "spots are 1.8 px wide on plane w390"),
        ("[jig]", "[jig]\nbright = 20.0\ndark = 90.0", "would not be found"),
        ("[jig]", "[jig]\nbright = 900.0\ndark = 400.0", "light spots of 255 grey levels on 255"),
        ("[laser]", "[laser]\npeak = 2.0", "more laser power"),
        ("through = [0.0, 0.0, 340.0]", "through = [0.0, 900.0, 340.0]", "shows on 0 of 2 planes.*aim the laser"),
        ("centre_px", "blur_px = 6.0\ncentre_px", "are blurred by 6.0 px"),
    ],
)  # fmt: skip
def test_what_could_not_be_calibrated_is_refused_before_it_is_rendered(old, new, why, tmp_path):
    text = DESIGN.format(fiducials="[[5, 7], [5, 9], [2, 7]]", large=7.5, near=300.0)
    assert old in text
    (tmp_path / "design.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(FileError, match=why) as refused:
        simulation.simulate(tmp_path / "design.toml", tmp_path / "out", 1)
    assert len(str(refused.value)) < 300
    assert not (tmp_path / "out").exists()


def test_patterns_are_refused_where_a_calibration_refuses_them() -> None:
    rng = np.random.default_rng(3)
    cells = list(product(range(4), range(4)))
    patterns = [*combinations(cells, 2), *[p for p in combinations(cells, 3) if rng.random() < 0.3]]
    for pattern in patterns:
        try:
            SpotGrid(6, 7, (10.0, 10.0), 4.0, fiducials=pattern, fiducial_diameter=6.0).check_fiducials()
            accepted = True
        except CalibrationError:
            accepted = False
        assert unlike_itself(pattern) is accepted, pattern
    with pytest.raises(ValidationError, match="look the same"):
        JigDesign((300.0,), 6, 7, 10.0, 4.0, fiducials=((0, 0), (0, 1), (1, 0)), fiducial_diameter=6.0)
