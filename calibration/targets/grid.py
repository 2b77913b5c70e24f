"""Which mark of a spot grid every spot of an image is.

A lattice is grown among the centroids (`calibration.targets.lattice`); then all ways in which it can lie on the target are
compared with what was seen: four turns, each as it is and mirrored, at every place. Larger spots speak for a way that
puts fiducials there; spots beyond the grid, larger spots where none should be and ordinary ones where a fiducial should
be speak against it. A way is taken only where nothing else is as good: a view that cannot be told is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.geometry import Array, Bools, Ints
from calibration.targets.lattice import index_lattice
from calibration.targets.layout import SpotGrid
from calibration.targets.spots import Spots

Turned = Literal[0, 90, 180, 270]

_ODD_SIZE = 0.25  # a spot whose size is off by more than this part is no mark

# Maps of lattice indices (i, j) to (column, row) of the target, up to a shift: the turns and reflections, and all of
# them along the diagonals of a cell too, since a strong tilt can make these look squarer than its sides.
_WAYS: tuple[NDArray[np.int64], ...] = tuple(
    np.array(((a, b), (c, d)), dtype=np.int64)
    for a, b, c, d in product((-1, 0, 1), repeat=4)
    if abs(a * d - b * c) == 1
)


@dataclass(frozen=True, slots=True, eq=False)
class GridLabels:
    """Which mark each spot is, and how sure that is."""

    mark: Ints  # (N,) row * columns + column of the target, -1 where the spot is no mark
    mirrored: bool  # the view is a mirror image: the fault ``labelling``
    fiducials: int  # fiducials that were recognised
    contradictions: int  # spots that speak against these labels
    runner_up: int | None  # the same for the next best labels; None where no other is possible

    @property
    def labelled(self) -> Bools:
        """(N,) which spots are marks of the target."""
        return self.mark >= 0


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """One way to lay the lattice on the target."""

    cell: Ints  # (K, 2) column and row of the spots on the lattice
    mirrored: bool
    matched: int  # fiducials seen where they should be
    against: int
    outside: int


_Offer: TypeAlias = list[_Way]


def label_grid(
    spots: Spots, target: SpotGrid, *, image_size: tuple[int, int], turned: Turned | None = None
) -> GridLabels:
    """Label the spots of one view of a spot grid.

    Parameters
    ----------
    spots : Spots
        As `calibration.targets.spots.find_spots` gives them.
    target : SpotGrid
        The grid; with fiducials any part of it may be in view, without them all of it must be.
    image_size : (width, height), px
        Of the image, whose top left corner decides where (0, 0) is when there are no fiducials.
    turned : {0, 90, 180, 270}, optional
        By how many degrees the target is turned clockwise in the image; only for grids without fiducials. By default
        mark (0, 0) is the corner nearest to the top left of the image.

    Returns
    -------
    GridLabels
        Row i belongs to spot i. Without fiducials a mirror image cannot be told, and ``mirrored`` is False.

    Raises
    ------
    CalibrationError
        The view cannot be told from another, or contradicts the target; the message says which.
    """
    least = 6
    if len(spots) < least:
        small = [why for _, _, why in spots.rejected if "px across" in why]
        told = f" ({len(small)} more are too small, e.g. {small[0]})" if small else ""
        raise CalibrationError(
            f"found {len(spots)} spots{told}; at least {least} of the grid of {target.rows} x {target.columns} are needed: "
            "check exposure, focus, polarity and diameter"
        )
    target.check_fiducials()
    points = spots.centroids
    lattice = index_lattice(points, target.pitch[0] / target.pitch[1])
    index, on = lattice.index, lattice.on
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] < 0.02 * spread[0]:
        raise CalibrationError(
            f"the {len(spots)} spots found lie on one line, from which no plane follows; spots of two rows or more of the grid "
            f"of {target.rows} x {target.columns} are needed: uncover or light the rest of the target"
        )
    if on.sum() < max(least, len(spots) // 3):
        raise CalibrationError(
            f"only {int(on.sum())} of {len(spots)} spots form a grid; the grid of {target.rows} x {target.columns} "
            "must fill most of the view: check polarity, reflections and whether this is the right target"
        )
    if lattice.strays > 0.12 * on.sum():
        raise CalibrationError(
            f"{lattice.strays} spots lie between the {int(on.sum())} that form a grid: which is which cannot be told: "
            "clean the target, remove reflections or look at it less obliquely"
        )
    where = np.flatnonzero(on)
    cell = _right_handed(index[on], points[on])
    # spots over the side of their cell: tilt and lens cancel, so that only fiducials, and dirt, stand out
    size = spots.diameter[on] / lattice.side[on]
    size = size / np.median(size)
    if target.fiducials:
        way, runner_up = _by_fiducials(cell, size, target, strays=bool(on.sum() < len(spots)))
    else:
        way, runner_up = _by_border(cell, points[on], target, image_size, turned)
    mark = np.full(len(spots), -1, dtype=np.int64)
    column, row = way.cell.T
    inside = (column >= 0) & (column < target.columns) & (row >= 0) & (row < target.rows)
    inside &= np.abs(size / _expected_size(way.cell, target) - 1.0) < _ODD_SIZE
    mark[where[inside]] = row[inside] * target.columns + column[inside]
    return GridLabels(mark, way.mirrored, way.matched, way.against, runner_up)


def _expected_size(cell: Ints, target: SpotGrid) -> Array:
    """Diameters (K,) that the target has at cells (K, 2), over that of an ordinary spot."""
    fiducials = np.array([(column, row) for row, column in target.fiducials], dtype=np.int64).reshape(-1, 2)
    special = (cell[:, None] == fiducials[None]).all(axis=2).any(axis=1)
    return np.where(special, _fiducial_size(target), 1.0)


def _fiducial_size(target: SpotGrid) -> float:
    """Diameter of a fiducial over that of an ordinary spot; half as large again where the target does not say."""
    if target.fiducial_diameter is None or target.diameter is None:
        return 1.5
    return target.fiducial_diameter / target.diameter


def _right_handed(index: Ints, points: Array) -> Ints:
    """Indices with j swapped in sign where needed, so that i to j turns as u to v does."""
    middle = index - np.round(index.mean(axis=0))
    slope = np.linalg.lstsq(np.column_stack([middle, np.ones(len(middle))]), points, rcond=None)[0][:2]
    return index if np.linalg.det(slope) > 0 else index * np.array([1, -1])


def _by_fiducials(cell: Ints, size: Array, target: SpotGrid, *, strays: bool) -> tuple[_Way, int | None]:
    """Find the way that the larger spots demand; ``size`` (K,) is relative, 1 for ordinary ones."""
    expected = _fiducial_size(target)
    large = size > 1.0 + 0.6 * (expected - 1.0) if expected > 1.0 else size < 1.0 - 0.6 * (1.0 - expected)
    plain = size < 1.0 + 0.4 * (expected - 1.0) if expected > 1.0 else size > 1.0 - 0.4 * (1.0 - expected)
    offers = _offers(cell, large, plain, target)
    best = _choose(offers, len(target.fiducials), len(cell), margin=2 if strays else 1)
    if best is not None:
        others = [w.against for w in offers if w is not best]
        return best, min(others, default=None)
    swapped = SpotGrid(
        target.columns,
        target.rows,
        (target.pitch[1], target.pitch[0]),
        target.diameter,
        target.polarity,
        tuple((c, r) for r, c in target.fiducials),
        target.fiducial_diameter,
    )
    flipped = SpotGrid(
        target.columns,
        target.rows,
        target.pitch,
        target.diameter,
        target.polarity,
        target.fiducials,
        target.fiducial_diameter,
    )
    for other in (flipped, swapped):
        if _choose(_offers(cell, large, plain, other), len(target.fiducials), len(cell), margin=2) is not None:
            raise CalibrationError(
                f"the image shows a grid of {other.rows} rows and {other.columns} columns, the file says "
                f"{target.rows} and {target.columns}: rows and columns look swapped in the target"
            )
    seen = int(large.sum())
    extent = cell.max(axis=0) - cell.min(axis=0) + 1
    raise CalibrationError(
        f"the view fits the target in no way or in several: {len(cell)} spots on a grid of {extent[1]} x {extent[0]}, "
        f"{seen} of them large, where {target.rows} x {target.columns} with {len(target.fiducials)} fiducials are "
        "needed: bring all fiducials into view, and check rows, columns and fiducials of the target"
    )


def _offers(cell: Ints, large: Bools, plain: Bools, target: SpotGrid) -> _Offer:
    """All ways that put a fiducial on a large spot, each with what speaks for and against it."""
    fiducials = np.array([(column, row) for row, column in target.fiducials], dtype=np.int64)
    size = np.array([target.columns, target.rows])
    seen: set[tuple[int, int, int]] = set()
    offers: _Offer = []
    bigs = cell[large]
    if len(bigs) > 12:
        return offers
    for number, way in enumerate(_WAYS):
        laid = cell @ way.T
        mirrored = bool(way[0, 0] * way[1, 1] < way[0, 1] * way[1, 0])
        for big in bigs @ way.T:
            for fiducial in fiducials:
                shift = fiducial - big
                key = (number, int(shift[0]), int(shift[1]))
                if key in seen:
                    continue
                seen.add(key)
                at = laid + shift
                outside = ((at < 0) | (at >= size)).any(axis=1)
                should = (at[:, None] == fiducials[None]).all(axis=2).any(axis=1)
                matched = int((should & large).sum())
                against = int((should & plain).sum() + (~should & large & ~outside).sum() + outside.sum())
                offers.append(_Way(at, mirrored, matched, against, int(outside.sum())))
    return offers


def _choose(offers: _Offer, fiducials: int, spots: int, *, margin: int) -> _Way | None:
    """The one way that is certain, if there is one.

    All fiducials seen and next to nothing against it: certain, since their pattern is unlike its images. Otherwise
    nothing may speak against it, ``margin`` spots must speak against every other, and it must have two fiducials.
    """
    if not offers:
        return None
    ranked = sorted(offers, key=lambda w: (w.against, -w.matched))
    complete = [w for w in ranked if w.matched == fiducials and fiducials >= 3 and w.outside <= 0.02 * spots]
    if len(complete) == 1 and complete[0].against <= complete[0].outside + 1:
        return complete[0]
    best = ranked[0]
    if best.against == 0 and (len(ranked) == 1 or ranked[1].against >= margin) and best.matched >= 2:
        return best
    return None


def _by_border(
    cell: Ints, points: Array, target: SpotGrid, image_size: tuple[int, int], turned: Turned | None
) -> tuple[_Way, int | None]:
    """The way that a grid without fiducials lies: all of it in view, (0, 0) at the top left unless ``turned``."""
    wanted = np.array([target.columns, target.rows])
    found: list[tuple[float, Ints]] = []  # how far from the place where (0, 0) should be, and the cells
    extents: set[tuple[int, int]] = set()
    for way in _WAYS:
        if way[0, 0] * way[1, 1] < way[0, 1] * way[1, 0]:
            continue  # without fiducials a mirror image cannot be told, and none is assumed
        laid = cell @ way.T
        laid = laid - laid.min(axis=0)
        extent = laid.max(axis=0) + 1
        extents.add((int(extent[1]), int(extent[0])))
        middle = (extent - 1) / 2.0
        slope = np.linalg.lstsq(np.column_stack([laid - middle, np.ones(len(laid))]), points, rcond=None)[0]
        if turned is None:
            rank = float(np.linalg.norm(slope[2] - middle @ slope[:2]))
        else:
            angle = float(np.degrees(np.arctan2(slope[0, 1], slope[0, 0])))
            rank = abs((angle - turned + 180.0) % 360.0 - 180.0)
        if (extent == wanted).all() or (extent == wanted[::-1]).all():
            found.append((rank, laid))
    if not found:
        smallest = min(extents, key=lambda e: e[0] * e[1])
        raise CalibrationError(
            f"found a grid of {smallest[0]} x {smallest[1]} spots, the target has {target.rows} x {target.columns} and "
            "no fiducials: all of it must be in view, or it needs fiducials"
        )
    found.sort(key=lambda item: item[0])
    close = 0.05 * float(np.hypot(*image_size)) if turned is None else 10.0
    if len(found) > 1 and found[1][0] - found[0][0] < close:
        raise CalibrationError(
            "two corners of the grid are about as near to the image's top left: which is mark (0, 0) cannot be told: "
            "set `turned` on the plane, or use a target with fiducials"
        )
    laid = found[0][1]
    shape = laid.max(axis=0) + 1
    if tuple(shape) != tuple(wanted):
        raise CalibrationError(
            f"the image shows {shape[1]} rows and {shape[0]} columns, the file says {target.rows} and "
            f"{target.columns}: rows and columns are swapped in the target, or it is turned: set `turned = 90` or `270`"
        )
    return _Way(laid, False, 0, 0, 0), None
