"""All scans in one frame: the assembly that most contacts support, adjusted together, and whether it is the only one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Pose
from scope.merge.overlap import contact
from scope.merge.patch import Patch
from scope.merge.search import GUESSED, SEEN_THROUGH, Candidate, blocked, candidates, lines, lines_back

_CONTRADICTED = 0.55  # purity below which two scans that overlap contradict each other
_RIVAL = 0.85  # of the best assembly's support, from which another one counts
_THROUGH = 12.0  # points that a point costs where another scan would have stopped its light
_HELD = 280.0  # 1/mm^2 that hold the loosest motion: 0.3 mm, were all contacts in 25 independent groups only
_SPREAD = 6.0  # spacings: noise of a point over that is the noise of a normal from its neighbours

Edges = Mapping[tuple[int, int], Sequence[Candidate]]


@dataclass(frozen=True, slots=True, eq=False)
class Assembly:
    """Poses of all scans in the frame of the first."""

    poses: tuple[Pose, ...]
    support: float  # points on other scans, less twice those that lie beside them, and those seen through
    contradictions: tuple[tuple[int, int], ...]  # pairs


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """The answer, or why there is none."""

    poses: tuple[Pose, ...] | None
    why: str = ""


def placed(patches: Sequence[Patch]) -> Placed:
    """Poses of scans by their shapes alone, in the frame of the first.

    Every pair is searched; the strongest sound contacts make a tree; what all other pairs then say supports or contradicts
    it. Each contact of the tree is left out in turn: an assembly that differs and has nearly the same support makes the
    answer ambiguous. Then all are adjusted together (point to plane, weighted with sigma), and a motion that no contact
    holds is refused.
    """
    n = len(patches)
    edges = {
        (i, j): [c for c in candidates(patches[i], patches[j], tried=(Pose.identity(),)) if c.sound][:3]
        for i in range(n)
        for j in range(i + 1, n)
    }
    best, rivals = _best(patches, edges)
    if best is None:
        return Placed(None, _unconnected(patches, edges))
    if best.contradictions:
        i, j = best.contradictions[0]
        return Placed(
            None,
            f"{patches[i].name} and {patches[j].name} contradict each other where the other scans put them; give scans that "
            "overlap by a quarter or more, or their poses (--poses)",
        )
    reach = 0.02 * max(p.size for p in patches)
    for rival in rivals:
        if rival.support > _RIVAL * best.support and not rival.contradictions:
            k = int(np.argmax([_apart(a, b, p) for a, b, p in zip(best.poses, rival.poses, patches, strict=True)]))
            return Placed(
                None,
                f"{patches[k].name} fits in more than one place alike (the part repeats itself where scans overlap): give scans "
                "that share more of it, or their poses (--poses)",
            )
    poses, normal, weight = adjusted(patches, best.poses, reach=reach)
    held = _loose(patches, normal, weight)
    if held is not None:
        return Placed(
            None,
            f"where {patches[held].name} overlaps others their shape does not hold it: it slides or turns on them (planes, one "
            "cylinder, a sphere): give scans that share edges or three faces, or their poses (--poses)",
        )
    return Placed(poses)


def adjusted(
    patches: Sequence[Patch], poses: Sequence[Pose], *, reach: float, steps: int = 6
) -> tuple[tuple[Pose, ...], Array, float]:
    """All poses but the first by least squares of all contacts; also the normal matrix (6 (n - 1), 6 (n - 1)) and its weight."""
    n = len(patches)
    at = list(poses)
    finest = 8.0 * float(np.median(np.concatenate([p.sigma for p in patches]))) + 0.1 * max(p.spacing for p in patches)
    cuts = np.geomspace(reach, min(finest, reach), steps)
    normal, total = np.zeros((6 * n, 6 * n)), 0.0
    middles = [p.points[p.few].mean(axis=0) for p in patches]
    for cut in cuts:
        normal, right, total = np.zeros((6 * n, 6 * n)), np.zeros(6 * n), 0.0
        for i in range(n):
            for j in range(i + 1, n):
                total += _pair(patches, at, (i, j), float(cut), normal, right)
        free = normal[6:, 6:] + 1e-9 * np.trace(normal) / (6 * n) * np.eye(6 * n - 6)
        step = -np.linalg.solve(free, right[6:])
        for k in range(1, n):
            x = step[6 * (k - 1) : 6 * k]
            pivot = at[k].apply(middles[k])
            turn = Pose.from_rotation_vector(x[:3], np.zeros(3)).rotation
            at[k] = Pose(turn @ at[k].rotation, turn @ (at[k].translation - pivot) + pivot + x[3:])
    return tuple(at), normal[6:, 6:], total


def _pair(
    patches: Sequence[Patch], at: Sequence[Pose], pair: tuple[int, int], reach: float, normal: Array, right: Array
) -> float:
    """Add what two scans say to the normal equations; each scan turns about its own middle, in the frame of the whole."""
    i, j = pair
    relative = at[j].inverse @ at[i]
    one = contact(patches[i], patches[j], relative, reach=reach)
    other = contact(patches[j], patches[i], relative.inverse, reach=reach)
    gap = np.concatenate([one.gap, other.gap])
    if len(gap) < 20:
        return 0.0
    sigma = np.concatenate([one.sigma, other.sigma])
    usual = max(1.4826 * float(np.median(np.abs(gap / sigma))), 1.0)
    weight = 1.0 / sigma**2 / np.maximum(np.abs(gap / sigma) / (3.0 * usual), 1.0)
    turn = np.kron(np.eye(2), at[j].rotation)  # from the second's frame to the whole's
    rows = []
    for k in (i, j):
        middle = relative.apply(patches[i].points[patches[i].few].mean(axis=0)) if k == i else patches[j].points[patches[j].few].mean(axis=0)  # fmt: skip
        moved = np.concatenate([lines(one, middle), lines_back(other, relative, middle)]) @ turn.T
        rows.append(moved if k == i else -moved)
    both = np.concatenate(rows, axis=1)
    place = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
    normal[np.ix_(place, place)] += both.T @ (weight[:, None] * both)
    right[place] += both.T @ (weight * gap)
    return float(weight.sum())


def _loose(patches: Sequence[Patch], normal: Array, weight: float) -> int | None:
    """The scan that moves most in a motion that the contacts do not hold; None where they hold all."""
    scale = np.concatenate([[3.0 / p.size] * 3 + [1.0] * 3 for p in patches[1:]])
    values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
    noise = max(float(np.median(p.sigma)) / (_SPREAD * p.spacing) for p in patches)
    if values[0] > _HELD + 4.0 * noise**2 * weight / max(len(patches) - 1, 1):
        return None
    return 1 + int(np.argmax((vectors[:, 0].reshape(-1, 6) ** 2).sum(axis=1)))


def _best(patches: Sequence[Patch], edges: Edges) -> tuple[Assembly | None, list[Assembly]]:
    """The assembly with most support, and others that differ from it."""
    flat = sorted(
        ((c.score, pair, k) for pair, found in edges.items() for k, c in enumerate(found)), key=lambda e: -e[0]
    )
    first = _tree(len(patches), edges, flat)
    if first is None:
        return None, []
    trees = [first]
    for out in first:
        other = _tree(len(patches), edges, [e for e in flat if (e[1], e[2]) != out])
        if other is not None and other not in trees:
            trees.append(other)
    found = [_assembly(patches, edges, tree) for tree in trees]
    found.sort(key=lambda a: (bool(a.contradictions), -a.support))
    best = found[0]
    size = max(p.size for p in patches)
    return best, [
        a for a in found[1:]
        if max(_apart(x, y, p) for x, y, p in zip(best.poses, a.poses, patches, strict=True)) > 0.02 * size
    ]  # fmt: skip


def _tree(
    n: int, edges: Edges, flat: list[tuple[float, tuple[int, int], int]]
) -> list[tuple[tuple[int, int], int]] | None:
    """Strongest contacts that connect all scans (Kruskal); None where they do not."""
    group, chosen = list(range(n)), []
    for _, (i, j), k in flat:
        if group[i] != group[j]:
            old, new = group[j], group[i]
            group = [new if g == old else g for g in group]
            chosen.append(((i, j), k))
    del edges
    return chosen if len(chosen) == n - 1 else None


def _assembly(patches: Sequence[Patch], edges: Edges, tree: list[tuple[tuple[int, int], int]]) -> Assembly:
    n = len(patches)
    poses: list[Pose | None] = [Pose.identity(), *([None] * (n - 1))]
    for _ in range(n):
        for (i, j), k in tree:
            second_from_first = edges[(i, j)][k].second_from_first
            a, b = poses[i], poses[j]
            if a is not None and b is None:
                poses[j] = a @ second_from_first.inverse
            elif b is not None and a is None:
                poses[i] = b @ second_from_first
    known = [p for p in poses if p is not None]
    reach = 0.02 * max(p.size for p in patches)
    known = list(adjusted(patches, known, reach=reach, steps=3)[0])
    support, bad = 0.0, []
    for i in range(n):
        for j in range(i + 1, n):
            relative = known[j].inverse @ known[i]
            both = (
                contact(patches[i], patches[j], relative, reach=0.6 * reach),
                contact(patches[j], patches[i], relative.inverse, reach=0.6 * reach),
            )
            tight, all_ = sum(int(c.tight.sum()) for c in both), sum(len(c.gap) for c in both)
            share = max(len(c.gap) / max(c.tried, 1) for c in both)
            margin = max(0.25 * reach, 2.0 * max(patches[i].spacing, patches[j].spacing))
            stopped = blocked(patches[i], patches[j], relative, margin, 800)
            limit = SEEN_THROUGH if patches[i].told and patches[j].told else GUESSED
            support += tight - 2.0 * (all_ - tight) - _THROUGH * stopped * (len(patches[i].few) + len(patches[j].few))
            if (share > 0.05 and tight < _CONTRADICTED * all_) or stopped > limit:
                bad.append((i, j))
    return Assembly(tuple(known), support, tuple(bad))


def _unconnected(patches: Sequence[Patch], edges: Edges) -> str:
    joined = {0}
    for _ in patches:
        joined |= {k for (i, j), found in edges.items() if found and ({i, j} & joined) for k in (i, j)}
    alone = [p.name for k, p in enumerate(patches) if k not in joined]
    return (
        f"no overlap with {patches[0].name} is sure for {', '.join(alone[:3])}{' and others' if len(alone) > 3 else ''}: give scans "
        "that overlap by a quarter or more, or their poses (--poses)"
    )


def _apart(a: Pose, b: Pose, patch: Patch) -> float:
    some = patch.points[patch.few[:: max(1, len(patch.few) // 200)]]
    return float(np.sqrt(((a.apply(some) - b.apply(some)) ** 2).sum(axis=1).mean()))
