"""A known part, prepared once: distance grid, samples, views and the poses in which it looks like itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints, Pose
from calibration.notebook import Picture, Shown, Summary, number, scatter
from scope.errors import MeasurementError
from scope.model.alignment import Scanned, Weighting, refine
from scope.model.grid import DistanceGrid, align
from scope.model.surface import Surface, sample_surface

NODES = 150  # nodes of the fine grid along the longest side
COARSE = 4  # the coarse grid has one node for so many of the fine one
SAMPLES = 18_000
MARGIN = 0.12  # of the diameter, around the model in the grid


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """An axis of revolution of the model."""

    point: Array  # (3,) mm
    direction: Array  # (3,) unit


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Model(Shown):
    """A part in its own frame, mm."""

    name: str
    sha256: str
    vertices: Array  # (V, 3)
    faces: Ints  # (F, 3), outwards
    diameter: float  # mm, diagonal of the bounding box
    fine: DistanceGrid
    coarse: DistanceGrid
    samples: Array  # (S, 3) even over the surface
    normals: Array  # (S, 3) unit, outwards
    view_direction: Array  # (W, 3) unit, from the part to a far camera
    view_centroid: Array  # (W, 3) middle of the surface that this camera sees
    likenesses: tuple[Pose, ...]  # motions that take the model nearly onto itself, identity left out
    symmetries: tuple[Pose, ...]  # those of them that take it exactly onto itself
    axis: Axis | None  # of revolution

    def summary(self) -> Summary:
        """Name and size."""
        return Summary(
            f"Model {self.name}", (("triangles", f"{len(self.faces):,}"), ("diagonal", number(self.diameter, "mm")))
        )

    def picture(self) -> tuple[Picture | None, str]:
        """Its surface, seen along its z."""
        x, y, z = self.samples.T
        return scatter(x, y, z), "x to the right, y down, coloured by z"

    @property
    def centre(self) -> Array:
        """Middle of the bounding box (3,) mm."""
        return np.asarray(0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0)))


def prepare_model(vertices: Array, faces: Ints, *, name: str = "model", sha256: str = "") -> Model:
    """Everything that a search for this part needs, from a closed mesh (V, 3) mm, (F, 3) with faces outwards.

    Raises
    ------
    MeasurementError
        A mesh without extent, or one that intersects itself over more than 1 % of its surface.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    diameter = float(np.linalg.norm(high - low))
    if not np.isfinite(diameter) or diameter <= 0:
        raise MeasurementError(f"{name}: the mesh has no extent; export it again")
    surface = Surface(vertices, faces)
    samples, normals = sample_surface(vertices, faces, SAMPLES, np.random.default_rng(0))
    _require_simple(surface, samples, normals, diameter, name)
    fine, coarse = _grids(surface, low, high, diameter)
    views = fibonacci_sphere(162)
    centroids = _view_centroids(surface, samples, normals, views, diameter)
    middle, axes = principal_axes(vertices, faces)
    axis = _axis_of_revolution(fine, samples, middle, axes, diameter)
    likenesses = tuple(
        _sharpened(surface, samples, p, diameter) for p in _likenesses(coarse, fine, samples, normals, diameter)
    )
    close = max(2e-4 * diameter, 2e-3)
    likenesses += _plain_turns(surface, samples, likenesses, middle, axes, close)
    exact = tuple(p for p in likenesses if _misfit(surface, samples, p) < close)
    return Model(
        name,
        sha256,
        vertices,
        faces,
        diameter,
        fine,
        coarse,
        samples,
        normals,
        views,
        centroids,
        likenesses,
        exact,
        axis,
    )


