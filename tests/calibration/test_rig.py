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


@pytest.mark.long
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


def leaves(value: object, path: tuple[object, ...] = ()) -> list[tuple[object, ...]]:
    """Paths of all numbers, words and truth values."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if items is None:
        return [path]
    return [leaf for key, item in items for leaf in leaves(item, (*path, key))]


def test_any_altered_value_is_refused_by_the_name_of_its_section(session, tmp_path: Path) -> None:
    """One leaf altered by the least that a double can be: no other file would range as if nothing were."""
    whole = json.loads(session.rig.read_text(encoding="utf-8"))
    paths = [path for path in leaves(whole) if path[0] not in ("seal", "kind", "format")]
    for k in np.random.default_rng(3).permutation(len(paths))[:80]:
        path = paths[int(k)]
        copy = json.loads(json.dumps(whole))
        place = copy
        for key in path[:-1]:
            place = place[key]
        old = place[path[-1]]
        if not isinstance(old, float) or old == 0.0:
            continue
        place[path[-1]] = float(np.nextafter(old, np.inf))
        (tmp_path / "rig.json").write_text(json.dumps(copy), encoding="utf-8")
        with pytest.raises(FileError, match="altered since") as caught:
            Rig.load(tmp_path / "rig.json")
        assert ".".join(str(key) for key in path[:2] if isinstance(key, str)) in str(caught.value)
        taken = Rig.load(tmp_path / "rig.json", allow_edited=True)
        assert not taken.verification.passed
        assert "edited after calibration" in taken.verification.why


def test_a_rig_without_a_seal_loads_and_says_so(session, tmp_path: Path) -> None:
    content = json.loads(session.rig.read_text(encoding="utf-8"))
    seal = content.pop("seal")
    (tmp_path / "rig.json").write_text(json.dumps(content), encoding="utf-8")
    old = Rig.load(tmp_path / "rig.json")
    assert not old.sealed
    assert old.verification.passed == Rig.load(session.rig).verification.passed
    seal["sections"]["camera.field"] = "0" * 64
    (tmp_path / "rig.json").write_text(json.dumps({**content, "seal": seal}), encoding="utf-8")
    with pytest.raises(FileError, match="seal"):
        Rig.load(tmp_path / "rig.json")
    (tmp_path / "rig.json").write_text(json.dumps({**content, "seal": None}), encoding="utf-8")
    with pytest.raises(FileError, match="seal"):
        Rig.load(tmp_path / "rig.json")


def test_white_space_and_the_order_of_keys_are_no_alteration(session, tmp_path: Path) -> None:
    content = json.loads(session.rig.read_text(encoding="utf-8"))
    (tmp_path / "rig.json").write_text(json.dumps(content, sort_keys=True, indent=4), encoding="utf-8")
    assert Rig.load(tmp_path / "rig.json").sealed


def test_nothing_is_left_of_a_rig_that_could_not_be_written(session, tmp_path: Path) -> None:
    with pytest.raises(FileError, match="does not exist"):
        Rig.load(session.rig).save(tmp_path / "absent/rig.json")
    assert list(tmp_path.iterdir()) == []
