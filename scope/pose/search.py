"""Many starts over all orientations, thinned to a few poses worth refining."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints, Pose
from scope.model import Model, align, distinct, fibonacci_sphere, rotations


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A part of a scan as the search sees it, thinned."""

    points: Array  # (N, 3) mm, cloud frame
    normals: Array  # (N, 3) unit, towards the camera; zero where unknown
    camera: Array | None  # (N, 3) mm, where the camera was for each point
    laser: Array | None  # (N, 3) mm


def thin(points: Array, spacing: float) -> Ints:
    """Indices of one point a cube of side ``spacing`` mm: the one nearest to the mean of its cube."""
    cell = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    size = cell.max(axis=0) + 1
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(key[order]) > 0])
    group = np.cumsum(np.r_[False, np.diff(key[order]) > 0])
    count = np.diff(np.r_[starts, len(order)])
    mean = np.add.reduceat(points[order], starts, axis=0) / count[:, None]
    gap = ((points[order] - mean[group]) ** 2).sum(axis=1)
    best = np.lexsort((gap, group))[starts]
    return np.asarray(np.sort(order[best]), dtype=np.int64)


def normals_of(points: Array, at: Array, camera: Array | None, *, radius: float) -> Array:
    """Unit normals (M, 3) at the points ``at`` (M, 3), from their neighbours among ``points`` (N, 3) within ``radius`` mm.

    Towards the camera; zero where there are fewer than six neighbours, where they lie on no plane (an edge) or where the
    camera is unknown, so that nobody knows which side is out.
    """
    from scipy.spatial import cKDTree

    if camera is None:
        return np.zeros_like(at)
    _, index = cKDTree(points).query(at, k=16, distance_upper_bound=radius, workers=1)
    known = index < len(points)
    near = points[np.where(known, index, 0)]
    count = known.sum(axis=1)
    mean = (near * known[..., None]).sum(axis=1) / np.maximum(count, 1)[:, None]
    offset = (near - mean[:, None]) * known[..., None]
    value, vector = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))
    normal = vector[:, :, 0]
    normal *= np.where(((camera - at) * normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    flat = (count >= 6) & (value[:, 0] < 0.05 * value[:, 1])
    return np.where(flat[:, None], normal, 0.0)


def search(
    model: Model,
    view: View,
    *,
    starts: int = 1000,
    keep: int = 40,
    spread: float = 0.0,
    uncovered: Callable[[Pose], float] | None = None,
) -> tuple[list[Pose], Array]:
    """Poses cloud_from_model worth refining, best first, and their costs (0: all points explained, 1: none).

    Starts lie evenly over all orientations; each puts the middle of the surface that a camera would see in this orientation
    onto the middle of the scan. Three batches of Gauss-Newton steps follow, on a coarse and on a fine distance grid.

    Parameters
    ----------
    model, view : Model, View
        The part and the thinned scan of it.
    starts, keep : int
        Orientations tried; poses that reach the last batch.
    spread : float
        How far, in diameters, the starts are put aside of that, each in another direction: things that touch the part shift
        the middle of the scan.
    uncovered : callable, optional
        Share of the surface that should have been seen at a pose cloud_from_model and was not. It is asked only where more
        poses than ``keep`` explain the points alike: a small face fits anywhere on a large one.
    """
    points = view.points
    middle = points.mean(axis=0)
    few = _some(len(points), 300)
    start = rotations(starts)  # model_from_cloud
    if view.camera is None:
        target = np.broadcast_to(model.samples.mean(axis=0), (len(start), 3))
    else:
        towards = view.camera.mean(axis=0) - middle
        seen = start @ (towards / np.linalg.norm(towards))
        target = model.view_centroid[np.argmax(seen @ model.view_direction.T, axis=1)]
    d = model.diameter
    aside = spread * d * np.roll(fibonacci_sphere(len(start)), 7 * len(start) // 19, axis=0)
    shift = target + aside - start @ middle
    p, n = np.ascontiguousarray(points[few]), np.ascontiguousarray(view.normals[few])
    reach = d * np.array([0.2, 0.2, 0.15, 0.15, 0.1, 0.1, 0.08, 0.06, 0.05, 0.04])
    rough = align(model.coarse, p, n, start, shift, reach)
    kept = distinct(rough.rotation, rough.translation, rough.cost, middle, 0.12, 0.04 * d, most=4 * keep)
    reach = d * np.array([0.05, 0.04, 0.03, 0.02, 0.02, 0.015])
    mid = align(model.fine, p, n, rough.rotation[kept], rough.translation[kept], reach)
    kept = distinct(mid.rotation, mid.translation, mid.cost, middle, 0.05, 0.02 * d)
    alike = kept[mid.cost[kept] < mid.cost[kept[0]] + 0.08]
    if uncovered is not None and len(alike) > keep // 2:
        missing = np.array([uncovered(Pose(mid.rotation[i], mid.translation[i]).inverse) for i in alike])
        kept = np.concatenate([alike[np.argsort(mid.cost[alike] + missing, kind="stable")], kept[len(alike) :]])
    kept = kept[:keep]
    many = _some(len(points), 1500)
    p, n = np.ascontiguousarray(points[many]), np.ascontiguousarray(view.normals[many])
    reach = d * np.array([0.02, 0.015, 0.012, 0.01, 0.01, 0.01])
    done = align(model.fine, p, n, mid.rotation[kept], mid.translation[kept], reach)
    order = distinct(done.rotation, done.translation, done.cost, middle, 0.03, 0.012 * d)
    return [Pose(done.rotation[i], done.translation[i]).inverse for i in order], done.cost[order]


def polish(model: Model, view: View, poses: list[Pose]) -> tuple[list[Pose], Array]:
    """The last batch of steps of `search` for further poses cloud_from_model (self-similar ones)."""
    many = _some(len(view.points), 1500)
    p, n = np.ascontiguousarray(view.points[many]), np.ascontiguousarray(view.normals[many])
    inverse = [pose.inverse for pose in poses]
    rotation = np.ascontiguousarray([q.rotation for q in inverse])
    translation = np.ascontiguousarray([q.translation for q in inverse])
    reach = model.diameter * np.array([0.03, 0.02, 0.02, 0.015, 0.012, 0.01, 0.01, 0.01])
    done = align(model.fine, p, n, rotation, translation, reach)
    return [Pose(r, t).inverse for r, t in zip(done.rotation, done.translation, strict=True)], done.cost


def _some(count: int, wanted: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Indices of ``wanted`` of ``count`` rows, evenly over the order (all of them where there are fewer)."""
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).astype(np.int64))
