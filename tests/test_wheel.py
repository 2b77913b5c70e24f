"""The wheel is whole: what a user installs does what the checkout does, from anywhere."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which nothing but the wheel is unpacked."""
    place = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(place), str(ROOT)]
    made = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    if made.returncode and "hatchling" in made.stderr:
        pytest.skip(f"no network to fetch the build tool: {made.stderr.splitlines()[-1]}")
    assert made.returncode == 0, made.stderr
    (wheel,) = place.glob("scope_scanner-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(place / "site")
    return place / "site"


def scope(installed: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    code = (
        "import sys, scope; assert sys.argv.pop(1) in scope.__file__, scope.__file__\nfrom cli.main import main\nmain()"
    )
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    command = [sys.executable, "-c", code, str(installed), *words]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


def test_it_holds_the_four_packages_and_nothing_of_the_tests(installed: Path) -> None:
    there = {path.name for path in installed.iterdir() if not path.name.endswith(".dist-info")}
    assert there == {"scope", "calibration", "ranging", "cli"}
    checkout = {
        p.relative_to(ROOT) for top in there for p in (ROOT / top).rglob("*") if p.is_file() and p.suffix != ".pyc"
    }
    unpacked = {p.relative_to(installed) for top in there for p in (installed / top).rglob("*") if p.is_file()}
    missing = {path for path in checkout - unpacked if not path.name.endswith((".nbc", ".nbi"))}
    assert missing == set()


def test_its_command_works_from_anywhere(installed: Path, tmp_path: Path) -> None:
    assert scope(installed, tmp_path, "--version").stdout.startswith("scope 0.")
    made = scope(installed, tmp_path, "calibrate", "--init", "chessboard")
    assert made.returncode == 0, made.stderr
    assert (tmp_path / "calibration.toml").is_file() or "[target]" in made.stdout
    refused = scope(installed, tmp_path, "scan", "nothing.toml", "--rig", "rig.json")
    assert refused.returncode == 1
    assert "Traceback" not in refused.stderr
