"""Where a known part is: a pose that is right, or says that it does not know."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.geometry import Array, Ints, Pose
from scope import segmentation
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.pose_decision import CAP, MISSING, Evidence, area_of, margin, same_answer, weigh
from scope.pose_light import Light, light_of
from scope.pose_model import Model, Surface
from scope.pose_hold import hold
from scope.pose_report import what_differs
from scope.pose_refine import evaluate, refine
from scope.pose_search import View, normals_of, polish, search, thin
from scope.pose_uncertainty import Uncertainty, shared_errors, uncertainty
from scope.region import Region


LEAST_SHOWN = 0.02  # of the part's surface; a sight of less is no basis for a decision


@dataclass(frozen=True, slots=True)
class PoseOptions:
    """How a pose is searched and when it is believed."""

    tolerance: float = 0.05  # mm, one sigma: by how much the part may differ from its mesh, when poses are compared
    form: float = 0.01  # mm, one sigma: no residual is known better than this, when a pose is refined
    starts: int = 800  # orientations tried
    candidates: int = 10  # poses weighed against each other
    least_explained: float = 0.6  # share of the points that must lie on the model (a clamp may hide and add some)
    least_covered: float = 0.75  # share of the surface that should have been seen and was
    most_blocked: float = 0.05  # share of the points seen through the model
    several: bool = True  # look for further equal parts


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One pose that was weighed."""

    cloud_from_model: Pose
    explained: float  # share of the points that lie on the model
    blocked: float  # share of the points seen through the model
    covered: float  # share of the expected surface that was seen, NaN where unknown
    behind: float  # nats by which it is worse than the best


@dataclass(frozen=True, slots=True, eq=False)
class PoseResult:
    """The pose of one part; ``cloud_from_model`` is None where the answer must not be used."""

    cloud_from_model: Pose | None
    covariance: Array | None  # (6, 6) of x, y, z (mm) and turns about x, y, z of the cloud at the model's origin (rad)
    uncertainty: Uncertainty | None
    score: float  # nats to the runner-up, inf without one
    rmse_mm: float  # of the explained points, across the surface
    ambiguous: bool
    why: str  # one sentence: why refused or ambiguous, or what decided
    candidates: tuple[Candidate, ...]  # best first; the first is the answer if there is one
    tell_apart: str  # what would settle it, where ambiguous
    axis: tuple[Array, Array] | None  # point and direction, cloud frame, of a continuous symmetry of the part
    points: Ints  # rows of the cloud that were taken for this part
    deviation: Array  # (len(points),) mm, signed distance from the model at the best candidate
    model: Model
    others: tuple[PoseResult, ...] = ()  # further equal parts in the same scan

    @property
    def found(self) -> bool:
        """Whether there is a pose to use."""
        return self.cloud_from_model is not None


def estimate_pose(
    cloud: ScanCloud, model: str | Path | Model, *, region: Region | None = None, options: PoseOptions | None = None
) -> PoseResult:
    """Position and orientation of a known part in a scan.

    Parameters
    ----------
    cloud : ScanCloud
        mm; with its sensors the free space and the missing surface speak too, without them only the points do.
    model : path or Model
        Mesh file in mm, or a model prepared by `load_model`.
    region : Region, optional
        Where the part is; without it tables are taken away and what stands on them is tried.
    options : PoseOptions, optional

    Returns
    -------
    PoseResult
        Refused and ambiguous answers carry no pose. Further equal parts are in ``others``.

    Raises
    ------
    MeasurementError
        A cloud in which nothing can be the part: empty, a table only, too small or too large, other units.
    """
    from scope.pose_files import load_model

    chosen = options or PoseOptions()
    prepared = model if isinstance(model, Model) else load_model(model)
    sides = np.sort(np.ptp(prepared.vertices, axis=0))
    if len(cloud):
        _require_units(cloud, prepared, region)
    pieces = segmentation.clusters(cloud, prepared.diameter, float(sides[1] * sides[2]), region=region)
    surface = Surface(prepared.vertices, prepared.faces)
    results: list[PoseResult] = []
    pieces = pieces if chosen.several else pieces[:1]
    for rows in pieces[:12]:
        results.append(_locate(cloud, rows, prepared, surface, chosen))
    results.sort(key=lambda r: (not r.found, -len(r.points)))
    best = results[0]
    if not best.found:
        best = max(results, key=lambda r: len(r.points))
    others: list[PoseResult] = []
    for result in results:
        if result is not best and result.found and not any(_overlap(r, result) for r in (best, *others)):
            others.append(result)
    return replace(best, others=tuple(others))


