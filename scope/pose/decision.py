"""Which pose it is, if any: what each candidate explains, what it forbids and what it leaves missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Pose
from scope.model import Model, Surface, angle_between, passes
from scope.pose.search import View
from scope.pose.visibility import Visibility

CAP = 8.0  # nats: a point that the model does not explain
BLOCKED = 12.0  # nats: a point that camera or laser could not have reached through the model
MISSING = 3.0  # nats: surface that both should have seen and no point lies on; less, since metal also loses light
MARGIN = 30.0  # nats between a pose and its runner-up
GRAZE = 0.15  # spacings of the thinned scan: how deep a line of sight must lead into the model to be blocked by it
STEP = 0.01  # spacings behind the first crossing, where the next one is looked for
LEAST_NATS = 2.0  # nats: what a single point or sample must say to be heard in this


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """What a scan says of one pose."""

    pose: Pose  # cloud_from_model
    point_cost: Array  # (N + W,) nats, of the scan's points and of the background
    sample_cost: Array  # (S,) nats, of the model's samples
    explained: float  # share of the points that lie on the model
    blocked: float  # share of the points seen through the model
    covered: float  # share of the expected surface that has points; NaN where nobody knows what to expect
    expected: int  # samples of the model that should have been seen

    @property
    def cost(self) -> float:
        """Nats, of all."""
        return float(self.point_cost.sum() + self.sample_cost.sum())


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What poses of a part are rated by."""

    view: View  # the thinned scan of the part
    sigma: Array  # (N,) mm, of its points
    visibility: Visibility | None  # what camera and laser could see; without it, only the points speak
    background: View | None  # points of other things: they need not lie on the model, but must not be seen through it
    tolerance: float  # mm, one sigma: by how much the part may differ from its mesh
    spacing: float  # mm, of the thinned points


def log_likelihood(model: Model, surface: Surface, pose: Pose, scene: Scene) -> Likelihood:
    """Two-way evidence for a pose cloud_from_model."""
    view, visibility, background, spacing = scene.view, scene.visibility, scene.background, scene.spacing
    inverse = pose.inverse
    local = inverse.apply(view.points)
    closest, _ = surface.nearest(local)
    gap = np.linalg.norm(local - closest, axis=1)
    variance = scene.sigma**2 + scene.tolerance**2
    cost = np.minimum(gap**2 / (2 * variance), CAP)
    blocked = lines_blocked(surface, inverse, view, spacing)
    # a point that lies well and is blocked sits on the far side of a wall
    cost[blocked] = BLOCKED
    explained = float(((gap**2 < 16 * variance) & ~blocked).mean())
    through = float(blocked.mean())
    if background is not None:
        denied = _seen_through(model, inverse, background, 0.5 * spacing)
        cost = np.concatenate([cost, np.where(denied, BLOCKED, 0.0)])
        through += float(denied.sum()) / len(local)
    sample_cost, covered, expected = np.zeros(len(model.samples)), float("nan"), 0
    if visibility is not None:
        foreign = view.points[(gap > 2.0 * spacing) & ~blocked]
        wanted = visibility.expected(surface, pose, model.samples, model.normals, foreign)
        there = visibility.covered(pose.apply(model.samples[wanted]))
        area = area_of(model) / len(model.samples)
        sample_cost[wanted] = np.where(there, 0.0, MISSING * min(area / spacing**2, 1.0))
        expected = int(wanted.sum())
        covered = float(there.mean()) if expected else 0.0
    return Likelihood(pose, cost, sample_cost, explained, through, covered, expected)


def lines_blocked(surface: Surface, inverse: Pose, view: View, spacing: float) -> Bools:
    """Points (N,) between which and the camera or the laser the model stands.

    The first two spacings of the way are let pass, and so is a way that only grazes an edge or runs along a wall: in the middle
    of its stretch inside the model it must be deeper than ``GRAZE`` spacings.
    """
    local = inverse.apply(view.points)
    blocked = np.zeros(len(local), dtype=np.bool_)
    for eye in (view.camera, view.laser):
        if eye is None:
            continue
        way = inverse.apply(eye) - local
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        origin = local + 2.0 * spacing * way
        first = surface.first_hit(origin, way)
        rows = np.flatnonzero(np.isfinite(first) & ~blocked)
        if len(rows) == 0:
            continue
        origin, way, first = origin[rows], way[rows], first[rows, None]
        behind = origin + (first + STEP * spacing) * way
        second = surface.first_hit(behind, way)
        second = np.where(np.isfinite(second), second, 0.0)[:, None]
        for middle in (origin + 0.5 * first * way, behind + 0.5 * second * way):  # one of the two stretches is inside
            depth = np.linalg.norm(surface.nearest(middle)[0] - middle, axis=1)
            blocked[rows] |= surface.inside(middle) & (depth > GRAZE * spacing)
    return blocked


