"""Labels of simulated views of spot grids: ``python -m benchmarks.labelling [sets [rendered views]]``.

A pinhole with barrel distortion, which shares no code with what it tests, sees a grid of random rows, columns, pitch
and fiducials from a random pose: any rotation, tilts to 45 degrees, as it is or mirrored, whole or cut by the border of
the image. Up to 30 % of the spots are missing, some spots are dirt, centroids and diameters are noisy. A set is wrong
as soon as one spot carries a label that is not its own, or is called mirrored when it is not; a refusal is not wrong.

The rendered views go the whole way, from an image of the simulator (`scope.simulation.session`) to labels: light or dark spots,
uneven light, dirt, any rotation, tilts to 45 degrees, mirrored or not, up to 30 % of the spots missing.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.targets import SpotGrid, find_spots, label_grid
from calibration.targets.spots import Spots
from scope.simulation.hardware_design import CameraDesign, FaultDesign, JigDesign, LaserDesign
from scope.simulation.optics import project as exact_project
from scope.simulation.rig_design import RigDesign
from scope.simulation.virtual_rig import VirtualRig

Array = NDArray[np.float64]
SIZE = (1280, 960)


@dataclass(frozen=True)
class View:
    """One simulated view, with its truth."""

    target: SpotGrid
    spots: Spots
    mark: NDArray[np.int64]  # (N,) true mark of every spot, -1 for dirt
    mirrored: bool
    fiducials: int  # fiducials that are among the spots


def camera(rng: np.random.Generator) -> tuple[float, Array, tuple[float, float]]:
    """Focal length, principal point and barrel distortion."""
    return (
        rng.uniform(950, 2000),
        np.array(SIZE) / 2 + rng.uniform(-30, 30, 2),
        (rng.uniform(-0.35, 0.0), rng.uniform(0, 0.06)),
    )


def project(points: Array, focal: float, centre: Array, lens: tuple[float, float]) -> Array:
    """Pixels of points (N, 3) in front of the camera, NaN beyond where the lens is monotonic."""
    x = points[:, :2] / points[:, 2:]
    r2 = (x**2).sum(axis=1, keepdims=True)
    out = centre + focal * x * (1 + lens[0] * r2 + lens[1] * r2**2)
    fold = 1 + 3 * lens[0] * r2[:, 0] + 5 * lens[1] * r2[:, 0] ** 2
    out[(fold < 0.4) | (points[:, 2] <= 0)] = np.nan
    return np.asarray(out)


def view(
    rng: np.random.Generator, *, fiducials: bool = True, lose_fiducials: bool = False, max_missing: float = 0.3
) -> View:
    """One view within the limits: at least 6 x 6 cells' worth of spots and, if asked, all fiducials in the image."""
    while True:
        rows, columns = int(rng.integers(9, 21)), int(rng.integers(9, 27))
        if rows == columns and not fiducials:
            continue
        pitch = (12.0, 12.0 * float(rng.choice([1.0, 1.0, 1.0, 0.8, 1.25])))
        marks: tuple[tuple[int, int], ...] = ()
        ratio = float(rng.uniform(1.3, 1.8))
        if fiducials:
            row, column = int(rng.integers(3, rows - 3)), int(rng.integers(3, columns - 3))
            marks = ((row, column), (row, column + 2), (row - 3, column))
        diameter = float(rng.uniform(0.25, 0.42)) * min(pitch)
        target = SpotGrid(rows, columns, pitch, diameter, "light", marks, ratio * diameter if fiducials else None)
        focal, centre, lens = camera(rng)
        spin, tilt, toward = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(0, 45)), rng.uniform(-np.pi, np.pi)
        if not fiducials:
            # (0, 0) is the corner nearest to the top left: within 25 degrees of upright nobody disputes which that is
            spin = np.radians(rng.uniform(-25, 25))
        axis = np.array([np.cos(toward), np.sin(toward), 0.0])
        k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        lean = np.eye(3) + np.sin(tilt) * k + (1 - np.cos(tilt)) * k @ k
        turn = np.array([[np.cos(spin), -np.sin(spin), 0], [np.sin(spin), np.cos(spin), 0], [0, 0, 1]])
        mirrored = bool(fiducials and rng.random() < 0.5)
        flip = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0])
        rotation = lean @ turn @ flip
        extent = np.hypot((columns - 1) * pitch[0], (rows - 1) * pitch[1])
        fill = rng.uniform(0.5, 1.6) if fiducials else rng.uniform(0.5, 0.9)
        depth = focal * extent / (fill * np.hypot(*SIZE))
        middle = target.marks.mean(axis=0) + (rng.uniform(-0.2, 0.2, 3) * extent if fiducials else 0.0) * np.array(
            [1, 1, 0]
        )
        place = (target.marks - middle) @ rotation.T + np.array([0, 0, depth])
        if place[:, 2].min() < 0.3 * depth:
            continue
        pixels = project(place, focal, centre, lens)
        step = 1e-3
        right = project(
            (target.marks + np.array([step, 0, 0]) - middle) @ rotation.T + np.array([0, 0, depth]), focal, centre, lens
        )
        down = project(
            (target.marks + np.array([0, step, 0]) - middle) @ rotation.T + np.array([0, 0, depth]), focal, centre, lens
        )
        a, b = (right - pixels) / step, (down - pixels) / step
        scale = np.sqrt(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))  # px a mm
        size = np.full(len(pixels), diameter)
        number = np.array([r * columns + c for r, c in marks], dtype=int)
        size[number] = diameter * ratio
        size = size * scale
        with np.errstate(invalid="ignore"):
            seen = (pixels > size[:, None]).all(axis=1) & (pixels < np.array(SIZE) - size[:, None]).all(axis=1)
        if seen.sum() < 36 or (not fiducials and not seen.all()) or (fiducials and not seen[number].all()):
            continue
        if size[seen].min() < 4.0:
            continue
        lost = rng.random(len(pixels)) < rng.uniform(0, max_missing)
        if not lose_fiducials:
            lost[number] = False
        if not fiducials:
            index = np.arange(len(pixels))
            border = [
                index % columns == 0,
                index % columns == columns - 1,
                index < columns,
                index >= len(index) - columns,
            ]
            if any((~lost[edge]).sum() == 0 for edge in border):
                continue
        seen &= ~lost
        good = np.flatnonzero(seen)
        dirt = int(rng.integers(0, 1 + max(1, len(good) // 25)))
        where = np.concatenate(
            [pixels[good] + rng.normal(0, 0.05, (len(good), 2)), rng.uniform((0, 0), SIZE, (dirt, 2))]
        )
        wide = np.concatenate(
            [size[good] * (1 + rng.normal(0, 0.015, len(good))), rng.uniform(0.5, 1.5, dirt) * np.median(size[good])]
        )
        truth = np.concatenate([good, np.full(dirt, -1)])
        # dirt on a spot makes one mark, not two
        gap = (
            np.linalg.norm(where[:, None] - where[None, len(good) :], axis=2)
            if dirt
            else np.full((len(where), 1), np.inf)
        )
        clear = np.ones(len(where), dtype=bool)
        for d in range(dirt):
            close = gap[:, d] < wide[len(good) + d]
            close[len(good) + d] = False
            clear[len(good) + d] &= not close.any()
        order = rng.permutation(np.flatnonzero(clear))
        n = len(order)
        spots = Spots(
            where[order],
            np.tile(np.eye(2) * 0.0025, (n, 1, 1)),
            wide[order],
            np.full(n, 100.0),
            np.full(n, 1.0),
            np.zeros(n),
        )
        return View(target, spots, truth[order], mirrored, int(seen[number].sum()) if fiducials else 0)


def judge(seen: View, size: tuple[int, int] = SIZE) -> str:
    """What became of a view: "labelled", "wrong", "dirt labelled" or the first words of the refusal."""
    try:
        labels = label_grid(seen.spots, seen.target, image_size=size)
    except CalibrationError as error:
        return "refused: " + str(error)[:40]
    given = labels.labelled
    if (
        labels.mirrored != seen.mirrored
        or (labels.mark[given & (seen.mark >= 0)] != seen.mark[given & (seen.mark >= 0)]).any()
    ):
        return "wrong"
    if (given & (seen.mark < 0)).any():
        return "dirt taken for a mark"
    if given[seen.mark >= 0].mean() < 0.9:
        return "labelled less than 90 % of the spots"
    return "labelled"


def rendered(rng: np.random.Generator) -> View:
    """A view from an image: its spots as they were found, and what each of them is."""
    size = (800, 600)
    while True:
        rows, columns = int(rng.integers(9, 15)), int(rng.integers(9, 17))
        row, column = int(rng.integers(3, rows - 3)), int(rng.integers(3, columns - 3))
        marks = ((row, column), (row, column + 2), (row - 3, column))
        pitch, diameter = 12.0, float(rng.uniform(4.2, 5.5))
        spin, tilt, toward = rng.uniform(-180, 180), np.radians(rng.uniform(0, 45)), rng.uniform(-np.pi, np.pi)
        lean = cv2.Rodrigues(tilt * np.array([np.cos(toward), np.sin(toward), 0.0]))[0]
        turn = cv2.Rodrigues(np.radians([0.0, 0.0, spin]))[0]
        vector = np.degrees(cv2.Rodrigues(lean @ turn)[0].ravel())
        extent = float(np.hypot((columns - 1) * pitch, (rows - 1) * pitch))
        depth = 900.0 * extent / (rng.uniform(0.55, 0.95) * float(np.hypot(*size)))
        cells = [(r, c) for r in range(rows) for c in range(columns) if (r, c) not in marks]
        lost = rng.permutation(len(cells))[: int(rng.uniform(0, 0.3) * len(cells))]
        polarity = "light" if rng.random() < 0.5 else "dark"
        design = RigDesign(
            CameraDesign(size, 900.0, (400.0, 300.0), distortion=(float(rng.uniform(-0.35, 0.0)), 0.05, 0.0, 0.0, 0.0)),
            LaserDesign((-160.0, 0.0, 0.0), (0.0, 0.0, depth)),
            JigDesign(
                (depth,), rows, columns, pitch, diameter, polarity=polarity, fiducials=marks,  # type: ignore[arg-type]
                fiducial_diameter=diameter * float(rng.uniform(1.4, 1.7)), rotation=tuple(map(float, vector)),
                uneven=float(rng.uniform(0, 0.5)),
            ),
            faults=(FaultDesign(f"w{depth:g}", missing=tuple(cells[k] for k in lost), dirt=int(rng.integers(0, 4))),),
        )  # fmt: skip
        rig = VirtualRig.of(design)
        image = rig.target_images(0, 1, rng)[0]
        r, c = np.mgrid[0:rows, 0:columns]
        flat = np.column_stack([c.ravel() * pitch, r.ravel() * pitch, np.zeros(rows * columns)])
        truth = exact_project(rig.camera, rig.actual[0].apply(flat))
        whole = (truth > 12).all(axis=1) & (truth < np.array(size) - 13).all(axis=1)
        number = [r * columns + c for r, c in marks]
        if not whole[number].all() or whole.sum() < 36:
            continue
        mirrored = bool(rng.random() < 0.5)
        if mirrored:
            image, truth = np.ascontiguousarray(image[:, ::-1]), truth * [-1, 1] + [size[0] - 1, 0]
        spots = find_spots(image, polarity=polarity)  # type: ignore[arg-type]
        truth[[rr * columns + cc for rr, cc in (cells[k] for k in lost)]] = np.inf
        gap = np.linalg.norm(spots.centroids[:, None] - truth[None], axis=2)
        mark = np.where(gap.min(axis=1) < 2.0, gap.argmin(axis=1), -1)
        target = SpotGrid(rows, columns, (pitch, pitch), diameter, polarity, marks, design.jig.fiducial_diameter)  # type: ignore[arg-type]
        return View(target, spots, mark, mirrored, 3)


def main() -> None:
    sets = int(sys.argv[1]) if len(sys.argv) > 1 else 10000
    kinds = (
        ("all fiducials seen, any rotation, mirrored or not, partial views", {}, sets),
        ("no fiducials, whole grid in view", {"fiducials": False}, sets // 10),
        ("fiducials may be among the missing", {"lose_fiducials": True}, sets // 10),
    )
    print("| simulated sets | number | wrong | labelled | the rest |")
    print("| --- | --- | --- | --- | --- |")
    for name, options, number in kinds:
        if not number:
            continue
        rng = np.random.default_rng(11)
        count = Counter(judge(view(rng, **options)) for _ in range(number))  # type: ignore[arg-type]
        rest = {k: v for k, v in count.items() if k not in ("labelled", "wrong")}
        print(f"| {name} | {number} | {count['wrong']} | {100 * count['labelled'] / number:.2f} % | {rest or '-'} |")
    views = int(sys.argv[2]) if len(sys.argv) > 2 else 200
    rng = np.random.default_rng(12)
    count = Counter(judge(rendered(rng), (800, 600)) for _ in range(views))
    rest = {k: v for k, v in count.items() if k not in ("labelled", "wrong")}
    share = 100 * count["labelled"] / max(views, 1)
    print(f"| rendered images | {views} | {count['wrong']} | {share:.2f} % | {rest or '-'} |")


if __name__ == "__main__":
    main()
