"""The exact surface of a mesh: nearest points, rays, inside and outside, even samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Ints
from calibration.threads import own_threads
from scope.errors import MeasurementError
from scope.model.features import Features, features_of
from scope.optional import import_open3d


class Surface:
    """The exact surface of a mesh: nearest points and rays."""

    def __init__(self, vertices: Array, faces: Ints) -> None:
        self._o3d = import_open3d()
        self._scene = self._o3d.t.geometry.RaycastingScene(nthreads=own_threads(0))  # 0: all cores
        # single precision is finest near the origin
        self._shift = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        self._scene.add_triangles((vertices - self._shift).astype(np.float32), faces.astype(np.uint32))
        corners = vertices[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        self._normals = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
        self._offsets = ((corners[:, 0] - self._shift) * self._normals).sum(axis=1)
        self._creases: Any = None  # cKDTree of points along the sharp edges, made when first asked for
        self._sharp = (vertices, faces)
        self._features: Features | None = None

    @property
    def features(self) -> Features:
        """Flat faces, round features and convex edges of the mesh, found when first asked for."""
        if self._features is None:
            self._features = features_of(*self._sharp)
        return self._features

    def _tensor(self, values: Array) -> Any:
        return self._o3d.core.Tensor(np.ascontiguousarray(values, dtype=np.float32))

    def nearest(self, points: Array) -> tuple[Array, Array]:
        """Nearest surface points (N, 3) and the outward normals (N, 3) of their faces.

        The nearest face is found in single precision; the point on it is then put on the face's plane in double.
        """
        closest, normal, _ = self.foot(points)
        return closest, normal

    def foot(self, points: Array) -> tuple[Array, Array, Ints]:
        """What `nearest` gives, and the triangles (N,) on which the nearest points lie."""
        local = points - self._shift
        found = self._scene.compute_closest_points(self._tensor(local))
        closest = found["points"].numpy().astype(np.float64)
        face = found["primitive_ids"].numpy().astype(np.int64)
        normal = self._normals[face]
        closest += (self._offsets[face] - (closest * normal).sum(axis=1))[:, None] * normal
        return closest + self._shift, normal, face

    def signed_distance(self, points: Array, *, votes: int = 3) -> Array:
        """Distances (N,) mm, negative inside (parity of crossings, majority of ``votes`` rays)."""
        local = self._tensor(points - self._shift)
        return np.asarray(self._scene.compute_signed_distance(local, nsamples=votes).numpy(), dtype=np.float64)

    def inside(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (N, 3) lie inside (parity)."""
        return np.asarray(self._scene.compute_occupancy(self._tensor(points - self._shift), nsamples=3).numpy() > 0.5)

    def crease_distance(self, points: Array, reach: float) -> Array:
        """Distance (N,) mm to the nearest sharp edge of the mesh (convex or hollow), inf beyond ``reach`` mm."""
        if self._creases is None:
            from scipy.spatial import cKDTree

            self._creases = cKDTree(creases(*self._sharp, self._normals))
        if self._creases.n == 0:
            return np.full(len(points), np.inf)
        return np.asarray(self._creases.query(points, distance_upper_bound=reach, workers=1)[0])

    def first_hit(self, origin: Array, direction: Array) -> Array:
        """Distance (N,) mm along unit directions to the first crossing, inf where there is none."""
        rays = self._tensor(np.concatenate([origin - self._shift, direction], axis=1))
        return np.asarray(self._scene.cast_rays(rays)["t_hit"].numpy(), dtype=np.float64)


def sample_surface(vertices: Array, faces: Ints, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (count, 3) spread over a mesh by area (systematic sampling of the faces), with their face normals."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    if area.sum() <= 0:
        raise MeasurementError("all faces of the mesh have no area; export it again")
    at = (np.arange(count) + 0.5) / count * area.sum()
    face = np.minimum(np.searchsorted(np.cumsum(area), at), len(faces) - 1)
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    points = (1 - u)[:, None] * a[face] + (u * (1 - v))[:, None] * b[face] + (u * v)[:, None] * c[face]
    return points, np.asarray(cross[face] / area[face, None])


SHARP = 0.35  # rad between the normals of two faces, above which their edge is one of the part and not of its facets


def creases(vertices: Array, faces: Ints, normals: Array, *, most: int = 400_000) -> Array:
    """Points (K, 3) along all sharp edges of a mesh with face normals (F, 3), a two-thousandth of the diameter apart.

    Further apart where they would be more than ``most``. A part without sharp edges gives none.
    """
    low, diameter = vertices.min(axis=0), float(np.linalg.norm(np.ptp(vertices, axis=0)))
    _, same = np.unique(np.round((vertices - low) / (1e-6 * diameter)), axis=0, return_inverse=True)
    corner = same.ravel()[faces]
    ends = np.sort(np.stack([corner, np.roll(corner, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    place = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    key = ends[:, 0] * (int(corner.max()) + 1) + ends[:, 1]
    order = np.argsort(key, kind="stable")
    twin = key[order[:-1]] == key[order[1:]]
    first, second = order[:-1][twin], order[1:][twin]
    cosine = (normals[first // 3] * normals[second // 3]).sum(axis=1)
    sharp = place[first[cosine < np.cos(SHARP)]]
    a, b = vertices[sharp[:, 0]], vertices[sharp[:, 1]]
    length = np.linalg.norm(b - a, axis=1)
    step = max(diameter / 2000, float(length.sum()) / most)
    count = np.ceil(length / step).astype(np.int64) + 1
    edge = np.repeat(np.arange(len(sharp)), count)
    along = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    part = along / np.maximum(count[edge] - 1, 1)
    return np.asarray(a[edge] + part[:, None] * (b - a)[edge])
