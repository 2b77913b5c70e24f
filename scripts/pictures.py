"""Makes the pictures of docs/first-scan.md by the commands that it names: .venv/bin/python scripts/pictures.py."""

from __future__ import annotations

import base64
import os
import re
import tempfile
from pathlib import Path

import cv2
import numpy as np
from typer.testing import CliRunner

from cli.main import app

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs" / "pictures"
COMMANDS = (
    f"simulate {ROOT}/examples/webcam-design.toml -o webcam --seed 3",
    "calibrate webcam/calibration.toml -o rig.json --report calibration.html",
    "scan webcam/capture.toml --rig rig.json -o cloud.ply --report scan.html",
)


def shown(page: Path, caption: str) -> np.ndarray:
    """The first picture of a page whose caption begins so."""
    for alt, data in re.findall(r'alt="([^"]*)" src="data:image/\w+;base64,([^"]*)"', page.read_text(encoding="utf-8")):
        if alt.startswith(caption):
            return np.asarray(cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR))
    raise SystemExit(f"{page}: no picture {caption!r}")


def side_by_side(*images: np.ndarray, height: int = 300) -> np.ndarray:
    """One row of pictures of one height."""
    same = [
        cv2.resize(i, (round(i.shape[1] * height / i.shape[0]), height), interpolation=cv2.INTER_AREA) for i in images
    ]
    return np.hstack([np.pad(i, ((0, 0), (0, 6), (0, 0)), constant_values=255) for i in same])[:, :-6]


def main() -> None:
    """Run the commands in an empty folder and keep what their pages show."""
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        os.chdir(folder)
        for command in COMMANDS:
            done = CliRunner().invoke(app, command.split())
            if done.exit_code:
                raise SystemExit(f"scope {command}: {done.output}")
        taken = [
            folder / "webcam" / name
            for name in ("board/im03.jpg", "laser/im05.jpg", "markers/im02.jpg", "turn/im12.jpg")
        ]
        frames = [np.asarray(cv2.imread(str(path))) for path in taken]
        made = {
            "first-scan-images.jpg": side_by_side(*frames, height=240),
            "first-scan-calibration.jpg": side_by_side(
                shown(folder / "calibration.html", "board/im03"),
                shown(folder / "calibration.html", "stripe on laser/im05"),
            ),
            "first-scan-cloud.jpg": side_by_side(
                shown(folder / "scan.html", "seen along z"), shown(folder / "scan.html", "seen along y")
            ),
        }
    for name, picture in made.items():
        cv2.imwrite(str(PICTURES / name), picture, [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()