def _seen_through(model: Model, inverse: Pose, view: View, depth: float) -> Bools:
    """Points (N,) whose way to the camera or the laser leads deeper than ``depth`` mm into the model: no grazing of edges."""
    local = inverse.apply(view.points)
    through = np.zeros(len(local), dtype=np.bool_)
    for eye in (view.camera, view.laser):
        if eye is not None:
            through |= ~passes(model.fine, local, inverse.apply(eye), depth, 4.0 * depth)
    return through


def area_of(model: Model) -> float:
    """Surface of a model, mm2."""
    corners = model.vertices[model.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(cross, axis=1).sum() / 2)


def margin(best: Likelihood, other: Likelihood) -> tuple[float, bool]:
    """Nats by which ``best`` is better than ``other``, and whether that decides between them.

    It does where the gain is large and what speaks for the other is less than half of what speaks against it. Single
    differences below 2 nats are noise and speak for neither.
    """
    gain = np.concatenate([other.point_cost - best.point_cost, other.sample_cost - best.sample_cost])
    total = float(gain.sum())
    pro, contra = float(gain[gain > LEAST_NATS].sum()), float(-gain[gain < -LEAST_NATS].sum())
    return total, total > MARGIN and pro - contra > MARGIN and contra < 0.5 * pro


def same_answer(model: Model, a: Pose, b: Pose, *, turn: float, shift: float) -> bool:
    """Whether two poses put the part into the same place, its exact symmetries taken into account."""
    between = a.inverse @ b  # model to model
    for motion in (Pose.identity(), *model.symmetries):
        rest = motion.inverse @ between
        if _small(model, rest.rotation, rest.translation, turn, shift):
            return True
        if model.axis is not None and _about(model, rest, turn, shift):
            return True
    return False


def _small(model: Model, rotation: Array, translation: Array, turn: float, shift: float) -> bool:
    moved = rotation @ model.centre + translation - model.centre
    return bool(angle_between(rotation, np.eye(3)) < turn and np.linalg.norm(moved) < shift)


def _about(model: Model, motion: Pose, turn: float, shift: float) -> bool:
    if model.axis is None:
        return False
    u, p = model.axis.direction, model.axis.point
    tilt = float(np.arccos(np.clip((motion.rotation @ u) @ u, -1, 1)))
    return bool(tilt < turn and np.linalg.norm(motion.apply(p) - p) < shift)


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """Where on the model two poses differ most."""

    at: Array  # (3,) mm, model frame
    out: Array  # (3,) unit, outwards there, model frame
    size: float  # mm between the surfaces


def difference(model: Model, best: Pose, rival: Pose) -> Difference | None:
    """Where two poses cloud_from_model differ most; None where the mesh itself looks the same in both.

    The model's samples are moved by the motion between the two poses; those far from the surface then are the features
    that tell them apart.
    """
    motion = rival.inverse @ best
    away = np.abs(model.fine.look_up(motion.apply(model.samples))[0])
    worst = away > 0.5 * float(away.max())
    if float(away.max()) < 1e-3 * model.diameter:
        return None
    middle = np.median(model.samples[worst], axis=0)
    near = worst & (np.linalg.norm(model.samples - middle, axis=1) < 0.15 * model.diameter)
    out = model.normals[near if near.any() else worst].mean(axis=0)
    return Difference(middle, out / max(float(np.linalg.norm(out)), 1e-9), float(away.max()))


def what_differs(model: Model, best: Pose, rival: Pose) -> str:
    """Where on the model two poses differ most, and from where that is seen, in words."""
    found = difference(model, best, rival)
    if found is None:
        return "the mesh itself looks the same in both poses"
    x, y, z = found.at
    seen = best.rotation @ found.out
    return (
        f"the poses differ most about ({x:.0f}, {y:.0f}, {z:.0f}) mm of the model (by {found.size:.1f} mm); "
        f"scan it from the direction ({seen[0]:.2f}, {seen[1]:.2f}, {seen[2]:.2f}) of the cloud"
    )
