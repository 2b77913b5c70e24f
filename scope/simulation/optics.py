"""Exact optics of a simulated rig: a camera with distortion and a sheet of laser light, both behind flat glass.

Frame C is the camera's own: x right, y down, z forward, its pinhole at the origin. Lengths mm, pixels (u, v) with
(0, 0) at the centre of the first pixel. Nothing here is shared with the code that is judged by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from calibration.geometry import Array, Rays
from scope.simulation.physics import Beam

_STEPS = 30  # Newton steps at most; four to six are usual


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A slab of glass with parallel faces in air, wide enough for camera and laser.

    A ray leaves it in the direction in which it entered, shifted along the slab's normal (`shift`), so ``distance``
    moves nothing; it only says that nothing to be seen may stand before the far face.
    """

    thickness: float  # mm
    index: float  # of refraction, glass over air
    normal: Array  # (3,) unit, away from the camera
    distance: float  # mm, from the pinhole along z to the near face

    @classmethod
    def tilted(cls, thickness: float, index: float, tilt: tuple[float, float], distance: float) -> Window:
        """Window turned first about x, then about y, by ``tilt`` (rad); (0, 0) faces the camera squarely."""
        about_x, about_y = tilt
        normal = np.array([np.sin(about_y) * np.cos(about_x), -np.sin(about_x), np.cos(about_y) * np.cos(about_x)])
        return cls(thickness, index, normal, distance)

    def depth(self, points: Array) -> Array:
        """Signed distances (N,) mm of points (N, 3) beyond the far face."""
        return np.asarray(points @ self.normal - self.distance * self.normal[2] - self.thickness)

    def shift(self, direction: Array) -> Array:
        """Displacements (N,) mm along the normal of rays with unit directions (N, 3): Snell's law, twice.

        With the angle of incidence a: t (1 - cos a / sqrt(index^2 - sin^2 a)). NaN for rays along or against the faces.
        """
        cosine = direction @ self.normal
        cosine = np.where(cosine > 0.0, cosine, np.nan)
        return np.asarray(self.thickness * (1.0 - cosine / np.sqrt(self.index**2 - 1.0 + cosine**2)))

    def aim(self, source: Array, points: Array) -> Array:
        """Unit directions (N, 3) in which ``source`` (3,) sends the rays that reach ``points`` (N, 3) beyond the glass.

        The tangent T of the angle of incidence solves (h - t) T + t T / sqrt(index^2 + (index^2 - 1) T^2) = r, with h
        and r the point's distances along and from the normal through the source; the left side is increasing and
        concave, so Newton's method cannot fail. NaN for points that are not beyond the slab.
        """
        offset = points - source
        height = offset @ self.normal
        across = offset - height[:, None] * self.normal
        radius = np.linalg.norm(across, axis=1)
        gap = np.where(height > self.thickness, height - self.thickness, np.nan)
        square, excess = self.index**2, self.index**2 - 1.0
        tangent = radius / height
        for _ in range(_STEPS):
            root = np.sqrt(square + excess * tangent**2)
            step = (gap * tangent + self.thickness * tangent / root - radius) / (
                gap + self.thickness * square / root**3
            )
            tangent = np.maximum(tangent - step, 0.0)
            if not np.any(np.abs(step) > 1e-14 * (1.0 + tangent)):
                break
        outward = np.divide(across, radius[:, None], out=np.zeros_like(across), where=radius[:, None] > 0.0)
        direction = self.normal + tangent[:, None] * outward
        return np.asarray(direction / np.linalg.norm(direction, axis=1)[:, None])


