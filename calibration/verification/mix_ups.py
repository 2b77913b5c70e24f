"""Whole planes mixed up: images exchanged or used twice, grids labelled mirrored or turned.

Such mistakes move marks by many pixels, so that coarse fits tell them, before anything finer is asked of the planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from calibration.geometry import Array
from calibration.rays import Domain, PlaneMarks, depth_frame, polynomial

_ALIKE = 3e-3  # of the scale of the image: changes of less over the stand-offs tell no direction
_STILL = 0.05  # of the movement that the stand-offs let expect: less, and it is the same view


@dataclass(frozen=True, slots=True)
class MixUp:
    """One plane, or two, that are not what they are said to be."""

    kind: Literal["swapped", "repeated", "labelling", "reversed"]
    plane: str
    other: str  # whose images it has instead of its own, or repeats
    what: str  # of a labelling: "mirrored left to right", "turned by 90 degrees"
    suspects: tuple[str, ...]  # planes that could as well be the wrong one


def find_mix_ups(planes: Sequence[PlaneMarks]) -> tuple[MixUp, ...]:
    """Mix-ups of whole planes, in the order of the planes; empty where there are none.

    Repeated images show by marks that do not move between two stand-offs; wrong labels by a plane whose map from image
    to space has another handedness or orientation than most; exchanged images by a coarse field of rays that fits far
    better when planes change places, and about as well as any field that leaves one plane out. Stand-offs that all grow
    towards a camera which sees the target unmirrored ("reversed") leave no residual, but would mirror all that is ranged.
    """
    c_from_d = depth_frame(list(planes))
    found = _repeated(planes, c_from_d) + _labelled(planes, c_from_d)
    wrong = {m.plane for m in found}
    good = [p for p in planes if p.name not in wrong]
    found += _swapped(good, c_from_d)
    if not any(m.kind == "swapped" for m in found) and len(good) >= 2 and not _seen_from_the_front(good, c_from_d):
        if len(planes) == 2:
            found += [MixUp("swapped", a.name, b.name, "", ()) for a, b in (good, good[::-1])]
        else:
            found.append(MixUp("reversed", good[0].name, good[-1].name, "", ()))
    return tuple(found)


def untangle(planes: Sequence[PlaneMarks], mixed: Sequence[MixUp]) -> tuple[PlaneMarks, ...]:
    """The planes as they should have been: exchanged ones put back, repeated and mislabelled ones left out."""
    by_name = {p.name: p for p in planes}
    left_out = {m.plane for m in mixed if m.kind in {"repeated", "labelling"}}
    partner = {m.plane: m.other for m in mixed if m.kind == "swapped"}
    return tuple(
        replace(by_name[partner.get(p.name, p.name)], name=p.name, c_from_plane=p.c_from_plane)
        for p in planes
        if p.name not in left_out
    )


def _repeated(planes: Sequence[PlaneMarks], c_from_d: Array) -> list[MixUp]:
    depth = np.array([(p.world @ c_from_d[:, 2]).mean() for p in planes])
    movement: dict[tuple[int, int], float] = {}
    for i, j in combinations(range(len(planes)), 2):
        _, a, b = np.intersect1d(planes[i].mark, planes[j].mark, return_indices=True)
        if len(a) >= 4 and depth[i] != depth[j]:
            away = planes[i].pixels[a] - planes[j].pixels[b]
            movement[i, j] = float(np.sqrt((away**2).sum(axis=1).mean()))
    if not movement:
        return []
    rate = float(np.median([m / abs(depth[i] - depth[j]) for (i, j), m in movement.items()]))
    found: list[MixUp] = []
    for (i, j), moved in movement.items():
        expected = rate * abs(float(depth[i] - depth[j]))
        same = moved < _STILL * expected and expected > 1.0 if len(planes) > 2 else moved < 1e-6
        if same and not {planes[i].name, planes[j].name} & {m.plane for m in found}:
            misfit = [coarse_misfit([p for n, p in enumerate(planes) if n != k], c_from_d) for k in (i, j)]
            wrong, right = (i, j) if misfit[0] < misfit[1] else (j, i)
            clear = len(planes) > 3 and max(misfit) > 2 * min(misfit)
            suspects = () if clear else (planes[right].name,)
            found.append(MixUp("repeated", planes[wrong].name, planes[right].name, "", suspects))
    return found


def _labelled(planes: Sequence[PlaneMarks], c_from_d: Array) -> list[MixUp]:
    """Planes whose map from image to space is mirrored or turned against the others'."""
    maps = []
    for p in planes:
        linear = _linear_map(p, c_from_d)
        maps.append(linear / np.sqrt(max(abs(float(np.linalg.det(linear))), 1e-300)))
    hands = np.array([np.sign(np.linalg.det(m)) for m in maps])
    tie = bool(hands.sum() == 0)
    usual = hands[0] if tie else np.sign(hands.sum())
    alike = [m for m, h in zip(maps, hands, strict=True) if h == usual]
    typical = min(alike, key=lambda m: sum(float(np.linalg.norm(m - other)) for other in alike))
    found = []
    for k, p in enumerate(planes):
        change = maps[k] @ np.linalg.inv(typical)
        left, _, right = np.linalg.svd(change)
        turn = left @ right
        what = _symmetry(turn)
        if what:
            others = tuple(q.name for q, h in zip(planes, hands, strict=True) if h == usual) if tie else ()
            if len(planes) == 2:
                others = (planes[1 - k].name,)
            found.append(MixUp("labelling", p.name, "", what, others))
    return found[:1] if len(planes) == 2 else found


