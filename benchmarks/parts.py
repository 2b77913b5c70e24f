"""Three parts of about 100 mm, made of plain triangles, and one-sided scans of them at the level of points.

The simulator shares nothing with the pose code but the ray caster of Open3D: a sheet of light sweeps over the scene, a
point is kept where the laser's first hit is also the camera's, and noise is added along the camera's ray.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import Delaunay

from calibration.geometry import Array, Ints, Pose
from scope.cloud import ScanCloud, Sensors
from scope.optional import import_open3d

STAND_OFF = 400.0  # mm from the camera to the part
LASER = np.array([0.0, -170.0, 0.0])  # mm, in C
TRAVEL = np.array([0.0, 1.0, 0.0])  # the object moves along y


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A closed mesh, in mm."""

    name: str
    vertices: Array  # (V, 3)
    faces: Ints  # (F, 3)

    def mesh(self) -> trimesh.Trimesh:
        """The same as a trimesh object."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


# --- prisms: a plan of regions, each with its own height ----------------------------------------------------------


def rectangle(x0: float, y0: float, x1: float, y1: float, *, step: float = 4.0) -> Array:
    """Border of a rectangle, in steps short enough for the triangulation to keep it."""
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    sides = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / step)))
        sides.append(a + (b - a) * np.arange(n)[:, None] / n)
    return np.concatenate(sides)


def circle(x: float, y: float, radius: float, *, n: int = 48) -> Array:
    """Border of a circle."""
    angle = 2 * np.pi * np.arange(n) / n
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def prisms(outline: Array, regions: list[tuple[Array, float, float]], low: float, high: float) -> tuple[Array, Ints]:
    """Mesh of a body that fills z from ``low`` to ``high`` over an outline, other heights inside the regions.

    Later regions overrule earlier ones; a region whose bottom is its top is a through hole. Walls are cut at every
    height that occurs, so that neighbours share their edges and the mesh is closed.
    """
    borders = [outline, *(border for border, _, _ in regions)]
    plan = np.unique(np.round(np.concatenate(borders), 6), axis=0)
    triangles = Delaunay(plan).simplices
    a, b, c = (plan[triangles[:, k]] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    triangles = triangles[np.abs(area) > 1e-9]
    area = area[np.abs(area) > 1e-9]
    triangles = np.where((area > 0)[:, None], triangles, triangles[:, ::-1])
    middle = plan[triangles].mean(axis=1)
    inside = _in_polygon(outline, middle)
    triangles, middle = triangles[inside], middle[inside]
    bottom, top = np.full(len(middle), low), np.full(len(middle), high)
    for border, z0, z1 in regions:
        held = _in_polygon(border, middle)
        bottom[held], top[held] = z0, z1
    levels = np.unique(np.concatenate([bottom, top]))
    n = len(plan)
    vertices = np.concatenate([np.column_stack([plan, np.full(n, z)]) for z in levels])
    faces = []
    solid = {tuple(sorted(t)): k for k, t in enumerate(triangles.tolist())}
    assert len(solid) == len(triangles)
    neighbour: dict[tuple[int, int], int] = {}
    for k, (i, j, m) in enumerate(triangles.tolist()):
        for edge in ((i, j), (j, m), (m, i)):
            neighbour[edge] = k
    for k, (i, j, m) in enumerate(triangles.tolist()):
        if bottom[k] >= top[k]:
            continue
        kt, kb = int(np.searchsorted(levels, top[k])) * n, int(np.searchsorted(levels, bottom[k])) * n
        faces += [[i + kt, j + kt, m + kt], [m + kb, j + kb, i + kb]]
        for p, q in ((i, j), (j, m), (m, i)):
            other = neighbour.get((q, p))
            for z in range(len(levels) - 1):
                if levels[z] < bottom[k] or levels[z + 1] > top[k]:
                    continue
                if other is not None and bottom[other] <= levels[z] and levels[z + 1] <= top[other]:
                    continue
                lower, upper = z * n, (z + 1) * n
                faces += [[p + lower, q + lower, q + upper], [p + lower, q + upper, p + upper]]
    mesh = trimesh.Trimesh(vertices, np.array(faces), process=False)
    mesh.merge_vertices()
    mesh.remove_unreferenced_vertices()
    assert mesh.is_watertight, "the triangulation cut a border"
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _in_polygon(border: Array, points: Array) -> Any:
    inside = np.zeros(len(points), dtype=bool)
    x, y = points[:, 0], points[:, 1]
    for (x0, y0), (x1, y1) in zip(border, np.roll(border, -1, axis=0), strict=True):
        if y0 != y1:
            crossed = (y0 > y) != (y1 > y)
            inside ^= crossed & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def bracket() -> Part:
    """A machined bracket without any symmetry: foot, stepped upright, gusset, boss, two holes and a slot."""
    regions = [
        (rectangle(0, 58, 100, 70), 0.0, 35.0),
        (rectangle(0, 58, 62, 70), 0.0, 58.0),
        (rectangle(20, 40, 28, 58), 0.0, 30.0),
        (circle(72, 30, 13), 0.0, 24.0),
        (circle(72, 30, 7), 0.0, 0.0),
        (circle(16, 18, 6), 0.0, 0.0),
        (rectangle(36, 10, 44, 32), 0.0, 0.0),
        (rectangle(84, 0, 100, 16), 0.0, 5.0),
    ]
    return Part("bracket", *prisms(rectangle(0, 0, 100, 70), regions, 0.0, 12.0))


def plate() -> Part:
    """A plate of 100 x 100 mm with four equal holes; only a small hole and a shallow pocket break its symmetry."""
    holes = [(circle(x, y, 5), 0.0, 0.0) for x in (15, 85) for y in (15, 85)]
    regions = [*holes, (circle(70, 50, 3, n=32), 0.0, 0.0), (rectangle(30, 62, 46, 72), 0.0, 8.0)]
    return Part("plate", *prisms(rectangle(0, 0, 100, 100), regions, 0.0, 10.0))


def casting() -> Part:
    """A smooth casting: a sphere drawn out by broad lumps, nowhere flat and nowhere sharp."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    direction = np.asarray(ball.vertices)
    radius = np.full(len(direction), 32.0)
    lumps = (((1, 0.2, 0.1), 22, 3.0), ((-0.6, 0.8, 0), 15, 4.0), ((0.1, -0.7, 0.7), 12, 6.0), ((-0.3, -0.4, -0.9), -7, 5.0),
             ((0.2, 0.5, -0.8), 8, 8.0), ((-0.9, -0.4, 0.3), 9, 9.0))  # fmt: skip
    for centre, height, sharpness in lumps:
        unit = np.array(centre, dtype=np.float64)
        radius += height * np.exp(sharpness * (direction @ (unit / np.linalg.norm(unit)) - 1))
    return Part("casting", direction * radius[:, None], np.asarray(ball.faces, dtype=np.int64))


