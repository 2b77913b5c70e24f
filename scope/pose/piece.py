"""The pose of the part in one piece of a scan: search, refine, rate, decide, and ask whether it is this part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints, Pose
from scope.cloud import ScanCloud
from scope.model import Fit, Model, Scanned, Surface, Weighting, distinct, evaluate, refine
from scope.pose import segmentation
from scope.pose.answer import LEAST_SHOWN, Candidate, PoseOptions, PoseResult
from scope.pose.borders import REACH, Sliding, settle_by_borders
from scope.pose.decision import (
    CAP,
    MISSING,
    Likelihood,
    Scene,
    area_of,
    log_likelihood,
    margin,
    same_answer,
    what_differs,
)
from scope.pose.residuals import residuals_by_face
from scope.pose.rim import settle_by_rim
from scope.pose.search import View, normals_of, polish, search, thin
from scope.pose.uncertainty import Shared, Uncertainty, shared_errors, uncertainty
from scope.pose.visibility import Visibility, seen_of, viewpoints, visibility_of
from scope.refinement import Frame, Held, Seen, refined
from scope.variants import MIRROR, Evidence, Undecided, Variant, judge

CLEAR_EXPLAINED = 0.9  # share of the points, above which a first search is not repeated with more starts
CLEAR_COVERED = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """One piece of a scan, and the part that is looked for in it."""

    cloud: ScanCloud
    rows: Ints  # of the cloud
    model: Model
    surface: Surface
    options: PoseOptions
    seen: Seen  # its points, all of them
    visibility: Visibility | None

    @property
    def scan(self) -> Scanned:
        """The points, as alignment sees them."""
        return self.seen.scan


def locate(
    cloud: ScanCloud, rows: Ints, model: Model, surface: Surface, initial: Pose | None, options: PoseOptions
) -> PoseResult:
    """Search, refine and decide for one piece of the scan."""
    points = cloud.points[rows]
    size = segmentation.extent(points)
    if size > 1.6 * model.diameter:
        return _refused(
            model, rows,
            f"the piece of the scan is {size:.0f} mm across and the part {model.diameter:.0f} mm; give the region of the part",
        )  # fmt: skip
    spacing = model.diameter / 100
    chosen = thin(points, spacing)
    shown, whole = len(chosen) * spacing**2, area_of(model)
    if len(chosen) < 60 or shown < LEAST_SHOWN * whole:
        return _refused(
            model, rows,
            f"the scan shows {shown:.0f} mm2 of the part's {whole:.0f} mm2, at least {100 * LEAST_SHOWN:.0f} % needed; scan more of it",
        )  # fmt: skip
    piece, scene = _prepared(cloud, rows, model, surface, options, chosen)
    return _decide(piece, _rated(piece, scene, initial), scene.view)


def _prepared(
    cloud: ScanCloud, rows: Ints, model: Model, surface: Surface, options: PoseOptions, chosen: Ints
) -> tuple[Piece, Scene]:
    """The piece, and the thinned scan of it with what else is in the cloud."""
    points, spacing = cloud.points[rows], model.diameter / 100
    camera, laser = viewpoints(cloud, rows)
    chosen = chosen[np.random.default_rng(0).permutation(len(chosen))]
    at = camera[chosen] if camera is not None else None
    normal = normals_of(points, points[chosen], at, radius=4 * spacing)
    view = View(points[chosen], normal, at, None if laser is None else laser[chosen])
    sigma = _sigma(cloud, rows)
    others = np.setdiff1d(np.arange(len(cloud)), rows)
    if len(others):
        others = others[segmentation.crowded(cloud.points[others], 2 * spacing)]
    if len(others):
        others = others[thin(cloud.points[others], 2 * spacing)]
    background = None
    if len(others) and camera is not None:
        far_camera, far_laser = viewpoints(cloud, others)
        background = View(cloud.points[others], np.zeros((len(others), 3)), far_camera, far_laser)
    visibility = visibility_of(cloud, cloud.points[others], voxel=1.5 * spacing)
    piece = Piece(cloud, rows, model, surface, options, seen_of(cloud, rows, sigma), visibility)
    return piece, Scene(view, sigma[chosen], visibility, background, options.tolerance, spacing)


def _rated(piece: Piece, scene: Scene, initial: Pose | None) -> list[Likelihood]:
    """Candidates, refined and rated, best first; with more starts where the first leave much unexplained."""
    model, surface, options, visibility = piece.model, piece.surface, piece.options, piece.visibility
    uncovered = (
        None
        if visibility is None
        else lambda pose: visibility.uncovered(surface, pose, model.samples[::40], model.normals[::40])
    )
    rated: list[Likelihood] = []
    for starts, keep, spread in ((options.starts, 40, 0.0), (4 * options.starts, 120, 0.15)):
        poses, cost = search(model, scene.view, starts=starts, keep=keep, spread=spread, uncovered=uncovered)
        poses, cost = _with_likenesses(model, scene.view, poses, cost, initial)
        found = _log_likelihoods(piece, scene, poses)
        if not rated or found[0].cost < rated[0].cost:
            rated = found
        if not options.harder or (rated[0].explained >= CLEAR_EXPLAINED and not rated[0].covered < CLEAR_COVERED):
            break  # else look harder, before saying no and before believing a pose that leaves much unexplained
    return rated


def _refused(model: Model, rows: Ints, why: str) -> PoseResult:
    """An answer for a piece that was not even searched."""
    unknown = np.full(len(rows), np.nan)
    return PoseResult(None, None, None, 0.0, float("nan"), False, why, (), "", None, rows, unknown, model)


def _sigma(cloud: ScanCloud, rows: Ints) -> Array:
    """Sigma (N,) mm of points; where unknown, the usual one of those known, else 0.1."""
    sigma = cloud.sigma[rows].astype(np.float64)
    known = np.isfinite(sigma) & (sigma > 0)
    usual = float(np.median(sigma[known])) if known.any() else 0.1
    return np.where(known, sigma, usual)


def _with_likenesses(
    model: Model, view: View, poses: list[Pose], cost: Array, initial: Pose | None
) -> tuple[list[Pose], Array]:
    """Add to the best poses those in which the model looks like itself; distinct ones, best first."""
    more = [poses[i] @ motion for i in range(min(2, len(poses))) for motion in model.likenesses]
    more += [] if initial is None else [initial, *(initial @ motion for motion in model.likenesses)]
    if not more:
        return poses, cost
    more, costs = polish(model, view, more)
    everything = poses + more
    total = np.concatenate([cost, costs])
    rotation = np.stack([p.inverse.rotation for p in everything])
    translation = np.stack([p.inverse.translation for p in everything])
    kept = distinct(rotation, translation, total, view.points.mean(axis=0), 0.03, 0.012 * model.diameter)
    return [everything[i] for i in kept], total[kept]


def _log_likelihoods(piece: Piece, scene: Scene, poses: list[Pose]) -> list[Likelihood]:
    """Refined and rated candidates, best first.

    A quick look on the distance grid leaves out those that are far behind; the rest are refined on the mesh.
    """
    model, surface, options, view, sigma = piece.model, piece.surface, piece.options, scene.view, scene.sigma
    visibility = scene.visibility
    d, tolerance = model.diameter, options.tolerance
    variance = sigma**2 + tolerance**2 + (0.1 * model.fine.spacing) ** 2
    quick = []
    for pose in poses:
        gap = model.fine.look_up(pose.inverse.apply(view.points))[0]
        quick.append(float(np.minimum(gap**2 / (2 * variance), CAP).sum()))
    order = np.argsort(quick)
    near = [k for n, k in enumerate(order) if n < 3 or quick[k] < quick[order[0]] + 0.15 * CAP * len(sigma)]
    if visibility is not None and len(near) > options.candidates:
        samples, normals = model.samples[::18], model.normals[::18]
        missing = [len(sigma) * visibility.uncovered(surface, poses[k], samples, normals) for k in near]
        near = [near[i] for i in np.argsort([quick[k] + MISSING * m for k, m in zip(near, missing, strict=True)])]
    few = Scanned(view.points, sigma, view.camera).only(slice(0, 2500))
    reach = (0.01 * d, 0.008 * d, 0.006 * d, 0.005 * d, max(1.0, 0.003 * d), max(1.0, 0.003 * d))
    done: list[Likelihood] = []
    hopeless = quick[order[0]] > 0.7 * CAP * len(sigma)
    for k in near[: 2 if hopeless else options.candidates]:
        fit = refine(surface, poses[k], few, reach=reach, weighting=Weighting(tolerance, borders=True))
        if not any(same_answer(model, fit.pose, e.pose, turn=0.004, shift=0.002 * d) for e in done):
            done.append(log_likelihood(model, surface, fit.pose, scene))
    return sorted(done, key=lambda e: e.cost)


def _calibration(piece: Piece) -> Shared:
    """What the points of the piece share."""
    sigma_cal = piece.cloud.sigma_cal[piece.rows].astype(np.float64)
    visibility, scan = piece.visibility, piece.scan
    parameters = None
    if visibility is not None and visibility.sheet is not None and scan.camera is not None:
        normal = visibility.camera_from_cloud[0].rotation.T @ visibility.sheet.normal
        parameters = shared_errors(scan.points, scan.camera, normal, sigma_cal)
    return Shared(scan.camera, sigma_cal, parameters)


def _refined(piece: Piece, start: Pose, calibration: Shared, *, settle: bool) -> tuple[Fit, Uncertainty, bool]:
    """The pose on all points, how sure it is, and whether borders had to place faces that slide in themselves."""
    model, surface, scan, form = piece.model, piece.surface, piece.scan, piece.options.form
    frame = Frame(model.centre, model.diameter / 2)
    reach = max(10 * float(np.median(scan.sigma)), 0.5)
    weighting = Weighting(form)
    rough = refine(surface, start, scan, reach=(reach,) * 2, weighting=weighting).pose

    def known_at(pose: Pose, held: Held | None = None) -> tuple[Fit, Uncertainty, Array]:
        found = refined(surface, pose, piece.seen, frame, cut=reach, form=form, held=held)
        middle = found.pose.apply(model.centre)
        known = uncertainty(found, piece.seen, calibration, centre=middle, radius=frame.radius)
        fit = evaluate(surface, found.pose, scan, cut=reach, weighting=weighting)
        return fit, known, _but_axis(model, found.pose, known.loose_motions, middle)

    fit, known, loose = known_at(rough)
    if not settle or not len(loose):
        return fit, known, False
    middle = fit.pose.apply(model.centre)
    local = fit.pose.inverse.apply(scan.points)
    near = np.linalg.norm(surface.nearest(local)[0] - local, axis=1) < 1.5 * REACH
    sliding = Sliding(fit.pose, loose, scan.points[near], scan.sigma[near], middle, frame.radius)
    settled = settle_by_borders(surface, sliding)
    if settled is None and piece.visibility is not None:
        settled = settle_by_rim(surface, model, sliding, piece.visibility)
    if settled is None:
        return fit, known, False
    fit, known, _ = known_at(settled[0], Held(settled[0], loose, settled[1]))
    return fit, known, True


def _decide(piece: Piece, rated: list[Likelihood], view: View) -> PoseResult:
    model, best = piece.model, rated[0]
    candidates = tuple(Candidate(e.pose, e.explained, e.blocked, e.covered, e.cost - best.cost) for e in rated)
    misfit = _misfit(best, piece.options)
    score, rival = _runner_up(model, rated)
    calibration = _calibration(piece)
    fit, known, bordered = _refined(piece, best.pose, calibration, settle=not misfit and rival is None)
    variant, undecided = _judged(piece, fit.pose, calibration, view)
    why, tell = misfit, ""
    if not why and rival is not None:
        why = f"two poses explain the scan alike ({score:.0f} nats apart)"
        tell = what_differs(model, best.pose, rival.pose)
    if not why and known.loose and not _of_axis(model, fit.pose, known):
        why = f"the scan does not hold the part: it {' and '.join(known.loose)}"
        tell = "scan a part of it that stops this motion"
    if variant is not None:
        why = f"not this part: {variant.text}" + (f"; {why}" if why else "")
    good, ambiguous = not why, bool(tell)
    if good:
        why = "no other pose comes near" if np.isinf(score) else f"{score:.0f} nats better than the runner-up"
        why += "; faces that slide in themselves were placed by their borders" if bordered else ""
    axis = None
    if model.axis is not None:
        axis = (fit.pose.apply(model.axis.point), fit.pose.rotation @ model.axis.direction)
    return PoseResult(
        cloud_from_model=fit.pose if good else None,
        covariance=known.covariance if good else None,
        uncertainty=known,
        score=score,
        rmse_mm=float(np.sqrt(np.mean(fit.residual[fit.used] ** 2))) if fit.used.any() else float("nan"),
        ambiguous=ambiguous,
        why=why,
        candidates=candidates,
        tell_apart=tell,
        axis=axis,
        points=piece.rows,
        deviation=fit.residual,
        model=model,
        variant=variant,
        undecided=undecided,
        faces=residuals_by_face(
            piece.surface,
            fit.pose,
            piece.scan.points,
            piece.cloud.sigma[piece.rows].astype(np.float64),
            diameter=model.diameter,
            tolerance=piece.options.part_tolerance,
        ),
        part_tolerance=piece.options.part_tolerance,
    )


def _judged(piece: Piece, pose: Pose, calibration: Shared, view: View) -> tuple[Variant | None, tuple[Undecided, ...]]:
    """Whether it is this part; nothing is asked where any deviation is tolerated."""
    tolerance = piece.options.part_tolerance
    if not np.isfinite(tolerance):
        return None, ()
    evidence = Evidence(
        piece.model, piece.surface, pose, piece.scan, piece.seen.laser, calibration.basis, piece.cloud.points, tolerance
    )
    return judge(evidence, lambda: _mirrored(piece, view))


def _mirrored(piece: Piece, view: View) -> Pose | None:
    """The best pose, model from mirrored cloud, in which the scan's mirror image lies on the mesh."""
    eyes = (None if e is None else e @ MIRROR for e in (view.camera, view.laser))
    image = View(view.points @ MIRROR, view.normals @ MIRROR, *eyes)
    poses, cost = search(piece.model, image, starts=piece.options.starts, keep=40)
    poses, cost = _with_likenesses(piece.model, image, poses, cost, None)
    if not poses:
        return None
    d = piece.model.diameter
    few = Scanned(image.points, np.full(len(image.points), piece.options.tolerance), image.camera).only(slice(0, 2500))
    reach = (0.01 * d, 0.008 * d, 0.006 * d, 0.005 * d, max(1.0, 0.003 * d), max(1.0, 0.003 * d))
    weighting = Weighting(piece.options.tolerance, borders=True)
    fits = [refine(piece.surface, p, few, reach=reach, weighting=weighting).pose.inverse for p in poses[:6]]

    def off(pose: Pose) -> float:
        local = pose.apply(few.points)
        gap = np.linalg.norm(piece.surface.nearest(local)[0] - local, axis=1)
        return float(np.minimum(gap**2, 9 * piece.options.tolerance**2).sum())

    return min(fits, key=off)


