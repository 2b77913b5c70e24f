"""Files in, values out: what the commands call, each stage in a file of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from calibration.atomic import require_folder
from scope.calibrating import Calibration, calibrate
from scope.calibration_report import (
    calibration_page,
    calibration_text,
    check_text,
    verification_page,
    verification_text,
)
from scope.demo import demo_text, run_demo
from scope.scan_file import scan_to_file
from scope.scan_report import scan_page, scan_result, scan_text
from scope.scan_setup import ScanOptions, scan_options
from scope.scanning import run_scan, scan
from scope.tally import Scan
from scope.templates import TEMPLATES, write_template
from scope.verifying import check_plane, verify

__all__ = [
    "TEMPLATES",
    "Calibration",
    "Scan",
    "ScanOptions",
    "calibrate",
    "calibration_page",
    "calibration_text",
    "check_plane",
    "check_text",
    "demo_text",
    "require_writable",
    "run_demo",
    "run_scan",
    "scan",
    "scan_options",
    "scan_page",
    "scan_result",
    "scan_text",
    "scan_to_file",
    "simulate",
    "verification_page",
    "verification_text",
    "verify",
    "write_template",
]


def require_writable(*paths: Path | None) -> None:
    """Refuse outputs that cannot be written before any work is done for them."""
    for path in paths:
        if path is not None:
            require_folder(path)


def simulate(
    design: Path, out: Path, *, seed: int = 0, on_image: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Render a rig-design.toml into a session."""
    import numpy as np

    from scope import simulation

    made = simulation.simulate(simulation.read_design(design), out, np.random.default_rng(seed), on_image=on_image)
    return {
        "folder": str(made.folder),
        "planes": list(made.planes),
        "frames": made.frames,
        "images": made.images,
        "expected_sigma_mm": made.expected_sigma_mm,
    }
