"""Hand and eye: where a camera is on a robot's arm, or beside it, from views of a target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Bools, Pose
from calibration.stages.hand_eye_start import Mount, SeenTarget, Start, consensus, turns
from calibration.stages.hand_eye_system import (
    Adjusted,
    Said,
    adjust,
    moved,
    predicted,
    robot_covariance,
    said,
    scatter_of_robot,
)

_LEAST = 3  # views
_LEAST_TURN = np.deg2rad(1.0)  # rms turn between views about the second axis
_CHANCE = 0.01  # that a sound view is left out, over all views
_BEYOND = 1e-4  # chance below which a stated repeatability is contradicted
_SCATTER_AT = (1, 3)  # steps at which the robot's scatter is estimated
_FAR = 20.0  # times the typical distance beyond which a view does not belong, before anything is weighted


@dataclass(frozen=True, slots=True, eq=False)
class Repeatability:
    """Standard deviations of a robot's pose: of each coordinate of the flange and of the turn about each axis."""

    mm: float
    rad: float


@dataclass(frozen=True, slots=True, eq=False)
class ViewOfHandEye:
    """What became of one view."""

    name: str
    used: bool
    reason: str  # why not; empty where it was used
    loo_mm: float  # rms distance of its marks, as the view puts them, from where the other views put them
    loo_ray_mm: float  # rms distance of its sighting rays from there
    off_mm: float  # by which the robot's pose is off, as the other views tell
    off_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeFit:
    """The two unknowns with covariance; frames by ``mount`` (`hand_eye_start`)."""

    mount: Mount
    sensor: Pose  # flange_from_camera, or base_from_camera
    target: Pose  # base_from_target, or flange_from_target
    covariance: Array  # (12, 12) turn rad, shift mm of ``sensor`` in its own frame, then of ``target``
    of_camera: Array  # (12, 12) the part of it that comes from the camera's calibration
    robot: Repeatability  # that was used
    robot_stated: bool  # or else estimated from the views' scatter
    beyond: float  # times by which the views scatter more than the stated repeatability explains; 1 where they do not
    views: tuple[ViewOfHandEye, ...]
    pixel_sigma: float  # rms px of a coordinate of a mark about each view's own best pose
    rms_mm: float  # of the marks from their rays, the robot's poses as they are stated
    rms_px: float

    @property
    def used(self) -> int:
        """Views that count."""
        return sum(view.used for view in self.views)

    @property
    def loo_mm(self) -> float:
        """Median over the views that count."""
        return float(np.median([view.loo_mm for view in self.views if view.used]))


def require_turns(views: Sequence[SeenTarget]) -> None:
    """``CalibrationError`` unless the arm turns about two axes, without which hand and eye are not determined.

    A pure shift tells nothing of the lever, and turns about one axis leave the place along it open (Tsai and Lenz, IEEE
    Trans. Robotics Automation 5, 1989, lemmas 1 to 4).
    """
    if len(views) < _LEAST:
        raise CalibrationError(
            f"{len(views)} views; {_LEAST} are the least and 10 or more are wanted: add views, the arm turned by 20 degrees "
            "or more about two different axes"
        )
    require_arm_turns([view.base_from_flange for view in views])


def require_arm_turns(poses: Sequence[Pose], what: str = "views") -> None:
    """``CalibrationError`` unless the flange turns about two axes between its poses in the base."""
    size, axes = turns(poses)
    if size[0] < _LEAST_TURN:
        raise CalibrationError(
            f"the arm turns by {np.rad2deg(size[0]):.2g} degrees (rms) between {len(poses)} {what}, and shifts alone do not "
            f"tell where the camera is: add {what}, the wrist turned by 20 degrees or more about two different axes"
        )
    if size[1] < _LEAST_TURN:
        x, y, z = axes[0] * np.sign(axes[0][int(np.argmax(np.abs(axes[0])))])
        raise CalibrationError(
            f"the arm turns about one axis only, ({x:.2f}, {y:.2f}, {z:.2f}) of its flange ({np.rad2deg(size[1]):.2g} degrees "
            f"rms about any other), which leaves the camera's place along it open: add {what} tilted by 20 degrees or more about "
            "another axis"
        )


