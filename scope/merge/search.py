"""Where one scan lies in the frame of another, by their shapes alone: candidates, refined and judged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.geometry import Array, Pose
from scope.merge.overlap import Contact, contact
from scope.merge.patch import Patch
from scope.merge.sight import through
from scope.optional import import_open3d

_TRIPLETS = 150_000  # of corresponding points that are tried
_STARTS = 60  # poses that are refined
_QUICK = 700  # points of a scan by which they are refined first
PURE = 0.75  # of the contact that must be tight
LEAST_SHARE = 0.06  # of the points that must lie on the other scan
_LEAST_POINTS = 120
SEEN_THROUGH = 0.03  # of a scan's points whose light the other would have stopped; more is a contradiction
GUESSED = 0.06  # the same where the place of a sensor is not known


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One pose of a scan in the frame of another."""

    second_from_first: Pose
    one: Contact
    other: Contact
    blocked: float  # part of the points whose light the other scan would have stopped
    allowed: float

    @property
    def score(self) -> float:
        """Points on each other, of those tried."""
        return self.one.share + self.other.share

    @property
    def purity(self) -> float:
        """Part of the contact that is tight."""
        gaps = len(self.one.gap) + len(self.other.gap)
        return float(self.one.tight.sum() + self.other.tight.sum()) / max(gaps, 1)

    @property
    def sound(self) -> bool:
        """Whether the contact is large and tight enough to be believed."""
        tight = int(self.one.tight.sum() + self.other.tight.sum())
        return (
            self.blocked <= self.allowed
            and self.purity >= PURE
            and max(self.one.share, self.other.share) >= LEAST_SHARE
            and tight >= _LEAST_POINTS
        )


def candidates(first: Patch, second: Patch, *, tried: tuple[Pose, ...] = ()) -> list[Candidate]:
    """Distinct poses of the first scan in the frame of the second, the soundest first; ``tried`` are refined too.

    Points are matched by FPFH features (Rusu et al. 2009, as Open3D has them) at a voxel of a fortieth of the scans' size,
    and poses made of triplets of matches. On a part of planes a wrong pose may bring more points together than the right
    one: poses in which a scan would have looked through the other are left out before they are refined, point to plane with
    the points' own sigma, and judged by what lies on what.
    """
    voxel = max(0.025 * min(first.size, second.size), 1.5 * max(first.spacing, second.spacing))
    starts = [*tried, *triplets(*_features(first, second, voxel), voxel)]
    quick = [p for p in starts if blocked(first, second, p, 2.5 * voxel, 250) < 0.15]
    some = tuple(_thinned(patch, _QUICK) for patch in (first, second))
    near: list[Pose] = []
    for start in quick[:_STARTS]:
        pose = refined(some[0], some[1], start, voxel, parts=(2.0, 1.0, 0.6, 0.3))
        if all(_apart(pose, other, first) > 0.5 * voxel for other in near):
            near.append(pose)
    found: list[Candidate] = []
    for pose in near:
        if blocked(first, second, pose, voxel, 400) > 0.1:
            continue
        judged = judge(first, second, refined(first, second, pose, voxel, parts=(0.3, 0.15, 0.15, 0.15)), voxel)
        if all(_apart(judged.second_from_first, o.second_from_first, first) > voxel for o in found):
            found.append(judged)
    return sorted(found, key=lambda c: (not c.sound, -c.score))


def judge(first: Patch, second: Patch, pose: Pose, voxel: float) -> Candidate:
    """What speaks for and against a pose."""
    reach = max(0.5 * voxel, first.spacing, second.spacing)
    return Candidate(
        pose, contact(first, second, pose, reach=reach), contact(second, first, pose.inverse, reach=reach),
        blocked(first, second, pose, max(0.4 * voxel, 2.0 * max(first.spacing, second.spacing)), 1200),
        SEEN_THROUGH if first.told and second.told else GUESSED,
    )  # fmt: skip


