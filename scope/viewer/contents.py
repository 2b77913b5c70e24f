"""What SCOPE makes as scenes: a cloud with all its columns, a rig with camera, rays, sheets, volume and axes, a mesh."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.camera import centre_of, pixel_grid
from calibration.geometry import Array, Rays
from calibration.rig import Rig
from calibration.volume import Volume
from scope.cloud import ScanCloud
from scope.viewer.scene import Layer, Scalar, Scene, tilted

_RAYS = (6, 8)  # rows and columns of the rays that are drawn
_SHEET = (96, 128)  # of those that meet a sheet
_FAR = 1e7  # mm: a volume without bounds is cut here
_FACES = 20_000  # of a mesh, so that the page stays small


def cloud_scene(
    cloud: ScanCloud, *, first: Sequence[Scalar] = (), layers: Sequence[Layer] = (), at: Array | None = None
) -> Scene:
    """A cloud with everything that is known of its points.

    Parameters
    ----------
    cloud : ScanCloud
    first : sequence of Scalar
        Scalars beside its columns; the first is shown. Without any it is coloured by z.
    layers : sequence of Layer
        What is shown beside it.
    at : (N, 3) array, optional
        The points in the frame of a part (z up), mm, in which they are shown then. Normals are left out.
    """
    points = cloud.points if at is None else at
    columns = [*first, *([] if first else [Scalar("z", points[:, 2])])]

    def add(name: str, values: ArrayLike, unit: str, label: str = "") -> None:
        columns.append(Scalar(name, np.asarray(values, np.float64), unit, label))

    add("intensity", cloud.intensity, "grey levels")
    add("sigma", cloud.sigma, "mm", "sigma, noise")
    add("sigma_cal", cloud.sigma_cal, "mm", "sigma, calibration")
    add("frame", cloud.frame, "")
    columns.append(Scalar("laser", cloud.laser.astype(np.float64), "", kind="names", names=_laser_names(cloud)))
    for k, axis in enumerate("uv"):
        add(axis, cloud.pixels[:, k], "px", f"pixel {axis}")
    if cloud.normals is not None and at is None:
        for k, axis in enumerate("xyz"):
            add(f"n{axis}", cloud.normals[:, k], "", f"normal {axis}")
    known = tuple(column for column in columns if np.isfinite(column.values).any())
    return Scene(points, known, tuple(layers), tilted("-z" if at is None else "z"))


def _laser_names(cloud: ScanCloud) -> tuple[str, ...]:
    highest = int(cloud.laser.max(initial=0))
    return (*cloud.laser_names, *(f"laser {k}" for k in range(len(cloud.laser_names), highest + 1)))


def rig_scene(rig: Rig) -> Scene:
    """A rig without points: its layers alone."""
    return Scene(np.zeros((0, 3)), layers=tuple(rig_layers(rig)))


def rig_layers(rig: Rig) -> list[Layer]:
    """Camera, sighting rays, calibrated volume, sheets of light, stages and axes of a rig, in C, mm.

    Rays and sheets end where the calibrated volume does. What a rig does not tell (the place of its laser, a bounded volume)
    is not drawn.
    """
    rays = _rays(rig, _RAYS)
    centre = centre_of(rays)
    sheets = [(name, laser, *_sheet(rig, laser.sheet)) for name, laser in rig.lasers.items()]
    lit = np.concatenate([np.zeros((0, 3)), *(vertices for *_, vertices, _ in sheets)])
    middle = np.median(lit, axis=0) if len(lit) else centre + 300.0 * rays.direction[len(rays) // 2]
    away = float(np.linalg.norm(middle - centre))
    seen = _within(rig.camera.volume, rays, centre, away)
    layers = [Layer("camera", "camera", lines=_frustum(rig, centre, 0.22 * away), bold=True)]
    if len(seen):
        layers.append(
            Layer(
                "sighting rays", "ray", lines=np.stack([np.broadcast_to(centre, seen[:, 1].shape), seen[:, 1]], axis=1)
            )
        )
    if (edges := _edges(rig.camera.volume, middle)) is not None:
        layers.append(Layer("calibrated volume", "volume", lines=edges))
    for k, (name, laser, vertices, faces) in enumerate(sheets):
        if len(faces):
            layers.append(Layer(f"sheet of {name}", "sheet", vertices=vertices, faces=faces, number=k))
        if np.isfinite(laser.origin).all() and len(vertices):
            rim = vertices[[int(np.argmin(vertices @ d)) for d in _ways(vertices)]]
            layers.append(
                Layer(
                    f"light of {name}",
                    "sheet",
                    lines=np.stack([np.broadcast_to(laser.origin, rim.shape), rim], axis=1),
                    number=k,
                )
            )
    layers += _stages(rig, middle, 0.25 * away)
    return [
        *layers,
        Layer("axes of C", "axes", lines=np.stack([np.zeros((3, 3)), 0.15 * away * np.eye(3)], axis=1), bold=True),
    ]


def mesh_layer(vertices: Array, faces: NDArray[np.integer], name: str) -> Layer | None:
    """A mesh (V, 3) mm, (F, 3) in grey, or None where it has too many faces for a page."""
    if len(faces) > _FACES:
        return None
    return Layer(name, "model", vertices=np.asarray(vertices, np.float64), faces=np.asarray(faces, np.int32))


def _rays(rig: Rig, grid: tuple[int, int]) -> Rays:
    """Sighting rays of a lattice of pixels that reaches to the border of the image."""
    width, height = rig.camera.size
    u, v = np.meshgrid(np.linspace(0, width - 1, grid[1]), np.linspace(0, height - 1, grid[0]))
    return rig.camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))


def _within(volume: Volume, rays: Rays, centre: Array, away: float) -> Array:
    """Where rays enter and leave a volume (n, 2, 3); those that miss it are left out. Without bounds: to twice the distance."""
    slope, gap = rays.direction @ volume.normals.T, volume.offsets - rays.origin @ volume.normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        t = gap / slope
    enter = np.where(slope < 0, t, -np.inf).max(axis=1, initial=-np.inf)
    leave = np.where(slope > 0, t, np.inf).min(axis=1, initial=np.inf)
    start = ((centre - rays.origin) * rays.direction).sum(axis=1)
    enter, leave = np.maximum(enter, start), np.minimum(leave, start + 2.0 * away)
    good = np.isfinite(enter) & np.isfinite(leave) & (enter < leave)
    both = np.stack([rays.at(enter), rays.at(leave)], axis=1)
    return np.asarray(both[good])


def _sheet(rig: Rig, sheet: object) -> tuple[Array, NDArray[np.int32]]:
    """A sheet of light within the calibrated volume and the view of the camera: a fan about its middle."""
    from scipy.spatial import ConvexHull, QhullError

    points = sheet.intersect(_rays(rig, _SHEET)).points  # type: ignore[attr-defined]
    points = points[rig.camera.volume.contains(points)]
    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    if len(points) < 3:
        return nothing
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2][:2]
    try:
        rim = ConvexHull((points - middle) @ axes.T).vertices
    except QhullError:
        return nothing
    k = np.arange(len(rim))
    faces = np.stack([np.zeros(len(rim), np.int64), k + 1, (k + 1) % len(rim) + 1], axis=1)
    return np.concatenate([middle[None], points[rim]]), faces.astype(np.int32)


def _ways(vertices: Array) -> Array:
    """The four directions to the furthest ends of a sheet."""
    axes = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2][:1]
    return np.concatenate([axes, -axes])


def _frustum(rig: Rig, centre: Array, long: float) -> Array:
    """Edges (8, 2, 3) of a pyramid from the centre of the camera through the corners of its image."""
    width, height = rig.camera.size
    corners = (
        pixel_grid(rig.camera.size, (1, 1)).reshape(-1, 2)
        + np.array([[-width, -height], [width, -height], [width, height], [-width, height]]) * 0.499
    )
    ways = rig.camera.rays(corners).direction
    ends = centre + long * ways
    ends = ends[np.isfinite(ends).all(axis=1)]
    around = np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)
    return np.concatenate([np.stack([np.broadcast_to(centre, ends.shape), ends], axis=1), around])


def _edges(volume: Volume, inside: Array) -> Array | None:
    """Edges (n, 2, 3) of a bounded volume, without those between faces of like direction; None where it has none."""
    from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

    if len(volume.offsets) < 4 or not (volume.normals @ inside < volume.offsets - 1e-6).all():
        return None
    try:
        corners = HalfspaceIntersection(np.column_stack([volume.normals, -volume.offsets]), inside).intersections
        hull = ConvexHull(corners)
    except QhullError:
        return None
    if not np.isfinite(corners).all() or np.abs(corners).max() > _FAR:
        return None
    found: dict[tuple[int, int], list[int]] = {}
    for k, face in enumerate(hull.simplices):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            found.setdefault((min(face[a], face[b]), max(face[a], face[b])), []).append(k)
    normal = hull.equations[:, :3]
    kept = [ends for ends, sides in found.items() if len(sides) == 2 and normal[sides[0]] @ normal[sides[1]] < 0.99]
    return np.asarray(corners[np.array(kept, dtype=np.int64).reshape(-1, 2)])


def _stages(rig: Rig, middle: Array, long: float) -> list[Layer]:
    layers = []
    for k, stage in enumerate(rig.stages):
        nearest = stage.point + ((middle - stage.point) @ stage.direction) * stage.direction
        line = np.stack([nearest - long * stage.direction, nearest + long * stage.direction])[None]
        name = {"linear": "travel of the stage", "turntable": "axis of the turntable"}[stage.kind]
        number = f" {k + 1}" if len(rig.stages) > 1 else ""
        layers.append(Layer(name + number, "stage", lines=line, bold=True))
    return layers
