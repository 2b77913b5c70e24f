"""Opaque solids that light falls on, and where rays meet them: the witness's scenes.

Every solid answers ``cast`` in its own frame (model, mm): the least positive distance along each ray and the surface's
normal there. A `Scene` places solids in one frame and finds the nearest.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array, Bools, Ints, Pose, Rays
from scope.errors import MissingLibraryError

_CLOSE = 1e-6  # mm; hits nearer than this to a ray's start are the start itself


class Solid(Protocol):
    """Anything that rays can meet."""

    @property
    def sphere(self) -> tuple[Array, float]:
        """Centre (3,) and radius, mm, of a sphere around the solid in its own frame; the radius may be inf."""
        ...

    def cast(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Distances (N,) mm to the first hit, inf where none, and normals (N, 3) of either sign."""
        ...


@dataclass(frozen=True, slots=True)
class Sheet:
    """The rectangle |x| <= size[0] / 2, |y| <= size[1] / 2 of the plane z = 0; without size the whole plane."""

    size: tuple[float, float] | None = None  # mm

    @property
    def sphere(self) -> tuple[Array, float]:
        """See `Solid`."""
        return np.zeros(3), np.inf if self.size is None else float(np.hypot(*self.size)) / 2

    def cast(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `Solid`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origin[:, 2] / direction[:, 2]
            hit = t > _CLOSE
            if self.size is not None:
                hit &= np.abs(origin[:, 0] + t * direction[:, 0]) <= self.size[0] / 2
                hit &= np.abs(origin[:, 1] + t * direction[:, 1]) <= self.size[1] / 2
        return np.where(hit, t, np.inf), np.broadcast_to([0.0, 0.0, 1.0], origin.shape)


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere about the origin."""

    radius: float  # mm

    @property
    def sphere(self) -> tuple[Array, float]:
        """See `Solid`."""
        return np.zeros(3), self.radius

    def cast(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `Solid`."""
        t = _first_root(
            np.ones(len(origin)),
            np.einsum("ij,ij->i", origin, direction),
            np.einsum("ij,ij->i", origin, origin) - self.radius**2,
        )
        return t, _at(origin, direction, t) / self.radius


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A capped cylinder about the z axis, |z| <= length / 2."""

    radius: float  # mm
    length: float  # mm

    @property
    def sphere(self) -> tuple[Array, float]:
        """See `Solid`."""
        return np.zeros(3), float(np.hypot(self.radius, self.length / 2))

    def cast(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `Solid`."""
        o, d = origin[:, :2], direction[:, :2]
        side = _first_root(
            np.einsum("ij,ij->i", d, d),
            np.einsum("ij,ij->i", o, d),
            np.einsum("ij,ij->i", o, o) - self.radius**2,
        )
        on_side = _at(origin, direction, side)
        side = np.where(np.abs(on_side[:, 2]) <= self.length / 2, side, np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            cap = (-np.sign(direction[:, 2]) * self.length / 2 - origin[:, 2]) / direction[:, 2]
        inside = np.einsum("ij,ij->i", o + _finite(cap)[:, None] * d, o + _finite(cap)[:, None] * d) <= self.radius**2
        cap = np.where(inside & (cap > _CLOSE), cap, np.inf)
        normal = on_side * [1.0, 1.0, 0.0] / self.radius
        normal[cap < side] = [0.0, 0.0, 1.0]
        return np.minimum(side, cap), normal


@dataclass(frozen=True, slots=True)
class Box:
    """A box between two corners."""

    low: tuple[float, float, float]  # mm
    high: tuple[float, float, float]  # mm

    @property
    def sphere(self) -> tuple[Array, float]:
        """See `Solid`."""
        low, high = np.array(self.low), np.array(self.high)
        return (low + high) / 2, float(np.linalg.norm(high - low)) / 2

    def cast(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `Solid`: the slab method; a ray that starts inside meets nothing."""
        enter, leave, axis = _slabs(origin, direction, np.array(self.low), np.array(self.high))
        hit = (enter <= leave) & (enter > _CLOSE)
        return np.where(hit, enter, np.inf), np.eye(3)[axis]


@dataclass(frozen=True, slots=True, eq=False)
class HeightField:
    """A surface z = h(x, y) over a rectangle that starts at (0, 0), bilinear between its samples, with upright walls.

    Sampled finely against its correlation length, so that rays meet it once within a few samples' travel: surfaces
    steeper than the rays that look at them are not resolved.
    """

    heights: Array  # (rows, columns) mm; [j, i] at x = i spacing, y = j spacing
    spacing: float  # mm

    @classmethod
    def rough(
        cls, size: tuple[float, float], sq: float, correlation: float, rng: np.random.Generator, *, samples: int = 10
    ) -> HeightField:
        """Gaussian heights of rms ``sq`` with autocorrelation exp(-(r / correlation)^2), all mm.

        The realised mean is zero and the realised rms exactly ``sq``. Made on a periodic field larger than the
        rectangle, so that opposite borders are independent; ``samples`` a correlation length.
        """
        spacing = correlation / samples
        columns, rows = (int(np.ceil(side / spacing)) + 1 for side in size)
        shape = (rows + 4 * samples, columns + 4 * samples)
        fy, fx = np.fft.fftfreq(shape[0], spacing), np.fft.rfftfreq(shape[1], spacing)
        # the filter is the root of the spectrum: exp(-(pi f c)^2 / 2) smooths to the autocorrelation above
        kernel = np.exp(-((np.pi * correlation) ** 2) * (fy[:, None] ** 2 + fx**2) / 2)
        field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * kernel, s=shape)[:rows, :columns]
        field = field - field.mean()
        return cls(field * (sq / field.std()), spacing)

    @property
    def extent(self) -> tuple[float, float]:
        """Length along x and y, mm."""
        return (self.heights.shape[1] - 1) * self.spacing, (self.heights.shape[0] - 1) * self.spacing

    @property
    def sphere(self) -> tuple[Array, float]:
        """See `Solid`."""
        low, high = np.array([0.0, 0.0, self.heights.min()]), np.array([*self.extent, self.heights.max()])
        return (low + high) / 2, float(np.linalg.norm(high - low)) / 2

    def sample(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Heights (N,) mm and slopes (N,) along x and y; the border's values beyond the border."""
        rows, columns = self.heights.shape
        i = np.clip(x / self.spacing, 0.0, columns - 1.000001)
        j = np.clip(y / self.spacing, 0.0, rows - 1.000001)
        left, top = i.astype(np.int64), j.astype(np.int64)
        a, b = i - left, j - top
        flat = self.heights.ravel()
        corner = top * columns + left
        h00, h01, h10, h11 = flat[corner], flat[corner + 1], flat[corner + columns], flat[corner + columns + 1]
        upper, lower = h00 + a * (h01 - h00), h10 + a * (h11 - h10)
        slope_x = ((h01 - h00) * (1 - b) + (h11 - h10) * b) / self.spacing
        return upper + b * (lower - upper), slope_x, (lower - upper) / self.spacing

    def cast(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `Solid`: the first change of sign over sixteen stretches of the ray, then regula falsi (Illinois)."""
        low = np.array([0.0, 0.0, self.heights.min() - 1e-3])
        high = np.array([*self.extent, self.heights.max() + 1e-3])
        enter, leave, axis = _slabs(origin, direction, low, high)
        distance, normal = np.full(len(origin), np.inf), np.tile([0.0, 0.0, 1.0], (len(origin), 1))
        rows = np.flatnonzero((enter <= leave) & (enter > _CLOSE))
        if len(rows) == 0:
            return distance, normal
        o, d, start, stop = origin[rows], direction[rows], enter[rows], leave[rows]

        def above(t: Array) -> Array:
            p = o + t[:, None] * d
            return np.asarray(p[:, 2] - self.sample(p[:, 0], p[:, 1])[0])

        t0, f0 = start, above(start)
        side = np.sign(f0)
        wall = f0 < 0.0  # entered from the side, below the border of the surface
        t1, f1, found = t0, f0, wall.copy()
        stretches = 4 if np.max((stop - start) * np.linalg.norm(d[:, :2], axis=1)) < 8 * self.spacing else 16
        for k in range(1, stretches + 1):
            t = start + (stop - start) * (k / stretches)
            f = above(t)
            crossed = ~found & (f * side <= 0.0)
            t1, f1 = np.where(crossed, t, t1), np.where(crossed, f, f1)
            found |= crossed
            t0, f0 = np.where(found, t0, t), np.where(found, f0, f)
        for _ in range(12):
            slope = f1 - f0
            t = np.where(slope != 0.0, t1 - f1 * (t1 - t0) / np.where(slope != 0.0, slope, 1.0), t1)
            f = above(t)
            same = f * f1 > 0.0
            t0, f0 = np.where(same, t0, t1), np.where(same, f0 / 2, f1)
            t1, f1 = np.where(wall, start, t), np.where(wall, 0.0, f)
            if np.abs(f1[found]).max(initial=0.0) < 1e-10:
                break
        distance[rows] = np.where(found, t1, np.inf)
        p = o + t1[:, None] * d
        _, slope_x, slope_y = self.sample(p[:, 0], p[:, 1])
        n = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=1)
        normal[rows] = n / np.linalg.norm(n, axis=1)[:, None]
        normal[rows[wall]] = np.eye(3)[axis[rows[wall]]]
        return distance, normal


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles. The nearest is found by Open3D in single precision; the hit on it is solved in double."""

    corners: Array  # (T, 3, 3) mm
    scene: Any  # open3d.t.geometry.RaycastingScene

    @classmethod
    def load(cls, path: Path) -> Mesh:
        """Read a mesh file (mm).

        Raises
        ------
        FileError
            A file that is missing, is no mesh or has no triangles.
        MissingLibraryError
            Without Open3D.
        """
        try:
            import open3d
        except (ImportError, OSError) as error:
            raise MissingLibraryError(
                f"a mesh as an object needs Open3D, which does not load ({error}): pip install open3d"
            ) from error
        import trimesh

        if not path.is_file():
            raise FileError(f"{path}: no such mesh; object.mesh names an STL, PLY or OBJ file beside the design")
        try:
            mesh = trimesh.load_mesh(path)
            triangles = np.asarray(mesh.triangles, dtype=np.float64)
        except (ValueError, AttributeError, IndexError, KeyError, TypeError, NotImplementedError) as error:
            raise FileError(f"{path}: not read as a mesh ({error}); needed is an STL, PLY or OBJ file") from error
        if len(triangles) == 0 or not np.isfinite(triangles).all():
            raise FileError(f"{path}: {len(triangles)} triangles, or some not finite; needed is a mesh of triangles")
        return cls.from_triangles(triangles, open3d)

    @classmethod
    def from_triangles(cls, corners: Array, open3d: Any) -> Mesh:
        """Mesh of triangles (T, 3, 3) mm, given the imported ``open3d`` module."""
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            open3d.core.Tensor(corners.reshape(-1, 3).astype(np.float32)),
            open3d.core.Tensor(np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)),
        )
        return cls(corners, scene)

    @property
    def sphere(self) -> tuple[Array, float]:
        """See `Solid`."""
        points = self.corners.reshape(-1, 3)
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        return centre, float(np.linalg.norm(points - centre, axis=1).max())

    def cast(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `Solid`."""
        centre, radius = self.sphere
        # rays start just before the mesh, where single precision is finest
        lead = np.maximum(np.einsum("ij,ij->i", centre - origin, direction) - 1.5 * radius, 0.0)
        near = origin + lead[:, None] * direction
        answer = self.scene.cast_rays(np.concatenate([near, direction], axis=1).astype(np.float32))
        hit = np.isfinite(answer["t_hit"].numpy())
        triangle = self.corners[np.where(hit, answer["primitive_ids"].numpy(), 0).astype(np.int64)]
        normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
        length = np.linalg.norm(normal, axis=1)
        hit &= length > 0.0
        normal /= np.where(length > 0.0, length, 1.0)[:, None]
        cosine = np.einsum("ij,ij->i", normal, direction)
        hit &= np.abs(cosine) > 1e-9
        t = np.einsum("ij,ij->i", triangle[:, 0] - origin, normal) / np.where(hit, cosine, 1.0)
        return np.where(hit & (t > _CLOSE), t, np.inf), normal


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A solid, placed in the frame of a scene."""

    solid: Solid
    pose: Pose  # scene from model
    albedo: float = 1.0  # of a Lambertian surface, against the laser's stated peak


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Where N rays met a scene."""

    distance: Array  # (N,) mm along the ray, inf where there is nothing
    points: Array  # (N, 3) mm, NaN where there is nothing
    normal: Array  # (N, 3) unit, towards where the ray came from
    albedo: Array  # (N,)
    part: Ints  # (N,) index, -1 where there is nothing

    @property
    def found(self) -> Bools:
        """(N,) the ray met something."""
        return self.part >= 0


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Solids in one frame, which may itself be moved: ``moved(pose)``."""

    parts: tuple[Part, ...]

    def moved(self, pose: Pose) -> Scene:
        """The scene after a motion."""
        return Scene(tuple(Part(p.solid, pose @ p.pose, p.albedo) for p in self.parts))

    @property
    def shadowless(self) -> bool:
        """Whether nothing can stand in another point's light: a single flat sheet."""
        return len(self.parts) == 1 and isinstance(self.parts[0].solid, Sheet)

    def cast(self, rays: Rays) -> Hits:
        """Nearest hits of N rays (NaN rays meet nothing)."""
        n = len(rays)
        distance, part = np.full(n, np.inf), np.full(n, -1, dtype=np.int64)
        normal, albedo = np.zeros((n, 3)), np.zeros(n)
        usable = np.isfinite(rays.direction.sum(axis=1))
        if not usable.any():
            return Hits(distance, np.full((n, 3), np.nan), normal, albedo, part)
        # all rays against all bounding spheres at once: they start near one point
        start = rays.origin[usable].mean(axis=0)
        spread = float(np.sqrt(np.max(np.sum((rays.origin[usable] - start) ** 2, axis=1))))
        spheres = [item.solid.sphere for item in self.parts]
        offset = np.stack([item.pose.apply(c) - start for item, (c, _) in zip(self.parts, spheres, strict=True)])
        reach = np.array([radius for _, radius in spheres]) + spread + 1e-6
        along = rays.direction @ offset.T
        near = (np.sum(offset**2, axis=1) - along**2 <= reach**2) & usable[:, None]
        for index, item in enumerate(self.parts):
            rows = np.flatnonzero(near[:, index])
            if len(rows) == 0:
                continue
            back = item.pose.inverse
            t, facing = item.solid.cast(back.apply(rays.origin[rows]), rays.direction[rows] @ back.rotation.T)
            nearer = t < distance[rows]
            chosen = rows[nearer]
            distance[chosen], part[chosen], albedo[chosen] = t[nearer], index, item.albedo
            normal[chosen] = facing[nearer] @ item.pose.rotation.T
        normal *= np.where(np.einsum("ij,ij->i", normal, rays.direction) > 0.0, -1.0, 1.0)[:, None]
        points = rays.origin + np.where(np.isfinite(distance), distance, np.nan)[:, None] * rays.direction
        return Hits(distance, points, normal, albedo, part)

    def lit(self, light: Rays, points: Array, *, tolerance: float = 1e-3) -> Bools:
        """Whether rays of light reach points (N, 3) mm on the scene before anything else (within ``tolerance`` mm)."""
        reached = np.einsum("ij,ij->i", points - light.origin, light.direction)
        if self.shadowless:
            return np.asarray(np.isfinite(reached))
        return np.asarray(self.cast(light).distance >= reached - tolerance)


def _finite(values: Array) -> Array:
    return np.where(np.isfinite(values), values, 0.0)


def _at(origin: Array, direction: Array, t: Array) -> Array:
    return np.asarray(origin + _finite(t)[:, None] * direction)


def _first_root(a: Array, b: Array, c: Array) -> Array:
    """Least positive root of a t^2 + 2 b t + c, inf where there is none; the first root alone: solids are opaque."""
    square = b * b - a * c
    hit = (square >= 0.0) & (a > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (-b - np.sqrt(np.where(hit, square, 0.0))) / a
    return np.where(hit & (t > _CLOSE), t, np.inf)


def _slabs(origin: Array, direction: Array, low: Array, high: Array) -> tuple[Array, Array, Ints]:
    """Distances at which rays enter and leave a box, and the axis of the face entered by."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / direction
        one, two = (low - origin) * inverse, (high - origin) * inverse
    near, far = np.fmin(one, two), np.fmax(one, two)
    x, y, z = near.T
    axis = np.where(x >= y, np.where(x >= z, 0, 2), np.where(y >= z, 1, 2))
    leave = np.minimum(np.minimum(far[:, 0], far[:, 1]), far[:, 2])
    return np.maximum(np.maximum(x, y), z), leave, axis