def blocked(first: Patch, second: Patch, pose: Pose, margin: float, count: int) -> float:
    """Part of the points of either scan whose light the other would have stopped, the worse of both."""
    one, other = (p.few[:: max(1, len(p.few) // count)] for p in (first, second))
    return max(
        through(first.points[one], first.cameras[one], second.splats, pose, margin),
        through(second.points[other], second.cameras[other], first.splats, pose.inverse, margin),
    )


def triplets(a: Array, b: Array, normal_a: Array, normal_b: Array, pairs: Array, voxel: float) -> list[Pose]:
    """Distinct poses b_from_a of triplets of matches that keep their distances and normals, those that explain most matches first."""
    rng = np.random.default_rng(1992)
    chosen = pairs[rng.integers(len(pairs), size=(_TRIPLETS, 3))]
    p, q = a[chosen[..., 0]], b[chosen[..., 1]]
    sides = [np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2) for x in (p, q)]
    alike = (np.abs(sides[0] - sides[1]) < 1.0 * voxel).all(axis=1) & (sides[0].min(axis=1) > 4.0 * voxel)
    p, q, chosen = p[alike][:6000], q[alike][:6000], chosen[alike][:6000]
    if len(p) == 0:
        return []
    mp, mq = p.mean(axis=1, keepdims=True), q.mean(axis=1, keepdims=True)
    na, nb = normal_a[chosen[..., 0]], normal_b[chosen[..., 1]]
    # normals count as much as a point five voxels away
    spread = np.einsum("nki,nkj->nij", q - mq, p - mp) + (5.0 * voxel) ** 2 * np.einsum("nki,nkj->nij", nb, na)
    left, _, right = np.linalg.svd(spread)
    left[:, :, -1] *= np.sign(np.linalg.det(left @ right))[:, None]
    turn = left @ right
    shift = mq[:, 0] - np.einsum("nij,nj->ni", turn, mp[:, 0])
    kept = (np.einsum("nki,nij,nkj->nk", nb, turn, na) > 0.85).all(axis=1)
    kept &= (np.linalg.norm(np.einsum("nij,nkj->nki", turn, p) + shift[:, None] - q, axis=2) < voxel).all(axis=1)
    turn, shift = turn[kept], shift[kept]
    some = pairs[rng.permutation(len(pairs))[:500]]
    score = np.array([
        (np.linalg.norm(a[some[:, 0]] @ r.T + t - b[some[:, 1]], axis=1) < 1.5 * voxel).sum() for r, t in zip(turn, shift, strict=True)
    ])  # fmt: skip
    poses: list[Pose] = []
    middle = a.mean(axis=0)
    for k in np.argsort(-score, kind="stable")[:1500]:
        pose = Pose(turn[k], shift[k])
        far = [
            np.linalg.norm(pose.apply(middle) - o.apply(middle)) > 3 * voxel
            or np.trace(pose.rotation @ o.rotation.T) < 2.93
            for o in poses
        ]
        if all(far):
            poses.append(pose)
        if len(poses) >= 4 * _STARTS:
            break
    return poses


def _thinned(patch: Patch, count: int) -> Patch:
    return replace(patch, few=patch.few[:: max(1, len(patch.few) // count)])


def refined(first: Patch, second: Patch, pose: Pose, voxel: float, *, parts: tuple[float, ...]) -> Pose:
    """Point to plane (Chen and Medioni 1992), the reach growing smaller, weighted with sigma at the end."""
    for part in parts:
        one = contact(first, second, pose, reach=max(part * voxel, 0.5 * second.spacing))
        other = contact(second, first, pose.inverse, reach=max(part * voxel, 0.5 * first.spacing))
        middle = pose.apply(first.points[first.few]).mean(axis=0)
        matrix = np.concatenate([lines(one, middle), lines_back(other, pose, middle)])
        value = np.concatenate([one.gap, other.gap])
        if len(value) < 20:
            return pose
        usual = 1.4826 * float(np.median(np.abs(value))) + 1e-6
        root = 1.0 / np.concatenate([one.sigma, other.sigma])
        root /= np.sqrt(np.maximum(np.abs(value) / (2.0 * usual), 1.0))
        scale = np.array([first.size / 3] * 3 + [1.0] * 3)
        held = np.concatenate([matrix / scale * root[:, None], 1e-4 * float(np.linalg.norm(root)) * np.eye(6)])
        step = -np.linalg.lstsq(held, np.concatenate([value * root, np.zeros(6)]), rcond=None)[0] / scale
        turn = Pose.from_rotation_vector(step[:3], np.zeros(3)).rotation
        pose = Pose(turn @ pose.rotation, turn @ (pose.translation - middle) + middle + step[3:])
    return pose


def lines(found: Contact, middle: Array) -> Array:
    """Derivatives (K, 6) of the gaps when the first scan turns (rad) about ``middle`` and shifts (mm), in the second's frame."""
    return np.concatenate([np.cross(found.foot - middle, found.normal), found.normal], axis=1)


def lines_back(found: Contact, pose: Pose, middle: Array) -> Array:
    """The same of contacts that were found from the second scan, whose gaps shrink when the first comes nearer."""
    normal = found.normal @ pose.rotation.T
    return -np.concatenate([np.cross(pose.apply(found.foot) - middle, normal), normal], axis=1)


def _features(first: Patch, second: Patch, voxel: float) -> tuple[Array, Array, Array, Array, Array]:
    """Thinned points and normals of both scans, and pairs (K, 2) whose features are alike: mutual ones and the nearest three."""
    from scipy.spatial import cKDTree

    o3d = import_open3d()
    (a, na, fa), (b, nb, fb) = (_described(o3d, patch, voxel) for patch in (first, second))
    forth = cKDTree(fb).query(fa, k=3, workers=1)[1]
    back = cKDTree(fa).query(fb, k=3, workers=1)[1]
    one = np.stack([np.repeat(np.arange(len(a)), 3), forth.ravel()], axis=1)
    two = np.stack([back.ravel(), np.repeat(np.arange(len(b)), 3)], axis=1)
    return a, b, na, nb, np.concatenate([one, two])


def _described(o3d: Any, patch: Patch, voxel: float) -> tuple[Array, Array, Array]:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(patch.points))
    cloud.normals = o3d.utility.Vector3dVector(patch.normals)
    small = cloud.voxel_down_sample(voxel)
    small.normalize_normals()
    feature = o3d.pipelines.registration.compute_fpfh_feature(
        small, o3d.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100)
    )
    return np.asarray(small.points), np.asarray(small.normals), np.asarray(feature.data).T


def _apart(a: Pose, b: Pose, patch: Patch) -> float:
    """Rms distance, mm, between where two poses put a scan."""
    some = patch.points[patch.few[:: max(1, len(patch.few) // 200)]]
    return float(np.sqrt(((a.apply(some) - b.apply(some)) ** 2).sum(axis=1).mean()))
