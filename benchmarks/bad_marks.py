"""Bad marks left out of the rays, beside OpenCV: ``python -m benchmarks.bad_marks [draws]``.

Marks of five planes by the independent witness (as in `benchmarks.rays`), of which a share is moved by 5 px in random
directions. The figure is the median error of the rays between the planes over that of the same marks without the bad ones moved.
OpenCV's calibrateCamera gets the same marks. Then a lens of 110 degrees without any bad mark, and with them.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from benchmarks.rays import SIZE, OpenCv, camera, ray_error, session
from benchmarks.shared import head, row
from calibration.geometry import Array, Pose, Rays
from calibration.rays import PlaneMarks, find_bad_marks, fit_two_plane
from calibration.verification import find_faults
from scope.simulation.optics import exact_rays

BAD_PX = 5.0


def spoilt(
    planes: list[PlaneMarks], share: float, rng: np.random.Generator, px: float = BAD_PX
) -> tuple[list[PlaneMarks], list[Array]]:
    """The planes with a share of the marks of each moved, and which (rows)."""
    found, rows = [], []
    for marks in planes:
        bad = rng.choice(len(marks), round(share * len(marks)), replace=False)
        angle = rng.uniform(0, 2 * np.pi, len(bad))
        pixels = marks.pixels.copy()
        pixels[bad] += px * np.column_stack([np.cos(angle), np.sin(angle)])
        found.append(replace(marks, pixels=pixels))
        rows.append(bad)
    return found, rows


def good(planes: list[PlaneMarks]) -> tuple[list[PlaneMarks], list[Array]]:
    """The planes without the marks that `find_bad_marks` names, as the calibration takes them, and those rows."""
    bad = [find_bad_marks(m) for m in planes]
    return [m.select(~b.rows) for m, b in zip(planes, bad, strict=True)], [np.flatnonzero(b.rows) for b in bad]


def five_planes(draws: int) -> None:
    """The issue's row: 1 % and 5 % of 475 marks a plane."""
    u, v = np.meshgrid(np.linspace(60, 1220, 40), np.linspace(60, 900, 30))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    exact = camera(None)
    truth = exact_rays(exact, pixels)

    def error(rays: Rays) -> float:
        return 1000 * float(np.median(ray_error(rays, truth)))

    head(
        "bad marks of 5 px, five planes",
        "ray error, um: clean; spoilt",
        "ratio",
        "reach",
        "OpenCV ratio",
        "found; false",
    )
    for share, reach in ((0.01, 1.3), (0.05, 1.6)):
        ours, theirs, ratios, cv_ratios, found, false = [], [], [], [], 0, 0
        for seed in range(draws):
            clean = session(exact, np.random.default_rng(seed))
            bad, rows = spoilt(clean, share, np.random.default_rng([seed, 1]))
            kept, named = good(bad)
            ours.append(error(fit_two_plane(clean, SIZE).camera.rays(pixels)))
            theirs.append(error(fit_two_plane(kept, SIZE).camera.rays(pixels)))
            ratios.append(theirs[-1] / ours[-1])
            cv_ratios.append(error(OpenCv.fit(bad, 0).rays(pixels)) / error(OpenCv.fit(clean, 0).rays(pixels)))
            found += sum(len(set(a) & set(b)) for a, b in zip(rows, named, strict=True))
            false += sum(len(set(b) - set(a)) for a, b in zip(rows, named, strict=True))
        total = draws * 5 * round(share * 475)
        row(
            f"{100 * share:.0f} % of the marks, {draws} sessions",
            f"{np.median(ours):.2f}; {np.median(theirs):.2f}",
            f"{np.median(ratios):.2f}",
            f"<= {reach}",
            f"{np.median(cv_ratios):.0f}",
            f"{found} of {total}; {false}",
        )


LENSES = {
    "equidistant": lambda r: np.arctan(r) / r,
    "k1 = -0.10, k2 = 0.006": lambda r: 1 - 0.10 * r**2 + 0.006 * r**4,
}


def wide(lens: str, rng: np.random.Generator) -> list[PlaneMarks]:
    """Marks on five planes before a lens of 110 degrees across, in closed form."""
    pitch = 2 * 200.0 * np.tan(np.deg2rad(55.0)) / 24
    flat = np.stack(np.meshgrid(np.arange(25) * pitch, np.arange(19) * pitch), axis=-1).reshape(-1, 2)
    middle, edge = flat.mean(axis=0), float(np.tan(np.deg2rad(55.0)))
    focal = 640.0 / (edge * float(LENSES[lens](edge)))
    planes = []
    for z in (100.0, 125.0, 150.0, 175.0, 200.0):
        slope = (flat - middle) / z
        length = np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
        pixels = focal * slope * LENSES[lens](length) + [655.0, 470.0] + 0.02 * rng.standard_normal(slope.shape)
        inside = ((pixels > 5) & (pixels < np.array(SIZE) - 6)).all(axis=1)
        unknown = np.full((int(inside.sum()), 2, 2), np.nan)
        pose = Pose(np.eye(3), np.array([-middle[0], -middle[1], z]))
        planes.append(PlaneMarks(f"w{z:.0f}", pixels[inside], flat[inside], pose, np.flatnonzero(inside), unknown))
    return planes


def wide_lens(draws: int) -> None:
    """Nobody is blamed for what the polynomial cannot follow."""
    head("a lens of 110 degrees", "marks named without a bad one", "5 px, 3 %: found; false")
    for lens in LENSES:
        blamed = found = false = total = 0
        for seed in range(draws):
            clean = wide(lens, np.random.default_rng(seed))
            blamed += sum(len(rows) for rows in good(clean)[1]) + len(find_faults(clean))
            bad, rows = spoilt(clean, 0.03, np.random.default_rng([seed, 1]))
            named = good(bad)[1]
            found += sum(len(set(a) & set(b)) for a, b in zip(rows, named, strict=True))
            false += sum(len(set(b) - set(a)) for a, b in zip(rows, named, strict=True))
            total += sum(map(len, rows))
        row(f"{lens}, {draws} sessions", str(blamed), f"{found} of {total}; {false}")


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 6
    five_planes(draws)
    print()
    wide_lens(draws)


if __name__ == "__main__":
    main()
