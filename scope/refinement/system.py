"""The linear system of a pose: points on faces, what the points of a face share, and where the scan ends at edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Ints, Pose
from scope.model import Surface, patches
from scope.refinement.groups import SHARED
from scope.refinement.stripe import Seen
from scope.variants import Sight, rims_of

LEAST_SLOPE = (
    0.1  # cosine to the camera, and motion across the surface for 1 mm along the ray, below which neither is believed
)
WALL = 0.6  # cosine to the camera below which a surface counts as a wall: ranging corrects its edges less
SHARES = ((0.2, 0.2), (0.4, 0.3))  # of the shift at edges that ranging leaves, on faces and on walls: mean, one sigma
DOUBT = 0.3  # of that shift, one sigma of single points
BANDS = (1.0, 2.5)  # widths of the stripe from an edge
LOSS = 0.15  # mm, one sigma: what all ends of the scan lose alike
TAIL = 0.8  # mm from the usual, beyond which an end has no weight
NOTHING = 1e-4  # 1/mm2: what is known of a motion that nothing holds
NEAR = 1.0  # 1/mm2: on the way such a motion stays about where it began


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Points of the scan on the surface of the model at one pose; motions are mm at the middle and at the radius."""

    jacobian: Array  # (N, 6)
    residual: Array  # (N,) mm, outside positive
    normal: Array  # (N, 3) cloud frame
    slope: Array  # (N,) cosine to the camera; 1 where unknown
    across: Array  # (N,) motion across the surface for 1 mm along the ray, absolute
    used: Bools  # (N,) straight above their foot, facing, not at the very edge
    edge: Array  # (N,) mm from the nearest sharp edge, up to a dozen widths
    group: Ints  # (N,) flat face, or patch of a tenth of the part
    band: Ints  # (N,) 0 at the edge to 2 far from it


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """About what motions are told."""

    middle: Array  # (3,) mm, model frame
    radius: float  # mm


def rows_at(surface: Surface, pose: Pose, seen: Seen, frame: Frame, cut: float) -> Rows:
    """The rows at a pose cloud_from_model; points further off than ``cut`` mm are not used."""
    scan = seen.scan
    closest, normal, triangle = surface.foot(pose.inverse.apply(scan.points))
    normal = normal @ pose.rotation.T
    on = pose.apply(closest)
    gap = scan.points - on
    residual = (gap * normal).sum(axis=1)
    aside = np.linalg.norm(gap - residual[:, None] * normal, axis=1)
    slope = np.ones(len(gap))
    if scan.camera is not None:
        ray = scan.camera - scan.points
        slope = (ray * normal).sum(axis=1) / np.linalg.norm(ray, axis=1)
    across = np.ones(len(gap)) if scan.line is None else np.abs((scan.line * normal).sum(axis=1))
    edge = np.minimum(surface.crease_distance(closest, 12 * seen.width), 12 * seen.width)
    used = (np.abs(residual) < cut) & (slope > LEAST_SLOPE) & (aside < 0.3 * scan.sigma + 0.01)
    used &= edge > np.minimum(3 * scan.sigma, seen.width)
    face = surface.features.face_of[triangle]
    number = np.where(face >= 0, face, len(surface.features.faces) + patches(closest, frame.radius / 5))
    group = np.unique(number, return_inverse=True)[1].ravel()
    turns = np.cross(on - pose.apply(frame.middle), normal) / frame.radius
    jacobian = -np.concatenate([normal, turns], axis=1)
    band = np.digitize(edge / seen.width, BANDS)
    return Rows(jacobian, residual, normal, slope, np.maximum(across, LEAST_SLOPE), used, edge, group, band)


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """What faces say of the P unknowns, the points of one group sharing an error; unknowns are the motion and shares at edges."""

    full: Array  # (N, P)
    residual: Array  # (N,)
    weight: Array  # (N,) 1/mm2
    group: Ints  # (N,)
    fixed: Array  # (P, P) information that is not of single points: ends of the scan, priors
    push: Array  # (P,) the same times its residual

    def solved(self) -> tuple[Array, Array, float]:
        """Unknowns (P,), information (P, P), and what the points of a group share, mm, by restricted maximum likelihood.

        Source: Patterson & Thompson 1971; on a grid, since each value costs a solution of P unknowns only.
        """
        many = int(self.group.max(initial=0)) + 1
        total = np.bincount(self.group, weights=self.weight, minlength=many)
        weighted = self.full * self.weight[:, None]
        sums = np.stack([np.bincount(self.group, weights=column, minlength=many) for column in weighted.T], axis=1)
        off = np.bincount(self.group, weights=self.weight * self.residual, minlength=many)
        own, own_push = self.full.T @ weighted + self.fixed, weighted.T @ self.residual + self.push
        square = float(self.weight @ self.residual**2)
        best = (-np.inf, np.zeros(0), np.zeros((0, 0)), 0.0)
        for shared in SHARED:
            part = shared**2 / (1 + shared**2 * total)
            known = own - (sums.T * part) @ sums
            push = own_push - sums.T @ (part * off)
            x = -np.linalg.solve(known, push)
            left = square - float(part @ off**2) + float(push @ x)
            told = -0.5 * (left + np.log1p(shared**2 * total).sum() + np.linalg.slogdet(known)[1])
            if told > best[0]:
                best = (told, x, known, float(shared))
        return best[1:]

    def gain(self, known: Array, shared: float) -> tuple[Array, Array]:
        """Unknowns for a unit of each residual (P, N), up to sign, and the residual (N,) that its group shares, at a solution x = 0."""
        many = int(self.group.max(initial=0)) + 1
        total = np.bincount(self.group, weights=self.weight, minlength=many)
        part = shared**2 / (1 + shared**2 * total)
        weighted = self.full * self.weight[:, None]
        sums = np.stack([np.bincount(self.group, weights=column, minlength=many) for column in weighted.T], axis=1)
        free = weighted - self.weight[:, None] * (part[:, None] * sums)[self.group]
        off = np.bincount(self.group, weights=self.weight * self.residual, minlength=many)
        return np.asarray(np.linalg.solve(known, free.T)), np.asarray((part * off)[self.group])


def ends_of(surface: Surface, pose: Pose, seen: Seen, frame: Frame) -> tuple[Array, Array]:
    """Information (6, 6) and push (6,) of where the scan ends at edges beyond which nothing is seen (`scope.variants`).

    Each wall is known no better than its own loss of the stripe, and all share another: they say nothing where faces know better.
    """
    sight = Sight.of(pose, seen.scan.points, seen.scan.camera, seen.laser)
    rims = rims_of(surface, surface.features.edges, sight, max(1.0, frame.radius / 75))
    if len(rims.at) == 0:
        return np.zeros((6, 6)), np.zeros(6)
    out = rims.out @ pose.rotation.T
    turns = np.cross(pose.apply(rims.at) - pose.apply(frame.middle), out) / frame.radius
    rows = -np.concatenate([out, turns], axis=1)
    share = np.minimum(((rims.beyond - float(np.median(rims.beyond))) / TAIL) ** 2, 1.0)
    weight = (1 - share) ** 2 / rims.variance
    common, lost = rows.T @ weight, float(weight.sum()) + 1 / LOSS**2
    known = (rows.T * weight) @ rows - np.outer(common, common) / lost
    return known, rows.T @ (weight * rims.beyond) - common * float(weight @ rims.beyond) / lost
