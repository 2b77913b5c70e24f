"""Two lasers on one surface: ``python -m benchmarks.two_lasers``.

The same simulated rig is rendered once for each laser, from either side of the camera, and the two sessions are merged:
frames that take turns, and colour frames in which a red and a green line shine together and bleed into each other's
channel. Calibrated and scanned as a user would, both lasers see a sphere on a plane; the table tells how far their
surfaces lie apart along the normal, beside what noise and calibration let expect.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from scope.calibrating import calibrate
from scope.scanning import run_scan
from scope.simulation.hardware_design import CameraDesign, JigDesign, LaserDesign
from scope.simulation.object_design import MotionDesign, PlaneDesign, SphereDesign
from scope.simulation.rig_design import RigDesign
from scope.simulation.session import simulate

BLEED = 0.08  # of a line's light in the other colour's pixels
NAMES = ("red", "green")
Sequence = Literal["cycle", "together"]


def design(side: float, frames: int, scale: float = 1.0) -> RigDesign:
    """Rig whose laser stands ``side`` mm from the camera along y; ``scale`` enlarges the image."""
    size = (int(640 * scale), int(480 * scale))
    return RigDesign(
        CameraDesign(size, 700.0 * scale, (318.0 * scale, 243.0 * scale), distortion=(-0.2, 0.05, 0.0, 0.0, 0.0)),
        LaserDesign((0.0, side, 5.0), (0.0, 0.0, 400.0), roll=1.0 if side < 0 else -1.0, width=0.5),
        JigDesign((360.0, 395.0, 430.0), 11, 15, 20.0, 7.0, fiducials=((5, 7), (5, 9), (2, 7)), fiducial_diameter=11.0),
        objects=(PlaneDesign(origin=(0.0, 0.0, 415.0)), SphereDesign(radius=25.0, origin=(0.0, 0.0, 408.0))),
        motion=MotionDesign(
            "linear", frames=frames, direction=(0.0, 1.0, 0.0), step=60.0 / frames, start=-30.0
        ),
    )  # fmt: skip


def session(folder: Path, sequence: Sequence, *, frames: int, scale: float = 1.0, seed: int = 1) -> tuple[Path, Path]:
    """Write a session of two lasers beside the renderings, made where they are not yet; returns its two files."""
    for name, side, k in zip(NAMES, (-180.0, 180.0), (0, 1), strict=True):
        if not (folder / name).exists():
            simulate(design(side, frames, scale), folder / name, np.random.default_rng(seed + k))
    out = folder / sequence
    out.mkdir()
    planes = sorted(path.name for path in (folder / "red").glob("w*-laser"))
    for plane in planes:
        for k, name in enumerate(NAMES):
            for path in (folder / name / plane).glob("*.png"):
                image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
                _write(out / f"{plane}-{name}" / path.name, _coloured(image, k) if sequence == "together" else image)
    for path in sorted((folder / "red" / "frames").glob("*.png")):
        pair = [cv2.imread(str(folder / name / "frames" / path.name), cv2.IMREAD_UNCHANGED) for name in NAMES]
        both = cv2.add(_coloured(pair[0], 0), _coloured(pair[1], 1))
        _write(out / "frames" / path.name, both if sequence == "together" else pair[int(path.stem) % 2])
    text = (folder / "red" / "calibration.toml").read_text()
    start = text.index("[laser]")
    planes_text = text[text.index("[[plane]]") :]
    for plane in planes:
        stem = plane.removesuffix("-laser")
        table = ", ".join(f'{name} = "{plane}-{name}/*.png"' for name in NAMES)
        planes_text = planes_text.replace(f'laser = "{plane}/*.png"', f"laser = {{{table}}}")
        planes_text = planes_text.replace(f'images = "{stem}/*.png"', f'images = "../red/{stem}/*.png"')
    lasers = "".join(
        f"[laser.{name}]\norigin = [0.0, {side}, 5.0]\n\n" for name, side in zip(NAMES, (-180.0, 180.0), strict=True)
    )
    (out / "calibration.toml").write_text(text[:start] + lasers + planes_text)
    capture = (folder / "red" / "capture.toml").read_text()
    capture = capture.replace("[motion]", f'sequence = "{sequence}"\n\n[motion]')
    (out / "capture.toml").write_text(capture)
    return out / "calibration.toml", out / "capture.toml"


def _coloured(image: np.ndarray, laser: int) -> np.ndarray:
    """BGR image of a grey one in red (0) or green (1) light, with the bleeding of a Bayer sensor."""
    faint = np.rint(image * BLEED).astype(image.dtype)
    return np.dstack([faint, faint, image] if laser == 0 else [faint, image, faint])


def _write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), image)


def main() -> None:
    print("| two lasers | cells | apart, mean mm | rms mm | expected rms mm | cells beyond 3 sigma |")
    print("| --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        for sequence in ("cycle", "together"):
            calibration, capture = session(Path(name), sequence, frames=60)
            (pair,) = run_scan(capture, calibrate(calibration).rig).agreement
            print(
                f"| {sequence} | {pair.cells} | {pair.mean_mm:+.4f} | {pair.rms_mm:.4f} | {pair.sigma_mm:.4f} | "
                f"{100 * pair.beyond:.1f} % |",
                flush=True,
            )


if __name__ == "__main__":
    main()
