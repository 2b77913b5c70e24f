"""One file holds the whole rig."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import FileError
from calibration.rig import Rig


def test_a_rig_comes_back_to_the_last_bit(session, tmp_path: Path) -> None:
    rig = Rig.load(session.rig)
    rig.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == session.rig.read_bytes()
    again = Rig.load(tmp_path / "again.json")
    pixels = np.random.default_rng(0).uniform([50, 50], [590, 430], (40, 2))
    assert np.array_equal(again.camera.rays(pixels).direction, rig.camera.rays(pixels).direction)
    points = rig.camera.rays(pixels).at_depth(340.0)
    assert np.array_equal(again.camera.sigma_at(pixels, points), rig.camera.sigma_at(pixels, points))
    assert np.array_equal(again.lasers["laser"].sigma_at(points), rig.lasers["laser"].sigma_at(points))
    assert again.verification.why == rig.verification.why
    assert "NaN" not in session.rig.read_text(encoding="utf-8")


def test_every_leaf_that_goes_wrong_is_refused_or_harmless(session, tmp_path: Path) -> None:
    """No damage to any value ends in anything but a FileError or a rig."""
    whole = json.loads(session.rig.read_text(encoding="utf-8"))
    paths: list[tuple[object, ...]] = []

    def walk(value: object, path: tuple[object, ...]) -> None:
        paths.append(path)
        items = value.items() if isinstance(value, dict) else enumerate(value[:2]) if isinstance(value, list) else ()
        for key, item in items:
            walk(item, (*path, key))

    walk(whole, ())
    rng = np.random.default_rng(0)
    refused = 0
    for k in rng.permutation(len(paths))[:150]:
        path = paths[int(k)]
        for wrong in (None, "x", -1, [], {}, 1e999):
            copy = json.loads(json.dumps(whole))
            if not path:
                copy = wrong
            else:
                place = copy
                for key in path[:-1]:
                    place = place[key]
                place[path[-1]] = wrong
            (tmp_path / "rig.json").write_text(json.dumps(copy), encoding="utf-8")
            try:
                Rig.load(tmp_path / "rig.json")
            except FileError:
                refused += 1
    assert refused > 300


def test_nothing_is_left_of_a_rig_that_could_not_be_written(session, tmp_path: Path) -> None:
    with pytest.raises(FileError, match="does not exist"):
        Rig.load(session.rig).save(tmp_path / "absent/rig.json")
    assert list(tmp_path.iterdir()) == []
