"""What a scan saw through: a scan that would have stood in the light of another is in the wrong place."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.geometry import Array, Ints, Pose
from scope.optional import import_open3d

_FAR = 1e3  # mm, of a sensor whose place is not known
_GRAZING = 0.3  # cosine below which a splat tells little of where the surface ends
_SPLAT = 0.75  # half edge of a splat, of the spacing


class Splats:
    """The surface of a scan as small squares, one a point, that rays may hit."""

    def __init__(self, points: Array, normals: Array, spacing: float) -> None:
        self._o3d = import_open3d()
        self._scene = self._o3d.t.geometry.RaycastingScene()
        other = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
        x = np.cross(normals, other)
        x *= _SPLAT * spacing / np.linalg.norm(x, axis=1, keepdims=True)
        y = np.cross(normals, x)
        corners = np.stack([points + x + y, points - x + y, points - x - y, points + x - y], axis=1).reshape(-1, 3)
        first = 4 * np.arange(len(points))[:, None]
        faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
        self._scene.add_triangles(self._tensor(corners), self._o3d.core.Tensor(faces.astype(np.uint32)))
        self._normals = np.concatenate([normals, normals])

    def _tensor(self, values: Array) -> Any:
        return self._o3d.core.Tensor(np.ascontiguousarray(values, dtype=np.float32))

    def blocked(self, points: Array, camera: Array, margin: float) -> Array:
        """Whether (N,) something stands between points (N, 3) and their cameras (N, 3), further than ``margin`` from both."""
        ray = camera - points
        length = np.linalg.norm(ray, axis=1)
        ray = ray / length[:, None]
        hit = self._scene.cast_rays(self._tensor(np.concatenate([points + margin * ray, ray], axis=1)))
        away = hit["t_hit"].numpy()
        seen = away < length - 2 * margin
        face = np.minimum(hit["primitive_ids"].numpy().astype(np.int64), len(self._normals) - 1)
        slant = np.abs((self._normals[face] * ray).sum(axis=1))
        return np.asarray(seen & (slant > _GRAZING))


def unknown_cameras(points: Array, normals: Array, splats: Splats, some: Ints, margin: float) -> Array:
    """Cameras (N, 3) of a scan that does not tell: far away, in the direction from which it hides least of itself."""
    middle = normals.mean(axis=0)
    middle = middle / max(float(np.linalg.norm(middle)), 1e-9)
    k = np.arange(400) + 0.5
    polar, turn = np.arccos(1 - 2 * k / 400), np.pi * (1 + 5**0.5) * k
    sphere = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    tried = np.concatenate([middle[None], sphere[sphere @ middle > 0.6]])
    cost = []
    for direction in tried:
        hidden = splats.blocked(points[some], points[some] + _FAR * direction, margin)
        away = (normals[some] @ direction < 0.05).mean()
        cost.append(float(hidden.mean() + away) + 0.05 * (1.0 - float(direction @ middle)))
    return np.asarray(points + _FAR * tried[int(np.argmin(cost))])


def through(points: Array, camera: Array, splats: Splats, second_from_first: Pose, margin: float) -> float:
    """Part of one scan's points whose light another scan, put so, would have stopped."""
    if len(points) == 0:
        return 0.0
    blocked = splats.blocked(second_from_first.apply(points), second_from_first.apply(camera), margin)
    return float(blocked.mean())
