"""Meshes of any CAD program: the same part in every format has the same size in mm, and what is no mesh is refused in a line."""

from __future__ import annotations

import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.errors import FileError
from scope.cloud import read_mesh
from scope.mesh import CHORD, ENDINGS, load_mesh
from scope.model import load_model

SIDES = np.array([60.0, 40.0, 25.4])
RADIUS, HEIGHT = 10.0, 30.0
MM, METRE = "SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT($,.METRE.)"


def box() -> Any:
    trimesh = pytest.importorskip("trimesh")
    made = trimesh.creation.box(SIDES)
    made.apply_translation([3.0, 4.0, 5.0])
    return made


def in_units_of(mm: float, name: str | None) -> Any:
    made = box()
    made.apply_scale(1.0 / mm)
    if name is not None:
        made.units = name
    return made


def step_cylinder(unit: str) -> str:
    """A right cylinder about z by its exact surfaces (ISO 10303-214): three faces, three edges, two vertices."""
    scale = 1.0 if unit == MM else 1e-3
    r, h = RADIUS * scale, HEIGHT * scale
    return f"""ISO-10303-21;
HEADER;
FILE_DESCRIPTION((''),'2;1');
FILE_NAME('','',(''),(''),'','','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN {{ 1 0 10303 214 1 1 1 1 }}'));
ENDSEC;
DATA;
#1=APPLICATION_CONTEXT('mechanical design');
#2=PRODUCT_CONTEXT('',#1,'mechanical');
#3=PRODUCT('part','part','',(#2));
#4=PRODUCT_DEFINITION_FORMATION('','',#3);
#5=PRODUCT_DEFINITION_CONTEXT('part definition',#1,'design');
#6=PRODUCT_DEFINITION('design','',#4,#5);
#7=PRODUCT_DEFINITION_SHAPE('','',#6);
#8=SHAPE_DEFINITION_REPRESENTATION(#7,#9);
#9=ADVANCED_BREP_SHAPE_REPRESENTATION('',(#20,#30),#10);
#10=(GEOMETRIC_REPRESENTATION_CONTEXT(3) GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT((#14))
 GLOBAL_UNIT_ASSIGNED_CONTEXT((#11,#12,#13)) REPRESENTATION_CONTEXT('',''));
#11=(LENGTH_UNIT() NAMED_UNIT(*) {unit});
#12=(NAMED_UNIT(*) PLANE_ANGLE_UNIT() SI_UNIT($,.RADIAN.));
#13=(NAMED_UNIT(*) SI_UNIT($,.STERADIAN.) SOLID_ANGLE_UNIT());
#14=UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-7),#11,'distance_accuracy_value','');
#20=AXIS2_PLACEMENT_3D('',#21,#22,#23);
#21=CARTESIAN_POINT('',(0.,0.,0.));
#22=DIRECTION('',(0.,0.,1.));
#23=DIRECTION('',(1.,0.,0.));
#24=AXIS2_PLACEMENT_3D('',#25,#22,#23);
#25=CARTESIAN_POINT('',(0.,0.,{h!r}));
#30=MANIFOLD_SOLID_BREP('',#31);
#31=CLOSED_SHELL('',(#40,#50,#60));
#32=CARTESIAN_POINT('',({r!r},0.,0.));
#33=CARTESIAN_POINT('',({r!r},0.,{h!r}));
#34=VERTEX_POINT('',#32);
#35=VERTEX_POINT('',#33);
#36=CIRCLE('',#20,{r!r});
#37=CIRCLE('',#24,{r!r});
#38=EDGE_CURVE('',#34,#34,#36,.T.);
#39=EDGE_CURVE('',#35,#35,#37,.T.);
#40=ADVANCED_FACE('',(#41),#44,.T.);
#41=FACE_BOUND('',#42,.T.);
#42=EDGE_LOOP('',(#43,#45,#46,#47));
#43=ORIENTED_EDGE('',*,*,#38,.T.);
#44=CYLINDRICAL_SURFACE('',#20,{r!r});
#45=ORIENTED_EDGE('',*,*,#72,.T.);
#46=ORIENTED_EDGE('',*,*,#39,.F.);
#47=ORIENTED_EDGE('',*,*,#72,.F.);
#50=ADVANCED_FACE('',(#51),#54,.F.);
#51=FACE_BOUND('',#52,.T.);
#52=EDGE_LOOP('',(#53));
#53=ORIENTED_EDGE('',*,*,#38,.F.);
#54=PLANE('',#20);
#60=ADVANCED_FACE('',(#61),#64,.T.);
#61=FACE_BOUND('',#62,.T.);
#62=EDGE_LOOP('',(#63));
#63=ORIENTED_EDGE('',*,*,#39,.T.);
#64=PLANE('',#24);
#70=VECTOR('',#22,1.);
#71=LINE('',#32,#70);
#72=EDGE_CURVE('',#34,#35,#71,.T.);
ENDSEC;
END-ISO-10303-21;
"""