def _symmetry(turn: Array) -> str:
    """Name of the symmetry of the square nearest to an orthogonal matrix (2, 2); empty for the identity."""
    angle = float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))
    quarter = round(angle / 90.0) % 4
    if np.linalg.det(turn) > 0:
        return f"turned by {90 * quarter} degrees" if quarter else ""
    return (
        "mirrored top to bottom",
        "mirrored about a diagonal",
        "mirrored left to right",
        "mirrored about a diagonal",
    )[quarter]


def _swapped(planes: Sequence[PlaneMarks], c_from_d: Array) -> list[MixUp]:
    if len(planes) < 3:
        return []
    stated = coarse_misfit(planes, c_from_d)
    if stated < 0.3:
        return []
    tried = []
    for order in _orders(planes, c_from_d):
        changed = [replace(planes[j], c_from_plane=p.c_from_plane) for p, j in zip(planes, order, strict=True)]
        moved = sum(k != j for k, j in enumerate(order))
        tried.append((not _seen_from_the_front(changed, c_from_d), coarse_misfit(changed, c_from_d), moved, order))
    best = min(misfit for _, misfit, _, _ in tried)
    without = min(coarse_misfit([p for n, p in enumerate(planes) if n != k], c_from_d) for k in range(len(planes)))
    # two planes always fit: with three, one that is somewhere else altogether is no rival to an exchange that fits exactly
    if best > stated / 3.0 or best > (1.5 * without if len(planes) > 3 else stated / 20.0):
        return []
    # Four evenly spaced planes look alike in reverse order; a camera that sees them unmirrored decides.
    order = min((back, moved, misfit, order) for back, misfit, moved, order in tried if misfit <= 1.5 * best)[3]
    return [MixUp("swapped", planes[k].name, planes[j].name, "", ()) for k, j in enumerate(order) if k != j]


def _orders(planes: Sequence[PlaneMarks], c_from_d: Array) -> set[tuple[int, ...]]:
    """Which plane's images each plane may have instead: every exchange of two, and all of them in the order of their size.

    Before one camera the scale of the image, mm/px, grows steadily with depth, whatever the images were mixed up.
    """
    n = len(planes)
    found = set()
    for i, j in combinations(range(n), 2):
        order = list(range(n))
        order[i], order[j] = j, i
        found.add(tuple(order))
    depth = np.array([(p.world @ c_from_d[:, 2]).mean() for p in planes])
    scale = np.array([abs(float(np.linalg.det(_linear_map(p, c_from_d)))) for p in planes])
    for by_size in (np.argsort(scale), np.argsort(-scale)):
        sorted_order = np.empty(n, dtype=np.int64)
        sorted_order[np.argsort(depth)] = by_size
        found.add(tuple(sorted_order.tolist()))
    return found - {tuple(range(n))}


def _seen_from_the_front(planes: Sequence[PlaneMarks], c_from_d: Array) -> bool:
    """Whether a camera that does not mirror can see the target as the planes say: nearer planes look larger.

    True too where the planes look too much alike to tell.
    """
    depth = np.array([(p.world @ c_from_d[:, 2]).mean() for p in planes])
    maps = [_linear_map(p, c_from_d) for p in planes]
    size = np.sqrt(np.abs([float(np.linalg.det(m)) for m in maps]))  # mm/px, growing away from the camera
    slope = float(np.polyfit(depth - depth.mean(), size, 1)[0])
    if abs(slope) * np.ptp(depth) < _ALIKE * size.mean():
        return True
    return bool(slope * float(np.linalg.det(maps[0])) > 0)


def _linear_map(marks: PlaneMarks, c_from_d: Array) -> Array:
    """Linear part (2, 2) mm/px of the map from the image to space, across depth."""
    a = np.column_stack([marks.pixels - marks.pixels.mean(axis=0), np.ones(len(marks))])
    return np.asarray(np.linalg.lstsq(a, (marks.world @ c_from_d)[:, :2], rcond=None)[0][:2].T)


def coarse_misfit(planes: Sequence[PlaneMarks], c_from_d: Array) -> float:
    """Root mean square residual, px, of a coarse field of rays: cubic in the pixel."""
    pixels = np.concatenate([p.pixels for p in planes])
    world = np.concatenate([p.world for p in planes]) @ c_from_d
    square = Domain.around(pixels).square(pixels)
    lever = (world[:, 2] - world[:, 2].mean()) / max(float(np.ptp(world[:, 2])), 1e-12)
    cubic = polynomial.design(square, 3)
    rows = np.hstack([cubic * lever[:, None], cubic])
    coefficients = np.linalg.lstsq(rows, world[:, :2], rcond=1e-9)[0]
    rest = world[:, :2] - rows @ coefficients
    extent = np.prod(np.maximum(np.ptp(world[:, :2], axis=0), 1e-12)) / np.prod(np.maximum(np.ptp(pixels, axis=0), 1.0))
    return float(np.sqrt((rest**2).sum(axis=1).mean() / extent))
