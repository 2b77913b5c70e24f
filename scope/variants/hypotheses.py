"""The directions in which parts come in variants, each as a column of the linear system that also holds the pose."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calibration.geometry import Array, Ints
from scope.model import Features, Surface

PARALLEL = 1e-3  # rad, half of it either side
LEAST_FACE = 0.008  # of the mesh's surface: a smaller face is no dimension of its own
MOST = 60  # dimensions and features asked about, the largest first


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Places of the model's surface (or edge) that were measured, one row each."""

    at: Array  # (N, 3) mm, model frame
    normal: (
        Array  # (N, 3) unit, the direction in which the residual is measured: out of the face, or out beyond the edge
    )
    triangle: Ints  # (N,) on which the place lies; for an edge, that of the wall beyond it


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One way in which the part may differ from its mesh, linear in one or two numbers."""

    kind: str  # "scale", "dimension", "hole", "diameter"
    name: str  # what it is of, in words
    at: Array  # (3,) mm on the model
    out: Array  # (3,) unit: from where it is seen, model frame
    nominal: float  # mm, or 1 for the scale
    count: int  # of numbers
    triangles: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # that move; none: all do
    axes: Array = field(
        default_factory=lambda: np.zeros((0, 3))
    )  # (count, 3) directions in which they move, for one unit
    start: float = 0.0  # mm along axes[0]: a stretch begins here and ends `nominal` further on

    def columns(self, rows: Rows, centre: Array) -> Array:
        """Change (N, count) of the residuals for one unit of each number (mm; for the scale a factor)."""
        if self.kind == "scale":
            return np.asarray(-(rows.normal * (rows.at - centre)).sum(axis=1, keepdims=True))
        if self.kind == "stretch":
            part = np.clip((rows.at @ self.axes[0] - self.start) / self.nominal, 0.0, 1.0)
            return np.asarray(-(part * (rows.normal @ self.axes[0]))[:, None])
        mine = np.isin(rows.triangle, self.triangles).astype(np.float64)
        if self.kind == "diameter":
            away = rows.at - self.at
            away = away - np.outer(away @ self.axes[0], self.axes[0])
            away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
            return np.asarray(-0.5 * (mine * (rows.normal * away).sum(axis=1))[:, None])
        return np.asarray(-mine[:, None] * (rows.normal @ self.axes.T))


def hypotheses_of(surface: Surface, features: Features, vertices: Array) -> list[Hypothesis]:
    """Scale, lengths over all, distances between parallel faces, and places and diameters of holes and bosses.

    A moved face stands for every dimension that ends at it: the distance to the face behind it is the one that is named.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    found = [Hypothesis("scale", "the scan", centre, np.zeros(3), 1.0, 1)]
    total = sum(f.area for f in features.faces)
    large = sorted((f for f in features.faces if f.area > LEAST_FACE * total), key=lambda f: -f.area)[:MOST]
    axes: list[Array] = []
    for face in large:
        if all(abs(float(face.normal @ a)) < 1 - PARALLEL for a in axes):
            axes.append(face.normal)
    for axis in axes[:12]:
        along = vertices @ axis
        ends = [f for f in large if abs(float(f.normal @ axis)) > 1 - PARALLEL]
        first, last = float(along.min()), float(along.max())
        near = 1e-3 * size
        if any(abs(f.point @ axis - first) < near for f in ends) and any(
            abs(f.point @ axis - last) < near for f in ends
        ):
            middle = centre + (last - centre @ axis) * axis
            found.append(
                Hypothesis(
                    "stretch", f"the length of {last - first:.2f} mm along {_text(axis)}", middle, axis, last - first, 1,
                    axes=axis[None], start=first,
                )
            )  # fmt: skip
    for face in large:
        depth = _depth(surface, face.point, face.normal, size)
        if depth is not None:
            name = f"the distance of {depth:.2f} mm from the face at {_text(face.point)} to the one behind it"
            found.append(
                Hypothesis(
                    "dimension", name, face.point, face.normal, depth, 1, triangles=face.triangles,
                    axes=face.normal[None],
                )
            )  # fmt: skip
    for feature in sorted(features.rounds, key=lambda r: -r.radius * r.length)[:MOST]:
        across = np.linalg.svd(feature.axis[None])[2][1:]
        what = "hole" if feature.hollow else "boss"
        name = f"the {what} of {2 * feature.radius:.2f} mm at {_text(feature.point)}"
        for kind, nominal, moves in ((what, 0.0, across), ("diameter", 2 * feature.radius, feature.axis[None])):
            found.append(
                Hypothesis(
                    kind,
                    name,
                    feature.point,
                    feature.axis,
                    nominal,
                    len(moves),
                    triangles=feature.triangles,
                    axes=moves,
                )
            )
    return found


def _depth(surface: Surface, point: Array, normal: Array, size: float) -> float | None:
    """Thickness mm of the material below a face; None where no parallel face ends it."""
    start = point - 1e-4 * size * normal
    reach = float(surface.first_hit(start[None], -normal[None])[0])
    if not np.isfinite(reach):
        return None
    opposite = surface.foot(start[None] - reach * normal)[1][0]
    return reach + 1e-4 * size if opposite @ normal < -1 + PARALLEL else None


def _text(vector: Array) -> str:
    return "(" + ", ".join(f"{x:.3g}" for x in np.round(vector, 2) + 0.0) + ")"
