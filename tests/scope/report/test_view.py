"""Pages of clouds and rigs: whole, honest about what must not be used, and refused for anything else."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.errors import FileError
from calibration.rig import Rig
from cli.main import app
from scope.cloud import ScanCloud
from scope.report import view_page


def shown(html: str) -> np.ndarray:
    """Points (N, 3) that a page holds, about their own centre."""
    found = re.search(r'data-points="([^"]*)"', html)
    assert found is not None
    rows = np.frombuffer(base64.b64decode(found[1]), dtype=[("xyz", "<f4", 3), ("rest", "<u4")])
    return rows["xyz"].astype(np.float64)


def test_a_cloud_is_shown_whole_and_says_what_it_is_worth(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0.0, 30.0, (500, 3))
    cloud = replace(ScanCloud.from_points(points), rig_sha256="a" * 64, verified=False)
    cloud.save(tmp_path / "cloud.ply")
    html = view_page(tmp_path / "cloud.ply")
    assert "500 points" in html
    assert "not verified" in html
    there = shown(html)
    np.testing.assert_allclose(there - there.mean(axis=0), points - points.mean(axis=0), atol=1e-4)


def test_a_rig_shows_its_rays_and_sheets(session) -> None:  # type: ignore[no-untyped-def]
    rig = Rig.load(session.rig)
    html = view_page(session.rig)
    assert "Passed" in html
    there = shown(html)
    assert len(there) > 1000
    depth = np.ptp(there[:, 2])
    assert 90.0 < depth <= 1.1 * 90.0 + 1e-3  # stand-offs from 300 to 390 mm, and 5 % more at either end
    assert rig.lasers["laser"].along in html


def test_the_command_keeps_the_page_and_refuses_other_files(tmp_path: Path, session) -> None:  # type: ignore[no-untyped-def]
    page = tmp_path / "page.html"
    done = CliRunner().invoke(app, ["view", str(session.rig), "-o", str(page), "--no-show", "--json"])
    assert done.exit_code == 0
    assert json.loads(done.stdout) == {"page": str(page), "shown": False}
    assert page.read_text(encoding="utf-8").endswith("</html>\n")
    with pytest.raises(FileError, match="neither a cloud nor a rig"):
        view_page(session.capture)
