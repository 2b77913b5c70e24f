"""A cloud to a mesh that has triangles only where there are points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.atomic import beside
from calibration.errors import FileError
from calibration.geometry import Array, Ints
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.merge.patch import prepared
from scope.optional import import_open3d

ENDINGS = (".stl", ".ply", ".obj")
_MOST = 400_000  # points
_SUPPORT = 2.5  # spacings from a point within which a triangle is believed
_DEEPEST = 10  # of the octree
_COMPARED = 50_000  # points


@dataclass(frozen=True, slots=True, eq=False)
class Meshed:
    """A mesh of a scan and how far it lies from the points."""

    vertices: Array  # (V, 3) mm
    faces: Ints  # (F, 3) outward by the right-hand rule
    open_edges: int  # edges of one triangle only: the rim of what was seen
    area: float  # mm^2
    volume: float  # mm^3; NaN where the mesh is open
    rms_mm: float  # of the points from the mesh
    p95_mm: float
    max_mm: float
    noise_mm: float  # what the points' sigma explains, rms; NaN where unknown
    uncovered: float  # part of the points further than the support from any triangle
    cell_mm: float  # of the reconstruction

    @property
    def watertight(self) -> bool:
        """Whether it is closed: seen all around."""
        return self.open_edges == 0


def reconstruct(cloud: ScanCloud, name: str) -> Meshed:
    """Screened Poisson surface (Kazhdan and Hoppe 2013, as Open3D has it), cut where no point supports it.

    Its cells are about as large as the points' spacing. It rounds edges by about that much, which the deviation tells; a
    triangle with a corner further than 2.5 spacings from every point is cut away, so that what was not seen stays open.

    Raises
    ------
    MeasurementError
        Too few points, or points from which no surface follows.
    """
    from scipy.spatial import cKDTree

    o3d = import_open3d()
    patch = prepared(cloud, name, most=_MOST)
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(patch.points))
    points.normals = o3d.utility.Vector3dVector(patch.normals)
    depth = int(np.clip(np.ceil(np.log2(1.1 * patch.size / max(patch.spacing, 1e-9))), 4, _DEEPEST))
    surface, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(points, depth=depth, n_threads=1)
    vertices, faces = np.asarray(surface.vertices).copy(), np.asarray(surface.triangles).astype(np.int64)
    if len(faces) == 0:
        raise MeasurementError(
            f"{name}: no surface follows from its points; give normals, or a cloud with more of them"
        )
    cell = 1.1 * patch.size / 2**depth
    reach = _SUPPORT * max(patch.spacing, cell)
    near = cKDTree(patch.points).query(vertices, distance_upper_bound=reach, workers=1)[0]
    kept = np.isfinite(near)[faces].all(axis=1)
    if not kept.any():
        raise MeasurementError(f"{name}: the surface leaves its points; their normals contradict each other")
    vertices, faces = _compact(vertices, _largest_pieces(faces[kept]))
    return _compared(cloud, patch, vertices, faces, reach, cell)


def save_mesh(path: Path, mesh: Meshed) -> None:
    """Write .stl, .ply or .obj, whole; ``FileError`` for another ending."""
    import trimesh

    require_mesh_format(path)
    with beside(path) as part:
        data = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type=path.suffix.lower()[1:])
        part.write_bytes(data if isinstance(data, bytes) else data.encode())


def require_mesh_format(path: Path) -> None:
    """``FileError`` for an ending that is none of a mesh."""
    if path.suffix.lower() not in ENDINGS:
        raise FileError(f"{path}: a mesh is written as {', '.join(ENDINGS)}; choose one of these endings")


def mesh_result(mesh: Meshed) -> dict[str, Any]:
    """What --json gives."""
    return {
        "triangles": len(mesh.faces), "vertices": len(mesh.vertices), "watertight": mesh.watertight, "open_edges": mesh.open_edges,
        "area_mm2": mesh.area, "volume_mm3": mesh.volume,
        "deviation_mm": {"rms": mesh.rms_mm, "p95": mesh.p95_mm, "max": mesh.max_mm, "noise": mesh.noise_mm},
        "uncovered": mesh.uncovered, "cell_mm": mesh.cell_mm,
    }  # fmt: skip


def mesh_text(mesh: Meshed) -> str:
    """What the terminal shows."""
    state = "watertight" if mesh.watertight else f"open along {mesh.open_edges:,} edges, where nothing was seen"
    noise = "" if not np.isfinite(mesh.noise_mm) else f" (noise {mesh.noise_mm:.4f})"
    return (
        f"{len(mesh.faces):,} triangles of about {mesh.cell_mm:.3g} mm, {state}\npoints from the mesh: rms {mesh.rms_mm:.4f} mm{noise}, "
        f"95 % within {mesh.p95_mm:.4f}, at most {mesh.max_mm:.4f} mm; {100 * mesh.uncovered:.2g} % of the points have no triangle near"
    )


def _compared(cloud: ScanCloud, patch: Any, vertices: Array, faces: Ints, reach: float, cell: float) -> Meshed:
    import trimesh

    o3d = import_open3d()
    scene, shift = o3d.t.geometry.RaycastingScene(), vertices.mean(axis=0)
    scene.add_triangles(
        o3d.core.Tensor((vertices - shift).astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    some = patch.points[:: max(1, len(patch.points) // _COMPARED)]
    away = scene.compute_distance(o3d.core.Tensor((some - shift).astype(np.float32))).numpy().astype(np.float64)
    covered = away <= reach
    whole = trimesh.Trimesh(vertices, faces, process=False)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    count = np.unique(edges, axis=0, return_counts=True)[1]
    rim = int((count == 1).sum())
    sigma = cloud.sigma[np.isfinite(cloud.sigma)].astype(np.float64)
    return Meshed(
        vertices, faces, rim, float(whole.area), float(whole.volume) if rim == 0 else float("nan"),
        float(np.sqrt(np.mean(away[covered] ** 2))), float(np.percentile(away[covered], 95)), float(away[covered].max()),
        float(np.sqrt(np.mean(sigma**2))) if len(sigma) else float("nan"), float((~covered).mean()), cell,
    )  # fmt: skip


def _largest_pieces(faces: Ints) -> Ints:
    """Without crumbs: pieces of fewer than a two-hundredth of the triangles of the largest."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = int(faces.max()) + 1
    a, b = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    label = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n)), directed=False)[1][faces[:, 0]]
    count = np.bincount(label)
    return np.asarray(faces[count[label] >= max(count.max() / 200, 1)])


def _compact(vertices: Array, faces: Ints) -> tuple[Array, Ints]:
    used, new = np.unique(faces, return_inverse=True)
    return vertices[used], new.reshape(-1, 3).astype(np.int64)
