"""The analyses themselves: python -m benchmarks.analyses [numerics | uncertainty | piv | time].

``numerics``: the paper's two numerical findings, and its best line beside that of the singular value decomposition.
``uncertainty``: the closed form of the rays' uncertainty against Monte Carlo. ``piv``: each plane of piv-e left out, over
OpenCV fed the same points. ``time``: a whole calibration over the mere decoding of its images, CPU time in one process.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from benchmarks.rays import SIZE, OpenCv, camera, session
from benchmarks.shared import SHARED, head, require, row
from calibration.geometry import Array
from calibration.rays import PlaneMarks, fit_plane_map, fit_ray_field, fit_two_plane, normal_equations, ray_uncertainty
from calibration.rays.two_plane import with_model
from calibration.verification import held_out, interplane
from scope.simulation.optics import Window

DRAWS = 600
GRID = (9, 12)
MODELS: tuple[Literal["joint", "two-plane"], ...] = ("joint", "two-plane")


def _seen(name: str) -> list[PlaneMarks]:
    from scope.calibrating.marks import measure_plane
    from scope.session import read_calibration

    plan = read_calibration(require(name) / "calibration.toml")
    return [measure_plane(plan, plane).marks for plane in plan.planes]


def numerics() -> None:
    """Conditioning of equation 4 by coordinates and basis, and equation 7 against the best line."""
    simulated = session(camera(None), np.random.default_rng(0))
    sets = {"simulated, 475 spots": simulated}
    if SHARED.is_dir():
        sets |= {"twin-a": _seen("twin-a"), "piv-e": _seen("piv-e")}
    head(
        "the paper's 11 terms",
        "coordinates",
        "orders of magnitude in P'P",
        "condition",
        "likest columns",
        "error of LU, mm",
        "in single precision, mm",
    )
    for name, planes in sets.items():
        for coordinates, text in (
            ("pixels", "raw pixels"),
            ("unit", "(0, 1), origin in a corner"),
            ("centred", "(-1, 1), origin in the centre"),
            ("chebyshev", "Chebyshev products, by LU as well"),
        ):
            _, c = normal_equations(planes[0], coordinates=coordinates)  # type: ignore[arg-type]
            row(
                name,
                text,
                f"{c.span:.1f}",
                f"{c.condition:.1e}",
                f"{c.dependence:.3f}",
                f"{c.error:.1e}",
                f"{c.error_single:.1e}",
            )
    print()
    head("best line of a pixel's points", "largest angle between equation 7 and the decomposition, rad", "limit")
    for name, planes in sets.items():
        size = SIZE if name.startswith("sim") else (1024, 768) if name == "twin-a" else (1024, 1024)
        row(name, f"{interplane(fit_two_plane(planes, size).camera).disagreement:.1e}", "agree: < 1e-6")


def uncertainty() -> None:
    """Scatter of the rays over many sessions, over what each session says of itself."""
    head(f"scatter of the rays over their stated sigma, {DRAWS} sessions", "rays", "rms ratio", "worst pixel", "limit")
    tilted = Window.tilted(10.0, 1.52, (np.deg2rad(20.0), np.deg2rad(10.0)), 60.0)
    for scene, window in (("bare lens", None), ("behind a tilted pane", tilted)):
        exact = camera(window)
        at: dict[str, list[Array]] = {"joint": [], "two-plane": []}
        stated: dict[str, list[Array]] = {"joint": [], "two-plane": []}
        first = fit_two_plane(session(exact, np.random.default_rng(0)), SIZE, order=6).camera
        orders = (first.field.slope_order, first.field.origin_order)
        for seed in range(DRAWS):
            planes = session(exact, np.random.default_rng(seed))  # by depth, as the camera's maps are
            maps = tuple(fit_plane_map(p, order=6).map for p in planes)
            again = replace(first, maps=maps, field=fit_ray_field(planes, orders=orders).field)
            for model in MODELS:
                seen = with_model(again, model)
                (view,) = ray_uncertainty(seen, [380.0], grid=GRID)
                near = None if model == "joint" else 380.0
                at[model].append(seen.rays(view.pixels.reshape(-1, 2), near=near).at_depth(380.0)[:, :2])
                stated[model].append(view.sigma_mm.ravel())
        for name, points in at.items():
            stack, sigma = np.array(points), np.array(stated[name])
            known = np.isfinite(sigma).all(axis=0)
            scatter = np.sqrt(((stack - stack.mean(axis=0)) ** 2).sum(axis=(0, 2)) / (2 * (len(stack) - 1)))
            ratio = (scatter / np.sqrt((sigma**2).mean(axis=0)))[known]
            worst = ratio[np.abs(ratio - 1).argmax()]
            row(scene, name, f"{np.sqrt((ratio**2).mean()):.3f}", f"{worst:.3f}", "0.90 to 1.10")


def piv() -> None:
    """Each plane of piv-e left out: SCOPE over OpenCV."""
    planes = _seen("piv-e")
    size = (1024, 1024)
    head("piv-e, rays on the plane left out, rms px", "SCOPE", "OpenCV, 5 coefficients", "ratio", "limit")
    found = held_out(fit_two_plane(planes, size))
    every: list[tuple[float, float]] = []
    for k, plane in enumerate(planes):
        others = [p for i, p in enumerate(planes) if i != k]
        peer = min(
            (_opencv(others, focal) for focal in (3000.0, 6000.0, 12000.0)), key=lambda fit: _misfit(fit, others)
        )
        own = next(h for h in found if h.name == plane.name)
        theirs = _misfit(peer, [plane])
        every.append((own.rms_px, theirs))
        where = "between others" if own.between else "outermost"
        row(f"{plane.name} ({where})", own.rms_px, theirs, own.rms_px / theirs, "")
    ours, peers = np.sqrt(np.mean(np.square(every), axis=0))
    row("all seven", float(ours), float(peers), float(ours / peers), "<= 1.05")


def _opencv(planes: list[PlaneMarks], focal: float) -> OpenCv:
    return OpenCv.fit(planes, 0, start=np.array([[focal, 0, 512.0], [0, focal, 512.0], [0, 0, 1]]), size=(1024, 1024))


def _misfit(peer: OpenCv, planes: list[PlaneMarks]) -> float:
    """Root mean square of the two-dimensional residual, px."""
    r = cv2.Rodrigues(peer.rotation)[0]
    away = [
        p.pixels - cv2.projectPoints(p.world, r, peer.translation, peer.matrix, peer.distortion)[0][:, 0]
        for p in planes
    ]
    return float(np.sqrt((np.concatenate(away) ** 2).sum(axis=1).mean()))


_DESIGN = """
format = 1
[camera]
size = [1280, 960]
focal_px = 1400.0
centre_px = [655.0, 470.0]
distortion = [-0.18, 0.05, 0.0004, -0.0003, 0.0]
[laser]
origin = [-160.0, 4.0, 6.0]
through = [0.0, 0.0, 400.0]
[jig]
stand_offs = [320, 360, 400, 440, 480]
rows = 19
columns = 25
pitch = 10.0
diameter = 4.0
fiducials = [[9, 12], [9, 14], [6, 12]]
fiducial_diameter = 6.0
images = 4
laser_images = 1
"""


def speed() -> None:
    """Calibration of 5 planes x 4 images of 475 spots over decoding the images."""
    from scope.calibrating import calibrate
    from scope.simulation.session import read_design, simulate

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "design.toml").write_text(_DESIGN, encoding="utf-8")
        simulate(read_design(folder / "design.toml"), folder / "s", np.random.default_rng(1), threads=1)
        file = folder / "s" / "calibration.toml"
        lines = file.read_text(encoding="utf-8").splitlines()
        file.write_text("\n".join(line for line in lines if not line.startswith("laser")), encoding="utf-8")
        images = sorted((folder / "s").glob("w???/*.png"))

        def decode() -> None:
            for path in images:
                cv2.imread(str(path), cv2.IMREAD_UNCHANGED)

        whole = _cpu(lambda: calibrate(file))
        mere = _cpu(decode)
    head(
        "5 planes x 4 images of 1280x960, 475 spots; CPU s, median of 5, warm", "decode", "calibrate", "ratio", "limit"
    )
    row(f"{len(images)} images", mere, whole, whole / mere, "<= 3")


def _cpu(work: Callable[[], object]) -> float:
    work()
    times = []
    for _ in range(5):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return float(np.median(times))


def main() -> None:
    """Print one table, or all."""
    tables = {"numerics": numerics, "uncertainty": uncertainty, "piv": piv, "time": speed}
    for name in sys.argv[1:] or tables:
        tables[name]()
        print()


if __name__ == "__main__":
    main()
