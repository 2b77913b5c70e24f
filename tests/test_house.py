"""Laws of the house: who may import whom, what an import costs, what holds without Open3D, what the papers say."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import scope

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts"))
import rooms  # noqa: E402  (a script beside the packages)

LAYERS = ("calibration", "ranging", "scope", "cli")  # each may import those before it
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
SOURCES = sorted(path for layer in LAYERS for path in (ROOT / layer).rglob("*.py"))

# Modules that neither `import scope` nor any `--help` may load.
COSTLY = ("cv2", "matplotlib", "numba", "open3d", "rtree", "scipy", "trimesh")
# Modules that stand in no file outside a function: 1.5 to 3 s each.
ONLY_IN_FUNCTIONS = ("matplotlib", "open3d", "scipy.spatial", "trimesh")
# Where a distribution's name is not the name one imports.
IMPORTED_AS = {"opencv-python-headless": "cv2", "open3d-cpu": "open3d"}

IMPORT_ALL = "import scope\nfor name in scope.__all__: getattr(scope, name)\n"
# Runs `scope --help` and the help of every command in one process.
ALL_HELP = """
import contextlib, io, sys, typer
from cli.main import app, main
commands = sorted(typer.main.get_command(app).commands)
for words in ([], *([name] for name in commands)):
    sys.argv = ["scope", *words, "--help"]
    with contextlib.redirect_stdout(io.StringIO()) as page:
        try:
            main()
        except SystemExit as stop:
            assert stop.code == 0, (words, stop.code)
    assert "--help" in page.getvalue(), words
"""
# Clouds to every format that needs no optional package, and back.
EXPORT = """
import sys, tempfile
from pathlib import Path
import numpy as np
import scope
points = np.arange(12.0).reshape(4, 3)
with tempfile.TemporaryDirectory() as folder:
    for ending in ("ply", "pcd", "xyz"):
        scope.ScanCloud.from_points(points).save(Path(folder) / f"cloud.{ending}")
        assert (Path(folder) / f"cloud.{ending}").stat().st_size > 0
    assert np.array_equal(scope.ScanCloud.load(Path(folder) / "cloud.ply").points, points)