@dataclass(frozen=True, slots=True, eq=False)
class ExactCamera:
    """A pinhole with Brown's distortion in OpenCV's order, looking along +z of C, with or without a window."""

    size: tuple[int, int]  # px, (columns, rows)
    focal: tuple[float, float]  # px
    centre: tuple[float, float]  # px
    distortion: tuple[float, float, float, float, float]  # k1 k2 p1 p2 k3
    window: Window | None = None

    @property
    def matrix(self) -> Array:
        """The 3x3 camera matrix, px."""
        return np.array([[self.focal[0], 0.0, self.centre[0]], [0.0, self.focal[1], self.centre[1]], [0.0, 0.0, 1.0]])

    @property
    def fold(self) -> float:
        """Least tangent of the angle off axis at which radial distortion turns back; inf where it never does."""
        return _fold(self.distortion)


@cache
def _fold(distortion: tuple[float, float, float, float, float]) -> float:
    """Least positive root of the derivative of r (1 + k1 r^2 + k2 r^4 + k3 r^6)."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots(np.trim_zeros(np.array([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0]), "f"))
    real = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0.0)].real
    return float(np.sqrt(real.min())) if len(real) else np.inf


def _distort(camera: ExactCamera, x: Array, y: Array) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


def _undistort(camera: ExactCamera, xd: Array, yd: Array) -> tuple[Array, Array]:
    """Inverse of `_distort` by Newton's method; NaN where it does not converge (beyond the fold)."""
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = xd.copy(), yd.copy()
    error = np.zeros_like(x)
    for _ in range(_STEPS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        fx, fy = _distort(camera, x, y)
        ex, ey = fx - xd, fy - yd
        xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        xy = x * y * slope + 2.0 * (p1 * x + p2 * y)
        determinant = xx * yy - xy * xy
        determinant = np.where(np.abs(determinant) > 1e-9, determinant, np.nan)
        x = x - (yy * ex - xy * ey) / determinant
        y = y - (xx * ey - xy * ex) / determinant
        error = np.hypot(ex, ey)
        if not np.any(error > 1e-15):
            break
    inside = (error < 1e-10) & (x * x + y * y < camera.fold**2)
    return np.where(inside, x, np.nan), np.where(inside, y, np.nan)


def project(camera: ExactCamera, points: Array) -> Array:
    """Pixels (N, 2) in which points (N, 3) mm in C are seen.

    NaN for points behind the camera, before the far face of its window, or beyond the fold of its distortion. The image
    has no border here: pixels outside it are returned as well.
    """
    if camera.window is None:
        direction = points
    else:
        direction = camera.window.aim(np.zeros(3), points)
        direction = np.where(camera.window.depth(points)[:, None] > 0.0, direction, np.nan)
    ahead = np.where(direction[:, 2] > 0.0, direction[:, 2], np.nan)
    x, y = direction[:, 0] / ahead, direction[:, 1] / ahead
    x = np.where(x * x + y * y < camera.fold**2, x, np.nan)
    xd, yd = _distort(camera, x, y)
    return np.stack([camera.focal[0] * xd + camera.centre[0], camera.focal[1] * yd + camera.centre[1]], axis=1)


def exact_rays(camera: ExactCamera, pixels: Array) -> Rays:
    """Sighting rays of pixels (N, 2), beyond the window: the truth against which calibrated rays are judged.

    Each starts at the point of the window's normal through the pinhole from which it seems to come (the pinhole itself
    without a window). NaN rows beyond the fold of the distortion.
    """
    x, y = _undistort(
        camera,
        (pixels[:, 0] - camera.centre[0]) / camera.focal[0],
        (pixels[:, 1] - camera.centre[1]) / camera.focal[1],
    )
    direction = np.stack([x, y, np.ones_like(x)], axis=1)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    if camera.window is None:
        return Rays(np.zeros_like(direction), direction)
    return Rays(camera.window.shift(direction)[:, None] * camera.window.normal, direction)


@dataclass(frozen=True, slots=True, eq=False)
class ExactLaser:
    """A fan of laser light in one plane before the window; its sheet is slightly curved beyond it.

    Across the sheet the light is Gaussian, ``width`` mm wide at every range (a collimated cross-section) unless a ``beam``
    says how it widens, and along the fan it is even: fall-off with the angle is left out, since it moves no stripe.
    """

    origin: Array  # (3,) mm, in C
    axis: Array  # (3,) unit, the middle of the fan
    along: Array  # (3,) unit, in the plane of the fan, square to the axis
    normal: Array  # (3,) unit, of the fan's plane
    width: float  # mm, one sigma
    half_fan: float  # rad
    window: Window | None = None
    beam: Beam | None = None  # without one, the light is as wide and as strong everywhere

    @classmethod
    def aimed(
        cls,
        origin: Array,
        through: Array,
        *,
        width: float,
        roll: float = 0.0,
        half_fan: float = np.pi / 6,
        window: Window | None = None,
        beam: Beam | None = None,
    ) -> ExactLaser:
        """Laser whose axis leaves ``origin`` towards ``through`` (mm, C; before the window bends it).

        With ``roll`` = 0 (rad) the fan is square to the plane of its axis and the camera's, where it triangulates best;
        a positive roll turns it right-handedly about its axis. ``ValueError`` where both points are one.
        """
        axis = np.asarray(through, dtype=np.float64) - origin
        length = np.linalg.norm(axis)
        if length == 0.0:
            raise ValueError("a laser must be aimed at another point than its origin")
        axis = axis / length
        along = np.cross([0.0, 0.0, 1.0], axis)
        if np.linalg.norm(along) < 1e-9:
            along = np.cross(axis, [1.0, 0.0, 0.0])
        along = along / np.linalg.norm(along)
        along = np.cos(roll) * along + np.sin(roll) * np.cross(axis, along)
        return cls(
            np.asarray(origin, dtype=np.float64), axis, along, np.cross(axis, along), width, half_fan, window, beam
        )

    def rays(self, angle: Array, offset: Array | float = 0.0) -> Rays:
        """Rays beyond the window at angles (N,) rad from the axis, displaced by ``offset`` mm across the sheet."""
        direction = np.cos(angle)[:, None] * self.axis + np.sin(angle)[:, None] * self.along
        origin = self.origin + np.broadcast_to(np.asarray(offset, dtype=np.float64), angle.shape)[:, None] * self.normal
        if self.window is not None:
            origin = origin + self.window.shift(direction)[:, None] * self.window.normal
        return Rays(origin, direction)

    def reach(self, points: Array) -> tuple[Rays, Array]:
        """Rays that light points (N, 3) beyond the window, and the points' distances (N,) mm from the sheet."""
        if self.window is None:
            offset = points - self.origin
            rays = Rays(np.broadcast_to(self.origin, points.shape), offset / np.linalg.norm(offset, axis=1)[:, None])
            return rays, np.asarray(offset @ self.normal)
        direction = self.window.aim(self.origin, points)
        rays = Rays(self.origin + self.window.shift(direction)[:, None] * self.window.normal, direction)
        return rays, np.asarray(np.linalg.norm(points - rays.origin, axis=1) * (direction @ self.normal))

    def width_at(self, points: Array) -> Array:
        """Width (N,) mm of the light across the sheet at points (N, 3), one sigma."""
        if self.beam is None:
            return np.full(len(points), self.width)
        return self.beam.width(np.linalg.norm(points - self.origin, axis=1))

    def strength_at(self, points: Array) -> Array:
        """Light (N,) in the middle of the sheet at points (N, 3), of one."""
        if self.beam is None:
            return np.ones(len(points))
        return self.beam.strength(np.linalg.norm(points - self.origin, axis=1))

    def sheet_normal(self, points: Array) -> Array:
        """Unit normals (N, 3) of the sheet at points (N, 3): the gradient of the distance, by central differences."""
        if self.window is None:
            return np.broadcast_to(self.normal, points.shape)
        step = 0.05
        gradient = np.stack(
            [(self.reach(points + step * e)[1] - self.reach(points - step * e)[1]) for e in np.eye(3)], axis=1
        )
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1)[:, None])
