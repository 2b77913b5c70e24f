"""How much a scanner stretches and shears what it sees, from points of a known shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Ints, Pose, rotation_from_quaternion
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.model import Model, Surface, patches

_AXES = "xyz"
# one sigma that is thought possible before anything is seen, rows: what moves, columns: with which coordinate
_PRIOR = np.where(np.eye(3, dtype=bool), 0.005, 0.001)
_PINHOLE_PRIOR = np.array([0.005, 0.001, 0.001, 0.001])
_FREE = (5.0, 0.05)  # mm, rad: of the artefact's place
_TOLD = 0.2  # of its prior, below which a term counts as determined
_CUT = 3.5
_LEAST = 200  # points
_STEPS = 12
_FLAT = 0.03  # third extent of the points in C over the second, below which they lie in one sheet
_ACROSS = 0.1  # square of the cosine between an axis and the sheet
_MIXED = 0.2  # component on another axis from which they are not told apart
_SLANT = 0.5  # of that displacement, one sigma that is thought possible
_FORM = 0.001  # mm: no patch of the surface is known better


@dataclass(frozen=True, slots=True, eq=False)
class Strain:
    """Matrix that takes the scanner's C to true lengths, and how sure it is."""

    matrix: Array  # (3, 3), near 1: true = matrix @ seen, in C
    terms: Array  # (3, 3), row: what moves, column: with which axis of C, along the sheet of light: mm a mm; 0 for no stretch
    sigma: Array  # (3, 3), one standard deviation of each, of the points alone
    told: Bools  # (3, 3) whether the artefact determines it; others stay near what was thought before
    pose: Pose  # cloud_from_model, with the stretch undone
    rms_mm: float  # of the points about the mesh, as scanned, at the best rigid pose
    rms_after_mm: float  # with the stretch undone
    error_mm: float  # mean deviation, as scanned, of the patch that lies furthest off
    error_sigma: float  # mm, one sigma of it
    points: Ints  # rows of the cloud that took part
    deviation: Array  # (len(points),) mm, as scanned, outside positive
    after: Array  # (len(points),) mm, with the stretch undone

    @property
    def scale(self) -> Array:
        """(3,) by how much lengths along x, y, z of C are seen too large, 1."""
        return np.asarray(-np.diag(self.terms))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Points of the artefact: in the cloud, in C, and how C is turned there."""

    rows: Ints
    cloud: Array  # (n, 3) mm
    c: Array  # (n, 3) mm
    turn: Array  # (n, 3, 3) cloud_from_C
    across: Array  # (n, 3) unit sighting rays, cloud frame
    sigma: Array  # (n,) mm


def find_strain(cloud: ScanCloud, model: Model, start: Pose, *, rows: Ints, pinhole: bool) -> Strain:
    """Least squares of pose and stretch together on the points that lie on the artefact.

    Parameters
    ----------
    cloud : ScanCloud
        With the places of its sensor.
    model : Model
        The artefact.
    start : Pose
        cloud_from_model, within about a millimetre.
    rows : (n,)
        Points that may be of it.
    pinhole : bool
        Whether the camera is one: then only a scale of all lengths and turns of C against the motion are sought.

    Returns
    -------
    Strain
        The scanner moves the point x of C to M x and carries it with the motion, which is believed. Points on edges, and
        beyond 3.5 robust deviations, take no part. Terms that the artefact does not determine (a stepped block with level
        tops tells only lengths across them) stay near 1 by what is thought possible beforehand: 0.5 % of scale, 0.1 % of tilt.

    Raises
    ------
    MeasurementError
        A cloud without the places of its sensor, or too few points.
    """
    surface = Surface(model.vertices, model.faces)
    seen = _seen(cloud, rows, model, surface, start)
    basis = _basis(pinhole)
    rigid, residual, keep, _, _ = _solved(seen, surface, start, basis[:0], np.zeros(0))
    kept = np.flatnonzero(keep)
    error, error_sigma = _worst_patch(seen.cloud[kept], residual[kept], seen.sigma[kept], model.diameter)
    prior = _PINHOLE_PRIOR if pinhole else _PRIOR.ravel()
    pose, after, keep, value, covariance = _solved(seen, surface, rigid, basis, prior)
    kept = np.flatnonzero(keep)
    along = _along(seen.c[kept])
    told_by = np.einsum("kij,lj->kil", basis, along)  # (k, 3, 3) of the terms
    sigma = np.sqrt(np.maximum(np.einsum("kij,kl,lij->ij", told_by, covariance, told_by), 0.0))
    before = np.sqrt(np.einsum("kij,k,kij->ij", told_by, prior**2, told_by))
    apart = np.abs(along.T) < _MIXED  # along the sheet, another axis may be the same direction
    told = (sigma < _TOLD * before) & along.any(axis=1) & (apart | np.eye(3, dtype=np.bool_))
    return Strain(
        np.eye(3) + np.tensordot(value, basis, 1), np.tensordot(value, told_by, 1), sigma, told, pose, _rms(residual[kept]), _rms(after[kept]),
        error, error_sigma, seen.rows[kept], residual[kept], after[kept],
    )  # fmt: skip


def _along(points: Array) -> Array:
    """Directions (3, 3) along which each axis of C is seen, their component on it 1: the axis, or within the sheet; 0 across it.

    Points of one sheet never leave it, so that nothing tells what a stretch does across it.
    """
    values, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[1:]
    if values[2] > _FLAT * values[1]:
        return np.eye(3)
    project = np.eye(3) - np.outer(axes[2], axes[2])
    own = np.diag(project)
    return np.asarray(project * np.where(own > _ACROSS, 1.0 / np.maximum(own, _ACROSS), 0.0)[:, None])


def cloud_from_c(cloud: ScanCloud, rows: Ints) -> tuple[Array, Array]:
    """Rotation (n, 3, 3) and camera's centre (n, 3) mm in the cloud at the moment of each point; ``MeasurementError`` where not told."""
    sensors = cloud.sensors
    if sensors is None or not np.isfinite(cloud.camera_centre).all():
        raise MeasurementError(
            "the cloud does not tell where its sensor was: give the cloud.ply of scope scan, as it was written"
        )
    key = sensors.frame.astype(np.int64) * 256 + sensors.laser
    order = np.argsort(key)
    wanted = cloud.frame[rows].astype(np.int64) * 256 + cloud.laser[rows]
    at = order[np.minimum(np.searchsorted(key[order], wanted), len(order) - 1)]
    if not np.array_equal(key[at], wanted):
        raise MeasurementError("some points are of frames whose sensor the cloud does not place: scan again")
    each = np.stack([rotation_from_quaternion(q) for q in sensors.rotation])
    return each[at], sensors.centre[at]


