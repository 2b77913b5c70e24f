"""The last step of a pose: closed forms of how points move and what edges show, and the bound by repeats."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import norm

from benchmarks import parts
from calibration.geometry import Array, Plane, Pose

pytest.importorskip("open3d")

from scope.model import Scanned, Surface
from scope.model.surface import sample_surface
from scope.pose.uncertainty import Shared, uncertainty
from scope.refinement import Estimate, Frame, Seen, Stripe, motions_of, refined
from scope.refinement.footprint import shift_of_stripe
from scope.refinement.groups import FEW, bounded
from scope.refinement.system import LEAST_SLOPE

LASER = np.array([0.0, -170.0, 0.0])
SHEET = np.cross([1.0, 0, 0], np.array([0.0, 0, 400]) - LASER)
SHEET /= np.linalg.norm(SHEET)
ACROSS = np.array([0.0, 1.0, 0.0])
FORM = 0.002  # mm


def test_a_point_moves_as_a_pinhole_ranges_it() -> None:
    """One pixel more across the stripe, ranged again with the sheet, against the motion for the same step along the ray."""
    rng = np.random.default_rng(0)
    ray = np.column_stack([rng.uniform(-0.2, 0.2, (50, 2)), np.ones(50)])
    sheet = Plane(SHEET, float(SHEET @ LASER))

    def ranged(direction: Array) -> Array:
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        return np.asarray(unit * (sheet.offset / (unit @ sheet.normal))[:, None])

    points, there = ranged(ray), ranged(ray + 1e-6 * ACROSS)
    unit = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    step = there - points
    line = motions_of(points, np.zeros((50, 3)), np.tile(SHEET, (50, 1)), np.tile(ACROSS, (50, 1)))
    slide = (step * line).sum(axis=1) / (line * line).sum(axis=1)
    assert np.abs(step - slide[:, None] * line).max() < 1e-4 * np.abs(step).max()
    assert np.abs(line @ SHEET).max() < 1e-12
    aside = ACROSS - (ACROSS * unit).sum(axis=1, keepdims=True) * unit
    assert np.abs((line + unit) - aside * ((line + unit) * aside).sum(axis=1, keepdims=True) / (aside**2).sum(axis=1, keepdims=True)).max() < 1e-12  # fmt: skip


@pytest.mark.parametrize("width", [0.2, 0.4])
def test_an_edge_shifts_the_stripe_as_a_truncated_gaussian(width: float) -> None:
    """A face square to the camera that ends: the mean of a Gaussian cut at a is w pdf(a/w) / cdf(a/w) from its middle."""
    block = parts.box_part(np.array([-30.0, -30, 0]), np.array([30.0, 10, 20]))
    surface, pose = Surface(block.vertices, block.faces), Pose(np.eye(3), np.array([0.0, 0.0, 400.0]))
    away = np.array([0.2, 0.4, 0.8, 5.0])  # mm to the edge at y = 10
    points = np.column_stack([np.zeros(4), 10 - away, np.full(4, 400.0)])
    camera = points - [0.0, 0.0, 400.0]
    many = np.ones((4, 1))
    stripe = Stripe(SHEET * many, ACROSS * many, points + 1e6 * (LASER - [0, 0, 400.0]), width)
    normal = np.array([0.0, 0, -1]) * many
    shift = shift_of_stripe(surface, pose, points, camera, stripe, normal, np.zeros(4))
    spread = width / abs(SHEET[1])  # one sigma of the light on the face
    mean = -spread * norm.pdf(away / spread) / norm.cdf(away / spread)  # away from the edge
    ray = points + np.outer(mean, ACROSS) - camera
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    told = camera + ray * (((points - camera) @ SHEET) / (ray @ SHEET))[:, None]
    assert shift == pytest.approx(-(told - points)[:, 2], abs=0.06 * spread)  # of 41 rays


def test_no_direction_rests_on_a_few_points() -> None:
    rng = np.random.default_rng(1)
    jacobian = np.concatenate([np.tile([0.0, 0, 1, 0, 0, 0], (500, 1)), rng.normal(size=(500, 6)) * [0, 0, 1, 1, 1, 1]])
    jacobian = np.concatenate([jacobian, [[1.0, 0, 0, 0, 0, 0]] * 3, np.tile([0.0, 1, 0, 0, 0, 0], (40, 1))])
    weight = bounded(jacobian, np.ones(len(jacobian)))
    assert weight[:1000].min() > 0.9
    assert weight[1003:] == pytest.approx(1.0)  # forty hold their direction together
    assert weight[1000:1003].max() < 3.0 / FEW**2  # three do not


# --- scatter, bound and what information is worth -----------------------------------------------------------------


@cache
def _bracket() -> tuple[Surface, Array, Array, Frame]:
    made = parts.bracket()
    surface = Surface(made.vertices, made.faces)
    points, normals = sample_surface(made.vertices, made.faces, 6000, np.random.default_rng(3))
    low, high = made.vertices.min(axis=0), made.vertices.max(axis=0)
    return surface, points, normals, Frame(0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)))


def _scene(seed: int) -> tuple[Seen, Pose, Array]:
    """A bracket tilted at random, seen by camera and laser; sigma differs threefold between points. Also the true rows' sigma."""
    rng = np.random.default_rng(seed)
    surface, points, normals, frame = _bracket()
    lean, about, spin = rng.uniform(0.4, 0.7), rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi, np.pi)
    turns = [lean * np.array([np.cos(about), np.sin(about), 0.0]), np.array([0.0, 0.0, spin])]
    tilted, spun = (Pose.from_rotation_vector(turn, np.zeros(3)).rotation for turn in turns)
    turn = tilted @ spun @ np.diag([1.0, -1.0, -1.0])
    pose = Pose(turn, np.array([0.0, 0, 400]) - turn @ frame.middle)
    at, out = pose.apply(points), normals @ turn.T
    camera = at * [0.0, 1.0, 0.0]
    way = camera - at
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    front = ((way * out).sum(axis=1) > 0.2) & np.isinf(surface.first_hit(points + 1e-3 * normals, way @ turn))
    front &= surface.crease_distance(points, 2.0) > 1.0
    chosen = np.flatnonzero(front)[:1000]
    at, camera = at[chosen], camera[chosen]
    line = motions_of(at, camera, np.tile(SHEET, (len(at), 1)), np.tile(ACROSS, (len(at), 1)))
    sigma = np.exp(rng.uniform(np.log(0.01), np.log(0.1), len(at)))
    noisy = at + (sigma * rng.normal(size=len(at)))[:, None] * line
    stripe = Stripe(np.tile(SHEET, (len(at), 1)), np.tile(ACROSS, (len(at), 1)), camera + LASER, 0.3)
    return Seen(Scanned(noisy, sigma, camera, line), stripe, camera + LASER, stated=True, line=None), pose, out[chosen]


