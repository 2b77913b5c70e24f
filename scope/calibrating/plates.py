"""Which light of a laser image lies on the plate that carries the marks.

A sheet of light meets a plane in a straight line. On the plate, therefore, the stripe goes on beyond the marks as the same line;
light on anything else, seen as if it were on the plate's plane, lies off that line, and off the sheet that all views share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.camera import Camera
from calibration.geometry import Array, Bools, Ints, Plane, fit_plane
from calibration.rays import PlaneMarks
from scope.session import Plate

LEAST = 8  # lines from which a stripe is taken for one
_REACH = 0.75  # of the extent of the marks, by which light may lie beyond them
_OFF = 1.0  # px that light of a stripe may lie off its straight line, where its own sigma is less
_GAP = 0.35  # of the extent of the marks, that may lie dark within a stripe
_LINES = 3  # straight stripes that are tried in a view
_DRAWS = 400
_BESIDE = 0.5  # of a vote, that a view has whose stripe lies beside the marks, where there may be no plate
_STILL = 0.8  # of the stripes of a sheet, that may as well keep their pixels as lie on it
_APART = 2.5  # px off the common sheet, beyond which a stripe is not of it
SHALLOWEST = (
    0.02  # sine of the angle between rays and a sheet (1.1 degrees), below which the light may as well stand still
)


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """What was found on the N lines of an image; NaN where a line has none."""

    pixels: Array  # (N, 2)
    sigma: Array  # (N,) px
    width: Array  # (N,) px, one sigma of the profile


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """The light of one laser image, as if all of it lay on the plate's plane."""

    name: str
    pixels: Array  # (n, 2)
    sigma: Array  # (n,) px
    width: Array  # (n,) px, one sigma of the profile
    line: Ints  # (n,) number of the image's line
    points: Array  # (n, 3) mm in C
    direction: Array  # (n, 3) unit, of the sighting rays
    flat: Array  # (n, 2) mm, in the target's frame
    marked: Bools  # (n,) between the marks
    scale: float  # mm a px, at the marks
    extent: float  # mm, the larger side of the marks

    def select(self, keep: Bools | Ints) -> Seen:
        """Return some of the light."""
        return Seen(
            self.name, self.pixels[keep], self.sigma[keep], self.width[keep], self.line[keep], self.points[keep], self.direction[keep], self.flat[keep],
            self.marked[keep], self.scale, self.extent,
        )  # fmt: skip


def seen_on(camera: Camera, marks: PlaneMarks, light: Light) -> Seen:
    """Light, NaN where a line has none, on the plane of the marks and within the calibrated volume."""
    pixels = light.pixels
    line = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    plane = Plane.through(marks.c_from_plane.translation, marks.c_from_plane.rotation[:, 2])
    rays = camera.rays(pixels[line])
    points = plane.intersect(rays).points if len(line) else np.zeros((0, 3))
    hull = cv2.convexHull(marks.pixels.astype(np.float32)).astype(np.float32)
    marked = np.array(
        [cv2.pointPolygonTest(hull, (float(u), float(v)), False) >= 0 for u, v in pixels[line]], dtype=bool
    )
    known = np.isfinite(points).all(axis=1) & (marked | camera.volume.contains(points))
    line, points, direction, marked = line[known], points[known], rays.direction[known], marked[known]
    flat = marks.c_from_plane.inverse.apply(points)[:, :2] if len(points) else np.zeros((0, 2))
    extent = float(np.ptp(marks.points, axis=0).max())
    spread = max(float(np.ptp(marks.pixels, axis=0).max()), 1.0)
    return Seen(
        marks.name,
        pixels[line],
        light.sigma[line],
        light.width[line],
        line,
        points,
        direction,
        flat,
        marked,
        extent / spread,
        extent,
    )