def _misfit(best: Likelihood, options: PoseOptions) -> str:
    """Why the best pose is no pose of this part; empty where it fits."""
    for share, limit, sign, what in (
        (best.explained, options.least_explained, 1, "of the points lie on the model"),
        (best.covered, options.least_covered, 1, "of the surface that should be seen has points"),
        (best.blocked, options.most_blocked, -1, "of the points were seen through the model"),
    ):
        if sign * share < sign * limit:
            bound = "at least" if sign > 0 else "at most"
            return (
                f"the best pose does not fit: {100 * share:.0f} % {what}, {bound} {100 * limit:.0f} % needed; "
                "is it this part, is more than the part in the region, is the mesh in mm?"
            )
    return ""


def _runner_up(model: Model, rated: list[Likelihood]) -> tuple[float, Likelihood | None]:
    """Nats to the nearest other pose (inf without one), and the pose itself where they do not decide."""
    best, score = rated[0], float("inf")
    for other in rated[1:]:
        if same_answer(model, best.pose, other.pose, turn=0.01, shift=0.004 * model.diameter):
            continue
        gain, sure = margin(best, other)
        score = min(score, gain)
        if not sure:
            return gain, other
    return score, None


def _but_axis(model: Model, pose: Pose, loose: Array, middle: Array) -> Array:
    """Loose motions (L, 6) without the turn about the model's own axis of revolution, which nothing can stop."""
    if model.axis is None or len(loose) == 0:
        return loose
    direction, arm = pose.rotation @ model.axis.direction, middle - pose.apply(model.axis.point)
    turn = np.concatenate([np.cross(direction, arm), direction * model.diameter / 2])
    turn /= np.linalg.norm(turn)
    if np.linalg.norm(loose @ turn) < 0.98:
        return loose
    rest = loose - np.outer(loose @ turn, turn)
    return np.asarray(np.linalg.svd(rest, full_matrices=False)[2][: len(loose) - 1])


def _of_axis(model: Model, pose: Pose, known: Uncertainty) -> bool:
    """Whether the one loose motion is the turn about the model's own axis of revolution."""
    if model.axis is None or len(known.loose_motions) != 1:
        return False
    axis = pose.rotation @ model.axis.direction
    turn = known.loose_motions[0][3:]
    length = float(np.linalg.norm(turn))
    return length > 0.5 and abs(float(turn @ axis)) / length > 0.98
