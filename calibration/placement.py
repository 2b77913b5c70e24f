"""How a misplaced plane shows in the residuals of its marks.

A mark that truly stands at ``x + d`` but is stated at ``x`` is seen by a ray that crosses the stated plane beside it.
For every way in which one plane can be misplaced, this module says by how much, mark by mark: these displacements are
the columns that the residual split (`calibration.analysis`) and the naming of faults (`calibration.faults`) fit.
"""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array
from calibration.plane_map import PlaneMarks
from calibration.ray_field import RayField

SLIP_X, SLIP_Y, ROTATION, PITCH, STAND_OFF, TILT_X, TILT_Y = range(7)
MODES = 7


def residuals(field: RayField, marks: PlaneMarks) -> Array:
    """Mark minus crossing of its ray with the stated plane, (n, 2) mm in the plane's own coordinates."""
    world = marks.world @ field.c_from_d
    across = world[:, :2] - field.crossing(marks.pixels, world[:, 2])
    return in_plane(field, marks, np.column_stack([across, np.zeros(len(across))]))


def in_plane(field: RayField, marks: PlaneMarks, offset: Array, *, ray: Array | None = None) -> Array:
    """Offsets (n, 3) mm in D of a mark from its ray, slid along the ray into the plane: (n, 2) mm, plane coordinates."""
    ray = directions(field, marks) if ray is None else ray
    plane_from_d = marks.c_from_plane.rotation.T @ field.c_from_d
    normal = plane_from_d[2]
    slid = offset - ray * ((offset @ normal) / (ray @ normal))[:, None]
    return np.asarray(slid @ plane_from_d[:2].T)


def directions(field: RayField, marks: PlaneMarks) -> Array:
    """Directions (n, 3) in D, of unit depth, of the rays that meet the stated marks: (dX/dz, dY/dz, 1).

    They belong to the pixel where the field expects the mark, not to the measured one: a mode that carried the noise of
    the centroids would fit that very noise.
    """
    world = marks.world @ field.c_from_d
    depth = world[:, 2]
    gap = world[:, :2] - field.crossing(marks.pixels, depth)
    step = np.linalg.solve(field.jacobian(marks.pixels, depth), gap[:, :, None])[:, :, 0]
    here = marks.pixels + step
    slope = (field.crossing(here, depth + field.reach) - field.crossing(here, depth)) / field.reach
    return np.column_stack([slope, np.ones(len(slope))])


def modes(field: RayField, marks: PlaneMarks) -> Array:
    """What each misplacement of one plane adds to `residuals`, (n, 2, 7) mm for a unit of it.

    The columns: slip along the plane's x and y (mm), rotation about its normal through the middle of its marks (rad),
    pitch (a relative excess of the true spacing over the stated, about the target's origin), stand-off along the depth
    axis (mm), tilts about the plane's x and y through the middle of its marks (rad). Positive means that the true plane
    lies beyond the stated one in that sense. Each is first order, and the field is taken as given.
    """
    n = len(marks)
    middle = marks.points.mean(axis=0)
    x, y = (marks.points - middle).T
    moved = np.zeros((n, 3, MODES))  # true minus stated, plane coordinates
    moved[:, 0, SLIP_X] = 1.0
    moved[:, 1, SLIP_Y] = 1.0
    moved[:, 0, ROTATION], moved[:, 1, ROTATION] = -y, x
    moved[:, :2, PITCH] = marks.points
    ray = directions(field, marks)
    plane_from_d = marks.c_from_plane.rotation.T @ field.c_from_d
    moved[:, :, STAND_OFF] = plane_from_d[:, 2]
    moved[:, 2, TILT_X], moved[:, 2, TILT_Y] = y, -x
    seen = np.empty((n, 2, MODES))
    for k in range(MODES):
        seen[:, :, k] = -in_plane(field, marks, moved[:, :, k] @ plane_from_d, ray=ray)
    return seen


def to_pixels(field: RayField, marks: PlaneMarks) -> Array:
    """Inverse Jacobians (n, 2, 2) px/mm: displacement in the plane to movement in the image."""
    depth = marks.world @ field.c_from_d[:, 2]
    jacobian = field.jacobian(marks.pixels, depth)  # of the crossing at constant depth
    columns = [in_plane(field, marks, np.column_stack([jacobian[:, :, j], np.zeros(len(marks))])) for j in range(2)]
    return np.asarray(np.linalg.inv(np.stack(columns, axis=-1)))