def _seen(cloud: ScanCloud, rows: Ints, model: Model, surface: Surface, start: Pose) -> _Seen:
    points = cloud.points[rows]
    local = start.inverse.apply(points)
    foot, _ = surface.nearest(local)
    gate = min(1.5, 0.05 * model.diameter)
    width = max([w for w in cloud.stripe_width if np.isfinite(w)], default=0.1)
    near = np.linalg.norm(foot - local, axis=1) < gate
    near &= surface.crease_distance(foot, 10 * width) > max(3.0 * width, 0.01 * model.diameter)
    rows = rows[near]
    if len(rows) < _LEAST:
        raise MeasurementError(
            f"{len(rows)} points lie on faces of the artefact, {_LEAST} are needed: scan more of it, or correct region or mesh"
        )
    turn, centre = cloud_from_c(cloud, rows)
    points = cloud.points[rows]
    c = np.einsum("nji,nj->ni", turn, points - centre) + cloud.camera_centre
    ray = points - centre
    return _Seen(rows, points, c, turn, ray / np.linalg.norm(ray, axis=1, keepdims=True), np.nan_to_num(cloud.sigma[rows]).astype(np.float64))  # fmt: skip


def _basis(pinhole: bool) -> Array:
    if not pinhole:
        return np.eye(9).reshape(9, 3, 3)
    turns = [np.cross(np.eye(3)[k], np.eye(3)).T for k in range(3)]
    return np.stack([np.eye(3), *turns])