def box_part(low: Array, high: Array, name: str = "box") -> Part:
    """An axis-parallel block."""
    block = trimesh.creation.box(bounds=np.array([low, high]))
    return Part(name, np.asarray(block.vertices, dtype=np.float64), np.asarray(block.faces, dtype=np.int64))


def random_rotation(rng: np.random.Generator) -> Array:
    """A rotation (3, 3), uniform over SO(3) (normalised normal quaternion)."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def random_pose(part: Part, rng: np.random.Generator) -> Pose:
    """A pose C_from_model with any orientation, the middle of the part near the middle of the view."""
    rotation = random_rotation(rng)
    middle = 0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0))
    return Pose(rotation, np.array([0, 0, STAND_OFF]) + rng.uniform(-8, 8, 3) - rotation @ middle)


# --- scans ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Scanner:
    """What a scan is made with."""

    noise: float = 0.1  # mm along the camera's ray, one standard deviation
    points: int = 50_000  # about; dense scans are thinned to it at random
    calibration: Array = field(
        default_factory=lambda: np.zeros((3, 3))
    )  # covariance of sheet offset (mm) and tilts (rad)


def sweep(solids: list[tuple[Part, Pose]], spacing: float, reach: float) -> tuple[Array, Ints, Ints]:
    """Noise-free points (N, 3) that camera and laser both see, their frame (N,) and the solid each lies on (N,)."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for part, pose in solids:
        scene.add_triangles(pose.apply(part.vertices).astype(np.float32), part.faces.astype(np.uint32))
    positions = np.arange(-reach * 1.25, reach * 1.25, spacing)
    across = np.arange(-reach, reach, spacing)
    shift = -positions[:, None, None] * TRAVEL  # the sensor, seen from the object
    origin = np.broadcast_to(LASER + shift, (len(positions), len(across), 3)).reshape(-1, 3)
    through = np.stack([across, np.zeros_like(across), np.full_like(across, STAND_OFF)], axis=1) - LASER
    through /= np.linalg.norm(through, axis=1, keepdims=True)
    direction = np.broadcast_to(through, (len(positions), len(across), 3)).reshape(-1, 3)
    frame = np.repeat(np.arange(len(positions)), len(across))
    hit = scene.cast_rays(o3d.core.Tensor(np.concatenate([origin, direction], axis=1).astype(np.float32)), nthreads=1)
    reached = hit["t_hit"].numpy().astype(np.float64)
    normal = hit["primitive_normals"].numpy().astype(np.float64)
    solid = hit["geometry_ids"].numpy().astype(np.int64)
    lit = np.isfinite(reached) & (np.abs((normal * direction).sum(axis=1)) > 0.1)
    points = origin[lit] + reached[lit, None] * direction[lit]
    frame, normal, solid = frame[lit], normal[lit], solid[lit]
    camera = -positions[frame, None] * TRAVEL
    ray = points - camera
    distance = np.linalg.norm(ray, axis=1)
    ray /= distance[:, None]
    look = scene.cast_rays(o3d.core.Tensor(np.concatenate([camera, ray], axis=1).astype(np.float32)), nthreads=1)
    seen = (look["t_hit"].numpy() > distance - 0.01) & ((normal * ray).sum(axis=1) < -0.15)
    return points[seen], frame[seen], solid[seen]