def solve_hand_eye(
    views: Sequence[SeenTarget],
    mount: Mount,
    *,
    repeatability: Repeatability | None = None,
    camera_covariance: Array | None = None,
    start: Start | None = None,
) -> HandEyeFit:
    """Where the camera is, by least squares in pixels with one error of the robot a view.

    Parameters
    ----------
    views : sequence of SeenTarget
        Three or more, the arm turned about two axes; ten or more are wanted.
    mount : {"hand", "fixed"}
        Whether the camera is on the arm or beside it.
    repeatability : Repeatability, optional
        Of the robot, one standard deviation. Without it, or where the views scatter more than it allows (a robot is less
        accurate than repeatable), it is estimated from their scatter.
    camera_covariance : (P, P), optional
        Of the parameters of the camera, for views with ``by_camera``: it does not average out over views.
    start : Start, optional
        What `consensus` gave for these views.

    Returns
    -------
    HandEyeFit
        Views that contradict the others are left out, worst first, each by its chi-square about the others (6 degrees of
        freedom), and named.

    Raises
    ------
    CalibrationError
        Poses from which nothing follows (`require_turns`), or fewer than three views that agree.
    """
    require_turns(views)
    start = consensus(views, mount) if start is None else start
    chosen = [view.taken(int(c)) for view, c in zip(views, start.choice, strict=True)]
    keep = start.distance <= max(_FAR * start.typical_mm, 1e-6)
    fit = _with_stated(chosen, mount, start, keep, repeatability) if repeatability is not None else None
    beyond, stated = 1.0, fit is not None
    if fit is None or fit.contradicted:
        least = (0.0, 0.0) if repeatability is None else (repeatability.mm, repeatability.rad)
        before, fit = fit, _estimated(chosen, mount, start, keep, least)
        if before is not None:
            beyond, stated = float(np.sqrt(before.ratio)), False
    if fit.keep.sum() < _LEAST:
        raise CalibrationError(
            f"{int(fit.keep.sum())} of {len(views)} views agree with each other; {_LEAST} are the least: check that each image "
            "has the pose it was taken at, and that the target did not move"
        )
    return _told(chosen, mount, fit, camera_covariance, stated, beyond)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    sensor: Pose
    target: Pose
    keep: Bools  # (n,)
    robot: Repeatability
    said: Said  # of all views, at the solution
    adjusted: Adjusted  # of those that are kept
    ratio: float  # chi-square over its degrees of freedom
    contradicted: bool


def _settled(
    views: list[SeenTarget], mount: Mount, at: tuple[Pose, Pose], keep: Bools, robot: Repeatability | None, least: tuple[float, float]
) -> _State:  # fmt: skip
    """Gauss-Newton on the views that are kept; the robot's scatter is estimated on the way where it is not given."""
    from scipy.stats import chi2

    x, y = at
    scatter = robot
    for count in range(30):
        seen = said(views, x, y, mount)
        kept = seen.select(keep)
        if robot is None and count in _SCATTER_AT:
            scatter = Repeatability(*scatter_of_robot(kept, least))
        used = scatter or Repeatability(1.0, 0.01)
        found = adjust(kept, robot_covariance(used.mm, used.rad))
        x, y = moved(x, found.step[:6]), moved(y, found.step[6:])
        if np.abs(found.step).max() < 1e-9 and (robot is not None or count >= _SCATTER_AT[-1]):
            break
    freedom = max(6 * int(keep.sum()) - 12, 1)
    contradicted = bool(chi2.sf(found.chi2, freedom) < _BEYOND)
    return _State(x, y, keep, used, said(views, x, y, mount), found, found.chi2 / freedom, contradicted)


def _without_strangers(
    views: list[SeenTarget], mount: Mount, start: Start, keep: Bools, robot: Repeatability | None, least: tuple[float, float]
) -> _State:  # fmt: skip
    """Leave out the view that contradicts the others most, again and again, while one does and most remain."""
    from scipy.stats import chi2

    limit = float(chi2.isf(_CHANCE / len(views), 6))
    fewest = max(4, int(np.ceil(0.6 * len(views))))
    state = _settled(views, mount, (start.sensor, start.target), keep, robot, least)
    while state.keep.sum() > fewest:
        away = state.adjusted.chi2_left_out
        worst = int(np.argmax(away))
        if away[worst] < limit:
            break
        rest = state.keep.copy()
        rest[np.flatnonzero(state.keep)[worst]] = False
        state = _settled(views, mount, (state.sensor, state.target), rest, robot, least)
    return state


def _with_stated(views: list[SeenTarget], mount: Mount, start: Start, keep: Bools, robot: Repeatability) -> _State:
    return _without_strangers(views, mount, start, keep, robot, (robot.mm, robot.rad))


def _estimated(views: list[SeenTarget], mount: Mount, start: Start, keep: Bools, least: tuple[float, float]) -> _State:
    return _without_strangers(views, mount, start, keep, None, least)


