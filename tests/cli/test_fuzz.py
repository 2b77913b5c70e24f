"""Damaged files through the commands; the large run is python -m benchmarks.fuzz."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from benchmarks import fuzz
from benchmarks.fuzz_more import prepare_texts
from benchmarks.small_session import design_text


@pytest.fixture(scope="module")
def prepared(session, tmp_path_factory: pytest.TempPathFactory) -> Path:  # type: ignore[no-untyped-def]
    folder = tmp_path_factory.mktemp("fuzz") / "s"
    shutil.copytree(session.folder, folder, ignore=shutil.ignore_patterns("truth"))
    fuzz.prepare(folder)
    prepare_texts(folder, design_text())
    return folder


@pytest.mark.parametrize(
    ("only", "inputs"),
    [("rig", 20), ("capture", 20), ("cloud: ", 20), ("export", 20), ("heights", 20), ("target", 12), ("of frames", 12)],
)
def test_damage_ends_in_one_line_or_changes_nothing(prepared: Path, only: str, inputs: int) -> None:
    failures, told, exits = fuzz.campaign(prepared, inputs, seed=11, only=only)  # it puts each file back
    assert not failures, told
    assert exits["exit 1"] >= inputs // 4  # it does spoil
