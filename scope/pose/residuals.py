"""What a scan leaves on each face of its part: where the points lie, how they scatter, and whether that is more than explained."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints, Pose
from scope.model import Surface, patches

LEAST = 20  # points of a face that is told of
SURE = 3.0  # standard errors
HANGING = 0.05  # mm beside the foot's normal, beyond which a point hangs over an edge and belongs to no face


@dataclass(frozen=True, slots=True, eq=False)
class FaceResidual:
    """The points of one face of the model at the best pose."""

    what: str  # "face", "hole", "boss" or "free-form"
    at: Array  # (3,) mm, middle of the points, model frame
    direction: Array  # (3,) unit: outward normal of a face, axis of a hole or boss; NaN for free-form surface
    points: int
    mean: float  # mm, outside positive (median)
    scatter: float  # mm, one sigma, robust
    stated: float  # mm, what sigma claims for one point along its sighting ray (median); NaN where unknown
    error: float  # mm, one sigma of the mean, points of one twentieth of the part being allowed any correlation
    off: bool  # lies further off than three errors and the tolerance of the part explain


def residuals_by_face(
    surface: Surface, pose: Pose, points: Array, sigma: Array, *, diameter: float, tolerance: float
) -> tuple[FaceResidual, ...]:
    """Residuals at a pose cloud_from_model by flat face, hole, boss and what is neither, those with most points first.

    Parameters
    ----------
    surface, pose : Surface, Pose
        Of the model, and where it is.
    points, sigma : (N, 3), (N,) mm
        Of the part, cloud frame, and what is claimed for each along its sighting ray (NaN where unknown).
    diameter : float, mm
        Of the part.
    tolerance : float, mm
        How far surfaces of the right part may lie from the mesh.

    Notes
    -----
    The error of a mean is that of independent patches a twentieth of the diameter across (Liang & Zeger 1986), so that a face
    seen in one patch only is told with an error as large as its scatter.
    """
    local = pose.inverse.apply(points)
    closest, normal, triangle = surface.foot(local)
    gap = local - closest
    off = (gap * normal).sum(axis=1)
    aside = np.linalg.norm(gap - off[:, None] * normal, axis=1)
    own = (aside < HANGING) & (np.abs(off) < 2.0)
    features, count = surface.features, len(surface.features.faces)
    flat, round_of = features.face_of[triangle], features.feature_of[triangle]
    kind = np.where(flat >= 0, flat, np.where(round_of >= 0, count + round_of, count + len(features.rounds)))
    told = []
    for number in np.unique(kind[own]):
        rows = np.flatnonzero(own & (kind == number))
        if len(rows) >= LEAST:
            patch = patches(closest[rows], diameter / 20)
            told.append(_told(surface, int(number), closest[rows], off[rows], sigma[rows], patch, tolerance))
    return tuple(sorted(told, key=lambda face: -face.points))


def _told(
    surface: Surface, number: int, at: Array, off: Array, sigma: Array, patch: Ints, tolerance: float
) -> FaceResidual:
    features = surface.features
    what, direction = "free-form", np.full(3, np.nan)
    if number < len(features.faces):
        what, direction = "face", features.faces[number].normal
    elif number < len(features.faces) + len(features.rounds):
        shape = features.rounds[number - len(features.faces)]
        what, direction = ("hole" if shape.hollow else "boss"), shape.axis
    mean = float(np.median(off))
    scatter = 1.4826 * float(np.median(np.abs(off - mean)))
    error = _error(off, patch)
    known = sigma[np.isfinite(sigma)]
    stated = float(np.median(known)) if len(known) else float("nan")
    far = abs(mean) > tolerance + SURE * error
    return FaceResidual(what, np.median(at, axis=0), direction, len(off), mean, scatter, stated, error, far)


def _error(off: Array, patch: Ints) -> float:
    """One sigma of a mean of values in groups that are alike."""
    number = np.bincount(patch)
    if len(number) < 2:
        return float(off.std())
    push = np.bincount(patch, weights=off - off.mean())
    return float(np.sqrt((push**2).sum() * len(number) / (len(number) - 1)) / len(off))