def _solved(
    seen: _Seen, surface: Surface, start: Pose, basis: Array, prior: Array
) -> tuple[Pose, Array, Bools, Array, Array]:
    """Pose, residuals (n,), which count, terms of the stretch (k,) and their covariance (k, k)."""
    pose, value = start, np.zeros(len(basis))
    steady = bool(np.ptp(seen.turn, axis=0).max() < 1e-9)
    about = (
        seen.c.mean(axis=0) if steady else np.zeros(3)
    )  # where C only shifts, the artefact's place takes up the difference
    moves = np.einsum("nij,kjl,nl->nki", seen.turn, basis, seen.c - about)  # (n, k, 3) of each point, in the cloud
    slant = _slants(seen, surface, start)
    hold = np.r_[np.full(3, _FREE[0]), np.full(3, _FREE[1]), prior, np.full(slant.shape[1], _SLANT)]
    k, push = 6 + len(basis), np.zeros(slant.shape[1])
    residual, keep = np.zeros(len(seen.rows)), np.ones(len(seen.rows), dtype=np.bool_)
    middle = seen.cloud.mean(axis=0)
    inverse, design, weight = np.zeros((len(hold), len(hold))), np.zeros((0, len(hold))), np.zeros(0)
    label = np.zeros(0, dtype=np.int64)
    for _ in range(_STEPS):
        points = seen.cloud + np.einsum("nki,k->ni", moves, value)
        local = pose.inverse.apply(points)
        foot, normal = surface.nearest(local)
        residual = ((local - foot) * normal).sum(axis=1) + slant @ push
        normal = normal @ pose.rotation.T
        spread = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
        keep = np.abs(residual) < _CUT * max(spread, 2.0 * _FORM)
        if keep.sum() < _LEAST:
            raise MeasurementError(
                f"{int(keep.sum())} points agree with the artefact, {_LEAST} are needed: check its mesh"
            )
        n = normal[keep]
        stretch = np.einsum("nki,ni->nk", moves[keep], n)
        design = np.concatenate([-n, -np.cross(points[keep] - middle, n), stretch, slant[keep]], axis=1)
        noise = seen.sigma[keep] * np.abs((n * seen.across[keep]).sum(axis=1))
        label = patches(seen.cloud[keep], float(np.ptp(seen.cloud[keep], axis=0).max()) / 25)
        weight = 1.0 / (
            noise**2 + _FORM**2 * np.bincount(label)[label]
        )  # what a patch errs by as a whole does not average out
        scaled = design * hold  # by what is thought possible: terms of very different size would be lost to rounding
        inverse = np.linalg.inv(scaled.T @ (weight[:, None] * scaled) + np.eye(len(hold))) * np.outer(hold, hold)
        right = -design.T @ (weight * residual[keep])
        right[6:] -= np.r_[value, push] / hold[6:] ** 2
        step = inverse @ right
        turn = Pose.from_rotation_vector(step[3:6], np.zeros(3))
        pose = Pose(turn.rotation @ pose.rotation, turn.rotation @ (pose.translation - middle) + middle + step[:3])
        value, push = value + step[6:k], push + step[k:]
        if np.abs(step[:6]).max() < 1e-8 and np.abs(step[6:k]).max(initial=0.0) < 1e-10:
            break
    pushes = design * (weight * residual[keep])[:, None]
    summed = np.stack([np.bincount(label, weights=column) for column in pushes.T])
    groups = summed.shape[1]
    meat = summed @ summed.T * groups / max(groups - len(hold), 1)
    meat = np.maximum(1.0, np.trace(design.T @ (weight[:, None] * design)) / max(np.trace(meat), 1e-30)) * meat
    covariance = inverse @ (meat + np.diag(hold**-2)) @ inverse
    return pose, residual - slant @ push, keep, value, covariance[6:k, 6:k]


def _slants(seen: _Seen, surface: Surface, start: Pose) -> Array:
    """By how much (n, K) mm each way that faces slope may displace a stripe: one sigma at grazing sight, alike on faces that slope alike."""
    _, normal = surface.nearest(start.inverse.apply(seen.cloud))
    cosine = np.abs(((normal @ start.rotation.T) * seen.across).sum(axis=1))
    label = np.unique(np.rint(4.0 * normal).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    found = np.zeros((len(label), int(label.max()) + 1))
    found[np.arange(len(label)), label] = seen.sigma * (1.0 - cosine)
    return found[:, np.abs(found).max(axis=0) > 0]


def _worst_patch(points: Array, residual: Array, sigma: Array, diameter: float) -> tuple[float, float]:
    label = patches(points, diameter / 15)
    count = np.bincount(label)
    mean = np.bincount(label, weights=residual) / count
    good = np.flatnonzero(count >= min(30, int(count.max())))
    worst = int(good[np.argmax(np.abs(mean[good]))])
    mine = label == worst
    noise = max(float(np.std(residual[mine])), float(np.median(sigma[mine])))
    return float(mean[worst]), noise / float(np.sqrt(max(count[worst] / 4.0, 1.0)))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