def scan(
    part: Part,
    pose: Pose,
    rng: np.random.Generator,
    *,
    scanner: Scanner | None = None,
    clutter: tuple[tuple[Part, Pose], ...] = (),
    stray: float = 0.0,
) -> ScanCloud:
    """A noisy one-sided scan of a part at ``pose`` (C_from_model with the object at position 0), with its sensors."""
    made = scanner or Scanner()
    solids = [(part, pose), *clutter]
    reach = 0.5 * float(np.linalg.norm(np.ptp(part.vertices, axis=0))) + 14.0
    rough, _, _ = sweep(solids, 2.0, reach)
    if len(rough) < 50:
        raise ValueError("the scanner sees nothing of the part")
    spacing = 2.0 * np.sqrt(len(rough) / (1.06 * made.points))
    points, frame, _ = sweep(solids, spacing, reach)
    if len(points) > made.points:
        chosen = np.sort(rng.permutation(len(points))[: made.points])
        points, frame = points[chosen], frame[chosen]
    positions = np.arange(-reach * 1.25, reach * 1.25, spacing)
    camera = -positions[:, None] * TRAVEL
    ray = points - camera[frame]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    slope = sheet_slopes(points, camera[frame], ray)
    shift = slope @ (np.linalg.cholesky(made.calibration + 1e-30 * np.eye(3)) @ rng.normal(size=3))
    noisy = points + (shift + rng.normal(scale=made.noise, size=len(points)))[:, None] * ray
    if stray:
        low, high = points.min(axis=0) - 10, points.max(axis=0) + 10
        lost = rng.permutation(len(noisy))[: int(stray * len(noisy))]
        noisy[lost] = rng.uniform(low, high, size=(len(lost), 3))
    n, f32 = len(noisy), np.float32
    sigma_cal = np.sqrt(np.einsum("ni,ij,nj->n", slope, made.calibration, slope))
    return ScanCloud(
        points=noisy,
        intensity=np.full(n, 128, dtype=f32),
        sigma=np.full(n, made.noise, dtype=f32),
        sigma_cal=sigma_cal.astype(f32),
        pixels=np.full((n, 2), np.nan, dtype=f32),
        frame=frame.astype(np.int32),
        laser=np.zeros(n, dtype=np.uint8),
        sensors=Sensors(
            frame=np.arange(len(positions), dtype=np.int32),
            laser=np.zeros(len(positions), dtype=np.uint8),
            centre=camera,
            rotation=np.tile([1.0, 0, 0, 0], (len(positions), 1)),
            laser_origin=camera + LASER,
        ),
        camera_centre=np.zeros(3),
        verified=True,
    )


def sheet_slopes(points: Array, camera: Array, ray: Array) -> Array:
    """Movement along the ray, mm, of points (N, 3) for a unit change of the sheet's offset (mm) and two tilts (rad)."""
    normal = np.cross([1.0, 0, 0], np.array([0, 0, STAND_OFF]) - LASER)
    normal /= np.linalg.norm(normal)
    along = np.cross(normal, [1.0, 0, 0])
    inside = points - camera - np.array([0, 0, STAND_OFF])
    return np.asarray(np.stack([np.ones(len(points)), inside[:, 0], inside @ along], axis=1) / (ray @ normal)[:, None])


def clutter_about(part: Part, pose: Pose, rng: np.random.Generator) -> tuple[tuple[Part, Pose], ...]:
    """A base plate behind the part and a clamp (a bar) in front of it, over about 15 % of what the camera sees."""
    moved = pose.apply(part.vertices)
    far = float(moved[:, 2].max()) + 2.0
    base = box_part(np.array([-140.0, -140.0, far]), np.array([140.0, 140.0, far + 10.0]), "base")
    low, high = moved[:, :2].min(axis=0), moved[:, :2].max(axis=0)
    near = float(moved[:, 2].min())
    width = 0.12 * (high[0] - low[0])
    x = rng.uniform(low[0] + 0.2 * (high[0] - low[0]), high[0] - 0.2 * (high[0] - low[0]) - width)
    middle = 0.5 * (low[1] + high[1])
    clamp = box_part(np.array([x, middle, near - 6.0]), np.array([x + width, high[1] + 12.0, near - 0.5]), "clamp")
    return ((base, Pose.identity()), (clamp, Pose.identity()))