def stripes_on(seen: Seen, marks: PlaneMarks, plate: Plate) -> list[Seen]:
    """Stripes that may lie on the plate, the likeliest first: none where there is no light.

    With ``plate = "marks"`` the light between the marks is the only one, whatever its shape; a rectangle bounds it; "auto"
    gives up to three straight runs near the marks, those between the marks before others.
    """
    if plate == "marks":
        inside = seen.select(seen.marked)
        return [inside] if len(inside.line) else []
    if plate == "auto":
        low, high = marks.points.min(axis=0), marks.points.max(axis=0)
        low, high = low - _REACH * seen.extent, high + _REACH * seen.extent
    else:
        low, high = np.array([plate[0], plate[2]]), np.array([plate[1], plate[3]])
    rest = seen.select(((seen.flat >= low) & (seen.flat <= high)).all(axis=1))
    found: list[Seen] = []
    while len(found) < _LINES and len(rest.line) >= LEAST:
        on = _straight(rest)
        if on.sum() < LEAST:
            break
        run = _unbroken(rest, np.flatnonzero(on))
        if len(run) >= LEAST:
            found.append(rest.select(run))
        rest = rest.select(~on)
    return sorted(found, key=lambda stripe: -(len(stripe.line) + 4 * int(stripe.marked.sum())))


def _straight(seen: Seen) -> Bools:
    """Light on the line (n,) that most of it lies on (RANSAC; Fischler and Bolles 1981), the line then fitted again."""
    rng = np.random.default_rng(11)
    tolerance = np.maximum(_OFF, 3.0 * np.nan_to_num(seen.sigma, nan=1.0)) * seen.scale
    n = len(seen.flat)
    first = rng.integers(0, n, _DRAWS)
    second = (first + rng.integers(1, n, _DRAWS)) % n
    direction = seen.flat[second] - seen.flat[first]
    length = np.linalg.norm(direction, axis=1)
    usable = length > 0.05 * seen.extent
    if not usable.any():
        return np.zeros(n, dtype=bool)
    normal = np.stack([-direction[usable, 1], direction[usable, 0]], axis=1) / length[usable, None]
    offset = (normal * seen.flat[first[usable]]).sum(axis=1)
    weight = 1.0 + seen.marked
    votes = [(weight * (np.abs(seen.flat @ a - b) < tolerance)).sum() for a, b in zip(normal, offset, strict=True)]
    best = int(np.argmax(votes))
    on = np.abs(seen.flat @ normal[best] - offset[best]) < tolerance
    for _ in range(3):
        if on.sum() < LEAST:
            break
        middle = seen.flat[on].mean(axis=0)
        across = np.linalg.svd(seen.flat[on] - middle, full_matrices=False)[2][1]
        on = np.abs((seen.flat - middle) @ across) < tolerance
    return np.asarray(on)


def _unbroken(seen: Seen, chosen: Ints) -> Ints:
    """Those of the chosen that hang together along their line without a long gap: the longest such run."""
    flat = seen.flat[chosen]
    along = (flat - flat.mean(axis=0)) @ np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2][0]
    order = np.argsort(along)
    breaks = np.flatnonzero(np.diff(along[order]) > _GAP * seen.extent) + 1
    run = max(np.split(order, breaks), key=len)
    return np.asarray(np.sort(chosen[run]))


@dataclass(frozen=True, slots=True, eq=False)
class Common:
    """The sheet that most views share."""

    plane: Plane
    chosen: dict[str, Seen]  # by view: the stripe that lies on it
    apart: dict[str, float]  # mm, by view: how far the nearest stripe of a view that has none on it lies off


def common_sheet(views: Sequence[list[Seen]]) -> Common | None:
    """The plane on which the stripes of most views lie, one a view; None where no two views show stripes that span one.

    Pairs of stripes of two views give planes (RANSAC, at random where there are many); a view agrees where both ends of one of
    its stripes lie within 2.5 px of the plane. A view agrees with what most say, so half of the views may show other light.
    Light that keeps its pixels while the target moves (a stripe on the wall behind it, a window frame) spans a plane through the
    camera in which the rays themselves lie: no sheet that anything could be ranged with, so such planes are not counted. A view
    whose stripe lies beside the marks has half a vote: between them there surely is a plate.
    """
    stripes = [(k, stripe) for k, view in enumerate(views) for stripe in view]
    if len(stripes) < 2:
        return None
    owner = np.array([k for k, _ in stripes])
    ends = np.stack([_ends(stripe) for _, stripe in stripes])  # (s, 3, 3): ends and middle
    tolerance = np.array([_APART * stripe.scale for _, stripe in stripes])
    count = np.array([len(stripe.line) for _, stripe in stripes], dtype=np.float64)
    pairs = np.array([(a, b) for a in range(len(stripes)) for b in range(a) if owner[a] != owner[b]])
    if not len(pairs):
        return None
    if len(pairs) > 4 * _DRAWS:
        pairs = np.random.default_rng(5).permutation(pairs)[: 4 * _DRAWS]
    worth = np.array([1.0 if 2 * stripe.marked.sum() >= len(stripe.line) else _BESIDE for _, stripe in stripes])
    best, votes = None, (0.0, 0.0)
    for a, b in pairs:
        plane = _through(ends[a], ends[b])
        if plane is None or max(crossing(plane, stripes[a][1]), crossing(plane, stripes[b][1])) < SHALLOWEST:
            continue
        near = np.abs(ends @ plane.normal - plane.offset).max(axis=1) < tolerance
        of_view = np.zeros(len(views))
        np.maximum.at(of_view, owner[near], worth[near])
        agreeing = (float(of_view.sum()), float(count[near].sum()))
        if agreeing > votes and not _stands_still(ends[near], tolerance[near]):
            best, votes = plane, agreeing
    return None if best is None else _settled(best, views)


