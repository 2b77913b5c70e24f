"""The two analyses of DePiero & Kress, figures 5 and 6: do maps fit their marks, and do they agree on one ray a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.camera import GRID, pixel_grid
from calibration.geometry import Array
from calibration.rays import MAX_ORDER, PlaneMap, PlaneMarks, RayField, TwoPlaneCamera, TwoPlaneFit, rms
from calibration.verification.redundancy import redundancy_of
from calibration.verification.support import support_of

_BEYOND = 6.0  # times the median residual; chance gives the worst of 2,000 marks four times it
_BEYOND_PX = 0.05  # less is told by the figures


@dataclass(frozen=True, slots=True, eq=False)
class PlaneResiduals:
    """One plane of the intra-plane analysis; the arrays are the arrows of the picture."""

    name: str
    pixels: Array  # (n, 2) px, where each arrow starts
    residuals: Array  # (n, 2) px, mark minus the plane's own map
    left_out: Array  # (n, 2) px, the same, each mark predicted without it
    fit_px: float  # rms
    fit_px_mean: float  # mean length: the paper's figure
    loo_px: float  # rms
    fit_mm: float  # rms
    loo_mm: float  # rms


@dataclass(frozen=True, slots=True, eq=False)
class ResidualSplit:
    """What the residuals about the joint field are made of, rms px of the two-dimensional residual.

    Squares add up to about the square of the rms residual. NaN with fewer than three planes, whose marks determine no
    more than the field itself.
    """

    target_px: float  # repeats mark for mark on every plane: the target
    placement_px: float  # moves the marks of one plane together: where that plane stands
    random_px: float  # the rest
    plane_px: Array  # (planes,) the placement part of each plane
    mark: np.typing.NDArray[np.int64]  # (m,) numbers of the marks
    target_mm: Array  # (m, 2) mm by which each mark stands off its stated place, in the target's coordinates


@dataclass(frozen=True, slots=True, eq=False)
class Intraplane:
    """How well the maps fit their own marks, and what is left."""

    planes: tuple[PlaneResiduals, ...]
    split: ResidualSplit


def intraplane(fit: TwoPlaneFit) -> Intraplane:
    """Intra-plane analysis: the marks fed back into the maps (DePiero & Kress, "Model analysis", first method)."""
    planes = tuple(
        PlaneResiduals(
            m.name, m.pixels, f.residuals, f.left_out, f.fit_px, f.fit_px_mean, f.loo_px, rms(f.residuals_mm), f.loo_mm
        )
        for m, f in zip(fit.marks, fit.planes, strict=True)
    )
    return Intraplane(planes, split_residuals(fit.joint.field, fit.marks))


def split_residuals(field: RayField, planes: Sequence[PlaneMarks]) -> ResidualSplit:
    """Split residuals about a joint field into target, placement and random parts.

    Parameters
    ----------
    field : RayField
        Of these planes.
    planes : sequence of PlaneMarks
        Marks of the same number are the same mark of the target.

    Returns
    -------
    ResidualSplit
        Variance components of one least squares in which field, seven placement modes a plane and a random displacement
        of every mark of the target compete (`calibration.verification.redundancy`). What the field itself can follow (an affine
        error, for one) is in none of them.
    """
    n = len(planes)
    if n < 3:
        nan = float("nan")
        return ResidualSplit(nan, nan, nan, np.full(n, nan), np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
    found = redundancy_of(planes, field)
    marks = np.concatenate([p.pixels for p in planes])
    depth = np.concatenate([field.depth(p.world) for p in planes])
    scale = float((1.0 / np.abs(np.linalg.det(field.jacobian(marks, depth)))).mean())  # px^2/mm^2
    counts = np.array([len(p) for p in planes])
    square = np.add.reduceat((found.moved_px**2).sum(axis=1), np.concatenate([[0], np.cumsum(counts)[:-1]]))
    chance = found.rank * found.sigma_px**2 / n  # what noise alone puts into the modes, a plane
    by_plane = np.maximum(square - chance, 0.0)
    return ResidualSplit(
        float(np.sqrt(2.0 * scale) * found.target_mm),
        float(np.sqrt(by_plane.sum() / counts.sum())),
        float(np.sqrt(2.0) * found.sigma_px),
        np.sqrt(by_plane / counts),
        found.mark,
        found.target_shift,
    )


def beyond_reach(fit: TwoPlaneFit) -> str:
    """Where the field of rays does not follow the lens although its order is as high as it may be; empty where it does.

    At the corners of a very wide lens the polynomial converges slowly. What it misses there is its own and no fault of the
    marks: they are off by `_BEYOND` times what is usual.
    """
    field = fit.joint.field
    if field.slope_order < MAX_ORDER:
        return ""
    pixels = np.concatenate([m.pixels for m in fit.marks])
    world = np.concatenate([m.world for m in fit.marks]) @ field.c_from_d
    offset = world[:, :2] - field.crossing(pixels, world[:, 2])
    length = np.linalg.norm(np.linalg.inv(field.jacobian(pixels, world[:, 2])) @ offset[:, :, None], axis=1)[:, 0]
    off = length > max(_BEYOND * float(np.median(length)), _BEYOND_PX)
    if not off.any():
        return ""
    u, v = pixels[int(np.argmax(length))]
    return (
        f"the rays of order {field.slope_order} do not follow the lens as far as near pixel ({u:.0f}, {v:.0f}): {int(off.sum())} of "
        f"{len(length)} marks there are off by up to {length.max():.2g} px: keep what matters nearer to the middle of the image, or "
        "show more marks in that corner"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Interplane:
    """How well the points of one pixel on all planes lie on a line, over a grid of pixels (rows R, columns C).

    Only planes are joined that have marks around the pixel, three at least (two, where there are but two planes); other pixels
    are NaN, and so are pixels whose points fall outside the calibrated volume.
    """

    pixels: Array  # (R, C, 2) px (u, v)
    direction: Array  # (R, C, 3) unit, of the best line, by singular value decomposition
    error_mm: Array  # (R, C) rms distance of the points from the best line
    error_px: Array  # (R, C) the same, in px, through the maps' own scale
    sum_abs: Array  # (R, C) mm, the paper's scalar: sum of |E| of equation 8, which grows with the number of planes
    by_plane: Array  # (n, R, C, 2) px, point minus best line on each plane
    disagreement: float  # rad, largest angle between the lines of equation 7 and of the singular value decomposition

    @property
    def interplane_px(self) -> float:
        """Root mean square of `error_px` over the grid; NaN where no pixel is inside the volume."""
        return _rms_known(self.error_px)

    @property
    def interplane_mm(self) -> float:
        """Root mean square of `error_mm` over the grid."""
        return _rms_known(self.error_mm)


def interplane(
    camera: TwoPlaneCamera, marks: Sequence[PlaneMarks] | None = None, *, grid: tuple[int, int] = GRID
) -> Interplane:
    """Inter-plane analysis: whether the maps of all planes agree on one ray a pixel (equations 6 to 8, figure 6).

    Parameters
    ----------
    camera : TwoPlaneCamera
        Its maps; the joint field plays no part. Two planes always agree exactly.
    marks : sequence of PlaneMarks, optional
        Of its maps, in their order: planes are joined only where they have marks around the pixel. Where all planes have them
        around some pixels, those are the ones that count; else every pixel around which three have. Without it the
        calibrated volume alone bounds the pixels.
    grid : (rows, columns)
        Pixels are the centres of so many equal blocks of the image.
    """
    pixels = pixel_grid(camera.size, grid)
    flat = pixels.reshape(-1, 2)
    points = np.stack([m.points(flat) for m in camera.maps])  # (n, N, 3)
    inside = np.array([camera.volume.contains(p) for p in points])
    joined = inside if marks is None else inside & support_of(flat, marks)
    everywhere = joined.all(axis=0)
    joined = joined & everywhere if everywhere.any() else joined & (joined.sum(axis=0) >= min(3, len(points)))
    count = joined.sum(axis=0)
    ways, errors = np.full((len(flat), 3), np.nan), np.full((len(points), len(flat), 3), np.nan)
    by_plane = np.full((len(points), len(flat), 2), np.nan)
    summed, angles = np.full(len(flat), np.nan), []
    for mask in np.unique(joined[:, count > 0], axis=1).T:  # planes that are joined at the same pixels
        here, planes = np.flatnonzero((joined == mask[:, None]).all(axis=0)), np.flatnonzero(mask)
        own = points[planes][:, here]
        centroid, ways[here], error = lines(own)
        paper, paper_error = lines_paper(own)
        errors[planes[:, None], here] = error
        summed[here] = np.abs(paper_error).sum(axis=(0, 2))
        sine = np.linalg.norm(np.cross(ways[here], paper), axis=1)
        angles.append(np.arctan2(sine, np.abs(np.einsum("ni,ni->n", ways[here], paper))))
        for k in planes:
            by_plane[k, here] = _off_line(camera.maps[k], flat[here], centroid, ways[here], points[k, here])

    def mean(values: Array) -> Array:
        square = np.where(joined, (values**2).sum(axis=2), 0.0).sum(axis=0)
        return np.asarray(np.where(count > 0, np.sqrt(square / np.maximum(count, 1)), np.nan).reshape(grid))

    return Interplane(
        pixels,
        ways.reshape(*grid, 3),
        mean(errors),
        mean(by_plane),
        summed.reshape(grid),
        by_plane.reshape(len(points), *grid, 2),
        float(np.concatenate(angles).max()) if angles else float("nan"),
    )


def _off_line(plane: PlaneMap, pixels: Array, centroid: Array, way: Array, points: Array) -> Array:
    """Points (N, 3) of a map minus where lines cross its plane, (N, 2) px."""
    normal = plane.plane.normal
    gap = ((points - centroid) @ normal) / (way @ normal)
    offset = (points - centroid - gap[:, None] * way) @ plane.c_from_plane.rotation[:, :2]
    return np.asarray(np.linalg.solve(plane.jacobian(pixels), offset[:, :, None])[:, :, 0])


def lines(points: Array) -> tuple[Array, Array, Array]:
    """Best lines through n points each, (n, N, 3) mm, by singular value decomposition.

    Returns centroids (N, 3), unit directions (N, 3) from the first towards the last point, and offsets (n, N, 3) of the
    points from their line. The line is the total least squares one.
    """
    centroid = points.mean(axis=0)
    p = points - centroid
    direction = np.linalg.svd(np.moveaxis(p, 1, 0), full_matrices=False)[2][:, 0]
    direction = direction * np.where(np.einsum("ni,ni->n", direction, p[-1] - p[0]) < 0, -1.0, 1.0)[:, None]
    along = np.einsum("kni,ni->kn", p, direction)
    return centroid, direction, p - along[:, :, None] * direction


def lines_paper(points: Array) -> tuple[Array, Array]:
    """Best lines after equations 6 to 8: unit directions (N, 3), and E (n, N, 3) mm.

    S holds each point's distance from the centroid, with the sign of the side on which it lies; M = (S'S)^-1 S'P;
    E = P - S M. The distance stands for the coordinate along the line, which is exact to second order in E.
    """
    p = points - points.mean(axis=0)
    side = np.sign(np.einsum("kni,ni->kn", p, p[-1] - p[0]))
    s = side * np.linalg.norm(p, axis=2)
    m = np.einsum("kn,kni->ni", s, p) / np.maximum((s**2).sum(axis=0), 1e-300)[:, None]
    error = p - s[:, :, None] * m
    return m / np.maximum(np.linalg.norm(m, axis=1, keepdims=True), 1e-300), error


def block_image(pixels: Array, values: Array, size: tuple[int, int], *, step: int = 4) -> Array:
    """Grey block image of figure 5: a block at every mark, as light as its error is large.

    Parameters
    ----------
    pixels : (n, 2) array
        px, where the marks are.
    values : (n,) array
        What the blocks show, for example lengths of residuals in px.
    size : (width, height)
        Of the image, px.
    step : int
        px a picture element.

    Returns
    -------
    (height / step, width / step) array
        ``values`` within blocks of half the marks' typical spacing, NaN between them.
    """
    shape = (-(-size[1] // step), -(-size[0] // step))
    picture = np.full(shape, np.nan)
    if not len(pixels):
        return picture
    spread = np.sqrt(np.prod(np.maximum(np.ptp(pixels, axis=0), 1.0)) / len(pixels))
    half = max(1, round(0.25 * float(spread) / step))
    for (u, v), value in zip(np.floor(pixels / step).astype(int), values, strict=True):
        picture[max(0, v - half) : max(0, v + half + 1), max(0, u - half) : max(0, u + half + 1)] = value
    return picture


def _rms_known(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt((known**2).mean())) if len(known) else float("nan")
