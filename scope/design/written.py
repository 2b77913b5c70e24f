"""A design as a rig-design.toml, to be simulated or changed."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

from calibration.atomic import write_text
from scope.simulation import RigDesign


def write_design(design: RigDesign, path: Path) -> None:
    """Write camera, window, laser and jig of a design as TOML, with every key that is not at its default."""
    lines = ["# Proposed by scope design --want.", "format = 1"]
    for name in ("camera", "window", "laser", "jig"):
        table: Any = getattr(design, name)
        if table is None:
            continue
        lines += ["", f"[{name}]"]
        for each in fields(table):
            value = getattr(table, each.name)
            if each.name != "_" and value is not None and value != each.default and value != ():
                lines.append(f"{each.name} = {json.dumps(value)}")
    write_text(path, "\n".join(lines) + "\n")
