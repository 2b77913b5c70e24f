"""Images of one plane of a calibration file to its marks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.geometry import Array, Bools, Pose
from calibration.rays import PlaneMarks, find_bad_marks, fit_plane_map, polynomial
from calibration.targets import Charuco, Chessboard, CircleGrid, MarkerBoard, SpotGrid, Spots
from calibration.verification import Fault, of_marks, of_too_many_marks
from ranging.background import Image
from scope.calibrating.beside import beside_the_grid
from scope.session import CalibrationPlan, ListedMarks, PlanePlan, mean_gray, read_alike

Rejected = tuple[float, float, str]  # u, v in px, and why
_ALIKE = 0.4  # of the usual diameter: spots that differ by less are marks
_BESIDE = "beside where the other marks say: left out"


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPlane:
    """The marks of one plane, and what its images were like."""

    plan: PlanePlan
    marks: PlaneMarks
    found: int  # spots or corners seen, labelled or not
    expected: int  # marks of the whole target
    rejected: tuple[Rejected, ...]
    diameter_px: float  # median; NaN where the marks are corners
    contrast: float  # median, grey levels
    blur_px: float  # median, one sigma of the edge
    saturated: float  # share of the marks with more than a tenth of their pixels clipped
    repeat_px: float  # rms movement of a mark between repeats, over what noise explains; NaN for a single image
    repeat_noise_px: float  # what noise explains
    mirrored: bool
    eccentricity_px: float  # largest shift of a circle's centroid by perspective and lens, which was corrected
    image: Image  # the mean, for pictures
    size: tuple[int, int]
    bad: tuple[Fault, ...] = ()  # one a mark that is off and was left out

    def without(self, faults: Sequence[Fault]) -> MeasuredPlane:
        """The same without the marks of these faults."""
        off = np.isin(self.marks.mark, [f.mark for f in faults if f.mark is not None])
        places = tuple((float(u), float(v), _BESIDE) for u, v in self.marks.pixels[off])
        return replace(
            self, marks=self.marks.select(~off), rejected=(*self.rejected, *places), bad=(*self.bad, *faults)
        )

    @property
    def spoilt(self) -> str:
        """Why a view by hand does not serve: more than a quarter of its marks are off; empty where it does."""
        n = len(self.marks) + len(self.bad)
        return f"{len(self.bad)} of {n} marks are off their places" if len(self.bad) > max(1, 0.25 * n) else ""

    @property
    def too_many(self) -> Fault | None:
        """The fault of a plane with more bad marks than may be left out."""
        return of_too_many_marks(self.plan.name, self.bad, len(self.marks) + len(self.bad))


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    pixels: Array  # (n, 2)
    covariance: Array  # (n, 2, 2)
    mark: NDArray[np.int64]  # (n,)
    found: int
    rejected: tuple[Rejected, ...] = ()
    diameter: Array | None = None
    contrast: Array | None = None
    blur: Array | None = None
    saturated: Array | None = None
    mirrored: bool = False
    points: Array | None = None  # (m, 3) mm, of all marks, where the view tells how the target's frame lies
    strays: Array | None = None  # (s, 2) px, spots like those of the grid that lie on no place of it


def measure_plane(plan: CalibrationPlan, plane: PlanePlan) -> MeasuredPlane:
    """Read a plane's images and find its marks.

    Raises
    ------
    FileError
        Images that cannot be read or do not agree.
    CalibrationError
        Marks that cannot be found or told apart; the message names the plane.
    """
    images = read_alike(plane.images, f"plane {plane.name}")
    mean = mean_gray(images)
    height, width = mean.shape
    try:
        found = _find(plan, plane, mean)
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: plane {plane.name}: {error}") from error
    points, pose, expected = _positions(plan, plane, found)
    marks = PlaneMarks(plane.name, found.pixels, points, pose, found.mark, found.covariance)
    try:
        marks, shift = _centred(marks, _radii(plan, marks, found))
    except CalibrationError as error:
        raise CalibrationError(f"{plan.path}: {error}") from error
    repeat, noise = _repeats(plan, plane, images, found)
    seen = MeasuredPlane(
        plane, marks, found.found, expected, found.rejected, _median(found.diameter), _median(found.contrast),
        _median(found.blur), 0.0 if found.saturated is None else float((found.saturated > 0.1).mean()), repeat, noise,
        found.mirrored, shift, mean, (width, height),
    )  # fmt: skip
    seen = seen.without(of_marks(marks, find_bad_marks(marks)))
    if plan.target is None or plane.listed is not None:
        return seen
    beside = beside_the_grid(found.strays, seen.marks, plan.target.marks)
    return replace(seen, bad=(*seen.bad, *beside))


def _median(values: Array | None) -> float:
    return float("nan") if values is None or len(values) == 0 else float(np.nanmedian(values))


def _find(plan: CalibrationPlan, plane: PlanePlan, image: Image) -> _Found:
    if plane.listed is not None:
        return _find_listed(plan, plane.listed, image)
    if isinstance(plan.target, SpotGrid):
        return _find_grid(plan.target, plane, image)
    if isinstance(plan.target, CircleGrid):
        return _find_circles(plan.target, image)
    if isinstance(plan.target, Chessboard | Charuco | MarkerBoard):
        return _find_board(plan.target, image)
    raise ValueError("a plane without listed marks needs a target")


def _find_grid(target: SpotGrid, plane: PlanePlan, image: Image) -> _Found:
    from calibration.targets import find_spots, label_grid

    spots = find_spots(image, polarity=target.polarity)
    labels = label_grid(spots, target, image_size=(image.shape[1], image.shape[0]), turned=plane.turned)  # type: ignore[arg-type]
    kept = spots.select(labels.labelled)
    return _Found(
        kept.centroids, kept.covariance, labels.mark[labels.labelled], len(spots), spots.rejected, kept.diameter,
        kept.contrast, kept.blur, kept.saturated, labels.mirrored, strays=spots.select(_alike(spots, labels.labelled)).centroids,
    )  # fmt: skip


def _alike(spots: Spots, labelled: Bools) -> Bools:
    """Spots without a label that are as large as those with one: dirty marks rather than dirt."""
    usual = float(np.median(spots.diameter[labelled])) if labelled.any() else np.inf
    return np.asarray(~labelled & (np.abs(spots.diameter / usual - 1.0) < _ALIKE))


def _find_listed(plan: CalibrationPlan, listed: ListedMarks, image: Image) -> _Found:
    from calibration.targets import measure_marks

    everything = np.arange(len(listed.pixels))
    if not listed.refine:
        unknown = np.full((len(everything), 2, 2), np.nan)
        return _Found(listed.pixels, unknown, everything, len(everything))
    marks = measure_marks(image, listed.pixels, polarity=plan.polarity)
    known = marks.measured
    rejected = tuple(
        (float(u), float(v), reason) for (u, v), reason in zip(listed.pixels, marks.reason, strict=True) if reason
    )
    if known.sum() < 4:
        raise CalibrationError(
            f"{int(known.sum())} of {len(known)} listed marks were found near their (u, v) "
            f"({rejected[0][2] if rejected else 'none listed'}); four or more are needed: check the list, `polarity`, and "
            "that pixels count from 0"
        )
    return _Found(
        marks.centroids[known], marks.covariance[known], everything[known], int(known.sum()), rejected, marks.diameter[known],
        marks.contrast[known], marks.blur[known], marks.saturated[known],
    )  # fmt: skip


def _find_board(target: Chessboard | Charuco | MarkerBoard, image: Image) -> _Found:
    from calibration.targets import find_charuco, find_chessboard, find_markers, upright

    everything = None
    if isinstance(target, MarkerBoard):
        corners = find_markers(image, target)
        everything = upright(target, corners).marks
    else:
        corners = find_chessboard(image, target) if isinstance(target, Chessboard) else find_charuco(image, target)
    unknown = np.full((len(corners.pixels), 2, 2), np.nan)
    return _Found(corners.pixels, unknown, corners.mark, len(corners.pixels), points=everything)


def _find_circles(target: CircleGrid, image: Image) -> _Found:
    from calibration.targets import find_circles, measure_marks

    rough = find_circles(image, target)
    marks = measure_marks(image, rough.pixels, polarity=target.polarity)
    known = marks.measured
    if known.sum() < 0.5 * len(known):  # too small or too blurred for an edge to be fitted: OpenCV's own centres
        unknown = np.full((len(known), 2, 2), np.nan)
        return _Found(rough.pixels, unknown, rough.mark, len(known))
    rejected = tuple(
        (float(u), float(v), reason) for (u, v), reason in zip(rough.pixels, marks.reason, strict=True) if reason
    )
    return _Found(
        marks.centroids[known], marks.covariance[known], rough.mark[known], len(known), rejected, marks.diameter[known],
        marks.contrast[known], marks.blur[known], marks.saturated[known],
    )  # fmt: skip


def _positions(plan: CalibrationPlan, plane: PlanePlan, found: _Found) -> tuple[Array, Pose, int]:
    """Plane coordinates (n, 2) of the marks, the pose of that plane in C, and how many marks there are in all."""
    if plane.listed is not None:
        everything = plane.listed.points
    elif found.points is not None:
        everything = found.points
    elif plan.target is not None:
        everything = plan.target.marks
    else:
        raise ValueError("a plane without listed marks needs a target")
    pose = plane.c_from_target or Pose.identity()
    own, c_from_plane = _flatten(everything, pose, plane.name, plan)
    return own[found.mark], c_from_plane, len(everything)


def _flatten(points: Array, pose: Pose, name: str, plan: CalibrationPlan) -> tuple[Array, Pose]:
    """Points of one plane in coordinates of that plane, and its pose; a plane z = constant keeps x and y."""
    if np.ptp(points[:, 2]) <= 1e-9 * max(np.ptp(points[:, :2]), 1e-300):
        lift = Pose(np.eye(3), np.array([0.0, 0.0, float(points[:, 2].mean())]))
        return points[:, :2], pose @ lift
    from calibration.geometry import fit_plane

    try:
        plane = fit_plane(points)
    except ValueError as error:
        raise CalibrationError(
            f"{plan.path}: plane {name}: its {len(points)} listed marks lie on one line, from which no plane follows: list "
            "marks beside it"
        ) from error
    off = float(np.abs(plane.distance(points)).max())
    if off > 1e-4 * float(np.ptp(points, axis=0).max()):
        raise CalibrationError(
            f"{plan.path}: plane {name}: its listed marks lie up to {off:.4g} mm off one plane; a plane map needs marks in "
            "one plane: list each level as a [[plane]] of its own"
        )
    normal = plane.normal * np.sign(plane.normal[2] or 1.0)
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    frame = Pose(np.column_stack([x, np.cross(normal, x), normal]), normal * float(normal @ points.mean(axis=0)))
    return frame.inverse.apply(points)[:, :2], pose @ frame


def _radii(plan: CalibrationPlan, marks: PlaneMarks, found: _Found) -> Array | None:
    """Radii (n,) mm of round marks: of the target where it is a grid of spots, else as measured; None for corners."""
    target = plan.target
    if isinstance(target, SpotGrid):
        if target.diameter is None:
            return None if found.diameter is None else _measured_radii(marks, found.diameter)
        radii = np.full(len(marks), target.diameter / 2)
        large = [row * target.columns + column for row, column in target.fiducials]
        radii[np.isin(marks.mark, large)] = (target.fiducial_diameter or target.diameter) / 2
        return radii
    return None if found.diameter is None else _measured_radii(marks, found.diameter)


def _measured_radii(marks: PlaneMarks, diameter: Array) -> Array:
    scale = np.sqrt(np.abs(np.linalg.det(polynomial.homography(marks.points, marks.pixels)[:2, :2])))
    return np.asarray(diameter / (2 * max(float(scale), 1e-12)))


def _centred(marks: PlaneMarks, radii: Array | None) -> tuple[PlaneMarks, float]:
    """Marks at the images of the circles' centres, which perspective and lens part from the centroids."""
    if radii is None or len(marks) < 12:
        return marks, 0.0
    from calibration.targets import eccentricity_of_map

    shift = eccentricity_of_map(fit_plane_map(marks, tilted=True).map.plane_points, marks.pixels, radii)
    shift = np.where(np.isfinite(shift), shift, 0.0)
    return replace(marks, pixels=marks.pixels - shift), float(np.linalg.norm(shift, axis=1).max())


def _repeats(plan: CalibrationPlan, plane: PlanePlan, images: list[Image], found: _Found) -> tuple[float, float]:
    """Common movement of the marks between repeats, rms px, and what the marks' own noise would give."""
    refined = plane.listed is None or plane.listed.refine
    if len(images) < 2 or not refined or not (plane.listed is not None or isinstance(plan.target, SpotGrid)):
        return float("nan"), float("nan")
    from calibration.targets import measure_marks

    shifts, noises = [], []
    for image in images:
        again = measure_marks(mean_gray([image]), found.pixels, polarity=plan.polarity)
        known = again.measured
        if known.sum() < 4:
            return float("inf"), float("nan")
        shifts.append(np.median(again.centroids[known] - found.pixels[known], axis=0))
        noises.append(np.nanmedian(again.covariance[known], axis=0).trace() * 1.57 / known.sum())
    return float(np.sqrt((np.square(shifts)).sum(axis=1).mean())), float(np.sqrt(np.mean(noises)))
