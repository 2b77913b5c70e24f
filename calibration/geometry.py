"""Rays, planes and poses: the nouns that every room shares. Lengths mm, angles rad, float64."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.reason import Reason

Array: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]
Codes: TypeAlias = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """N sighting rays. A row of NaN is a pixel that has no ray."""

    origin: Array  # (N, 3) a point on each ray, mm
    direction: Array  # (N, 3) unit vectors, away from the camera

    def __len__(self) -> int:
        return len(self.origin)

    def at(self, distance: ArrayLike) -> Array:
        """Points at signed distances (N,) mm along the rays from their origins: equation 1 of DePiero & Kress."""
        return np.asarray(self.origin + np.asarray(distance, dtype=np.float64)[..., None] * self.direction)

    def at_depth(self, z: ArrayLike) -> Array:
        """Points (N, 3) where the rays cross the planes z = ``z`` (a scalar or (N,) mm)."""
        return self.at((np.asarray(z, dtype=np.float64) - self.origin[:, 2]) / self.direction[:, 2])

    def distance_to(self, points: Array) -> Array:
        """Perpendicular distances (N,) mm from points (N, 3), one a ray."""
        offset = points - self.origin
        return np.asarray(np.linalg.norm(np.cross(offset, self.direction), axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Ranged:
    """Where rays met a sheet of light; row i belongs to ray i."""

    points: Array  # (N, 3) mm, NaN where not ranged
    incidence: Array  # (N,) |cos| of the angle between ray and sheet normal
    reason: Codes  # (N,) a Reason


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """The plane ``normal . x = offset``; also the simplest sheet of light."""

    normal: Array  # (3,) unit
    offset: float  # mm

    @classmethod
    def through(cls, point: ArrayLike, normal: ArrayLike) -> Plane:
        """Plane through a point with a normal of any length; ``ValueError`` for a zero normal."""
        direction = np.asarray(normal, dtype=np.float64)
        length = float(np.linalg.norm(direction))
        if not np.isfinite(length) or length == 0.0:
            raise ValueError("a plane needs a finite normal that is not zero")
        direction = direction / length
        return cls(direction, float(direction @ np.asarray(point, dtype=np.float64)))

    def distance(self, points: Array) -> Array:
        """Signed distances (N,) mm of points (N, 3)."""
        return np.asarray(points @ self.normal - self.offset)

    def normal_at(self, points: Array) -> Array:
        """Unit normals (N, 3) at points (N, 3): the same everywhere; a curved sheet answers otherwise."""
        return np.broadcast_to(self.normal, points.shape)

    def intersect(self, rays: Rays, *, min_incidence: float = 0.02) -> Ranged:
        """Points where rays meet the plane (DePiero & Kress, equation 1, solved for t).

        Parameters
        ----------
        rays : Rays
            N rays, mm, in the frame of the plane.
        min_incidence : float
            Least |cos| between ray and normal; shallower rays are not ranged.

        Returns
        -------
        Ranged
            NaN and ``Reason.SHALLOW`` for shallow rays; NaN and ``Reason.OUTSIDE_CALIBRATION`` for NaN rays.
        """
        cosine = rays.direction @ self.normal
        gap = self.offset - rays.origin @ self.normal
        usable = np.abs(cosine) >= min_incidence
        points = rays.at(np.divide(gap, cosine, out=np.full_like(gap, np.nan), where=usable))
        reason = np.zeros(len(gap), dtype=np.uint8)
        reason[~usable] = Reason.SHALLOW
        reason[~np.isfinite(cosine)] = Reason.OUTSIDE_CALIBRATION
        return Ranged(points, np.abs(cosine), reason)


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid motion x -> R x + t. Named right to left: ``camera_from_target``."""

    rotation: Array  # (3, 3), orthonormal, determinant +1
    translation: Array  # (3,) mm

    @classmethod
    def identity(cls) -> Pose:
        """The motion that moves nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike, *, tolerance: float = 1e-4) -> Pose:
        """Pose of a 4x4 row-major matrix; ``ValueError`` where that is no rigid motion to within ``tolerance``.

        The rotation is returned exactly orthonormal (nearest in the Frobenius norm).
        """
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape != (4, 4) or not np.isfinite(m).all():
            raise ValueError("a pose is a finite 4x4 matrix")
        r = m[:3, :3]
        if np.abs(r @ r.T - np.eye(3)).max() > tolerance or np.linalg.det(r) < 0:
            raise ValueError("its 3x3 part is no rotation (columns must be orthonormal, determinant +1)")
        if np.abs(m[3] - [0.0, 0.0, 0.0, 1.0]).max() > tolerance:
            raise ValueError("its last row is not 0 0 0 1")
        left, _, right = np.linalg.svd(r)
        return cls(left @ right, m[:3, 3].copy())

    @classmethod
    def from_rotation_vector(cls, vector: ArrayLike, translation: ArrayLike) -> Pose:
        """Pose of a rotation vector (axis times angle, rad; Rodrigues' formula) and a translation (mm)."""
        w = np.asarray(vector, dtype=np.float64)
        angle = float(np.linalg.norm(w))
        k = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        # sin(a)/a and (1 - cos a)/a^2, in forms that stay exact at a = 0
        rotation = np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (k @ k)
        return cls(rotation, np.asarray(translation, dtype=np.float64))

    @property
    def matrix(self) -> Array:
        """The 4x4 matrix."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.rotation, self.translation
        return m

    @property
    def inverse(self) -> Pose:
        """The motion that undoes this one."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: Pose) -> Pose:
        """Composition: ``(a @ b).apply(x) == a.apply(b.apply(x))``."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def apply(self, points: Array) -> Array:
        """Move points (..., 3) mm."""
        return np.asarray(points @ self.rotation.T + self.translation)


def fit_plane(points: Array, *, weights: Array | None = None) -> Plane:
    """Total least squares plane through points (N, 3) mm: the smallest singular direction about the centroid.

    The normal's largest component is positive, so that the same points always give the same plane.

    ``ValueError`` for fewer than three points or points on a line, from which no plane follows.
    """
    if len(points) < 3:
        raise ValueError("a plane needs three points")
    w = np.ones(len(points)) if weights is None else weights
    centre = w @ points / w.sum()
    _, spread, directions = np.linalg.svd(np.sqrt(w)[:, None] * (points - centre), full_matrices=False)
    if spread[1] <= 1e-12 * spread[0]:
        raise ValueError("the points lie on one line")
    normal = directions[2]
    return Plane.through(centre, normal * np.sign(normal[int(np.argmax(np.abs(normal)))]))


def rotation_from_quaternion(q: Array) -> Array:
    """Rotation matrix (3, 3) of a quaternion (4,) w x y z, which is normalised first."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: Array) -> Array:
    """Quaternion (4,) w x y z, w >= 0, of a rotation matrix: the dominant eigenvector (Bar-Itzhack 2000)."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0.0, r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2]],
            [0.0, 0.0, r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2]],
            [0.0, 0.0, 0.0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    q = np.linalg.eigh(k + np.triu(k, 1).T)[1][:, -1]
    return np.asarray(q if q[0] >= 0 else -q)