def _told(
    views: list[SeenTarget], mount: Mount, state: _State, camera: Array | None, stated: bool, beyond: float
) -> HandEyeFit:
    normal = state.adjusted
    of_camera = np.zeros((12, 12))
    if camera is not None and normal.by_camera is not None:
        of_camera = normal.by_camera @ camera @ normal.by_camera.T
    told, rank = [], 0
    for i, view in enumerate(views):
        step = np.zeros(12)
        if state.keep[i]:
            step, rank = normal.left_out[rank], rank + 1
        told.append(_view(view, mount, state, i, step))
    kept = [view for view, used in zip(views, state.keep, strict=True) if used]
    gaps = [_gap(view, predicted(view, state.sensor, state.target, mount)) for view in kept]
    squares = np.concatenate([(across**2).sum(axis=1) for across, _ in gaps])
    pixels = np.concatenate([(px**2).mean(axis=1) for _, px in gaps])
    known = all(np.isfinite(view.covariance).all() for view in views)
    variance = state.said.pixel_variance[state.keep]
    if known:
        variance = variance * np.array([np.median(np.linalg.det(view.covariance)) ** 0.5 for view in kept])
    return HandEyeFit(
        mount, state.sensor, state.target, normal.covariance + of_camera, of_camera, state.robot, stated, beyond,
        tuple(told), float(np.sqrt(np.median(variance))), float(np.sqrt(squares.mean())), float(np.sqrt(pixels.mean())),
    )  # fmt: skip


def _view(view: SeenTarget, mount: Mount, state: _State, i: int, step: Array) -> ViewOfHandEye:
    x, y = moved(state.sensor, step[:6]), moved(state.target, step[6:])
    back = predicted(view, x, y, mount)
    marks = back.apply(view.points[0])
    seen = view.camera_from_target[0].apply(view.points[0])
    loo = float(np.sqrt(((marks - seen) ** 2).sum(axis=1).mean()))
    across, _ = _gap(view, back)
    error = state.said.z[i] - state.said.k[i] @ step
    off_rad, off_mm = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
    used = bool(state.keep[i])
    reason = ""
    if not used:
        reason = (
            f"the robot's pose is off by {off_mm:.3g} mm and {np.rad2deg(off_rad):.2g} degrees from what the other views say "
            f"(its marks by {loo:.3g} mm): wrong row, moved target or moving arm"
        )
    return ViewOfHandEye(view.name, used, reason, loo, float(np.sqrt((across**2).sum(axis=1).mean())), off_mm, off_rad)


def _gap(view: SeenTarget, camera_from_target: Pose) -> tuple[Array, Array]:
    """Distances (n, 3) mm of the marks across their rays, and (n, 2) px in the image."""
    gap = camera_from_target.apply(view.points[0]) - view.origin
    pixels = np.einsum("nij,nj->ni", view.to_pixels, gap)
    return np.einsum("nij,nj->ni", np.linalg.pinv(view.to_pixels), pixels), pixels


def with_names(fit: HandEyeFit, names: Sequence[str]) -> HandEyeFit:
    """The same fit, its views called otherwise."""
    return replace(fit, views=tuple(replace(v, name=n) for v, n in zip(fit.views, names, strict=True)))


def delay_step(views: Sequence[SeenTarget], twists: Array, mount: Mount, fit: HandEyeFit) -> tuple[float, float, Array]:
    """By how many seconds the robot's poses should be read later, its standard deviation, and the covariance (12, 12) with it unknown.

    Parameters
    ----------
    views : sequence of SeenTarget
        Those that count, one pose each, at the poses that the fit took.
    twists : (n, 6)
        Velocity of the flange at each, in its own frame: turns rad/s, shift mm/s. A delay moves a pose along it, as an error of
        the robot would.
    """
    seen = said(views, fit.sensor, fit.target, mount)
    weight = np.linalg.inv(seen.c + robot_covariance(fit.robot.mm, fit.robot.rad))
    whole = np.concatenate([seen.k, twists[:, :, None]], axis=2)
    normal = np.einsum("nia,nij,njb->ab", whole, weight, whole)
    right = np.einsum("nia,nij,nj->a", whole, weight, seen.z)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal * np.outer(scale, scale), rcond=1e-14, hermitian=True) * np.outer(scale, scale)
    sigma = float(np.sqrt(inverse[12, 12])) if np.abs(twists).max() > 0 else float("inf")
    return float((inverse @ right)[12]), sigma, np.asarray(inverse[:12, :12])
