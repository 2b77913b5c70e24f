"""Patches chosen by a mesh: what stands over its triangles."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.geometry import Array, Bools, Ints, Pose
from scope.mesh import load_mesh

BESIDE = 0.1  # mm beside a triangle, at which a point still stands over it


NEAR = 2.0  # mm from a mesh within which a point belongs to it


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles in the cloud frame, their normals out of the material."""

    vertices: Array  # (V, 3) mm
    triangles: Ints  # (T, 3)

    def signed_distance(self, points: Array) -> Array:
        """Distance (N,) mm of points (N, 3) mm to the nearest triangle, positive on the side of its normal."""
        offset, normal = self._nearest(points)
        side = (offset * normal).sum(axis=1)
        return np.asarray(np.linalg.norm(offset, axis=1) * np.where(side >= 0.0, 1.0, -1.0))

    def over(self, points: Array, near: float) -> Bools:
        """Mask (N,) of the points (N, 3) mm that stand over a triangle within ``near`` mm, and not beside an edge."""
        offset, normal = self._nearest(points)
        along = (offset * normal).sum(axis=1)
        beside = np.linalg.norm(offset - along[:, None] * normal, axis=1)
        return np.asarray((np.abs(along) <= near) & (beside <= BESIDE + 0.2 * np.abs(along)))

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        """Offset (N, 3) mm from the nearest point of the mesh, and the unit normal of its triangle."""
        import open3d as o3d

        scene: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
        tensor: Any = o3d.core.Tensor
        scene.add_triangles(tensor(self.vertices.astype(np.float32)), tensor(self.triangles.astype(np.uint32)))
        found = scene.compute_closest_points(tensor(points.astype(np.float32)))
        return points - found["points"].numpy(), found["primitive_normals"].numpy().astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class NearMesh:
    """The region over a mesh, within ``near`` mm of it; what lies beside its borders and outer edges is none of it."""

    mesh: Mesh
    near: float = NEAR  # mm

    def contains(self, points: Array) -> Bools:
        """Mask (N,) of points (N, 3) mm."""
        if len(points) == 0:
            return np.zeros(0, dtype=np.bool_)
        return self.mesh.over(points, self.near)


def read_mesh(path: Path, *, cloud_from_model: Pose | None = None) -> Mesh:
    """Read a mesh (STL, PLY, OBJ, GLB, 3MF, STEP) that stands where the surface stands in the cloud, or is put there by its pose.

    ``FileError`` where it cannot be read or has no triangles.
    """
    loaded = load_mesh(path)
    vertices = np.asarray(loaded.vertices, dtype=np.float64)
    if cloud_from_model is not None:
        vertices = cloud_from_model.apply(vertices)
    return Mesh(vertices, np.asarray(loaded.faces, dtype=np.int64))
