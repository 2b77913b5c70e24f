"""Where the camera is on a robot, in closed form, from views of which some may be wrong or counted from the wrong end.

Both mountings are one equation, A_i X B_i = Y, in which B_i = camera_from_target is seen and A_i is what the robot says:

    on the arm    A = base_from_flange    X = flange_from_camera    Y = base_from_target
    beside it     A = flange_from_base    X = base_from_camera      Y = flange_from_target
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Literal, TypeVar

import numpy as np

from calibration.geometry import Array, Ints, Pose

Mount = Literal["hand", "fixed"]
T = TypeVar("T")
_TRIALS = 160  # subsets of three views that are tried
_LEAST = 3  # views from which both unknowns follow


@dataclass(frozen=True, slots=True, eq=False)
class SeenTarget:
    """One view of the target, with what the robot said; n marks."""

    name: str
    base_from_flange: Pose  # as the robot says
    camera_from_target: tuple[Pose, ...]  # as seen; several where the target looks the same after a turn
    points: tuple[Array, ...]  # (n, 3) mm, target frame: the marks, one array for each of these poses
    origin: Array  # (n, 3) mm, C: a point on the sighting ray of each mark
    to_pixels: Array  # (n, 2, 3) px/mm: movement of a mark's image when the mark moves, 0 along the ray
    covariance: Array  # (n, 2, 2) px^2 of the marks; NaN where unknown
    by_camera: Array | None = None  # (n, 2, P) px: movement of the image, a unit of each parameter of the camera

    def taken(self, choice: int) -> SeenTarget:
        """The same view with one of its poses alone."""
        return SeenTarget(
            self.name, self.base_from_flange, (self.camera_from_target[choice],), (self.points[choice],), self.origin,
            self.to_pixels, self.covariance, self.by_camera,
        )  # fmt: skip

    def saying(self, base_from_flange: Pose) -> SeenTarget:
        """The same view with another pose of the robot."""
        return SeenTarget(
            self.name, base_from_flange, self.camera_from_target, self.points, self.origin, self.to_pixels,
            self.covariance, self.by_camera,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """What most views agree on."""

    sensor: Pose  # X: flange_from_camera, or base_from_camera
    target: Pose  # Y: base_from_target, or flange_from_target
    choice: Ints  # (n,) which of its poses each view has
    distance: Array  # (n,) rms mm by which each view's marks lie away from where X and Y put them

    @property
    def typical_mm(self) -> float:
        """Median over the views."""
        return float(np.median(self.distance))


def arm(view: SeenTarget, mount: Mount) -> Pose:
    """A of the equation."""
    return view.base_from_flange if mount == "hand" else view.base_from_flange.inverse


def consensus(views: Sequence[SeenTarget], mount: Mount, *, trials: int = _TRIALS) -> Start:
    """X and Y on which most views agree: the best of many subsets of three, then all that agree with it.

    A view may have several poses (a board that looks the same after half a turn): the one that agrees is chosen.
    ``ValueError`` for fewer than three views.
    """
    if len(views) < _LEAST:
        raise ValueError(f"{len(views)} views; hand and eye follow from {_LEAST} or more")
    poses, arrays = [arm(view, mount) for view in views], _Views.of(views, mount)
    best: Start | None = None
    for subset, choice in _subsets(views, trials):
        seen = [views[i].camera_from_target[c] for i, c in zip(subset, choice, strict=True)]
        start = arrays.judged(*closed_form([poses[i] for i in subset], seen))
        if best is None or start.typical_mm < best.typical_mm:
            best = start
    if best is None:
        raise ValueError("no subset of the views was tried")
    for _ in range(3):  # all that agree, together
        limit = max(5.0 * best.typical_mm, 1e-6)
        agree = np.flatnonzero(best.distance <= limit)
        if len(agree) < _LEAST:
            break
        seen = [views[i].camera_from_target[best.choice[i]] for i in agree.tolist()]
        again = arrays.judged(*closed_form([poses[i] for i in agree.tolist()], seen))
        if again.typical_mm > 1.2 * best.typical_mm:
            break
        best = again
    return best


def closed_form(arms: Sequence[Pose], seen: Sequence[Pose]) -> tuple[Pose, Pose]:
    """X and Y of A_i X B_i = Y.

    The rotations maximise the sum of trace(R_Y^T R_A R_X R_B): the leading singular pair of the sum of the Kronecker
    products of R_B^T and R_A, brought to the nearest rotations (Shah, J. Mechanisms Robotics 5, 2013, 031007); the
    translations then solve R_A t_X - t_Y = -t_A - R_A R_X t_B. Views that turn about one axis leave t_X undetermined along
    it: the shortest solution is given. Rotation and translation are solved one after the other, which noise does not
    forgive: this is where an adjustment starts.
    """
    a, b = np.stack([p.rotation for p in arms]), np.stack([p.rotation for p in seen])
    whole = np.einsum("nji,nkl->ikjl", b, a).reshape(9, 9)  # kron(R_B^T, R_A), vec by columns
    left, _, right = np.linalg.svd(whole)
    x, y = right[0].reshape(3, 3).T, left[:, 0].reshape(3, 3).T
    sign = np.sign(np.linalg.det(x)) or 1.0
    rx, ry = _nearest(sign * x), _nearest(sign * y)
    ta, tb = np.stack([p.translation for p in arms]), np.stack([p.translation for p in seen])
    matrix = np.concatenate([a, -np.broadcast_to(np.eye(3), a.shape)], axis=2).reshape(-1, 6)
    t = np.linalg.lstsq(matrix, (-ta - np.einsum("nij,nj->ni", a @ rx, tb)).ravel(), rcond=1e-9)[0]
    return Pose(rx, t[:3]), Pose(ry, t[3:])


def turns(poses: Sequence[Pose]) -> tuple[Array, Array]:
    """Root mean square turn (3,) rad between views about three perpendicular axes, largest first, and the axes (3, 3), in rows."""
    from calibration.notation import rotation_vector

    chosen = poses if len(poses) <= 40 else [poses[int(i)] for i in np.linspace(0, len(poses) - 1, 40)]
    vectors = np.array([rotation_vector(p.rotation.T @ q.rotation) for p, q in combinations(chosen, 2)])
    values, axes = np.linalg.eigh(vectors.T @ vectors / len(vectors))
    return np.sqrt(np.maximum(values[::-1], 0.0)), axes[:, ::-1].T


def _subsets(views: Sequence[SeenTarget], trials: int) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Subsets of three views with one pose for each; all of them where they are few, else so many at random."""
    n = len(views)
    counts = [len(view.camera_from_target) for view in views]
    if n <= 7 and max(counts) == 1:
        return [(subset, (0, 0, 0)) for subset in combinations(range(n), _LEAST)]
    rng = np.random.default_rng(2013)
    found: list[tuple[tuple[int, ...], tuple[int, ...]]] = []
    while len(found) < trials:
        subset = tuple(int(i) for i in rng.choice(n, _LEAST, replace=False))
        # the first may keep its pose: a turn of the target's frame for all views is a turn of Y
        found += [(subset, (0, *rest)) for rest in product(*(range(counts[i]) for i in subset[1:]))]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """All views as arrays: n views, c poses of each (repeated where it has fewer), four marks of each."""

    rotation: Array  # (n, 3, 3) of A
    translation: Array  # (n, 3)
    points: Array  # (n, c, 4, 3) mm, target frame
    seen: Array  # (n, c, 4, 3) mm, C, by the pose that was seen

    @classmethod
    def of(cls, views: Sequence[SeenTarget], mount: Mount) -> _Views:
        arms = [arm(view, mount) for view in views]
        most = max(len(view.camera_from_target) for view in views)
        points = np.stack([[_spread(p) for p in _repeated(view.points, most)] for view in views])
        turn = np.stack([[p.rotation for p in _repeated(view.camera_from_target, most)] for view in views])
        shift = np.stack([[p.translation for p in _repeated(view.camera_from_target, most)] for view in views])
        seen = points @ turn.transpose(0, 1, 3, 2) + shift[:, :, None, :]
        return cls(np.stack([p.rotation for p in arms]), np.stack([p.translation for p in arms]), points, seen)

    def judged(self, x: Pose, y: Pose) -> Start:
        """How far the marks lie from where X and Y put them, and which pose of each view is nearest."""
        carried = y.apply(self.points) - self.translation[:, None, None, :]
        flange = np.einsum("nji,ncpj->ncpi", self.rotation, carried)
        away = self.seen - (flange - x.translation) @ x.rotation
        distance = np.sqrt(np.einsum("ncpi,ncpi->nc", away, away) / 4)
        choice = distance.argmin(axis=1)
        return Start(x, y, choice, distance[np.arange(len(choice)), choice])


def _repeated(items: Sequence[T], count: int) -> list[T]:
    return [items[min(k, len(items) - 1)] for k in range(count)]


def _spread(points: Array) -> Array:
    """Four marks (4, 3) at the rim of a target."""
    centred = points - points.mean(axis=0)
    a, b = centred[:, 0] + centred[:, 1], centred[:, 0] - centred[:, 1]
    return np.asarray(points[[int(a.argmin()), int(b.argmax()), int(a.argmax()), int(b.argmin())]])


def _nearest(matrix: Array) -> Array:
    left, _, right = np.linalg.svd(matrix)
    left[:, -1] *= np.sign(np.linalg.det(left @ right))
    return np.asarray(left @ right)