def _overlap(a: PoseResult, b: PoseResult) -> bool:
    """Whether two found parts would stand in each other (3 % of the surface of one deeper than 1 % of the diameter)."""
    if a.cloud_from_model is None or b.cloud_from_model is None:
        return False
    motion = a.cloud_from_model.inverse @ b.cloud_from_model
    depth = a.model.fine.look_up(motion.apply(a.model.samples[::10]))[0]
    return bool((depth < -0.01 * a.model.diameter).mean() > 0.03)


def _refused(model: Model, rows: Ints, why: str) -> PoseResult:
    """An answer for a piece that was not even searched."""
    unknown = np.full(len(rows), np.nan)
    return PoseResult(None, None, None, 0.0, float("nan"), False, why, (), "", None, rows, unknown, model)


_UNITS = ((1000.0, "metres"), (25.4, "inches"), (10.0, "centimetres"), (1 / 25.4, "mm, and the cloud in inches"), (1e-3, "micrometres"))


def _require_units(cloud: ScanCloud, model: Model, region: Region | None) -> None:
    """Refuse a model and a cloud whose sizes differ by more than any one-sided scan explains."""
    points = cloud.points if region is None else cloud.points[region.contains(cloud.points)]
    if len(points) < segmentation.LEAST_POINTS:
        return
    size = segmentation.extent(points)
    ratio = size / model.diameter
    if 0.15 < ratio < 8:
        return
    near = [name for factor, name in _UNITS if 0.15 < ratio / factor < 4]
    guess = f"it looks as if the mesh were in {' or '.join(near)}" if near else "no usual unit explains that"
    raise MeasurementError(
        f"the mesh {model.name} is {model.diameter:.4g} across and the cloud {size:.4g} mm: a factor of {ratio:.3g}; {guess}; "
        "export the mesh in mm, or give the region of the part"
    )


def _locate(cloud: ScanCloud, rows: Ints, model: Model, surface: Surface, options: PoseOptions) -> PoseResult:
    """Search, refine and decide for one piece of the scan."""
    points = cloud.points[rows]
    size = segmentation.extent(points)
    if size > 1.6 * model.diameter:
        return _refused(
            model, rows,
            f"the piece of the scan is {size:.0f} mm across and the part {model.diameter:.0f} mm; give the region of the part",
        )  # fmt: skip
    camera, laser = eyes(cloud, rows)
    spacing = model.diameter / 100
    chosen = thin(points, spacing)
    shown, whole = len(chosen) * spacing**2, area_of(model)
    if len(chosen) < 60 or shown < LEAST_SHOWN * whole:
        return _refused(
            model, rows,
            f"the scan shows {shown:.0f} mm2 of the part's {whole:.0f} mm2, at least {100 * LEAST_SHOWN:.0f} % needed; scan more of it",
        )  # fmt: skip
    order = np.random.default_rng(0).permutation(len(chosen))
    chosen = chosen[order]
    at = camera[chosen] if camera is not None else None
    normal = normals_of(points, points[chosen], at, radius=4 * spacing)
    view = View(points[chosen], normal, at, None if laser is None else laser[chosen])
    sigma = _sigma(cloud, rows)
    others = np.setdiff1d(np.arange(len(cloud)), rows)
    if len(others):
        others = others[segmentation.crowded(cloud.points[others], 2 * spacing)]
    if len(others):
        others = others[thin(cloud.points[others], 2 * spacing)]
    witnesses = None
    if len(others) and camera is not None:
        far_camera, far_laser = eyes(cloud, others)
        witnesses = View(cloud.points[others], np.zeros((len(others), 3)), far_camera, far_laser)
    light = light_of(cloud, cloud.points[others], voxel=1.5 * spacing)
    uncovered = None if light is None else lambda pose: light.uncovered(surface, pose, model.samples[::40], model.normals[::40])
    poses, cost = search(model, view, starts=options.starts, uncovered=uncovered)
    poses, cost = _with_likenesses(model, view, poses, cost)
    weighed = _weigh_all(model, surface, view, sigma[chosen], light, witnesses, poses, options, spacing)
    return _decide(cloud, rows, model, surface, weighed, view, sigma, camera, light, options)


