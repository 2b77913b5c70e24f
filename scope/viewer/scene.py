"""What a viewer shows: points with their scalars, and lines, sheets and meshes beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.geometry import Array

Kind = Literal["sequential", "diverging", "names"]
Role = Literal["camera", "ray", "sheet", "volume", "stage", "model", "axes"]

_USUAL = (2.0, 98.0)  # percentiles: a few wild values must not hide the rest
_GRID = 1 << 10  # cells along the longest side, by which points are thinned evenly


def tilted(up: str = "-z") -> tuple[Array, Array]:
    """Right and down (3,) of a view from above and to the side: of a camera's frame, or with ``up="z"`` of a part's."""
    turn, lean = np.deg2rad(25.0), np.deg2rad(38.0)
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    back = np.array([-np.sin(turn), np.cos(turn), 0.0])
    if up == "z":
        return right, -(np.cos(lean) * np.array([0.0, 0.0, 1.0]) + np.sin(lean) * back)
    return np.array([np.cos(turn), -np.sin(turn), 0.0]), np.cos(lean) * np.array(
        [np.sin(turn), np.cos(turn), 0.0]
    ) + np.sin(lean) * np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Scalar:
    """One value of every point, by which it can be coloured and which is told when it is picked."""

    name: str  # as in files
    values: Array  # (N,), NaN where not known; of kind "names" the index into `names`
    unit: str = "mm"
    label: str = ""  # as people read it; the name where empty
    kind: Kind = "sequential"
    names: tuple[str, ...] = ()
    limits: tuple[float, float] | None = None  # of the colours to begin with; None: the 2nd and 98th percentile

    def __post_init__(self) -> None:
        """Take usual limits where none are given."""
        if self.limits is None:
            object.__setattr__(self, "limits", self._usual())

    @property
    def usual(self) -> tuple[float, float]:
        """Limits of the colours to begin with; symmetric about zero for a deviation."""
        return self.limits if self.limits is not None else (0.0, 1.0)

    def _usual(self) -> tuple[float, float]:
        if self.kind == "names":
            return 0.0, float(max(0, len(self.names) - 1))
        known = self.values[np.isfinite(self.values)]
        if len(known) == 0:
            return 0.0, 1.0
        low, high = (float(x) for x in np.percentile(known, _USUAL))
        if self.kind == "diverging":
            reach = max(abs(low), abs(high))
            low, high = -reach, reach
        return (low, high) if high > low else (low, low + max(1e-9, 1e-6 * abs(low)))


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Lines, or a mesh, shown beside the points and switched off by name."""

    name: str
    role: Role  # chooses the colour, which differs from the ground in light and dark
    lines: Array | None = None  # (M, 2, 3) mm: M segments; of axes: x, y, z
    vertices: Array | None = None  # (V, 3) mm, with `faces`
    faces: NDArray[np.int32] | None = None  # (F, 3)
    number: int = 0  # which of several sheets: chooses the colour
    bold: bool = False  # drawn over everything, wider
    shown: bool = True

    @property
    def places(self) -> Array:
        """All its points (M, 3) mm."""
        found = self.lines if self.lines is not None else self.vertices
        return np.zeros((0, 3)) if found is None else found.reshape(-1, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What one viewer shows, in one frame, mm."""

    points: Array  # (N, 3) mm, finite
    scalars: tuple[Scalar, ...] = ()
    layers: tuple[Layer, ...] = ()
    look: tuple[Array, Array] = field(default_factory=tilted)  # right and down (3,) on the screen to begin with
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)  # by which x, y, z are shown larger; values stay true
    of: int = 0  # points that there are, where only some are shown
    rows: NDArray[np.int64] | None = None  # (N,) row of each of them

    def __post_init__(self) -> None:
        """Refuse scalars that do not fit the points."""
        points = self.points
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError("points must be (N, 3) mm and finite")
        for scalar in self.scalars:
            if scalar.values.shape != (len(points),):
                raise ValueError(f"scalar {scalar.name!r} must be ({len(points)},), not {scalar.values.shape}")

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def of_points(
        cls, points: Array, values: ArrayLike, name: str, *, unit: str = "mm", kind: Kind = "sequential"
    ) -> Self:
        """Points (N, 3) mm coloured by one value (N,), for what knows no more of them."""
        return cls(np.asarray(points, np.float64), (Scalar(name, np.asarray(values, np.float64), unit, kind=kind),))

    def thinned(self, limit: int) -> Self:
        """At most ``limit`` points, even over the surface: steps along a space-filling curve (Morton 1966), in scan order."""
        n = len(self.points)
        if n <= limit:
            return self
        chosen = np.sort(_along_curve(self.points)[((np.arange(limit) + 0.5) * n / limit).astype(np.int64)])
        scalars = tuple(replace(scalar, values=scalar.values[chosen]) for scalar in self.scalars)
        rows = chosen if self.rows is None else self.rows[chosen]
        return replace(self, points=self.points[chosen], scalars=scalars, of=self.of or n, rows=rows)

    def with_layers(self, layers: Sequence[Layer]) -> Self:
        """The same with more beside the points."""
        return replace(self, layers=(*self.layers, *layers))

    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest corner (3,) mm of the points; of the layers where there are none."""
        places = (
            self.points if len(self.points) else np.concatenate([np.zeros((1, 3)), *(x.places for x in self.layers)])
        )
        return places.min(axis=0), places.max(axis=0)


def _along_curve(points: Array) -> NDArray[np.int64]:
    """Order (N,) of points along a Morton curve."""
    low = points.min(axis=0)
    cell = max(float(np.ptp(points, axis=0).max()), 1e-12) / (_GRID - 0.001)
    key = np.zeros(len(points), dtype=np.uint32)
    for axis in range(3):
        k = ((points[:, axis] - low[axis]) / cell).astype(np.uint32)
        for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
            k = (k | (k << np.uint32(shift))) & np.uint32(mask)
        key |= k << np.uint32(axis)
    return np.argsort(key, kind="stable")
