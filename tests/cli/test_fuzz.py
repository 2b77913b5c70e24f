"""Damaged files through the commands; the large run is python -m benchmarks.fuzz."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from benchmarks import fuzz


@pytest.mark.parametrize("only", ["rig", "capture", "cloud: ", "export", "heights"])
def test_damage_ends_in_one_line_or_changes_nothing(session, tmp_path: Path, only: str) -> None:  # type: ignore[no-untyped-def]
    shutil.copytree(session.folder, tmp_path / "s", ignore=shutil.ignore_patterns("truth"))
    fuzz.prepare(tmp_path / "s")
    failures, told, exits = fuzz.campaign(tmp_path / "s", 20, seed=11, only=only)
    assert not failures, told
    assert exits["exit 1"] > 5  # it does spoil