def fibonacci_sphere(count: int) -> Array:
    """Unit vectors (count, 3), nearly even over the sphere (Gonzalez 2010)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def rotations(count: int) -> Array:
    """Rotations (count, 3, 3), nearly even over SO(3): the super-Fibonacci spirals of Alexa (CVPR 2022)."""
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    x, y, z, w = inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))


def angle_between(a: Array, b: Array) -> Array:
    """Angles, rad, between rotations (..., 3, 3)."""
    trace = np.einsum("...ij,...ij->...", a, b)
    return np.asarray(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def distinct(
    rotation: Array,
    translation: Array,
    cost: Array,
    centre: Array,
    turn: float,
    shift: float,
    *,
    most: int | None = None,
) -> Ints:
    """Indices of poses in order of cost, each at least ``turn`` rad or ``shift`` mm (at ``centre``) from the better ones.

    With ``most``, no more than so many.
    """
    kept: list[int] = []
    at = rotation @ centre + translation
    for i in np.argsort(cost, kind="stable"):
        if most is not None and len(kept) == most:
            break
        if kept:
            near = (angle_between(rotation[kept], rotation[i]) < turn) & (
                np.linalg.norm(at[kept] - at[i], axis=1) < shift
            )
            if near.any():
                continue
        kept.append(int(i))
    return np.array(kept, dtype=np.int64)


def _require_simple(surface: Surface, samples: Array, normals: Array, diameter: float, name: str) -> None:
    step = 1e-4 * diameter
    bad = surface.inside(samples + step * normals) | ~surface.inside(samples - step * normals)
    share = float(bad.mean())
    if share > 0.01:
        raise MeasurementError(
            f"{name}: {100 * share:.0f} % of its surface lies inside the body or faces the wrong way (bodies that overlap, "
            "faces turned round, walls without thickness); unite the bodies and export one closed shell"
        )


def _grids(surface: Surface, low: Array, high: Array, diameter: float) -> tuple[DistanceGrid, DistanceGrid]:
    """Fine and coarse grid; far from the surface the fine one is interpolated from the coarse one."""
    margin = MARGIN * diameter
    spacing = float((high - low + 2 * margin).max() / NODES)
    cells = np.ceil((high - low + 2 * margin) / (spacing * COARSE)).astype(int)
    origin = 0.5 * (low + high) - 0.5 * cells * spacing * COARSE
    rough = _nodes(origin, spacing * COARSE, cells + 1)
    coarse = surface.signed_distance(rough.reshape(-1, 3)).reshape(cells + 1)
    fine = coarse
    for axis in range(3):  # linear upsampling, one axis at a time
        n = cells[axis]
        at = np.arange(n * COARSE + 1) / COARSE
        k = np.minimum(at.astype(int), n - 1)
        part = (at - k).reshape([-1 if a == axis else 1 for a in range(3)])
        fine = np.take(fine, k, axis) * (1 - part) + np.take(fine, k + 1, axis) * part
    close = np.abs(fine) < 1.2 * COARSE * spacing
    index = np.stack(np.nonzero(close), axis=1)
    fine[close] = surface.signed_distance(origin + spacing * index)
    return _grid(origin, spacing, fine), _grid(origin, spacing * COARSE, coarse)


def _grid(origin: Array, spacing: float, values: Array) -> DistanceGrid:
    return DistanceGrid(origin, spacing, np.ascontiguousarray(values, dtype=np.float32))


def _nodes(origin: Array, spacing: float, shape: Ints) -> Array:
    axes = [origin[a] + spacing * np.arange(shape[a]) for a in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def _view_centroids(surface: Surface, samples: Array, normals: Array, views: Array, diameter: float) -> Array:
    few, out = samples[::18], normals[::18]
    start = few + 1e-4 * diameter * out
    facing = out @ views.T > 0.1  # (S, W)
    s, w = np.nonzero(facing)
    seen = np.isinf(surface.first_hit(start[s], views[w]))
    weight = np.zeros(facing.shape)
    weight[s[seen], w[seen]] = (out[s[seen]] * views[w[seen]]).sum(axis=1)
    total = weight.sum(axis=0)
    return np.asarray((weight.T @ few) / np.maximum(total, 1e-12)[:, None])


def _sharpened(surface: Surface, samples: Array, motion: Pose, diameter: float) -> Pose:
    """A motion of `_likenesses` refined on the mesh itself, so that an exact symmetry shows as one."""
    few = samples[::9]
    reach = diameter * np.array([0.01, 0.01, 0.005, 0.003, 0.003])
    spread = np.full(len(few), 1e-3 * diameter)
    scan = Scanned(few, spread, None)
    return refine(surface, motion.inverse, scan, reach=tuple(reach), weighting=Weighting(0.0)).pose.inverse


def _misfit(surface: Surface, samples: Array, motion: Pose) -> float:
    """Largest distance, mm (0.998 quantile), of the moved samples from the surface."""
    moved = motion.apply(samples[::9])
    return float(np.quantile(np.linalg.norm(surface.nearest(moved)[0] - moved, axis=1), 0.998))


def _likenesses(
    coarse: DistanceGrid, fine: DistanceGrid, samples: Array, normals: Array, diameter: float
) -> tuple[Pose, ...]:
    """Motions under which most of the surface lies on the surface again: alignment of the model with itself."""
    few, out = np.ascontiguousarray(samples[::45]), np.ascontiguousarray(normals[::45])
    middle = samples.mean(axis=0)
    start = rotations(600)
    quarter = quarter_turns(samples - middle)
    start = np.concatenate([start, quarter])
    shift = middle - start @ middle
    reach = diameter * np.array([0.12, 0.12, 0.1, 0.1, 0.08, 0.06, 0.05, 0.04, 0.03, 0.03])
    rough = align(coarse, few, out, start, shift, reach)
    kept = distinct(rough.rotation, rough.translation, rough.cost, middle, 0.1, 0.03 * diameter, most=60)
    many, more = np.ascontiguousarray(samples[::12]), np.ascontiguousarray(normals[::12])
    reach = diameter * np.array([0.03, 0.02, 0.02, 0.015, 0.01, 0.01])
    done = align(fine, many, more, rough.rotation[kept], rough.translation[kept], reach)
    order = distinct(done.rotation, done.translation, done.cost, middle, 0.05, 0.02 * diameter)
    found = []
    for i in order:
        at = done.rotation[i] @ middle + done.translation[i]
        itself = angle_between(done.rotation[i], np.eye(3)) < 0.03 and np.linalg.norm(at - middle) < 0.01 * diameter
        if done.cost[i] < 0.45 and not itself:
            found.append(Pose(done.rotation[i], done.translation[i]))
    return tuple(found[:24])


def quarter_turns(centred: Array) -> Array:
    """The 24 rotations of a cube, in the principal axes of points (N, 3) about their middle."""
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    return np.ascontiguousarray(axes.T @ _turns_of_a_cube() @ axes)


def _turns_of_a_cube() -> Array:
    """The rotations (24, 3, 3) that take the axes of coordinates into each other."""
    signs = [np.eye(3)[list(p)] * np.array(s) for p in _PERMUTATIONS for s in _SIGNS]
    return np.array([m for m in signs if np.linalg.det(m) > 0])


_PERMUTATIONS = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))
_SIGNS = tuple((a, b, c) for a in (1, -1) for b in (1, -1) for c in (1, -1))


def principal_axes(vertices: Array, faces: Ints) -> tuple[Array, Array]:
    """Middle (3,) mm of a mesh's surface and its principal axes (3, 3), rows, by exact integrals over the triangles."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    middle = area @ corners.mean(axis=1) / area.sum()
    local = corners - middle
    total = local.sum(axis=1)
    moment = np.einsum("f,fki,fkj->ij", area / 12, local, local) + np.einsum("f,fi,fj->ij", area / 12, total, total)
    axes = np.linalg.eigh(moment)[1].T
    return np.asarray(middle), np.asarray(axes * np.sign(np.linalg.det(axes)))


