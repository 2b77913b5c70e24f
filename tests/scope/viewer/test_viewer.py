"""What a page holds is what the cloud holds: read back by a decoder of the format's own description, and never markup."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import struct
import zlib
from dataclasses import replace
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from calibration.rig import Rig
from scope.cloud import ScanCloud
from scope.viewer import (
    Layer,
    Scalar,
    Scene,
    cloud_scene,
    mesh_layer,
    rig_layers,
    rig_scene,
    scene_bytes,
    still,
    tilted,
    viewer_code,
    viewer_element,
    viewer_page,
)

HOSTILE = '</script><img src=x onerror="alert(1)">'


def read(data: bytes) -> tuple[dict[str, Any], np.ndarray, dict[str, np.ndarray]]:
    """Header, points and scalars of a scene, number by number."""
    data = zlib.decompress(data)
    (size,) = struct.unpack_from("<I", data)
    header = json.loads(data[4 : 4 + size])
    at, n = 4 + size, header["points"]

    def column(told: dict[str, Any]) -> np.ndarray:
        nonlocal at
        whole, out = 0, []
        for i in range(n):
            u = sum(data[at + k * n + i] << (8 * k) for k in range(told["planes"]))
            whole += (u >> 1) if u % 2 == 0 else -((u + 1) >> 1)
            out.append(told["start"] + told["step"] * whole)
        at += told["planes"] * n
        values = np.array(out)
        if told["gaps"]:
            values[np.unpackbits(np.frombuffer(data[at : at + (n + 7) // 8], np.uint8))[:n] == 1] = np.nan
            at += (n + 7) // 8
        return values

    points = np.stack([column(told) for told in header["axes"]], axis=1).reshape(-1, 3) + header["centre"]
    scalars = {told["name"]: column(told) for told in header["columns"]}
    if header["rows"]:
        scalars["row"] = column(header["rows"])
    assert at == len(data)
    return header, points, scalars


def some_cloud(n: int = 400) -> ScanCloud:
    rng = np.random.default_rng(5)
    cloud = ScanCloud.from_points(rng.normal([0.0, 0.0, 400.0], 40.0, (n, 3)))
    sigma = rng.lognormal(-5.0, 0.5, n).astype(np.float32)
    sigma[::7] = np.nan
    return replace(
        cloud,
        sigma=sigma,
        intensity=rng.integers(0, 4096, n).astype(np.float32),
        frame=np.sort(rng.integers(0, 90, n)).astype(np.int32),
        laser=rng.integers(0, 2, n).astype(np.uint8),
        laser_names=("red", HOSTILE),
    )


def test_every_number_comes_back_as_fine_as_the_header_says() -> None:
    cloud = some_cloud()
    header, points, scalars = read(scene_bytes(cloud_scene(cloud)))
    assert np.abs(points - cloud.points).max() <= 0.51e-4  # mm: half a step of a tenth of a micrometre
    np.testing.assert_array_equal(scalars["frame"], cloud.frame)
    np.testing.assert_array_equal(scalars["intensity"], cloud.intensity)
    np.testing.assert_array_equal(np.isnan(scalars["sigma"]), np.isnan(cloud.sigma))
    assert np.nanmax(np.abs(scalars["sigma"] - cloud.sigma)) < 1e-5
    assert [header["columns"][-1]["names"][int(k)] for k in scalars["laser"][:5]] == [
        cloud.laser_names[k][:120] for k in cloud.laser[:5]
    ]
    assert "sigma_cal" not in scalars  # nothing is known of it


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3, 1e6])
def test_steps_follow_the_size_of_the_scene(scale: float) -> None:
    points = np.random.default_rng(1).uniform(-scale, scale, (200, 3))
    _, found, _ = read(scene_bytes(Scene(points)))
    assert np.abs(found - points).max() <= max(0.51e-4, 2e-8 * scale) if scale >= 1 else 1e-5 * scale


def test_nothing_and_one_point_are_scenes_too() -> None:
    for n in (0, 1):
        header, points, _ = read(scene_bytes(Scene(np.zeros((n, 3)), (Scalar("a", np.full(n, np.nan)),))))
        assert header["points"] == len(points) == n
        assert still(Scene(np.zeros((n, 3)))).shape[2] == 3


def test_thinning_leaves_no_hole() -> None:
    """Of a dense lattice a tenth is kept: no point of the lattice is further from a kept one than a few of the new steps."""
    x, y = np.meshgrid(np.arange(200.0), np.arange(200.0))
    scene = Scene(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), (Scalar("i", np.arange(40000.0)),))
    kept = scene.thinned(4000)
    assert (len(kept), kept.of) == (4000, 40000)
    np.testing.assert_array_equal(kept.rows, np.sort(kept.rows))
    np.testing.assert_array_equal(kept.scalars[0].values, kept.rows)
    cells = np.unique((kept.points[:, :2] // 10).astype(int), axis=0)
    assert len(cells) == 400  # blocks of 10 x 10, of which ten each are expected: none is empty
    assert read(scene_bytes(kept))[2]["row"][0] == kept.rows[0] + 1


def test_names_never_become_markup() -> None:
    page = viewer_page(cloud_scene(some_cloud(60)), HOSTILE)
    assert "<img src=x" not in page
    assert page.count("</script>") == 3  # scene, viewer, and the line that starts it
    assert "onerror=&quot;" in viewer_element(Scene(np.zeros((1, 3))), HOSTILE)


def test_a_rig_has_its_parts_where_they_are(session) -> None:  # type: ignore[no-untyped-def]
    rig = Rig.load(session.rig)
    layers = {layer.role: layer for layer in rig_layers(rig)}
    assert {"camera", "ray", "sheet", "volume", "axes"} <= set(layers)
    rays = layers["ray"].lines
    assert rays is not None
    assert rig.camera.volume.contains(
        rays[:, 1] * (1 - 1e-9) + 1e-9 * rays[:, 0], margin=1e-3
    ).all()  # where they leave it
    np.testing.assert_allclose(layers["axes"].lines[:, 0], 0.0)
    sheet = next(layer for layer in rig_layers(rig) if layer.faces is not None)
    (laser,) = rig.lasers.values()
    assert np.abs(laser.sheet.distance(sheet.vertices)).max() < 0.05
    edges = layers["volume"].lines
    assert edges is not None
    assert np.ptp(edges[..., 2]) == pytest.approx(
        99.0, abs=0.5
    )  # stand-offs from 300 to 390 mm, and 5 % more at either end
    header, _, _ = read(scene_bytes(rig_scene(rig)))
    assert [layer["role"] for layer in header["layers"]] == [layer.role for layer in rig_layers(rig)]
    assert len(np.unique(still(rig_scene(rig)).reshape(-1, 3), axis=0)) > 4


def test_a_still_shows_each_colour_where_its_points_are() -> None:
    x = np.linspace(-10.0, 10.0, 4000)
    points = np.stack([x, np.tile([-1.0, 1.0], 2000), np.zeros(4000)], axis=1)
    flat = (np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    picture = still(
        Scene(points, (Scalar("side", np.sign(x), kind="diverging", limits=(-1.0, 1.0)),), look=flat)
    ).astype(int)
    where = np.argwhere(picture[:, :700].min(axis=2) < 200)
    middle = where[:, 1].mean()
    reds = np.array([picture[r, c, 2] > picture[r, c, 0] for r, c in where])
    assert (reds == (where[:, 1] > middle)).mean() > 0.98  # negative is blue and on the left


def test_tilted_views_are_right_angled_and_see_what_they_should() -> None:
    for up, sign in (("-z", 1.0), ("z", -1.0)):
        right, down = tilted(up)
        assert right @ down == pytest.approx(0.0, abs=1e-12)
        assert np.cross(right, down)[2] * sign > 0.5  # from the camera's side, or from above


def test_scenes_refuse_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match=r"\(N, 3\) mm and finite"):
        Scene(np.array([[0.0, np.nan, 0.0]]))
    with pytest.raises(ValueError, match=r"must be \(2,\)"):
        Scene(np.zeros((2, 3)), (Scalar("a", np.zeros(3)),))
    assert mesh_layer(np.zeros((3, 3)), np.zeros((30_000, 3), np.int64), "m") is None
    assert isinstance(mesh_layer(np.zeros((3, 3)), np.zeros((2, 3), np.int64), "m"), Layer)


def test_three_is_the_one_that_its_paper_says() -> None:
    place = files("scope.viewer") / "static"
    (name,) = [item.name for item in place.iterdir() if item.name.startswith("three-") and item.name.endswith(".js")]
    told = re.search(r"([0-9a-f]{64})\s*\n```", (place / "README.md").read_text(encoding="utf-8"))
    assert told is not None
    assert hashlib.sha256((place / name).read_bytes()).hexdigest() == told[1]
    assert "MIT" in (place / "three-LICENSE.txt").read_text(encoding="utf-8")
    assert "</script" not in viewer_code()
    assert not re.search(
        r"https?://(?!www\.w3\.org|github\.com|threejs|[^\"'` ]*jcgt|[^\"'` ]*licen)[^\"'` )]+\.js", viewer_code()
    )


def test_the_element_holds_the_scene() -> None:
    cloud = some_cloud(50)
    found = re.search(r'class="scene">([^<]*)<', viewer_element(cloud_scene(cloud), "a cloud"))
    assert found is not None
    np.testing.assert_allclose(read(base64.b64decode(found[1]))[1], cloud.points, atol=1e-4)
