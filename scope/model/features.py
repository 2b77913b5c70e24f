"""What a mesh is made of: flat faces, round features and convex edges, found from its triangles alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.geometry import Array, Bools, Ints

FLAT = 0.01  # rad between triangles of one flat face
SMOOTH = 0.5  # rad between facets of one round feature: sixteen facets to a turn and more
SHARP = 0.35  # rad at a convex edge where a scan may end
LEAST_AREA = 0.003  # of the mesh: a smaller flat face is a facet
ROUND = 0.02  # of the radius: how far the facets of a cylinder may lie from it
MOST_FACES = 300_000  # a larger mesh is a scan itself and has no features


@dataclass(frozen=True, slots=True, eq=False)
class FlatFace:
    """One connected flat face."""

    triangles: Ints  # (T,)
    normal: Array  # (3,) unit, outwards
    point: Array  # (3,) mm on it: the middle of its largest triangle
    area: float  # mm2

    @property
    def offset(self) -> float:
        """Distance mm of its plane from the origin, along the normal."""
        return float(self.normal @ self.point)


@dataclass(frozen=True, slots=True, eq=False)
class RoundFeature:
    """A full cylinder: hole or boss."""

    triangles: Ints  # (T,) of its wall
    point: Array  # (3,) mm, middle of the wall
    axis: Array  # (3,) unit
    radius: float  # mm
    length: float  # mm along the axis
    hollow: bool  # a hole, else a boss


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Convex sharp edges, each once for either of its faces."""

    start: Array  # (E, 3) mm
    end: Array  # (E, 3) mm
    normal: Array  # (E, 3) of the face that ends there
    beyond: Array  # (E, 3) of the other face
    out: Array  # (E, 3) unit, in the face, square to the edge, away from the face
    triangle: Ints  # (E,) of the face
    other: Ints  # (E,) of the other face


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Of one mesh; ``face_of`` and ``feature_of`` say to what each triangle belongs, -1 to none."""

    faces: tuple[FlatFace, ...]
    rounds: tuple[RoundFeature, ...]
    edges: Edges
    face_of: Ints  # (F,)
    feature_of: Ints  # (F,)


def features_of(vertices: Array, faces: Ints) -> Features:
    """Flat faces, cylinders and convex edges of a closed mesh (V, 3) mm, (F, 3) with faces outwards.

    Triangles across an edge of less than 0.01 rad belong to one flat face, provided all of it lies within a
    twenty-thousandth of the diameter of one plane; what is left is cut at edges of more than half a radian, and a piece
    that lies on a cylinder over five sixths of a turn is a round feature. A mesh of free-form surfaces has neither.
    """
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    normal = np.divide(cross, length[:, None], out=np.zeros_like(cross), where=length[:, None] > 0)
    area = 0.5 * length
    twins = _twins(vertices, faces)
    first, second = twins[:2]
    cosine = (normal[first] * normal[second]).sum(axis=1)
    unknown = np.full(len(faces), -1, dtype=np.int64)
    if len(faces) > MOST_FACES:
        return Features((), (), _edges(corners, normal, twins, cosine, vertices), unknown, unknown)
    flat, face_of = _flat_faces(corners, normal, area, first, second, cosine)
    rounds, feature_of = _rounds(corners, normal, area, first, second, cosine, face_of >= 0)
    return Features(flat, rounds, _edges(corners, normal, twins, cosine, vertices), face_of, feature_of)


def _twins(vertices: Array, faces: Ints) -> tuple[Ints, Ints, Ints, Ints]:
    """Pairs of triangles that share an edge, and the edge's two vertices."""
    low, diameter = vertices.min(axis=0), float(np.linalg.norm(np.ptp(vertices, axis=0)))
    _, same = np.unique(np.round((vertices - low) / (1e-6 * diameter)), axis=0, return_inverse=True)
    corner = same.ravel()[faces]
    ends = np.sort(np.stack([corner, np.roll(corner, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    place = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    key = ends[:, 0] * (int(corner.max()) + 1) + ends[:, 1]
    order = np.argsort(key, kind="stable")
    twin = key[order[:-1]] == key[order[1:]]
    one, two = order[:-1][twin], order[1:][twin]
    return one // 3, two // 3, place[one, 0], place[one, 1]


def _pieces(count: int, first: Ints, second: Ints) -> Ints:
    """Number (count,) of the connected piece of each triangle."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(first), dtype=np.bool_), (first, second)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _members(piece: Ints) -> list[Ints]:
    order = np.argsort(piece, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(piece[order])) + 1)


def _flat_faces(
    corners: Array, normal: Array, area: Array, first: Ints, second: Ints, cosine: Array
) -> tuple[tuple[FlatFace, ...], Ints]:
    joined = cosine > np.cos(FLAT)
    piece = _pieces(len(corners), first[joined], second[joined])
    total = np.bincount(piece, weights=area)
    bent = (cosine <= np.cos(FLAT)) & (cosine > np.cos(SMOOTH))  # facets of one round wall join so
    beside = np.zeros(len(total))  # the area of the largest neighbour across such an edge
    np.maximum.at(beside, piece[first[bent]], total[piece[second[bent]]])
    np.maximum.at(beside, piece[second[bent]], total[piece[first[bent]]])
    diameter = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    found: list[FlatFace] = []
    face_of = np.full(len(corners), -1, dtype=np.int64)
    for rows in _members(piece):
        own = float(area[rows].sum())
        if own < LEAST_AREA * area.sum() or beside[piece[rows[0]]] > 0.2 * own:
            continue
        mean = area[rows] @ normal[rows]
        mean /= np.linalg.norm(mean)
        middle = corners[rows[np.argmax(area[rows])]].mean(axis=0)
        if np.abs((corners[rows] - middle) @ mean).max() > 5e-5 * diameter:
            continue
        face_of[rows] = len(found)
        found.append(FlatFace(rows, mean, middle, own))
    return tuple(found), face_of


def _rounds(
    corners: Array, normal: Array, area: Array, first: Ints, second: Ints, cosine: Array, taken: Bools
) -> tuple[tuple[RoundFeature, ...], Ints]:
    joined = (cosine > np.cos(SMOOTH)) & ~taken[first] & ~taken[second]
    piece = _pieces(len(corners), first[joined], second[joined])
    found: list[RoundFeature] = []
    feature_of = np.full(len(corners), -1, dtype=np.int64)
    for rows in _members(np.where(taken, -1, piece)):
        if len(rows) < 16 or taken[rows[0]]:
            continue
        made = _cylinder(corners[rows], normal[rows], area[rows], rows)
        if made is not None:
            feature_of[rows] = len(found)
            found.append(made)
    return tuple(found), feature_of


def _cylinder(corners: Array, normal: Array, area: Array, rows: Ints) -> RoundFeature | None:
    value, vector = np.linalg.eigh((area[:, None] * normal).T @ normal / area.sum())
    if value[0] > 1e-4 or value[1] < 0.3:  # square to the axis everywhere, all about it
        return None
    axis, across = vector[:, 0], vector[:, 1:]
    points = corners.reshape(-1, 3)
    flat = points @ across
    design = np.column_stack([2 * flat, np.ones(len(flat))])
    x, y, c = np.linalg.lstsq(design, (flat**2).sum(axis=1), rcond=None)[0]  # Kasa's circle
    radius = float(np.sqrt(max(c + x * x + y * y, 0.0)))
    away = flat - (x, y)
    if radius <= 0 or np.abs(np.linalg.norm(away, axis=1) - radius).max() > ROUND * radius:
        return None
    angle = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    if np.diff(np.append(angle, angle[0] + 2 * np.pi)).max() > np.pi / 3:
        return None
    along = points @ axis
    middle = across @ np.array([x, y]) + axis * 0.5 * (along.min() + along.max())
    out = float((area * ((corners.mean(axis=1) - middle) * normal).sum(axis=1)).sum())
    return RoundFeature(rows, middle, axis, radius, float(np.ptp(along)), out < 0)


def _edges(
    corners: Array, normal: Array, twins: tuple[Ints, Ints, Ints, Ints], cosine: Array, vertices: Array
) -> Edges:
    first, second, a, b = twins
    sharp = cosine < np.cos(SHARP)
    one, two = first[sharp], second[sharp]
    start, end = vertices[a[sharp]], vertices[b[sharp]]
    along = end - start
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.divide(along, length, out=np.zeros_like(along), where=length > 0)

    def side(own: Ints, other: Ints) -> tuple[Any, ...]:
        out = np.cross(along, normal[own])
        out *= np.sign(((start - corners[own].mean(axis=1)) * out).sum(axis=1))[:, None]
        convex = (normal[other] * out).sum(axis=1) > 0
        return tuple(v[convex] for v in (start, end, normal[own], normal[other], out, own, other))

    parts = [np.concatenate(pair) for pair in zip(side(one, two), side(two, one), strict=True)]
    return Edges(*parts)
