"""Pages of clouds and rigs: whole, honest about what must not be used, and refused for anything else."""

from __future__ import annotations

import base64
import json
import re
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.errors import FileError
from calibration.rig import Rig
from cli.main import app
from scope.cloud import ScanCloud
from scope.report import view_page


def told(html: str) -> dict[str, Any]:
    """Header of the scene that a page holds."""
    found = re.search(r'class="scene">([^<]*)<', html)
    assert found is not None
    data = zlib.decompress(base64.b64decode(found[1]))
    (size,) = struct.unpack_from("<I", data)
    header: dict[str, Any] = json.loads(data[4 : 4 + size])
    return header


def test_a_cloud_is_shown_whole_and_says_what_it_is_worth(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0.0, 30.0, (500, 3))
    cloud = replace(ScanCloud.from_points(points), rig_sha256="a" * 64, verified=False)
    cloud.save(tmp_path / "cloud.ply")
    html = view_page(tmp_path / "cloud.ply")
    assert "500 points" in html
    assert "not verified" in html
    header = told(html)
    assert (header["points"], header["of"], header["layers"]) == (500, 500, [])
    np.testing.assert_allclose(np.add(header["centre"], header["low"]), points.min(axis=0), atol=1e-4)


def test_a_rig_shows_its_rays_and_sheets(session) -> None:  # type: ignore[no-untyped-def]
    rig = Rig.load(session.rig)
    html = view_page(session.rig)
    assert "Passed" in html
    assert {"camera", "ray", "sheet", "volume", "axes"} <= {layer["role"] for layer in told(html)["layers"]}
    assert rig.lasers["laser"].along in html


def test_scalars_of_the_file_can_be_chosen(tmp_path: Path) -> None:
    from scope.export import write_scalars

    points = np.random.default_rng(2).uniform(0.0, 9.0, (50, 3))
    for ending in ("ply", "pcd", "xyz"):
        path = tmp_path / f"map.{ending}"
        write_scalars(path, points, {"deviation": points[:, 0] - 4.0, "wear": points[:, 1]})
        header = told(view_page(path))
        columns = {column["name"]: column for column in header["columns"]}
        assert header["shown"] == "deviation"
        assert (columns["deviation"]["kind"], columns["deviation"]["unit"]) == ("diverging", "mm")
        assert columns["wear"]["whole"] == pytest.approx([points[:, 1].min(), points[:, 1].max()], abs=1e-5)
        assert not {"quality", "red"} & set(columns)


def test_the_command_keeps_the_page_and_refuses_other_files(tmp_path: Path, session) -> None:  # type: ignore[no-untyped-def]
    page = tmp_path / "page.html"
    done = CliRunner().invoke(app, ["view", str(session.rig), "-o", str(page), "--no-show", "--json"])
    assert done.exit_code == 0
    assert {"page": str(page), "shown": False}.items() <= json.loads(done.stdout).items()
    assert page.read_text(encoding="utf-8").endswith("</html>\n")
    ScanCloud.from_points(np.eye(3)).save(tmp_path / "cloud.ply")
    done = CliRunner().invoke(
        app, ["view", str(tmp_path / "cloud.ply"), "--rig", str(session.rig), "-o", str(page), "--no-show"]
    )
    assert done.exit_code == 0
    assert "sheet" in {layer["role"] for layer in told(page.read_text(encoding="utf-8"))["layers"]}
    with pytest.raises(FileError, match="without another"):
        view_page(session.rig, rig=session.rig)
    with pytest.raises(FileError, match="neither a cloud nor a rig"):
        view_page(session.capture)
