"""The session folder: what the console reads and writes, and nothing outside it."""

from __future__ import annotations

import json
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.atomic import write_text
from calibration.errors import FileError

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._ -]{0,99}")
MODELS = (".stl", ".obj", ".ply", ".glb", ".3mf", ".step", ".stp")


@dataclass(frozen=True, slots=True)
class SessionFolder:
    """A folder as `scope calibrate` and `scope scan` use it, with one folder a scan."""

    root: Path

    @classmethod
    def open(cls, root: Path) -> SessionFolder:
        """Make the folder where it is not there; ``FileError`` where that cannot be."""
        try:
            root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FileError(f"{root}: cannot be made ({error.strerror}); name another --session folder") from error
        return cls(root.resolve())

    @property
    def calibration(self) -> Path:
        """calibration.toml."""
        return self.root / "calibration.toml"

    @property
    def rig(self) -> Path:
        """rig.json."""
        return self.root / "rig.json"

    @property
    def scans(self) -> Path:
        """Folder of the scans."""
        return self.root / "scans"

    def inside(self, *parts: str) -> Path:
        """Path of a file within the folder; ``FileError`` for a name that would lead out of it, or is none."""
        names = [part for piece in parts for part in piece.split("/")]
        if not names or not all(NAME.fullmatch(name) and not name.endswith(".") for name in names):
            raise FileError("this name is not allowed; use letters, digits, dots, dashes and underscores")
        path = self.root.joinpath(*names)
        if not path.resolve().is_relative_to(self.root):
            raise FileError(f"{path.name}: leads out of the session folder, by a link; copy the file into it")
        return path

    def models(self) -> list[str]:
        """Meshes of parts in `models`, by name."""
        place = self.root / "models"
        found = (
            [p.name for p in place.iterdir() if p.suffix.lower() in MODELS and p.is_file()] if place.is_dir() else []
        )
        return sorted(name for name in found if NAME.fullmatch(name))

    def clouds(self) -> list[str]:
        """Scans that have a cloud, the newest first."""
        if not self.scans.is_dir():
            return []
        found = [p for p in self.scans.iterdir() if (p / "cloud.ply").is_file() and NAME.fullmatch(p.name)]
        return [p.name for p in sorted(found, key=lambda p: (p / "cloud.ply").stat().st_mtime, reverse=True)]

    def unfinished(self) -> list[str]:
        """Scans that have frames and no cloud, since they broke off; the newest first."""
        if not self.scans.is_dir():
            return []
        found = [p for p in self.scans.iterdir() if NAME.fullmatch(p.name) and not (p / "cloud.ply").is_file()]
        found = [p for p in found if (p / "capture.toml").is_file() and frame_numbers(p)]
        return [p.name for p in sorted(found, key=lambda p: p.stat().st_mtime, reverse=True)]

    def scan(self, name: str) -> Path:
        """Folder of one scan."""
        return self.inside("scans", name)

    def new_scan(self, name: str) -> Path:
        """Folder for a new scan; ``FileError`` where the name is taken."""
        folder = self.scan(name)
        try:
            folder.mkdir(parents=True)
        except FileExistsError as error:
            raise FileError(f"a scan called {name} is there already; choose another name") from error
        except OSError as error:
            raise FileError(
                f"{folder}: cannot be made ({error.strerror}); free space or choose another folder"
            ) from error
        return folder


def frame_numbers(scan: Path) -> list[int]:
    """Numbers of the frames that a scan's folder holds."""
    return sorted(int(path.stem) for path in (scan / "frames").glob("*.png") if path.stem.isdigit())


def write_toml(path: Path, content: dict[str, Any], comment: str) -> None:
    """Write a TOML file of values, tables and arrays of tables."""
    write_text(path, f"# {comment}\n{toml_text(content)}")


def toml_text(content: dict[str, Any], name: str = "") -> str:
    """TOML of a dictionary, whose scalars and lists JSON spells alike."""
    lines = [f"{_key(key)} = {_value(value)}" for key, value in content.items() if not _is_table(value)]
    for key, value in content.items():
        full = f"{name}.{_key(key)}" if name else _key(key)
        if isinstance(value, dict):
            lines += ["", f"[{full}]", toml_text(value, full).rstrip("\n")]
        elif _is_table(value):
            for item in value:
                lines += ["", f"[[{full}]]", toml_text(item, full).rstrip("\n")]
    return "\n".join(lines) + "\n"


def _is_table(value: Any) -> bool:
    return isinstance(value, dict) or (
        isinstance(value, list) and bool(value) and isinstance(value[0], dict) and "id" not in value[0]
    )


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return json.dumps(value)


def stamp() -> str:
    """Name for something made now."""
    return time.strftime("%Y%m%d-%H%M%S")
