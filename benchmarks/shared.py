"""Where the captures are that are measured on, and how figures are printed."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def twin_capture(folder: Path, place: Path) -> Path:
    """capture.toml of twin-a, written into ``place`` with `moves`, which it is too old to have."""
    text = (folder / "capture.toml").read_text(encoding="utf-8")
    text = text.replace('images = "', f'images = "{folder}/').replace("[motion]", '[motion]\nmoves = "object"')
    (place / "capture.toml").write_text(text, encoding="utf-8")
    return place / "capture.toml"


def require(name: str) -> Path:
    """Folder of a shared capture; exits with a sentence where it is absent."""
    folder = SHARED / name
    if not folder.is_dir():
        raise SystemExit(f"{folder} is not here: these figures need the captures that are kept beside the project")
    return folder


def judge() -> ModuleType:
    """The judge of twin-a, from beside the data."""
    spec = importlib.util.spec_from_file_location("judge", SHARED / "judge.py")
    if spec is None or spec.loader is None:
        raise SystemExit(f"{SHARED / 'judge.py'} is not here")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def row(*cells: object) -> None:
    """Print one row of a Markdown table; floats with four figures."""
    print("| " + " | ".join(f"{c:.4g}" if isinstance(c, float) else str(c) for c in cells) + " |")


def head(*cells: str) -> None:
    """Print the head of a Markdown table."""
    row(*cells)
    row(*("---" for _ in cells))