def _less(seen: Seen, what: str) -> Seen:
    scan = seen.scan
    if what == "sensor":
        return Seen(Scanned(scan.points, scan.sigma, None), None, None, stated=True, line=None)
    if what == "sigma":
        return replace(seen, scan=replace(scan, sigma=np.full(len(scan.points), 0.1)), stated=False)
    rows = np.arange(0, len(scan.points), 2)
    assert seen.stripe is not None
    return Seen(scan.only(rows), seen.stripe.only(rows), None, stated=True, line=None)


def _motion(frame: Frame, found: Pose, truth: Pose) -> Array:
    turn = found.rotation @ truth.rotation.T
    axis = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return np.concatenate([found.apply(frame.middle) - truth.apply(frame.middle), frame.radius * axis])


def _found(seen: Seen, truth: Pose) -> Estimate:
    surface, _, _, frame = _bracket()
    return refined(surface, truth, seen, frame, cut=1.0, form=FORM)


def test_the_error_is_at_its_bound_and_knowing_less_never_helps() -> None:
    """Twenty scenes: within 1.15 of Cramer-Rao, stated as it is, and no smaller where sensor, sigma or half of the points go."""
    _, _, _, frame = _bracket()
    cost: dict[str, list[float]] = {"all": [], "sensor": [], "sigma": [], "half": []}
    whitened, stated = [], []
    for seed in range(20):
        seen, truth, normal = _scene(seed)
        across = np.abs((seen.scan.line * normal).sum(axis=1))  # type: ignore[operator]
        spread = np.hypot(seen.scan.sigma * np.maximum(across, LEAST_SLOPE), FORM)
        rows = np.concatenate([normal, np.cross(seen.scan.points - truth.apply(frame.middle), normal) / frame.radius], axis=1)  # fmt: skip
        known = (rows.T / spread**2) @ rows
        best = _found(seen, truth)
        error = _motion(frame, best.pose, truth)
        whitened.append(float(error @ known @ error) / 6)
        alone = Shared(None, np.zeros(len(spread)), None)
        told = uncertainty(best, seen, alone, centre=best.pose.apply(frame.middle), radius=frame.radius).random
        shift = best.pose.apply(frame.middle) - best.pose.translation
        about = np.eye(6)
        about[:3, 3:] = np.cross(np.eye(3), shift).T
        told = about @ told @ about.T * np.outer(*[np.repeat([1.0, frame.radius], 3)] * 2)
        stated.append(np.trace(known @ told) / 6)
        cost["all"].append(float(error @ error))
        for what in ("sensor", "sigma", "half"):
            less = _motion(frame, _found(_less(seen, what), truth).pose, truth)
            cost[what].append(float(less @ less))
    assert np.sqrt(np.mean(whitened)) < 1.15
    assert 0.8 < np.sqrt(np.mean(stated) / np.mean(whitened)) < 1.25
    for what in ("sensor", "sigma", "half"):
        assert np.mean(cost["all"]) < np.mean(cost[what]), what
