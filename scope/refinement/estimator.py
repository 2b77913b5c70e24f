"""Generalised least squares of a pose over all points, iterated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints, Pose
from scope.model import Surface
from scope.refinement.footprint import shift_of_stripe, soft
from scope.refinement.groups import bounded, scales
from scope.refinement.stripe import Seen
from scope.refinement.system import DOUBT, NEAR, NOTHING, SHARES, WALL, Frame, Rows, Sums, ends_of, rows_at

TAILS = 6.0  # where Tukey's weight ends, in standard deviations
STEPS = 14
LOOK = (1, 3)  # steps at which the edges are looked at
STILL = 5e-5  # mm, the last step
SURE = 0.02  # mm: directions that faces know better are not asked of the ends of the scan
EDGE = 3.0  # widths of the stripe (longer on a surface along the sheet) from an edge, in which its shift is looked for


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Motions that something else than the points holds at a pose."""

    pose: Pose  # cloud_from_model
    motions: Array  # (L, 6) unit: shift of the middle and turns as mm at the radius
    sigma: Array  # (L,) mm


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A pose, and how it depends on every residual; motions are mm at the middle and at the radius."""

    pose: Pose  # cloud_from_model
    gain: Array  # (6, N) motion for 1 mm of each residual
    left: Array  # (N,) mm: residual without what edges and the point's face share
    normal: Array  # (N, 3) of the surface, cloud frame
    group: Ints  # (N,) what shares an error
    shared: float  # mm, one sigma of that error
    fixed: Array  # (6, 6) mm2: covariance through what are no single points (ends of the scan, shares at edges, priors)


def refined(
    surface: Surface, start: Pose, seen: Seen, frame: Frame, *, cut: float, form: float, held: Held | None = None
) -> Estimate:
    """The pose cloud_from_model at which all points fit the model best, from one within about ``cut`` mm.

    Parameters
    ----------
    surface, start, seen, frame : Surface, Pose, Seen, Frame
        The model, a pose from robust alignment, the points, and about what motions are told.
    cut : float, mm
        Points further from the surface take no part.
    form : float, mm
        One sigma that no residual is better than (facets, form).
    held : Held, optional
        Motions that borders hold, added to what points and ends of the scan say.

    Notes
    -----
    Point-to-plane least squares (Chen & Medioni 1991) with Tukey's weights. A residual's variance is that of sigma along the motion
    of a misjudged stripe, which lies in the sheet; what points of one face near its edges, and away from them, scatter beyond it
    multiplies it. Near edges the shift of the stripe that the model predicts is taken off with a share that the scan itself
    shows, and doubted by three tenths. The points of a face share an error, whose size follows from how the faces agree. No
    direction is held by fewer than a dozen points in effect. Ends of the scan at edges are rows of their own, which know little and say
    so. A bias that all points of the only face that holds a direction share does not show in any of it.
    """
    pose, begun = start, Held(start, np.eye(6), np.full(6, NEAR**-0.5))
    shift, prior = np.zeros(len(seen.scan.points)), np.array([mean for mean, _ in SHARES])
    share = prior.copy()
    for step in range(STEPS):
        rows = rows_at(surface, pose, seen, frame, cut)
        if step in LOOK:
            shift = _shifts(surface, pose, seen, rows)
        sums = _sums(surface, pose, seen, frame, rows, shift, share, form, (begun, held))
        x, known, shared = sums.solved()
        share = prior + x[6:]
        pose = moved(pose, x[:6], frame)
        if step > LOOK[-1] and float(np.abs(x[:6]).max()) < STILL:
            break
    rows = rows_at(surface, pose, seen, frame, cut)
    sums = _sums(surface, pose, seen, frame, rows, shift, share, form, (held,))
    _, known, shared = sums.solved()
    at = Sums(
        sums.full, sums.residual + sums.full[:, 6:] @ (share - prior), sums.weight, sums.group, sums.fixed, sums.push
    )
    gain, alike = at.gain(known, shared)
    inverse = np.linalg.inv(known)
    fixed = (inverse @ sums.fixed @ inverse)[:6, :6]
    return Estimate(pose, gain[:6], at.residual - alike, rows.normal, sums.group, shared, fixed)


def moved(pose: Pose, motion: Array, frame: Frame) -> Pose:
    """Pose after a motion (6,): shift of the middle, and turns about it as mm at the radius."""
    turn = Pose.from_rotation_vector(motion[3:] / frame.radius, np.zeros(3)).rotation
    middle = pose.apply(frame.middle)
    return Pose(turn @ pose.rotation, middle + motion[:3] + turn @ (pose.translation - middle))


def _shifts(surface: Surface, pose: Pose, seen: Seen, rows: Rows) -> Array:
    """Shift (N,) mm across the surface that edges give to the stripe, beyond what ranging takes off."""
    shift, stripe, camera = np.zeros(len(rows.residual)), seen.stripe, seen.scan.camera
    if stripe is None or camera is None:
        return shift
    along = np.minimum(np.abs((rows.normal * stripe.sheet).sum(axis=1)), 0.968)  # a footprint of four widths at most
    near = rows.used & (rows.edge < EDGE * stripe.width / np.sqrt(1 - along**2))
    some = np.flatnonzero(near)
    if len(some):
        points, mine = seen.scan.points[some], stripe.only(some)
        shift[some] = soft(
            shift_of_stripe(surface, pose, points, camera[some], mine, rows.normal[some], rows.residual[some])
        )
    return shift


def _sums(
    surface: Surface, pose: Pose, seen: Seen, frame: Frame, rows: Rows, shift: Array, share: Array, form: float,
    holds: tuple[Held | None, ...],
) -> Sums:  # fmt: skip
    wall = rows.slope < WALL
    columns = np.stack([np.where(wall, 0.0, shift), np.where(wall, shift, 0.0)], axis=1)
    claimed = np.sqrt((seen.scan.sigma * rows.across) ** 2 + form**2 + (DOUBT * shift) ** 2)
    deviation = (rows.residual - columns @ share) / claimed
    claimed = claimed * scales(deviation, rows.used, rows.group, rows.band, stated=seen.stated)
    tail = np.minimum(((rows.residual - columns @ share) / (TAILS * claimed)) ** 2, 1.0)
    weight = np.where(rows.used, (1 - tail) ** 2 / claimed**2, 0.0)
    weight = bounded(rows.jacobian, weight)
    full = np.concatenate([rows.jacobian, -columns], axis=1)
    mean, spread = np.array(SHARES).T
    fixed, push = np.diag(np.append(np.full(6, NOTHING), 1 / spread**2)), np.zeros(8)
    for held in holds:
        if held is not None:
            motion = _between(held.pose, pose, frame)
            fixed[:6, :6] += (held.motions.T / held.sigma**2) @ held.motions
            push[:6] += held.motions.T @ ((held.motions @ motion) / held.sigma**2)
    faces = (rows.jacobian.T * weight) @ rows.jacobian
    if float(np.linalg.eigvalsh(faces)[0]) < 1 / SURE**2:
        known, by_ends = ends_of(surface, pose, seen, frame)
        fixed[:6, :6] += known
        push[:6] += by_ends
    return Sums(full, rows.residual - columns @ mean, weight, rows.group, fixed, push)


def _between(start: Pose, end: Pose, frame: Frame) -> Array:
    """Small motion (6,) from one pose to another."""
    turn = end.rotation @ start.rotation.T
    axis = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return np.concatenate([end.apply(frame.middle) - start.apply(frame.middle), axis * frame.radius])