@pytest.mark.parametrize(
    ("ending", "mm", "name"),
    [("stl", 1.0, None), ("obj", 1.0, None), ("ply", 1.0, None), ("glb", 1000.0, None), ("glb", 25.4, "inches"),
     ("glb", 1.0, "mm"), ("3mf", 1.0, None)],
)  # fmt: skip
def test_the_same_part_is_as_large_in_every_format(tmp_path: Path, ending: str, mm: float, name: str | None) -> None:
    if ending == "3mf":
        pytest.importorskip("networkx")
        pytest.importorskip("lxml")
    path = tmp_path / f"part.{ending}"
    in_units_of(mm, name).export(path)
    mesh = load_mesh(path)
    assert np.abs(mesh.bounds - (np.array([3.0, 4.0, 5.0]) + 0.5 * np.outer([-1, 1], SIDES))).max() < 1e-4
    assert mesh.volume == pytest.approx(SIDES.prod(), rel=1e-5)
    placed = read_mesh(path)
    assert np.abs(np.ptp(placed.vertices, axis=0) - SIDES).max() < 1e-4


def test_a_3mf_in_inches_is_read_in_mm(tmp_path: Path) -> None:
    pytest.importorskip("networkx")
    pytest.importorskip("lxml")
    in_units_of(25.4, None).export(tmp_path / "mm.3mf")
    with zipfile.ZipFile(tmp_path / "mm.3mf") as held, zipfile.ZipFile(tmp_path / "inch.3mf", "w") as made:
        for name in held.namelist():
            made.writestr(name, held.read(name).replace(b'unit="millimeter"', b'unit="inch"'))
    assert load_mesh(tmp_path / "inch.3mf").extents == pytest.approx(SIDES, rel=1e-6)


@pytest.mark.parametrize("unit", [MM, METRE])
@pytest.mark.parametrize("ending", ["step", "STP"])
def test_a_step_is_cut_within_the_chord_that_is_promised(tmp_path: Path, unit: str, ending: str) -> None:
    """A cylinder of n facets lies between r cos(pi / n) and r, and has the volume of a right prism on an n-gon."""
    pytest.importorskip("cascadio")
    (tmp_path / f"c.{ending}").write_text(step_cylinder(unit), encoding="ascii")
    mesh = read_mesh(tmp_path / f"c.{ending}")
    vertices, triangles = mesh.vertices, mesh.triangles
    middles = vertices[triangles].mean(axis=1)
    around = np.abs(middles[:, 2] - HEIGHT / 2) < HEIGHT / 2 - 1e-3
    corner = np.linalg.norm(vertices[:, :2], axis=1)
    assert np.abs(corner[corner > 1.0] - RADIUS).max() < 1e-4
    edges = vertices[triangles[around]]
    chord = np.linalg.norm(0.5 * (edges + np.roll(edges, 1, axis=1))[..., :2], axis=2)
    assert RADIUS - chord.min() < CHORD
    volume = (
        np.einsum("ni,ni->n", vertices[triangles[:, 0]], np.cross(*(vertices[triangles[:, k]] for k in (1, 2)))) / 6
    )
    assert volume.sum() == pytest.approx(np.pi * RADIUS**2 * HEIGHT, rel=2 * CHORD / RADIUS)


def test_a_step_is_a_model_for_a_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cascadio")
    pytest.importorskip("open3d")
    monkeypatch.setenv("SCOPE_CACHE", str(tmp_path / "cache"))
    (tmp_path / "c.step").write_text(step_cylinder(MM), encoding="ascii")
    model = load_model(tmp_path / "c.step")
    assert model.diameter == pytest.approx(np.hypot(np.hypot(20.0, 20.0), 30.0), abs=0.01)
    assert model.axis is not None
    assert np.abs(model.axis.direction) == pytest.approx([0.0, 0.0, 1.0], abs=1e-3)


def glb(scene: dict[str, Any]) -> bytes:
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.step", b"solid part", "ISO-10303-21"),
        ("a.step", b"ISO-10303-21;\nDATA;\n#1=NONSENSE;\n", r"a\.step"),
        ("a.3mf", b"PK\x03\x04 cut", "3MF"),
        ("a.glb", b"glTF", "GLB"),
        ("a.glb", glb({"asset": {"version": "2.0"}, "accessors": [{"count": 10**12}]}), "announces"),
        ("a.glb", glb({"asset": {"version": "2.0"}, "buffers": [{"uri": "/etc/hosts"}]}), "another file"),
        ("a.glb", glb({"asset": {"version": "2.0"}}), r"a\.glb"),
        ("a.iges", b"", r"'\.iges' is not known"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n", "no triangles"),
    ],
)  # fmt: skip
def test_what_is_no_mesh_is_refused_in_a_line(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    if name.endswith("step"):
        pytest.importorskip("cascadio")
    if name.endswith("3mf"):
        pytest.importorskip("networkx")
        pytest.importorskip("lxml")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match=said) as caught:
        load_mesh(tmp_path / name)
    assert len(str(caught.value).replace(str(tmp_path), "")) < 300


def test_every_ending_is_refused_when_the_file_is_absent(tmp_path: Path) -> None:
    for ending in ENDINGS:
        with pytest.raises(FileError, match="cannot be read"):
            load_mesh(tmp_path / f"absent{ending}")