def _stands_still(ends: Array, tolerance: Array) -> bool:
    """Whether stripes (s, 3, 3) mm keep their pixels: they lie in a plane through the camera as well as in any other."""
    normal = np.linalg.svd(ends.reshape(-1, 3) / np.linalg.norm(ends.reshape(-1, 3), axis=1)[:, None])[2][2]
    return bool((np.abs(ends @ normal).max(axis=1) < tolerance).mean() > _STILL)


def on_sheet(plane: Plane, views: Sequence[list[Seen]]) -> Common:
    """Of each view the longest stripe on a sheet, or how far its nearest one lies off."""
    chosen: dict[str, Seen] = {}
    apart: dict[str, float] = {}
    for view in views:
        if not view:
            continue
        off = np.array([float(np.median(np.abs(plane.distance(stripe.points)))) for stripe in view])
        near = [stripe for stripe, mm in zip(view, off, strict=True) if mm < _APART * stripe.scale]
        if near:
            longest = max(near, key=lambda stripe: len(stripe.line))
            chosen[longest.name] = longest
        else:
            apart[view[0].name] = float(off.min())
    return Common(plane, chosen, apart)


def _settled(plane: Plane, views: Sequence[list[Seen]]) -> Common:
    """Stripes of views on a plane, fitted to them again."""
    found = on_sheet(plane, views)
    for _ in range(3):
        if len(found.chosen) < 2:
            break
        stripes = found.chosen.values()
        weights = np.concatenate([np.full(len(s.line), 1.0 / len(s.line)) for s in stripes])
        try:
            plane = fit_plane(np.concatenate([s.points for s in stripes]), weights=weights)
        except ValueError:
            break
        found = on_sheet(plane, views)
    return found


def stands_still(views: Sequence[list[Seen]]) -> bool:
    """Whether in most of the views some light keeps its pixels while the target moves."""
    lit = [view for view in views if view]
    if len(lit) < 2:
        return False
    ends = [np.stack([_ends(stripe) for stripe in view]) for view in lit]
    rays = [of / np.linalg.norm(of, axis=2, keepdims=True) for of in ends]
    best = 0
    for view in rays:
        for one in view:
            normal = np.linalg.svd(one)[2][2]
            still = [
                (np.abs(of @ normal).max(axis=1) < [_APART * s.scale for s in stripes]).any()
                for of, stripes in zip(ends, lit, strict=True)
            ]
            best = max(best, sum(still))
    return best > _STILL * len(lit)


def crossing(plane: Plane, stripe: Seen) -> float:
    """Sine of the angle at which the rays of a stripe cross a plane, median."""
    return float(np.median(np.abs(stripe.direction @ plane.normal)))


def _ends(stripe: Seen) -> Array:
    """Ends and middle (3, 3) mm of a straight stripe."""
    middle = stripe.points.mean(axis=0)
    axis = np.linalg.svd(stripe.points - middle, full_matrices=False)[2][0]
    along = (stripe.points - middle) @ axis
    return np.stack([middle + along.min() * axis, middle, middle + along.max() * axis])


def _through(first: Array, second: Array) -> Plane | None:
    """The plane through two straight stripes; None where they lie on one line, which leaves it free to turn."""
    points = np.concatenate([first, second])
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] < 0.02 * spread[0]:
        return None
    return fit_plane(points)
