"""Patches chosen by a mesh, and the mesh itself as the form: a CAD surface in the cloud frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array, Bools, Ints
from scope.errors import MeasurementError
from scope.heightmap import HeightMap

NEAR = 2.0  # mm from a mesh within which a point belongs to it


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles in the cloud frame, their normals out of the material."""

    vertices: Array  # (V, 3) mm
    triangles: Ints  # (T, 3)

    def signed_distance(self, points: Array) -> Array:
        """Distance (N,) mm of points (N, 3) mm to the nearest triangle, positive on the side of its normal."""
        import open3d as o3d

        scene: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
        tensor: Any = o3d.core.Tensor
        scene.add_triangles(tensor(self.vertices.astype(np.float32)), tensor(self.triangles.astype(np.uint32)))
        found = scene.compute_closest_points(tensor(points.astype(np.float32)))
        offset = points - found["points"].numpy()
        side = (offset * found["primitive_normals"].numpy()).sum(axis=1)
        return np.asarray(np.linalg.norm(offset, axis=1) * np.where(side >= 0.0, 1.0, -1.0))


@dataclass(frozen=True, slots=True, eq=False)
class NearMesh:
    """The region within ``near`` mm of a mesh."""

    mesh: Mesh
    near: float = NEAR  # mm

    def contains(self, points: Array) -> Bools:
        """Mask (N,) of points (N, 3) mm."""
        if len(points) == 0:
            return np.zeros(0, dtype=np.bool_)
        return np.asarray(np.abs(self.mesh.signed_distance(points)) <= self.near)


def read_mesh(path: Path) -> Mesh:
    """Read a mesh (STL, PLY, OBJ) that stands where the surface stands in the cloud.

    ``FileError`` where it cannot be read or has no triangles.
    """
    import trimesh

    try:
        loaded = trimesh.load(path, force="mesh")
    except (OSError, ValueError, KeyError, IndexError, NotImplementedError) as error:
        raise FileError(f"{path}: could not be read as a mesh ({error}); give .stl, .ply or .obj") from error
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise FileError(f"{path}: holds no triangles; give the mesh of a surface")
    return Mesh(np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces, dtype=np.int64))


def remove_model(heights: HeightMap, mesh: Mesh) -> HeightMap:
    """Take a CAD surface off a height map: what is left is the signed distance to it, about its mean.

    The mesh must stand in the cloud frame to within what a plane can mend: offset and tilt that are left are removed.

    Raises
    ------
    MeasurementError
        The mesh is nowhere near the patch.
    ValueError
        A map without points.
    """
    if heights.points is None:
        raise ValueError("a model needs the points of the heights")
    known = heights.known
    distance = mesh.signed_distance(heights.points[known])
    middle = float(np.median(np.abs(distance)))
    if middle > 5.0 * NEAR:
        raise MeasurementError(
            f"the model is {middle:.3g} mm away from the patch; bring it into the cloud's frame (scope pose gives the "
            "pose) or choose the region it belongs to"
        )
    down, along = heights.places()
    design = np.stack([np.ones(int(known.sum())), down[known], along[known]], axis=1)
    z = np.full(heights.z.shape, np.nan)
    z[known] = distance - design @ np.linalg.lstsq(design, distance, rcond=None)[0]
    return heights.with_heights(z, form="model")
