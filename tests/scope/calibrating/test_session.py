"""A calibration from arrays is the calibration of the files."""

from __future__ import annotations

import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

import scope


def images(folder: Path, pattern: str) -> list[np.ndarray]:
    return [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted(folder.glob(pattern))]


@pytest.fixture(scope="module")
def in_memory(session) -> scope.CalibrationSession:
    told = tomllib.loads(session.calibration.read_text(encoding="utf-8"))
    target = told["target"]
    pitch = target["pitch"] if isinstance(target["pitch"], list) else [target["pitch"]] * 2
    grid = scope.SpotGrid(
        target["rows"], target["columns"], tuple(pitch), target["diameter"], fiducials=tuple(map(tuple, target["fiducials"])),
        fiducial_diameter=target["fiducial_diameter"],
    )  # fmt: skip
    planes = []
    for plane in told["plane"]:
        laser = plane["laser"]
        laser = laser if isinstance(laser, str) else next(iter(laser.values()))
        background = plane.get("background", [])
        if not isinstance(background, str):
            background = next(iter(background.values())) if background else ""
        patterns = plane["images"] if isinstance(plane["images"], list) else [plane["images"]]
        planes.append(
            scope.PlaneView(
                images=[image for pattern in patterns for image in images(session.folder, pattern)],
                origin=plane["origin"],
                rotation=plane.get("rotation", (0.0, 0.0, 0.0)),
                laser=images(session.folder, laser),
                background=images(session.folder, background) if background else [],
                turned=plane.get("turned"),
            )
        )
    return scope.CalibrationSession(target=grid, planes=planes)


def test_the_rays_and_the_sheet_are_those_of_the_files(session, in_memory) -> None:
    result = scope.calibrate(in_memory)
    rig = scope.Rig.load(session.rig)
    assert result.passed
    assert result.why
    assert result.faults == []
    assert len(result.planes) == len(in_memory.planes)
    pixels = np.random.default_rng(3).uniform((60, 60), (580, 420), (200, 2))
    here, there = result.rig.camera.rays(pixels), rig.camera.rays(pixels)
    assert np.allclose(here.origin, there.origin, atol=1e-9)
    assert np.allclose(here.direction, there.direction, atol=1e-12)
    sheets = [next(iter(r.lasers.values())) for r in (result.rig, rig)]
    assert np.allclose(
        sheets[0].sheet.intersect(here).points, sheets[1].sheet.intersect(there).points, atol=1e-9, equal_nan=True
    )


def test_a_rig_from_arrays_scans_and_is_kept_and_verified(in_memory, session, tmp_path: Path) -> None:
    rig = scope.calibrate(in_memory).rig
    rig.save(tmp_path / "rig.json")
    told = scope.verify(rig, in_memory)
    assert told["passed"], told["why"]
    assert scope.verify(tmp_path / "rig.json")["passed"]
    assert len(scope.scan(session.capture, rig)) > 1000


@pytest.mark.parametrize(
    ("planes", "told"),
    [
        ([], "planes is empty"),
        ([scope.PlaneView(images=[])], "images is empty"),
        ([scope.PlaneView(images=[np.zeros((4, 4))])], r"plane 1, image 1 must be .* \(4, 4\) of float64"),
        ([scope.PlaneView(images=[np.zeros((4, 4), np.uint8)], origin=(0, 0))], r"origin must be three .* mm"),
        ([scope.PlaneView(images=[np.zeros((4, 4), np.uint8)], rotation=(0, 0, 1))], "no origin"),
        ([scope.PlaneView(images=[np.zeros((4, 4), np.uint8)], name="a")] * 2, "two planes are called 'a'"),
    ],
)
def test_what_is_no_session_is_refused(planes, told: str) -> None:
    grid = scope.SpotGrid(3, 4, (10.0, 10.0), 4.0)
    with pytest.raises(ValueError, match=told):
        scope.calibrate(scope.CalibrationSession(grid, planes))