"""
REPORT = "\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))\n"


def run(code: str, *path: Path) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter that finds ``path``, then this checkout, before what is installed."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (*path, ROOT)))}
    return subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


def modules_after(code: str) -> set[str]:
    done = run(code + REPORT)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


def imports(tree: ast.Module) -> Iterator[tuple[str, bool]]:
    """Every module that a file imports by its full name, and whether that happens when the file itself is imported."""

    def visit(node: ast.AST, *, at_import: bool) -> Iterator[tuple[str, bool]]:
        if isinstance(node, ast.Import):
            yield from ((alias.name, at_import) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield node.module or "", at_import
            yield from ((f"{node.module}.{alias.name}", at_import) for alias in node.names)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            at_import = False
        inside = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for child in ast.iter_child_nodes(node):
            yield from visit(child, at_import=at_import and not inside)

    return visit(tree, at_import=True)


def is_or_is_in(module: str, packages: tuple[str, ...]) -> bool:
    return any(module == package or module.startswith(package + ".") for package in packages)


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def faults(tree: ast.Module, layer: str) -> list[str]:
    above = LAYERS[LAYERS.index(layer) + 1 :]
    return [
        module
        for module, at_import in imports(tree)
        if is_or_is_in(module, above) or (at_import and is_or_is_in(module, ONLY_IN_FUNCTIONS))
    ]


# --- who imports whom -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_imports_go_down_the_chain_and_heavy_ones_stay_inside_functions(path: Path) -> None:
    assert faults(parsed(path), path.relative_to(ROOT).parts[0]) == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import open3d", ["open3d"]),
        ("try:\n    import open3d.core\nexcept ImportError:\n    pass", ["open3d.core"]),
        ("from scipy import spatial", ["scipy.spatial"]),
        ("class A:\n    import trimesh", ["trimesh"]),
        ("def f():\n    import scope.cloud.scan_cloud", ["scope.cloud.scan_cloud"]),
        ("def f():\n    import open3d", []),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import trimesh", []),
        ("import scipy.optimize, calibration.geometry", []),
    ],
)
def test_the_law_of_imports_sees_what_it_should(source: str, found: list[str]) -> None:
    assert faults(ast.parse(source), "ranging") == found


def test_import_linter_agrees() -> None:
    pytest.importorskip("importlinter", reason="the extra 'check' is not installed")
    done = run("from importlinter.cli import lint_imports_command as command; command(['--no-cache'])")
    assert done.returncode == 0, done.stdout + done.stderr


def test_what_is_imported_is_declared() -> None:
    project = PROJECT["project"]
    declared = list(project["dependencies"])
    for extra in ("heightmaps", "clouds", "basler", "genicam", "console", "cluster"):
        declared += project["optional-dependencies"].get(extra, [])
    names = [re.split(r"[^A-Za-z0-9_.-]", line, maxsplit=1)[0] for line in declared]
    known = {IMPORTED_AS.get(name, name) for name in names} | set(LAYERS) | sys.stdlib_module_names
    used = {module.split(".")[0]: path for path in SOURCES for module, _ in imports(parsed(path))}
    assert {module: str(path) for module, path in used.items() if module not in known} == {}


def room(module: str) -> str:
    """The room that a module stands in: `calibration.rays` for `calibration.rays.two_plane`, itself for a file on top."""
    parts = module.split(".")
    return ".".join(parts[:2]) if len(parts) > 2 or (ROOT / Path(*parts)).is_dir() else module


def intrusions(tree: ast.Module, own: str) -> list[str]:
    """Imports that reach into a file of another room, past its `__init__`."""
    reached = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    reached += [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    return [m for m in reached if m.split(".")[0] in LAYERS and len(m.split(".")) > 2 and room(m) != own]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_room_is_entered_by_its_door(path: Path) -> None:
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    assert intrusions(parsed(path), room(module)) == []


def test_the_law_of_doors_sees_what_it_should() -> None:
    tree = ast.parse(
        "from calibration.rays.two_plane import x\nimport ranging.stripe._table\nfrom scope.cloud import y"
    )
    assert intrusions(tree, "scope.cloud") == ["calibration.rays.two_plane", "ranging.stripe._table"]
    assert intrusions(tree, "calibration.rays") == ["ranging.stripe._table"]


def test_no_folder_is_crowded() -> None:
    folders = {path.parent for path in SOURCES}
    crowded = {str(f.relative_to(ROOT)): len(list(f.glob("*.py"))) for f in folders if len(list(f.glob("*.py"))) > 16}
    assert crowded == {}


def test_rooms_tell_what_goes_in_what_comes_out_and_how_to_read_them() -> None:
    for room in rooms.rooms():
        told = rooms.story(room)
        assert {"title", "in", "out", "read"} == set(told), room
        files = {path.stem for path in room.glob("*.py") if not path.stem.startswith("_")}
        read = re.findall(r"[a-z_0-9]+", told["read"])
        assert files <= set(read), f"{room}: not told how to read {files - set(read)}"
        inside = {path.parent.name for path in room.glob("*/__init__.py")}
        assert inside <= set(read), f"{room}: does not name its rooms {inside - set(read)}"


def test_contributing_shows_the_rooms_as_they_are() -> None:
    paper = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert rooms.table() in paper, "python3 scripts/rooms.py --write"


# --- what an import costs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", ["import scope", ALL_HELP], ids=["import scope", "scope --help"])
def test_nothing_heavy_is_loaded_before_it_is_used(code: str) -> None:
    modules = modules_after(code)
    assert "scope" in modules
    assert sorted(modules & set(COSTLY)) == []


def test_the_library_loads_only_what_its_names_need() -> None:
    modules = modules_after(EXPORT)
    assert "calibration.geometry" in modules  # the names were loaded
    assert sorted(modules & {"open3d", "trimesh", "scipy.spatial"}) == []


# --- without Open3D ---------------------------------------------------------------------------------------------


@pytest.fixture(params=["ImportError('No module named open3d')", "OSError('libusb-1.0.so.0: cannot open')"])
def without_open3d(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A folder that, first on the path, makes `import open3d` fail as a missing package or system library does."""
    package = tmp_path / "open3d"
    package.mkdir()
    (package / "__init__.py").write_text(f"raise {request.param}\n", encoding="utf-8")
    return tmp_path


