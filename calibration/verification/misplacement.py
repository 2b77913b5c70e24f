"""How a misplaced plane shows in the residuals of its marks.

A mark that truly stands at ``x + d`` but is stated at ``x`` is missed by its ray. For every way in which one plane can be
misplaced, this module says by how much, mark by mark: these are the columns that the residual split
(`calibration.verification.analysis`) and the naming of faults (`calibration.verification.faults`) fit. All is in the depth frame D of the field,
"across" being its first two coordinates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.geometry import Array, Pose
from calibration.rays import PlaneMarks, RayField

SLIP_X, SLIP_Y, ROTATION, PITCH, STAND_OFF, TILT_X, TILT_Y = range(7)
MODES = 7


def expected(field: RayField, pixels: Array, world: Array) -> Array:
    """Pixels (n, 2) where the field expects marks at world (n, 3) mm in D that were seen at pixels (n, 2).

    One step of Newton's method. What is compared with the residuals must be taken here, not at the measured pixels:
    columns that carry the noise of the centroids would fit that very noise.
    """
    gap = world[:, :2] - field.crossing(pixels, world[:, 2])
    step = np.linalg.solve(field.jacobian(pixels, world[:, 2]), gap[:, :, None])[:, :, 0]
    return np.asarray(pixels + step)


def slopes(field: RayField, pixels: Array, world: Array) -> Array:
    """Slopes (n, 2) dX/dz in D of the rays of pixels (n, 2), as of `expected`, through marks at world (n, 3) mm in D."""
    ahead = field.crossing(pixels, world[:, 2] + field.reach)
    return np.asarray((ahead - field.crossing(pixels, world[:, 2])) / field.reach)


def across(field: RayField, marks: PlaneMarks, slope: Array, moved: Array) -> Array:
    """Movement (n, 2, k) mm, at the stated depth, of what is seen when marks move by (n, 3, k) mm in the plane's frame."""
    in_d = np.einsum("ij,njk->nik", field.c_from_d.T @ marks.c_from_plane.rotation, moved)
    return np.asarray(in_d[:, :2] - slope[:, :, None] * in_d[:, 2:])


def modes(field: RayField, marks: PlaneMarks, slope: Array) -> Array:
    """What each misplacement of one plane adds to "stated mark minus its ray" across depth, (n, 2, 7) mm for a unit of it.

    The columns: slip along the plane's x and y (mm), rotation about its normal through the middle of its marks (rad),
    pitch (relative excess of the true spacing over the stated, about the target's origin), stand-off along the depth
    axis (mm), tilts about the plane's x and y through the middle of its marks (rad). Positive means that the true plane
    lies beyond the stated one in that sense. First order in each; ``slope`` as of `slopes`.
    """
    x, y = (marks.points - middle(marks)).T
    moved = np.zeros((len(marks), 3, MODES))  # true minus stated
    moved[:, 0, SLIP_X] = 1.0
    moved[:, 1, SLIP_Y] = 1.0
    moved[:, 0, ROTATION], moved[:, 1, ROTATION] = -y, x
    moved[:, :2, PITCH] = marks.points
    moved[:, :, STAND_OFF] = marks.c_from_plane.rotation.T @ field.c_from_d[:, 2]
    moved[:, 2, TILT_X], moved[:, 2, TILT_Y] = y, -x
    return -across(field, marks, slope, moved)


def middle(marks: PlaneMarks) -> Array:
    """Mean (2,) mm of the marks' plane coordinates."""
    return np.asarray(marks.points.mean(axis=0))


def put_right(field: RayField, marks: PlaneMarks, amounts: Array) -> PlaneMarks:
    """Marks stated where a misplacement by ``amounts`` (7,), as of `modes`, says that they truly are."""
    points = marks.points * (1.0 + amounts[PITCH])
    centre = np.append(middle(marks), 0.0)
    turn = Pose.from_rotation_vector(amounts[[TILT_X, TILT_Y, ROTATION]], np.zeros(3))
    slip = np.append(amounts[[SLIP_X, SLIP_Y]], 0.0)
    about_centre = Pose(turn.rotation, centre - turn.rotation @ centre + slip)
    pose = marks.c_from_plane @ about_centre
    pose = Pose(pose.rotation, pose.translation + amounts[STAND_OFF] * field.c_from_d[:, 2])
    return replace(marks, points=points, c_from_plane=pose)