def _plain_turns(
    surface: Surface, samples: Array, known: tuple[Pose, ...], middle: Array, axes: Array, close: float
) -> tuple[Pose, ...]:
    """Half and quarter turns about the principal axes that are symmetries and were not found: those of thin sheets."""
    found: list[Pose] = []
    for turn in _turns_of_a_cube():
        motion = Pose(axes.T @ turn @ axes, middle - axes.T @ turn @ axes @ middle)
        new = all(angle_between(motion.rotation, p.rotation) > 0.03 for p in (Pose.identity(), *known, *found))
        if new and _misfit(surface, samples, motion) < close:
            found.append(motion)
    return tuple(found)


def _axis_of_revolution(fine: DistanceGrid, samples: Array, middle: Array, axes: Array, diameter: float) -> Axis | None:
    """The axis about which any turn leaves the surface where it is, if there is one (principal axes are tried)."""
    for direction in axes:
        worst = 0.0
        for angle in (0.3, 1.1, 2.3, 3.7):
            turned = Pose.from_rotation_vector(angle * direction, np.zeros(3)).apply(samples - middle) + middle
            worst = max(worst, float(np.quantile(np.abs(fine.look_up(turned)[0]), 0.99)))
        if worst < max(0.004 * diameter, 0.7 * fine.spacing):
            return Axis(middle, direction)
    return None