def test_the_stub_hides_open3d(without_open3d: Path) -> None:
    done = run("import open3d", without_open3d)
    assert done.returncode != 0
    assert "No module named open3d" in done.stderr or "libusb" in done.stderr


@pytest.mark.parametrize(
    "code", [IMPORT_ALL, ALL_HELP, EXPORT], ids=["every public name", "scope --help", "clouds to files"]
)
def test_works_without_open3d(code: str, without_open3d: Path) -> None:
    done = run(code, without_open3d)
    assert done.returncode == 0, done.stderr


# --- names and papers -------------------------------------------------------------------------------------------


def test_no_public_name_is_a_submodule() -> None:
    submodules = {path.stem for path in (ROOT / "scope").glob("*.py")}
    assert sorted(set(scope.__all__) & submodules) == []


def test_the_distribution_holds_the_layers_and_one_command() -> None:
    wheel = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert sorted(wheel) == sorted(LAYERS)
    assert PROJECT["project"]["scripts"] == {"scope": "cli.main:main"}
    assert all(importlib.util.find_spec(layer) is not None for layer in LAYERS)


def test_the_command_tells_the_version() -> None:
    done = run("import sys; sys.argv = ['scope', '--version']\nfrom cli.main import main; main()")
    assert (done.returncode, done.stdout.split()) == (0, ["scope", scope.__version__])


def test_the_changelog_knows_the_version() -> None:
    headings = re.findall(r"^## \[([^]]+)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert scope.__version__ in headings


def test_links_between_the_papers_lead_somewhere() -> None:
    papers = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    assert ROOT / "README.md" in papers
    links = [
        (paper, target)
        for paper in papers
        for target in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", paper.read_text(encoding="utf-8"))
    ]
    assert len(links) > 5
    assert [f"{paper.name} -> {target}" for paper, target in links if not (paper.parent / target).exists()] == []


# --- the documentation of files and the code that reads them ----------------------------------------------------

FORMATS = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")


def chapter(title: str) -> str:
    return FORMATS.split(f"\n## {title}\n")[1].split("\n## ")[0]


def examples(title: str) -> list[str]:
    return re.findall(r"```toml\n(.*?)```", chapter(title), re.DOTALL)


@pytest.mark.parametrize(
    ("title", "module", "model"),
    [
        ("calibration.toml", "scope.session.calibration_file", "CalibrationSection"),
        ("capture.toml", "scope.session.capture", "CaptureSection"),
    ],
)
def test_documented_examples_are_valid_and_every_key_is_documented(title: str, module: str, model: str) -> None:
    reader = importlib.import_module(module)
    section = getattr(reader, model)
    (example,) = examples(title)
    section.model_validate(tomllib.loads(example))
    with pytest.raises(ValueError, match="unknown"):
        section.model_validate(tomllib.loads("unknown = 1\n" + example))
    sections = [value for name, value in vars(reader).items() if name.endswith("Section") and name != "Section"]
    keys = {key for each in sections for key in each.model_fields}
    assert {"format", "units"} < keys
    assert sorted(key for key in keys if not re.search(rf"\b{key}\b", chapter(title))) == []