def eyes(cloud: ScanCloud, rows: Ints) -> tuple[Array | None, Array | None]:
    """Camera and laser (N, 3) of each point; None where the cloud does not tell."""
    sensors = cloud.sensors
    if sensors is None or len(sensors) == 0:
        return None, None
    key = sensors.frame.astype(np.int64) * 256 + sensors.laser
    order = np.argsort(key)
    wanted = cloud.frame[rows].astype(np.int64) * 256 + cloud.laser[rows]
    place = np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)
    found = order[place]
    if not (key[found] == wanted).all() or not np.isfinite(sensors.centre).all():
        return None, None
    laser = sensors.laser_origin[found]
    return sensors.centre[found], laser if np.isfinite(laser).all() else None


def _sigma(cloud: ScanCloud, rows: Ints) -> Array:
    """Sigma (N,) mm of points; where unknown, the usual one of those known, else 0.1."""
    sigma = cloud.sigma[rows].astype(np.float64)
    known = np.isfinite(sigma) & (sigma > 0)
    usual = float(np.median(sigma[known])) if known.any() else 0.1
    return np.where(known, sigma, usual)


def _with_likenesses(model: Model, view: View, poses: list[Pose], cost: Array) -> tuple[list[Pose], Array]:
    """Add to the best poses those in which the model looks like itself; distinct ones, best first."""
    from scope.pose_model import distinct

    if not model.likenesses:
        return poses, cost
    more = [poses[i] @ motion for i in range(min(2, len(poses))) for motion in model.likenesses]
    more, costs = polish(model, view, more)
    everything = poses + more
    total = np.concatenate([cost, costs])
    rotation = np.stack([p.inverse.rotation for p in everything])
    translation = np.stack([p.inverse.translation for p in everything])
    kept = distinct(rotation, translation, total, view.points.mean(axis=0), 0.03, 0.012 * model.diameter)
    return [everything[i] for i in kept], total[kept]


def _weigh_all(
    model: Model,
    surface: Surface,
    view: View,
    sigma: Array,
    light: Light | None,
    witnesses: View | None,
    poses: list[Pose],
    options: PoseOptions,
    spacing: float,
) -> list[Evidence]:
    """Refined and weighed candidates, best first.

    A quick look on the distance grid leaves out those that are far behind; the rest are refined on the mesh.
    """
    d, tolerance = model.diameter, options.tolerance
    variance = sigma**2 + tolerance**2 + (0.1 * model.fine.spacing) ** 2
    quick = []
    for pose in poses:
        gap = model.fine.look_up(pose.inverse.apply(view.points))[0]
        quick.append(float(np.minimum(gap**2 / (2 * variance), CAP).sum()))
    order = np.argsort(quick)
    near = [k for n, k in enumerate(order) if n < 3 or quick[k] < quick[order[0]] + 0.15 * CAP * len(sigma)]
    if light is not None and len(near) > options.candidates:
        samples, normals = model.samples[::18], model.normals[::18]
        missing = [len(sigma) * light.uncovered(surface, poses[k], samples, normals) for k in near]
        near = [near[i] for i in np.argsort([quick[k] + MISSING * m for k, m in zip(near, missing, strict=True)])]
    few = slice(0, 2500)
    camera = None if view.camera is None else view.camera[few]
    reach = (0.01 * d, 0.008 * d, 0.006 * d, 0.005 * d, max(1.0, 0.003 * d), max(1.0, 0.003 * d))
    done: list[Evidence] = []
    hopeless = quick[order[0]] > 0.7 * CAP * len(sigma)
    for k in near[: 2 if hopeless else options.candidates]:
        fit = refine(surface, poses[k], view.points[few], sigma[few], camera, reach=reach, floor=tolerance)
        if not any(same_answer(model, fit.pose, e.pose, turn=0.004, shift=0.002 * d) for e in done):
            done.append(weigh(model, surface, fit.pose, view, sigma, light, witnesses, tolerance=tolerance, spacing=spacing))
    return sorted(done, key=lambda e: e.cost)


def _decide(
    cloud: ScanCloud,
    rows: Ints,
    model: Model,
    surface: Surface,
    weighed: list[Evidence],
    view: View,
    sigma: Array,
    camera: Array | None,
    light: Light | None,
    options: PoseOptions,
) -> PoseResult:
    best = weighed[0]
    candidates = tuple(Candidate(e.pose, e.explained, e.blocked, e.covered, e.cost - best.cost) for e in weighed)
    points = cloud.points[rows]
    reach = max(10 * float(np.median(sigma)), 0.5)
    fit = refine(surface, best.pose, points, sigma, camera, reach=(reach,) * 2, floor=options.form)
    parameters = None
    if light is not None and light.sheet is not None and camera is not None:
        normal = light.camera_from_cloud[0].rotation.T @ light.sheet.normal
        parameters = shared_errors(points, camera, normal, cloud.sigma_cal[rows])
    middle = fit.pose.apply(model.centre)
    known = uncertainty(
        fit, points, camera, cloud.sigma_cal[rows], parameters, centre=middle, radius=model.diameter / 2
    )
    misfit = _misfit(best, options)
    score, rival = _runner_up(model, weighed)
    if not misfit and rival is None and known.loose and not _of_axis(model, fit.pose, known):
        settled = hold(surface, fit.pose, known.loose_motions, points[fit.used], sigma[fit.used], middle, model.diameter / 2)
        if settled is not None:
            rows_held = known.loose_motions / (0.5 * settled[1])[:, None]
            fit = evaluate(surface, settled[0], points, sigma, camera, cut=reach, floor=options.form)
            known = uncertainty(
                fit, points, camera, cloud.sigma_cal[rows], parameters,
                centre=middle, radius=model.diameter / 2, held=rows_held,
            )  # fmt: skip
    rmse = float(np.sqrt(np.mean(fit.residual[fit.used] ** 2))) if fit.used.any() else float("nan")
    axis = None
    if model.axis is not None:
        axis = (fit.pose.apply(model.axis.point), fit.pose.rotation @ model.axis.direction)
    why, tell = misfit, ""
    if not why and rival is not None:
        why = f"two poses explain the scan alike ({score:.0f} nats apart)"
        tell = what_differs(model, best.pose, rival.pose)
    if not why and known.loose and not _of_axis(model, fit.pose, known):
        why = f"the scan does not hold the part: it {' and '.join(known.loose)}"
        tell = "scan a part of it that stops this motion"
    good, ambiguous = not why, bool(tell)
    if good:
        why = "no other pose comes near" if np.isinf(score) else f"{score:.0f} nats better than the runner-up"
    return PoseResult(
        cloud_from_model=fit.pose if good else None,
        covariance=known.covariance if good else None,
        uncertainty=known,
        score=score,
        rmse_mm=rmse,
        ambiguous=ambiguous,
        why=why,
        candidates=candidates,
        tell_apart=tell,
        axis=axis,
        points=rows,
        deviation=fit.residual,
        model=model,
    )


def _misfit(best: Evidence, options: PoseOptions) -> str:
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


def _runner_up(model: Model, weighed: list[Evidence]) -> tuple[float, Evidence | None]:
    """Nats to the nearest other pose (inf without one), and the pose itself where they do not decide."""
    best, score = weighed[0], float("inf")
    for other in weighed[1:]:
        if same_answer(model, best.pose, other.pose, turn=0.01, shift=0.004 * model.diameter):
            continue
        gain, sure = margin(best, other)
        score = min(score, gain)
        if not sure:
            return gain, other
    return score, None


def _of_axis(model: Model, pose: Pose, known: Uncertainty) -> bool:
    """Whether the one loose motion is the turn about the model's own axis of revolution."""
    if model.axis is None or len(known.loose_motions) != 1:
        return False
    axis = pose.rotation @ model.axis.direction
    turn = known.loose_motions[0][3:]
    length = float(np.linalg.norm(turn))
    return length > 0.5 and abs(float(turn @ axis)) / length > 0.98
